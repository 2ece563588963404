"""A simulator plus what another physics would add to it."""

from __future__ import annotations

from typing import Any

import flax.struct
from jax import Array


@flax.struct.dataclass
class Corrected:
    """Any plant, corrected by the difference of two physics: ``p = simulator + wanted - had``.

    What the simulator knows beyond physics stays; where both physics agree, it is the simulator.

    Attributes:
        simulator: what is corrected.
        wanted: physics of the recordings.
        had: physics of the simulator itself.
    """

    simulator: Any
    wanted: Any
    had: Any

    def init(self, pressure: Array, peep: Array | None = None) -> tuple[Any, Any, Any]:
        """All three at rest; see :class:`~ventbench.interfaces.Plant`."""
        return tuple(  # type: ignore[return-value]
            one.init(pressure, peep) for one in (self.simulator, self.wanted, self.had)
        )

    def step(
        self, state: tuple[Any, Any, Any], u_in: Array, u_out: Array, dt: Array
    ) -> tuple[tuple[Any, Any, Any], Array]:
        """Hold one command; see :class:`~ventbench.interfaces.Plant`."""
        simulator, pressure = self.simulator.step(state[0], u_in, u_out, dt)
        wanted, more = self.wanted.step(state[1], u_in, u_out, dt)
        had, less = self.had.step(state[2], u_in, u_out, dt)
        return (simulator, wanted, had), pressure + more - less

    def vary(self, r_scale: Array, c_scale: Array) -> Corrected:
        """Return the same lung with another resistance and compliance."""
        parts = (self.simulator, self.wanted, self.had)
        return Corrected(*(one.vary(r_scale, c_scale) for one in parts))
