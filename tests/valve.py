"""Pure controllers whose commands are those of submissions."""

from __future__ import annotations

from typing import Any

import flax.struct
import jax.numpy as jnp


@flax.struct.dataclass
class Stepped:
    """Any controller, to 0.001 %."""

    controller: Any

    def init(self, shape: tuple[int, ...]) -> Any:
        return self.controller.init(shape)

    def step(self, state: Any, observation: Any) -> tuple[Any, Any]:
        state, command = self.controller.step(state, observation)
        return state, jnp.round(1000.0 * jnp.clip(command, 0.0, 100.0)) / 1000.0


@flax.struct.dataclass
class Lowered:
    """Any controller whose largest command falls with each reading far above the target."""

    controller: Any

    def init(self, shape: tuple[int, ...]) -> Any:
        return self.controller.init(shape), jnp.full(shape, 100.0)

    def step(self, state: Any, observation: Any) -> tuple[Any, Any]:
        state, most = state
        state, command = self.controller.step(state, observation)
        above = observation.pressure - observation.target > 8.0
        most = jnp.where(above, 0.7 * most, most)
        return (state, most), jnp.minimum(command, most)
