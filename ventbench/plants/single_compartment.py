"""The textbook lung: one resistance, one compliance, and the PVP's valves."""

from __future__ import annotations

import flax.struct
import jax.numpy as jnp
from jax import Array

from ventbench.physics.mechanism import EXPIRATORY_RESISTANCE, VALVE_GAIN
from ventbench.task.interfaces import Signals
from ventbench.task.lungs import Lung


@flax.struct.dataclass
class SingleCompartmentState:
    """Alveolar pressure and pressure behind the expiratory valve, cmH2O, shape ``(...)``."""

    alveolar: Array
    peep: Array


@flax.struct.dataclass
class SingleCompartment:
    """R-C lung, solved exactly over each held command.

    Inspiration: ``dP_alv/dt = q / C``, ``p = P_alv + R q`` with the valve's flow
    ``q = gain u_in``. Expiration (valve open): flow leaves through ``R_ex`` in series with ``R``
    towards PEEP, so that ``P_alv`` relaxes to ``peep + R_ex q_in`` with time constant
    ``(R + R_ex) C``. Everything with R in cmH2O/(L/s) and C in L/cmH2O inside.
    """

    R: Array  #: airway resistance, cmH2O/(L/s), shape ``()`` or ``(...)``.
    C: Array  #: compliance, mL/cmH2O, shape ``()`` or ``(...)``.
    gain: Array  #: flow of the inspiratory valve, mL/s per %.
    R_ex: Array  #: resistance of the expiratory path, cmH2O/(L/s).

    def init(
        self, pressure: Array, peep: Array | None = None
    ) -> tuple[SingleCompartmentState, Signals]:
        """Lung at rest; see :class:`~ventbench.task.interfaces.Plant`."""
        state = SingleCompartmentState(pressure, pressure if peep is None else peep)
        return state, Signals(pressure, pressure, 0.0 * pressure, self.C * pressure)

    def step(
        self, state: SingleCompartmentState, u_in: Array, u_out: Array, dt: Array
    ) -> tuple[SingleCompartmentState, Signals]:
        """Exact solution over one held command; see the class."""
        flow = self.gain * u_in / 1000.0  # L/s
        compliance = self.C / 1000.0  # L/cmH2O
        # Inspiration: all of the valve's flow enters the lung.
        filled = state.alveolar + flow * dt / compliance
        inspired = filled + self.R * flow
        # Expiration: the airway sits between the valve's flow, R to the lung and R_ex to PEEP.
        rest = state.peep + self.R_ex * flow
        decay = jnp.exp(-dt / ((self.R + self.R_ex) * compliance))
        emptied = rest + (state.alveolar - rest) * decay
        expired = (self.R * rest + self.R_ex * emptied) / (self.R + self.R_ex)
        alveolar = u_out * emptied + (1.0 - u_out) * filled
        pressure = u_out * expired + (1.0 - u_out) * inspired
        entering = 1000.0 * (pressure - alveolar) / self.R
        signals = Signals(pressure, pressure, entering, self.C * alveolar)
        return SingleCompartmentState(alveolar, state.peep), signals

    def vary(self, r_scale: Array, c_scale: Array, gain: Array | float = 1.0) -> SingleCompartment:
        """Return the same lung with other R, C and gain."""
        return self.replace(  # type: ignore[attr-defined]
            R=self.R * r_scale, C=self.C * c_scale, gain=self.gain * gain
        )

    def parameters(self) -> dict[str, Array]:
        """Its own by path; see :class:`~ventbench.task.interfaces.Plant`."""
        return {"R": self.R, "C": self.C, "gain": self.gain, "R_ex": self.R_ex}


def single_compartment(lung: Lung) -> SingleCompartment:
    """Build a :class:`SingleCompartment` lung of a label, behind the PVP's valves."""
    values = (lung.R, lung.C, VALVE_GAIN, EXPIRATORY_RESISTANCE)
    return SingleCompartment(*(jnp.asarray(x, float) for x in values))
