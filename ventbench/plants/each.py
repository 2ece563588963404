"""A stack of plants as one plant, for kinds whose parameters cannot broadcast."""

from __future__ import annotations

from typing import Any

import flax.struct
import jax
from jax import Array

from ventbench.interfaces import Plant


@flax.struct.dataclass
class Each:
    """n plants side by side; every argument has shape ``(n,)``.

    Attributes:
        plants: every leaf ``(n, ...)``.
    """

    plants: Any

    def init(self, pressure: Array, peep: Array | None = None) -> Any:
        """State of lungs at rest; see :class:`~ventbench.interfaces.Plant`."""

        def init(plant: Plant, pressure: Array, peep: Array) -> Any:
            return plant.init(pressure, peep)

        return jax.vmap(init)(self.plants, pressure, pressure if peep is None else peep)

    def step(self, state: Any, u_in: Array, u_out: Array, dt: Array) -> tuple[Any, Array]:
        """Hold one command each."""

        def step(plant: Plant, state: Any, u_in: Array, u_out: Array, dt: Array) -> Any:
            return plant.step(state, u_in, u_out, dt)

        return jax.vmap(step)(self.plants, state, u_in, u_out, dt)
