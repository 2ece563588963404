"""The PID, the baseline of the field."""

from __future__ import annotations

import flax.struct
import jax.numpy as jnp
from jax import Array

from ventbench.task.interfaces import Observation

#: Time constant of the exponential averages, s (authors' code; the recordings obey it).
TIME_CONSTANT = 0.5


@flax.struct.dataclass
class PIDState:
    """Averages of a PID."""

    error: Array  #: error in the previous step, cmH2O, shape ``(...)``.
    integral: Array  #: leaky integral of the error, cmH2O, shape ``(...)``.
    derivative: Array  #: smoothed difference of the error, cmH2O, shape ``(...)``.


@flax.struct.dataclass
class PID:
    """PID on the pressure error with leaky integral and smoothed difference.

    With ``e = target - pressure`` and ``a = dt / (dt + 0.5 s)``, at each step:
    ``i += a (e - i)``; ``d += a (e - e_before - d)``; ``u_in = P e + I i + D d``. All three start
    from zero at every breath.
    """

    P: Array | float  #: proportional gain, %/cmH2O, shape ``(...)``.
    #: integral gain, %/cmH2O, shape ``(...)``.
    I: Array | float  # noqa: E741 - the field's name
    D: Array | float = 0.0  #: derivative gain, %/cmH2O, shape ``(...)``.

    def init(self, shape: tuple[int, ...]) -> PIDState:
        """State before the first breath."""
        zero = jnp.zeros(shape)
        return PIDState(zero, zero, zero)

    def step(self, state: PIDState, observation: Observation) -> tuple[PIDState, Array]:
        """Return the next state and ``u_in``, %, shape ``(...)``."""
        restart = observation.time == 0
        before, integral, derivative = (
            jnp.where(restart, 0.0, leaf)
            for leaf in (state.error, state.integral, state.derivative)
        )
        error = observation.target - observation.pressure
        a = observation.dt / (observation.dt + TIME_CONSTANT)
        integral = integral + a * (error - integral)
        derivative = derivative + a * (error - before - derivative)
        u_in = self.P * error + self.I * integral + self.D * derivative
        return PIDState(error, integral, derivative), u_in
