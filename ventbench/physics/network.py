"""Airway, circuit, lung, leak and expiratory valve: one implicit step in closed form."""

from __future__ import annotations

import flax.struct
import jax.numpy as jnp
from jax import Array


@flax.struct.dataclass
class View:
    """Quantities that a mechanism may use while it changes the network; every array ``(...)``.

    Attributes:
        time: time since the start of the breath, s.
        volume: volume of the lung before the step, L; a linear lung has the recoil ``volume / C``.
        pressure: last known pressure at the airway, cmH2O.
        flow: last known flow into the lung, L/s.
        state: own state of the mechanism before the step (0 if it has none), ``(K, ...)`` for one
            with several states.
        length: length of the implicit step, s.
        elastance: elastance 1/C of the lung, cmH2O/L.
        peep: pressure behind the expiratory valve, cmH2O.
        position: position of the breath in the recording, 0..1.
        resistance: resistance R of the airway, cmH2O/(L/s).
        outlet: conductance of the open expiratory valve, 1 / R_ex, L/s per cmH2O.
        opened: expiratory valve, 0 closed, 1 open.
    """

    time: Array
    volume: Array
    pressure: Array
    flow: Array
    state: Array
    length: Array
    elastance: Array
    peep: Array
    position: Array
    resistance: Array
    outlet: Array
    opened: Array


@flax.struct.dataclass
class PneumaticNetwork:
    """Coefficients of one step; every array has shape ``(...)``.

    Flow balance at the airway, L/s, with ``p`` and ``Q`` after the step and ``p0``, ``Q0`` before::

        circuit (p - p0) / h = inflow - Q - leak p - leak_flow - outlet max(p - behind, 0)

    Pressure along the way into the lung, cmH2O::

        p = recoil + elastance h Q + resistance Q + quadratic Q |Q| + inertance (Q - Q0) / h

    Any of ``circuit``, ``inertance``, ``quadratic``, ``leak`` and ``outlet`` may be zero.

    Attributes:
        inflow: flow out of the inspiratory valve, L/s.
        circuit: compliance of tubing and connectors, L/cmH2O.
        leak: slope of the leak, L/s per cmH2O.
        leak_flow: leak at zero pressure on that slope, L/s.
        outlet: conductance of the expiratory valve, L/s per cmH2O.
        behind: pressure behind the expiratory valve, cmH2O.
        resistance: resistance of the airway, cmH2O/(L/s).
        quadratic: quadratic resistance of the airway, cmH2O s2/L2.
        inertance: inertance of the gas, cmH2O s2/L.
        recoil: recoil of the lung without flow, less the pressure of the muscles, cmH2O.
        elastance: slope of the recoil, cmH2O/L.
    """

    inflow: Array
    circuit: Array
    leak: Array
    leak_flow: Array
    outlet: Array
    behind: Array
    resistance: Array
    quadratic: Array
    inertance: Array
    recoil: Array
    elastance: Array

    def plus(self, **terms: Array) -> PneumaticNetwork:
        """Add to coefficients, so that the order of mechanisms does not matter."""
        return self.replace(  # type: ignore[attr-defined]
            **{name: getattr(self, name) + term for name, term in terms.items()}
        )

    def solve(self, pressure: Array, flow: Array, length: Array) -> tuple[Array, Array]:
        """Pressure at the airway, cmH2O, and flow into the lung, L/s, after an implicit step.

        Args:
            pressure: pressure before the step, cmH2O.
            flow: flow before the step, L/s.
            length: length of the step, s.
        """
        shut = self._balance(pressure, flow, length, jnp.zeros_like(self.outlet))
        vented = self._balance(pressure, flow, length, self.outlet)
        out = shut[0] > self.behind  # the valve lets gas out only
        return jnp.where(out, vented[0], shut[0]), jnp.where(out, vented[1], shut[1])

    def _balance(
        self, pressure: Array, flow: Array, length: Array, outlet: Array
    ) -> tuple[Array, Array]:
        series = self.resistance + self.inertance / length + self.elastance * length
        rest = self.recoil - self.inertance * flow / length
        conductance = self.circuit / length + self.leak + outlet
        source = self.inflow - self.leak_flow + self.circuit * pressure / length
        excess = source + outlet * self.behind - conductance * rest
        # conductance (quadratic Q |Q| + series Q) + Q = excess; written so that quadratic = 0
        # needs no case of its own.
        linear = conductance * series + 1.0
        root = jnp.sqrt(linear**2 + 4.0 * conductance * self.quadratic * jnp.abs(excess))
        after = 2.0 * excess / (linear + root)
        return rest + (series + self.quadratic * jnp.abs(after)) * after, after
