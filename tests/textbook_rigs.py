"""Textbook lungs on rigs in the place of the frozen simulators of version 2: quick."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import flax.struct
import jax
import numpy as np
from jax import Array

from ventbench.base import compilation
from ventbench.plants.rigs import Rigs
from ventbench.plants.single_compartment import (
    SingleCompartment,
    SingleCompartmentState,
    single_compartment,
)
from ventbench.plants.stacking import stack
from ventbench.task.interfaces import Signals
from ventbench.task.lungs import LUNGS, Lung

#: What the sensor shows above the airway pressure, cmH2O.
OFFSET = 0.4

#: Members of the ensemble, and rigs of every lung.
MEMBERS, RIGS_A_LUNG = 2, 2


@flax.struct.dataclass
class OffsetLung:
    """A textbook lung whose sensor shows :data:`OFFSET` too much."""

    lung: SingleCompartment

    def init(
        self, pressure: Array, peep: Array | None = None
    ) -> tuple[SingleCompartmentState, Signals]:
        return self.lung.init(pressure, peep)

    def step(
        self, state: SingleCompartmentState, u_in: Array, u_out: Array, dt: Array
    ) -> tuple[SingleCompartmentState, Signals]:
        after, signals = self.lung.step(state, u_in, u_out, dt)
        return after, signals._replace(reading=signals.reading + OFFSET)

    def vary(self, r_scale: Array, c_scale: Array, gain: Array | float = 1.0) -> OffsetLung:
        return OffsetLung(self.lung.vary(r_scale, c_scale, gain))

    def parameters(self) -> dict[str, Array]:
        return self.lung.parameters()


class TextbookRigs:
    """What :func:`ventbench.plants.frozen.load` returns for version 2, as far as it is needed."""

    manifest_sha256 = "2" * 64
    rigs = tuple((2 * k, 2 * k + 1) for k in range(len(LUNGS)))
    held_out_rigs = tuple((2 * k + 1,) for k in range(len(LUNGS)))
    population = None

    def __init__(self) -> None:
        with compilation.float64():
            members = [_sessions(factor) for factor in (1.0, 0.96)]
            self.sessions_plants: OffsetLung = jax.tree.map(np.asarray, stack(members))

    @property
    def plants(self) -> OffsetLung:
        return jax.tree.map(lambda leaf: leaf[0, ::RIGS_A_LUNG], self.sessions_plants)

    @property
    def ensemble(self) -> OffsetLung:
        return jax.tree.map(lambda leaf: leaf[:, ::RIGS_A_LUNG], self.sessions_plants)

    def about(self) -> Mapping[str, Any]:
        return {"version": 2, "kind": "textbook", "manifest_sha256": self.manifest_sha256}

    def scored(self) -> Rigs:
        return Rigs(LUNGS, self.sessions_plants, self.rigs, self.about(), self.manifest_sha256)


def _sessions(factor: float) -> OffsetLung:
    """One lung on its two rigs after the other: the second is stiffer and narrower.

    They have a quarter of the label's resistance: at 20 the bundled PIDs swing, and are unsafe.
    """
    settings = [
        Lung(x.R / 4 * factor * rig, x.C / factor / rig) for x in LUNGS for rig in (1.0, 1.15)
    ]
    return stack([OffsetLung(single_compartment(setting)) for setting in settings])
