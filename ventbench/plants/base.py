"""What every plant is: a frozen pytree with two pure methods."""

from __future__ import annotations

from typing import Any, Protocol, TypeVar, runtime_checkable

from jax import Array

State = Any
PlantT = TypeVar("PlantT")


@runtime_checkable
class Plant(Protocol):
    """Answers to valve commands with airway pressures.

    A plant is a pytree (its parameters are leaves), so that it can be an argument of ``jit``,
    stacked over lungs and ensemble members, and differentiated. Both methods are pure; every array
    argument may have any leading batch shape ``(...)``, which the parameters must broadcast with.
    Plants contain no ``cond`` or ``switch``: under ``vmap`` those copy weights per element.

    Time: the command of a sample is held for ``dt`` after that sample, and ``step`` returns the
    pressure at the end of that time, which is the next sample.
    """

    def init(self, pressure: Array, peep: Array | None = None) -> State:
        """State of a lung at rest.

        Args:
            pressure: airway and alveolar pressure, cmH2O, shape ``(...)``.
            peep: pressure behind the expiratory valve, cmH2O; ``pressure`` if not given.
        """
        ...

    def step(self, state: State, u_in: Array, u_out: Array, dt: Array) -> tuple[State, Array]:
        """Hold one command.

        Args:
            state: from ``init`` or ``step``.
            u_in: inspiratory valve, 0..100 %, shape ``(...)``.
            u_out: expiratory valve, 0 closed, 1 open, shape ``(...)``.
            dt: time for which the command is held, s, shape ``(...)`` or scalar.

        Returns:
            The next state and the measured airway pressure, cmH2O, shape ``(...)``.
        """
        ...
