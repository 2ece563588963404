"""The airway and the lung: what flow, volume and time do to pressure, and what muscles do."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from ventbench.physics.mechanism import (
    Description,
    Mechanism,
    Network,
    Parameter,
    Values,
    View,
)

#: The slope of the power by flow is rounded off below this flow, L/s.
_ROUND = 0.02


class TurbulentResistance(Mechanism):
    """A pressure drop that grows with the square of flow, or nearly."""

    description = Description(
        name="turbulent_resistance",
        title="resistance that grows with flow",
        site="airway",
        equation="p = ... + R Q + quadratic Q |Q| (Q^2 + e^2)^(exponent / 2 - 1), e = 0.02 L/s",
        parameters=(
            Parameter(
                "quadratic",
                "cmH2O s2/L2",
                "second coefficient of Rohrer; drop at 1 L/s",
                0.0,
                80.0,
                0.0,
                4.0,
                10.0,
                follows="R",
            ),
            Parameter(
                "exponent",
                "1",
                "2 for an orifice, 1.75 for a smooth tube",
                1.5,
                2.0,
                2.0,
                2.0,
                2.0,
                shape=True,
            ),
        ),
        source="Rohrer's equation (Otis, Fenn and Rahn, J. Appl. Physiol. 2, 1950, 592); parabolic "
        "resistors of test lungs hold their label at one flow only. 1 to 30 cmH2O s2/L2. In a "
        "smooth tube the exponent is 1.75 (Blasius).",
        signature="Pressure drop grows faster than flow: error at high flow, in inspiration and at "
        "the start of expiration, most in lungs with low R; fitted R falls below the label.",
        confusable=("valve_curve",),
        least=1.0,
        least_reason="the curvature of a straight tracheal tube; less is within R",
        special_case_of=("flow_shape",),
    )

    def network(self, values: Values, network: Network, view: View) -> Network:
        """Add the resistance; the part that differs from a square is taken at the last flow."""
        milder = jnp.log(view.flow**2 + _ROUND**2) * (0.5 * values["exponent"] - 1.0)
        return network.plus(quadratic=values["quadratic"] * jnp.exp(milder))


#: Inertance, cmH2O s2/L, at which half of the tubing's compliance acts, so that none acts without
#: inertance.
_HALF = 0.003


class Inertance(Mechanism):
    """Pressure needed to accelerate the flow into the lung, behind a compliant tube.

    Without a compliance at the airway, inertance acts on edges alone. With one, as in every real
    circuit, flow and pressure ring after each edge.
    """

    description = Description(
        name="inertance",
        title="inertance of the gas",
        site="airway",
        equation="p = ... + inertance dQ/dt, tubing inertance / (inertance + 0.003) dp/dt = q_in - "
        "Q - q_out",
        parameters=(
            Parameter(
                "inertance", "cmH2O s2/L", "of gas in airway and tubing", 0.0, 0.4, 0.0, 0.04, 0.1
            ),
            Parameter(
                "tubing",
                "mL/cmH2O",
                "compliance of the circuit before it",
                0.0,
                1.2,
                0.0,
                0.3,
                0.5,
                grid=(0.0, 0.15, 0.4, 0.8),
            ),
        ),
        source="Mass of the gas in airway and tubing, 0.01 to 0.02 cmH2O s2/L in adults (Bates, "
        "Lung Mechanics, Cambridge 2009), behind 0.1 to 1 mL/cmH2O of tubing.",
        signature="Overshoot and ringing after edges, above all at the start of expiration with "
        "low R; below 0.15 cmH2O s2/L without tubing invisible at 30 samples a second.",
        confusable=("circuit_compliance", "exhalation_valve_delay"),
        least=0.008,
        least_reason="less than the gas in a tracheal tube alone",
    )

    # With tubing it rings at 20 Hz: at 7 ms a step, a fit finds 15 to 50 % too little of it.
    divisions = 4

    def network(self, values: Values, network: Network, view: View) -> Network:
        """Add the inertance in series with the airway, and the tubing before it."""
        inertance = values["inertance"]
        tubing = 1e-3 * values["tubing"] * inertance / (inertance + _HALF)
        return network.plus(inertance=inertance, circuit=tubing)


#: Share of the capacity up to which the curve is followed.
_FULL = 0.97

#: Order of the recoil's series near zero, whose next term is below 1e-10.
_ORDER = 6


class NonlinearCompliance(Mechanism):
    """A recoil that rises faster than volume."""

    description = Description(
        name="nonlinear_compliance",
        title="lung that stiffens as it fills",
        site="alveolus",
        equation="P_elastic = (ln(1 + sigmoid x) - ln(1 - x)) / (1 + sigmoid) / stiffening, x = "
        "stiffening V / C",
        parameters=(
            Parameter(
                "stiffening",
                "1/cmH2O",
                "1 over (capacity / C); negative: the lung softens",
                -0.05,
                0.08,
                0.0,
                1 / 40,
                1 / 24,
            ),
            Parameter(
                "sigmoid",
                "1",
                "0 for an exponential curve, 1 for the upper half of a sigmoid, more for one "
                "whose middle lies above zero pressure",
                0.0,
                4.0,
                0.0,
                0.0,
                0.0,
                shape=True,
                grid=(0.0, 1.0),
            ),
        ),
        source="Exponential pressure-volume curve of Salazar and Knowles (J. Appl. Physiol. 19, "
        "1964, 97), or the sigmoid of Venegas, Harris and Simon (J. Appl. Physiol. 84, 1998, 389), "
        "as a function of the volume above that at zero pressure. 5 to 50 % of the volume missing "
        "at 30 cmH2O.",
        signature="Pressure rises faster at high volume: end of inspiration of big breaths; "
        "expiration begins faster.",
        confusable=("valve_curve", "leak"),
        least=0.003,
        least_reason="stiffening by 5 % at 15 cmH2O; less is within the spread of springs",
        special_case_of=("recoil_shape",),
    )

    def network(self, values: Values, network: Network, view: View) -> Network:
        """Tangent of the curve at the last volume, less the linear lung's.

        The curve is that of the lung as it has become in the session.
        """
        k = values["stiffening"]
        linear = network.elastance * view.volume  # cmH2O
        full = k * linear > _FULL  # from here on the curve goes on as its tangent
        within = jnp.where(full, _FULL / jnp.where(full, k, 1.0), linear)
        x = k * within
        # Below the volume at zero pressure, and where the lung softens, the curve is exponential.
        sigmoid = jnp.where(x > 0.0, jnp.where(k > 0.0, values["sigmoid"], 0.0), 0.0)
        slope = 1.0 / ((1.0 - x) * (1.0 + sigmoid * x))
        recoil = within * _recoil_ratio(x, sigmoid) + (linear - within) * slope
        return network.plus(recoil=recoil - linear, elastance=(slope - 1.0) * network.elastance)


def _recoil_ratio(x: Array, sigmoid: Array) -> Array:
    """Recoil over the linear lung's, for any ``x`` below 1 and with its derivatives at zero.

    The slope ``1 / ((1 - x)(1 + sigmoid x))`` is the series of ``c_n x^n`` with
    ``c_n = 1 - sigmoid c_(n - 1)``.
    """
    small = jnp.abs(x) < 1e-2
    safe = jnp.where(small, 0.5, x)
    c, series = jnp.ones_like(x), jnp.ones_like(x)
    for power in range(1, _ORDER + 1):
        c = 1.0 - sigmoid * c
        series = series + c * x**power / (power + 1)
    exact = (jnp.log1p(sigmoid * safe) - jnp.log1p(-safe)) / ((1.0 + sigmoid) * safe)
    return jnp.where(small, series, exact)


class Viscoelasticity(Mechanism):
    """A spring with a dashpot beside the lung's elastance."""

    description = Description(
        name="viscoelasticity",
        title="stress relaxation of the tissue",
        site="alveolus",
        equation="dS/dt = ratio / C Q - S / time, P = V / C + S",
        parameters=(
            Parameter(
                "ratio",
                "1",
                "elastance of the Maxwell element over that of the lung",
                0.0,
                1.5,
                0.0,
                0.25,
                0.7,
            ),
            Parameter(
                "time",
                "s",
                "its relaxation time",
                0.1,
                5.0,
                1.0,
                1.0,
                1.0,
                "log",
                grid=(0.2, 0.5, 1.5),
            ),
        ),
        source="Maxwell element beside the elastance (Bates, Lung Mechanics, Cambridge 2009): "
        "ratio 0.05 to 0.7, 0.3 to 2 s. A second compartment has an impedance of the same order.",
        signature="Pressure creeps down while volume is held and lags behind slow changes, in "
        "inspiration and expiration; nearly all of it can hide in R and C.",
        confusable=("leak", "supply_droop"),
        least=0.04,
        least_reason="creep below that of rubber bellows",
        special_case_of=("recoil_memory",),
        # Its slow stress trades against C, and what is left of another mechanism's form decides.
        beside_error=0.2,
        equivalents=("second_compartment",),
    )

    stateful = True

    def network(self, values: Values, network: Network, view: View) -> Network:
        """Stress after the step: the relaxed stress and what the flow adds."""
        decay = 1.0 / (1.0 + view.length / values["time"])
        elastance = values["ratio"] * view.elastance * decay
        return network.plus(recoil=view.state * decay, elastance=elastance)

    def next_state(self, values: Values, state: Array, flow: Array, view: View) -> Array:
        """Stress, cmH2O."""
        gained = view.length * values["ratio"] * view.elastance * flow
        return (state + gained) / (1.0 + view.length / values["time"])


class TrappedGas(Mechanism):
    """A pressure in the lung above that at the airway when a breath begins (auto-PEEP)."""

    description = Description(
        name="trapped_gas",
        title="trapped gas at the start of a breath",
        site="alveolus",
        equation="P_alveolus(0) = p(0) + pressure",
        parameters=(
            Parameter(
                "pressure",
                "cmH2O",
                "excess in the lung at the first sample",
                0.0,
                10.0,
                0.0,
                1.5,
                4.0,
            ),
        ),
        source="Expiration that ends before the lung is empty leaves 1 to 15 cmH2O (Pepe and "
        "Marini, Am. Rev. Respir. Dis. 126, 1982, 166).",
        signature=(
            "A breath begins above its first reading at once, and gas flows out before it is given."
        ),
        confusable=("leak", "zero_step"),
        least=0.3,
        least_reason="a valve that closes some milliseconds late",
    )

    def of_breath(self, values: Values, base: Values) -> Values:
        """Recoil above the pressure at the airway."""
        return {**base, "offset": base["offset"] + values["pressure"]}


#: Where a muscle that relaxes has its peak, and its time constant after it, as shares of the
#: duration: with these, the best duration is hardly another one than that of half a sine.
_PEAK, _RELAXING = 2 / 3, 1 / 6


class PatientEffort(Mechanism):
    """A pressure source at the alveolus: half a sine, or a muscle that relaxes after its peak."""

    description = Description(
        name="patient_effort",
        title="effort of the patient's muscles",
        site="alveolus",
        equation="P_alveolus = ... - amplitude ((1 - relaxing) sin(pi x) + relaxing m(x)), x = (t "
        "- onset) / duration, m = sin(3 pi x / 4) up to x = 2/3, then exp(4 - 6 x)",
        parameters=(
            Parameter(
                "amplitude",
                "cmH2O",
                "highest pressure of the muscles, positive if inspiratory",
                -20.0,
                20.0,
                0.0,
                2.0,
                5.0,
                scope="breath",
                scan=(2.0, -2.0),
            ),
            Parameter(
                "onset",
                "s",
                "after the first sample",
                0.0,
                2.5,
                0.3,
                0.3,
                0.3,
                scope="breath",
                scan=(0.05, 0.3, 0.6, 0.9, 1.2, 1.6),
            ),
            Parameter("duration", "s", "of the effort", 0.2, 2.0, 0.8, 0.8, 0.8),
            Parameter(
                "relaxing",
                "1",
                "0 for half a sine, 1 for a muscle that relaxes exponentially after its peak",
                0.0,
                1.0,
                0.0,
                0.0,
                0.0,
                shape=True,
                grid=(0.0, 1.0),
            ),
        ),
        source="Half-sine muscle pressure, as active lung simulators take it: 1 to 15 cmH2O for "
        "0.4 to 1.2 s; inspiratory muscles relax exponentially, with time constants of 0.05 to 0.2 "
        "s (S. A. Esau et al., J. Appl. Physiol. 55, 1983, 731).",
        signature="A dent in pressure that the commands do not explain and that differs from "
        "breath to breath: absent in some, early or late in others.",
        confusable=("a source at the alveolus that repeats in every breath",),
        least=0.5,
        least_reason="a muscle pressure that a trigger would hardly see",
    )

    def network(self, values: Values, network: Network, view: View) -> Network:
        """Subtract the pressure of the muscles from the recoil."""
        phase = (view.time - values["onset"]) / values["duration"]
        sine = jnp.sin(jnp.pi * jnp.clip(phase, 0.0, 1.0))
        rise = jnp.sin(0.5 * jnp.pi / _PEAK * jnp.clip(phase, 0.0, _PEAK))
        muscle = rise * jnp.exp(-jnp.maximum(phase - _PEAK, 0.0) / _RELAXING)
        course = sine + values["relaxing"] * (muscle - sine)
        return network.plus(recoil=-values["amplitude"] * course)


#: Time in which a plug opens, s: a sample, as faster cannot be resolved. Width of its threshold,
#: cmH2O: a slope by which a fit finds it.
_OPENING_TIME, _WIDTH = 0.03, 0.5


class AirwayOpening(Mechanism):
    """An airway that is narrow until a pressure has opened it, anew in each breath."""

    description = Description(
        name="airway_opening",
        title="airway that a pressure opens",
        site="airway",
        equation="p = ... + (R + resistance closed) Q, 0.03 s d closed/dt = -closed above opening",
        parameters=(
            Parameter(
                "resistance",
                "cmH2O/(L/s)",
                "of the part that opens",
                0.0,
                200.0,
                0.0,
                15.0,
                50.0,
            ),
            Parameter(
                "opening",
                "cmH2O",
                "pressure at the airway that opens it",
                6.0,
                30.0,
                13.0,
                13.0,
                13.0,
                shape=True,
                grid=(8.0, 10.0, 13.0, 16.0, 20.0),
                uncertain=True,
            ),
        ),
        source="Liquid plugs and collapsed airways open at 5 to 30 cmH2O (Gaver, Samsel and "
        "Solway, J. Appl. Physiol. 69, 1990, 74) and may close again in expiration.",
        signature="Pressure rises too fast for the flow until it reaches the opening pressure, "
        "then falls back to that of the open airway; breaths that stay below it never open.",
        confusable=("turbulent_resistance", "valve_lag", "circuit_compliance"),
        least=3.0,
        least_reason="a bend in a tube; less is within R",
        special_case_of=("volume_resistance",),
    )
    stateful = True
    # It begins to open within a step: at 7 ms a step, pressure is off by 0.14 cmH2O there.
    divisions = 2

    def initial_state(self, values: Values, flow: Array, pressure: Array) -> Array:
        """Share that is closed: all of it."""
        return 1.0 + 0.0 * (flow + pressure)

    def network(self, values: Values, network: Network, view: View) -> Network:
        """Add what is still closed."""
        closed = self.next_state(values, view.state, view.flow, view)
        return network.plus(resistance=values["resistance"] * closed)

    def next_state(self, values: Values, state: Array, flow: Array, view: View) -> Array:
        """Share that is still closed, by the last pressure."""
        above = jnp.clip(0.5 + (view.pressure - values["opening"]) / _WIDTH, 0.0, 1.0)
        return state / (1.0 + view.length * above / _OPENING_TIME)
