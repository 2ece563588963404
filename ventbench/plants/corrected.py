"""A simulator plus what another physics would add to it."""

from __future__ import annotations

from typing import Any

import flax.struct
from jax import Array

from ventbench.task.interfaces import Signals


@flax.struct.dataclass
class Corrected:
    """Any plant, corrected by the difference of two physics.

    The pressure is ``simulator + with_mechanisms - without_mechanisms``. What the simulator knows
    beyond the physics stays; where both physics agree, the plant is the simulator. Plant files
    call the two physics ``wanted`` and ``had``.

    Attributes:
        simulator: the plant that is corrected.
        with_mechanisms: physics of the recordings, with the missing mechanisms.
        without_mechanisms: physics of the simulator itself.
    """

    simulator: Any
    with_mechanisms: Any
    without_mechanisms: Any

    def init(
        self, pressure: Array, peep: Array | None = None
    ) -> tuple[tuple[Any, Any, Any], Signals]:
        """All three plants at rest; see :class:`~ventbench.task.interfaces.Plant`."""
        parts = (self.simulator, self.with_mechanisms, self.without_mechanisms)
        states, signals = zip(*(part.init(pressure, peep) for part in parts), strict=True)
        return states, corrected_signals(*signals)

    def step(
        self, state: tuple[Any, Any, Any], u_in: Array, u_out: Array, dt: Array
    ) -> tuple[tuple[Any, Any, Any], Signals]:
        """Hold one command; see :class:`~ventbench.task.interfaces.Plant`."""
        simulator, shown = self.simulator.step(state[0], u_in, u_out, dt)
        wanted, more = self.with_mechanisms.step(state[1], u_in, u_out, dt)
        own, less = self.without_mechanisms.step(state[2], u_in, u_out, dt)
        return (simulator, wanted, own), corrected_signals(shown, more, less)

    def vary(self, r_scale: Array, c_scale: Array) -> Corrected:
        """Return the same lung with another resistance and compliance."""
        parts = (self.simulator, self.with_mechanisms, self.without_mechanisms)
        return Corrected(*(part.vary(r_scale, c_scale) for part in parts))

    def parameters(self) -> dict[str, Array] | None:
        """Those with the mechanisms; see :class:`~ventbench.task.interfaces.Plant`."""
        return self.with_mechanisms.parameters()


def corrected_signals(simulator: Signals, more: Signals, less: Signals) -> Signals:
    """Signals of a simulator plus the difference of two physics.

    Flow and volume are None where the simulator has none. A simulator that has readings only is
    taken to read the airway.
    """

    def sum_of(base: Any, name: str) -> Any:
        return None if base is None else base + getattr(more, name) - getattr(less, name)

    return Signals(
        sum_of(simulator.reading, "reading"),
        sum_of(simulator.scored, "airway_pressure"),
        sum_of(simulator.flow, "flow"),
        sum_of(simulator.volume, "volume"),
    )
