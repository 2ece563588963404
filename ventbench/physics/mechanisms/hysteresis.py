"""Hysteresis of the lung and of the pressure sensor, in one form.

The form is that of Prandtl and Ishlinskii: a mean of stops of several radii. A stop moves with its
input and stands still at either end of its travel; many stops make loops that are smooth, nested
and independent of the rate. A breath starts from an expiration, so that all stops start at their
lower end, and the loop is counted from there.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from ventbench.physics.mechanism import (
    Description,
    Mechanism,
    Network,
    Pair,
    Parameter,
    Values,
    View,
)

#: Radii of the stops, cmH2O of recoil or reading: by factors of 3, so that loops of 2 to 20 cmH2O
#: have the same shape within a tenth of their height.
RADII = (1.0, 3.0, 9.0)

#: Recoil, cmH2O, that no lung rests at.
_ABOVE_ALL = 1e3


def _radii(like: Array) -> Array:
    """Radii along a first axis before the axes of an array."""
    return jnp.asarray(RADII, like.dtype).reshape(-1, *(1,) * like.ndim)


def _initial_stops(like: Array) -> Array:
    """The input, cmH2O, and all stops at their lower end, ``(4, ...)``."""
    return jnp.stack([like, *[0.0 * like - 1.0] * len(RADII)])


def _stop_operator(state: Array, like: Array) -> Array:
    """State after the input has gone to another value, cmH2O."""
    stops = jnp.clip(state[1:] + (like - state[0]) / _radii(like), -1.0, 1.0)
    return jnp.concatenate([like[None], stops])


class LungHysteresis(Mechanism):
    """The lung needs more pressure while it fills than while it empties."""

    description = Description(
        name="lung_hysteresis",
        title="hysteresis of the lung",
        site="alveolus",
        equation="p = ... + height (1 + mean of stops of V / C with radii 1, 3, 9 cmH2O) / 2",
        parameters=(
            Parameter("height", "cmH2O", "pressure between the branches", 0.0, 12.0, 0.0, 1.5, 4.0),
        ),
        source="Prandtl-Ishlinskii operator (Brokate and Sprekels, Hysteresis and Phase "
        "Transitions, Springer 1996). Lungs: Mead, Whittenberger and Radford (J. Appl. Physiol. "
        "10, 1957, 191); bellows with friction: 0.3 to 2 cmH2O.",
        signature="Pressure is higher while the lung fills than while it empties, by an amount "
        "that does not depend on flow; after a reversal it takes a few cmH2O to change sides.",
        confusable=("viscoelasticity", "nonlinear_compliance", "turbulent_resistance"),
        least=0.3,
        least_reason="friction of a bellows that is sold as a test lung",
        special_case_of=("recoil_memory",),
    )
    stateful = True
    begins = "substep"
    rank = 1  # behind what bends the lung, whose slope this one adds to

    def initial_state(self, values: Values, flow: Array, pressure: Array) -> Array:
        """Recoil of a linear lung, cmH2O, and the stops, ``(4, ...)``.

        It begins above all recoils, from where it comes to rest on the branch of expirations.
        """
        return _initial_stops(pressure + 0.0 * flow + _ABOVE_ALL)

    def network(self, values: Values, network: Network, view: View) -> Network:
        """Add the loop's pressure, and its slope where stops move, around the last flow."""
        change = view.elastance * view.flow * view.length
        stops = _stop_operator(view.state, view.elastance * view.volume + change)[1:]
        slope = jnp.mean((jnp.abs(stops) < 1.0) / _radii(change), axis=0)
        half = 0.5 * values["height"]
        return network.plus(
            recoil=half * (1.0 + jnp.mean(stops, axis=0) - slope * change),
            elastance=half * slope * view.elastance,
        )

    def next_state(self, values: Values, state: Array, flow: Array, view: View) -> Array:
        """Stops after the step."""
        return _stop_operator(state, view.elastance * (view.volume + flow * view.length))


class SensorHysteresis(Mechanism):
    """The sensor shows less while pressure rises than while it falls."""

    description = Description(
        name="sensor_hysteresis",
        title="hysteresis of the pressure sensor",
        site="sensor",
        equation="y = p - width (1 + mean of stops of p with radii 1, 3, 9 cmH2O) / 2",
        parameters=(
            Parameter("width", "cmH2O", "reading between the branches", 0.0, 6.0, 0.0, 0.8, 2.0),
        ),
        source="Prandtl-Ishlinskii operator (Brokate and Sprekels, Hysteresis and Phase "
        "Transitions, Springer 1996); 0.1 to 0.5 % of full scale in data sheets of piezoresistive "
        "sensors, several percent where a membrane sticks.",
        signature="Readings lag behind pressure by an amount that does not depend on time: low on "
        "the way up, high on the way down, whatever flow is.",
        confusable=("sensor_lag", "sensor_curve"),
        least=0.2,
        least_reason="half a percent of a usual sensor's full scale",
        special_case_of=("sensor_memory",),
    )
    stateful = True
    begins = "substep"
    rank = 2

    def initial_state(self, values: Values, flow: Array, pressure: Array) -> Array:
        """The pressure, cmH2O, and all stops at their lower end, ``(4, ...)``."""
        return _initial_stops(pressure + 0.0 * flow)

    def reading(
        self, values: Values, pressure: Array, flow: Array, state: Array, length: Array
    ) -> Pair:
        """The reading on its branch."""
        after = _stop_operator(state, pressure)
        return pressure - 0.5 * values["width"] * (1.0 + jnp.mean(after[1:], axis=0)), after
