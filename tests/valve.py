"""A pure controller whose commands have the step of the valve, as those of submissions do."""

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
