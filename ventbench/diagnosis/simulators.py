"""What the simulator under diagnosis answers to the recorded commands."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Literal

import numpy as np

from ventbench.errors import InputError
from ventbench.interfaces import Plant
from ventbench.plants.single_compartment import single_compartment
from ventbench.plants.stacking import nominal_plants, stack_heterogeneous
from ventbench.recordings.breaths import Breaths
from ventbench.rollouts import PlantsFor, open_loop_breaths
from ventbench.system_id.data import Data, Floats
from ventbench.system_id.noise import Noise

#: A simulator: base physics at the labels, the official ones, or the user's own by lung.
Given = Literal["physics", "frozen"] | Mapping[str, Plant]

#: Seed of the noise that a simulator's answers get.
_SEED = 20260101


def plants_for(plant: Given) -> PlantsFor:
    """Plants of some breaths, stacked.

    Raises:
        InputError: if there is no such simulator.
    """
    if plant == "physics":
        return partial(nominal_plants, single_compartment)
    if plant == "frozen":
        from ventbench.plants import frozen

        return frozen.load().for_breaths
    if isinstance(plant, str):
        raise InputError(f"no simulator {plant!r}; choose physics, frozen or plants by lung")
    return lambda breaths: _stacked(plant, breaths)


def _stacked(plants: Mapping[str, Plant], breaths: Breaths) -> Plant:
    missing = sorted(set(breaths.lung_ids.tolist()) - set(plants))
    if missing:
        raise InputError(f"the simulator has no lung {missing[0]}; it has {', '.join(plants)}")
    chosen = [plants[name] for name in breaths.lung_ids.tolist()]
    return stack_heterogeneous(chosen)


def answers(plant: Given, breaths: Breaths) -> Floats:
    """Open-loop pressures, cmH2O, ``(n, T)``, NaN for a breath without a first pressure."""
    return open_loop_breaths(plants_for(plant), breaths)


def measured(data: Data, answer: Floats, noise: Noise) -> Data:
    """A simulator's answers as the recording's sensor would have shown them.

    With the same noise, the same mechanisms can be seen in both.
    """
    rng = np.random.default_rng(_SEED)
    sigma, ar = noise.sigma[0], noise.ar[0]
    fresh = rng.normal(0.0, sigma * np.sqrt(1.0 - ar**2), answer.shape)
    coloured = np.zeros_like(fresh)
    coloured[:, 0] = rng.normal(0.0, sigma, len(fresh))
    for k in range(1, fresh.shape[1]):
        coloured[:, k] = ar * coloured[:, k - 1] + fresh[:, k]
    return data.answered(np.nan_to_num(answer) + coloured)
