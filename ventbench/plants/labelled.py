"""Textbook and balloon lungs of recorded breaths, at what their labels say: nothing is learned."""

from __future__ import annotations

import jax.numpy as jnp

from ventbench.plants.single_compartment import (
    EXPIRATORY_RESISTANCE,
    VALVE_GAIN,
    SingleCompartment,
)
from ventbench.plants.two_balloon import BALLOON_PRESSURE, SUPPLY_PRESSURE, TwoBalloon
from ventbench.recordings.breaths import Breaths


def single_compartments(breaths: Breaths) -> SingleCompartment:
    """R-C lungs with the PVP's valve; leaves ``(n,)``."""
    one = jnp.ones(len(breaths))
    R, C = jnp.asarray(breaths.R, float), jnp.asarray(breaths.C, float)
    return SingleCompartment(R, C, VALVE_GAIN * one, EXPIRATORY_RESISTANCE * one)


def two_balloons(breaths: Breaths) -> TwoBalloon:
    """The paper's physics model with the PVP's valve; leaves ``(n,)``."""
    one = jnp.ones(len(breaths))
    R, C = jnp.asarray(breaths.R, float), jnp.asarray(breaths.C, float)
    return TwoBalloon(
        R, C, VALVE_GAIN * one, EXPIRATORY_RESISTANCE * one, BALLOON_PRESSURE * one,
        SUPPLY_PRESSURE * one,
    )  # fmt: skip
