"""How something changes from breath to breath in a session: a step, or a steady or fading drift."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array

from ventbench.physics.mechanism import Values
from ventbench.physics.parameters import Parameter

#: Added to the fading, so that a steady drift is no division by zero.
_STEADY = 1e-4

#: Where a step is, which a fit finds by trying each breath; there is no slope towards it.
AT = Parameter(
    "at", "1", "position of the change between two breaths of the recording, 0..1",
    0.0, 1.0, 0.5, 0.5, 0.5, spread=np.inf, change_point=True,
)  # fmt: skip

#: How a drift fades, as what warms up does.
WARMING = Parameter(
    "warming", "1", "times that the drift fades by e in the recording; 0: it is steady",
    0.0, 10.0, 0.0, 0.0, 0.0, shape=True,
)  # fmt: skip


def stepped(values: Values, position: Array) -> Array:
    """Change of a breath at a position of the recording, 0..1: nothing up to ``at``, then all."""
    return jnp.where(position > values["at"], values["change"], 0.0)


def grown(values: Values, position: Array) -> Array:
    """Share of a drift that has set in at a position of the recording, 0..1."""
    fading = values["warming"] + _STEADY
    return jnp.expm1(-fading * position) / jnp.expm1(-fading)
