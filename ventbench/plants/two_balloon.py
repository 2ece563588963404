"""The paper's physics model: a balloon filled from a supply through a valve."""

from __future__ import annotations

from dataclasses import replace

import flax.struct
import jax.numpy as jnp
from jax import Array

from ventbench.plants.single_compartment import EXPIRATORY_RESISTANCE, VALVE_GAIN
from ventbench.task import protocol
from ventbench.task.interfaces import Signals
from ventbench.task.lungs import Lung

#: Pressure scale of the balloon, cmH2O: PC / r0^3 of the authors' code (40 cmH2O L, 1.5 L at rest).
BALLOON_PRESSURE = 111.7

#: Pressure of the supply behind the valve, cmH2O. Held below the balloon's peak, so that the lung
#: never enters the branch where a balloon's pressure falls as it grows.
SUPPLY_PRESSURE = 60.0

#: Highest balloon pressure over :data:`BALLOON_PRESSURE`, at ``x = sqrt(7)``.
PEAK = 6.0 / 7.0 * 7.0 ** (-1.0 / 6.0)

#: Runge-Kutta steps a control step, and Newton steps from pressure to volume.
SUBSTEPS = 2
NEWTON_STEPS = 12


@flax.struct.dataclass
class TwoBalloonState:
    """Volume over rest volume and pressure behind the expiratory valve, cmH2O, ``(...)``."""

    volume: Array
    peep: Array


@flax.struct.dataclass
class TwoBalloon:
    """Balloon lung with the paper's pressure curve and supply, at real intervals.

    Paper, section 2.2: ``p = p0 + K (1 - (r0/r)^6) r0 / r`` with the radius ``r`` of volume ``v``
    (``x = v / v0 = (r/r0)^3``) and inflow ``(p_supply - p) / R_in``. With the label's C as the
    compliance at rest, ``v0 = 2 K C``. What the paper leaves open is fixed so: ``p0 = 0``;
    Poiseuille's ``R_in ~ 1/d^4`` becomes a conductance proportional to ``u_in``, since PVP
    linearises its valve, equal to the gain in mL/s per % at zero pressure; between the sensor and
    the balloon lies the label's R (R -> 0 is the paper's model); expired air leaves through
    ``R_ex`` towards PEEP (the authors' code leaks ``0.05 p`` instead). Integrated by the classical
    Runge-Kutta method, half-size steps agree to 1e-4 cmH2O.
    """

    R: Array  #: airway resistance, cmH2O/(L/s), shape ``()`` or ``(...)``.
    C: Array  #: compliance at rest volume, mL/cmH2O, shape ``()`` or ``(...)``.
    gain: Array  #: flow of the inspiratory valve at zero pressure, mL/s per %.
    R_ex: Array  #: resistance of the expiratory path, cmH2O/(L/s).
    K: Array  #: pressure scale of the balloon, cmH2O.
    supply: Array  #: supply pressure, cmH2O.

    def init(self, pressure: Array, peep: Array | None = None) -> tuple[TwoBalloonState, Signals]:
        """Lung at rest; see :class:`~ventbench.task.interfaces.Plant`.

        Pressures outside -K/2 to 98 % of the balloon's peak become these.
        """
        pressure = jnp.asarray(pressure) * 1.0
        ratio = jnp.clip(pressure / self.K, -0.5, 0.98 * PEAK)
        x = jnp.ones_like(ratio)
        for _ in range(NEWTON_STEPS):  # concave: converges from below without overshoot
            value = (1.0 - x**-2) * x ** (-1.0 / 3.0)
            slope = (7.0 * x**-2 - 1.0) * x ** (-4.0 / 3.0) / 3.0
            x = x + (ratio - value) / slope
        behind = pressure if peep is None else jnp.broadcast_to(peep, pressure.shape)
        volume = x.astype(pressure.dtype)
        signals = Signals(pressure, pressure, 0.0 * pressure, 2.0 * self.K * self.C * volume)
        return TwoBalloonState(volume, behind.astype(pressure.dtype)), signals

    def alveolar(self, volume: Array) -> Array:
        """Pressure in the balloon, cmH2O, at a volume over rest volume, shape ``(...)``."""
        return self.K * (1.0 - volume**-2) * volume ** (-1.0 / 3.0)

    def step(
        self, state: TwoBalloonState, u_in: Array, u_out: Array, dt: Array
    ) -> tuple[TwoBalloonState, Signals]:
        """Hold one command; see the class."""
        supply = self.gain * jnp.clip(u_in, 0.0, protocol.U_MAX) / 1000.0 / self.supply
        outlet = u_out / self.R_ex  # conductances, L/s per cmH2O
        rest_volume = 2.0 * self.K * self.C / 1000.0  # L

        def flow(x: Array) -> Array:
            p = self.alveolar(x)
            driven = supply * (self.supply - p) + outlet * (state.peep - p)
            return driven / (1.0 + self.R * (supply + outlet))

        h = dt / SUBSTEPS / rest_volume
        x = state.volume
        for _ in range(SUBSTEPS):
            a = flow(x)
            b = flow(x + 0.5 * h * a)
            c = flow(x + 0.5 * h * b)
            d = flow(x + h * c)
            x = x + h / 6.0 * (a + 2.0 * b + 2.0 * c + d)
        entering = flow(x)
        pressure = self.alveolar(x) + self.R * entering
        volume = 1000.0 * rest_volume * x
        return TwoBalloonState(x, state.peep), Signals(pressure, pressure, 1e3 * entering, volume)

    def vary(self, r_scale: Array, c_scale: Array, gain: Array | float = 1.0) -> TwoBalloon:
        """Return the same lung with other R, C and gain."""
        return replace(self, R=self.R * r_scale, C=self.C * c_scale, gain=self.gain * gain)

    def parameters(self) -> None:
        """Nothing is known of its physics; see :class:`~ventbench.task.interfaces.Plant`."""


def two_balloon(lung: Lung) -> TwoBalloon:
    """Build a :class:`TwoBalloon` lung of a label, behind the PVP's valves."""
    valves = (VALVE_GAIN, EXPIRATORY_RESISTANCE)
    values = (lung.R, lung.C, *valves, BALLOON_PRESSURE, SUPPLY_PRESSURE)
    return TwoBalloon(*(jnp.asarray(x, float) for x in values))
