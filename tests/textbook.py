"""Textbook lungs in the place of the frozen simulators: quick, and made on the spot."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from ventbench.base import compilation
from ventbench.plants.single_compartment import SingleCompartment, single_compartment
from ventbench.plants.stacking import stack
from ventbench.task.lungs import LUNGS, Lung


class Textbook:
    """What :func:`ventbench.plants.frozen.load` returns, as far as scores and records need it."""

    manifest_sha256 = "0" * 64
    for_breaths = cross_fitted = None

    def __init__(self) -> None:
        with compilation.float64():
            # Numpy leaves, as the frozen ones have: they take the precision of their user.
            self.plants = jax.tree.map(np.asarray, _lungs(1.0))
            members = [_lungs(factor) for factor in (1.0, 0.97, 1.04)]
            self.ensemble: SingleCompartment = jax.tree.map(np.asarray, stack(members))

    def about(self) -> Mapping[str, Any]:
        return {"version": 1, "kind": "textbook", "manifest_sha256": self.manifest_sha256}


def _lungs(factor: float) -> SingleCompartment:
    return stack([single_compartment(Lung(x.R * factor, x.C / factor)) for x in LUNGS])
