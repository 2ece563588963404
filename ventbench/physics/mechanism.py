"""What a mechanism is: a description, and what it does at its place in the physics."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal

from jax import Array

from ventbench.physics.network import Network, View
from ventbench.physics.parameters import Parameter

#: Its own parameters, by short name.
Values = Mapping[str, Array]

#: Where in the physics a mechanism sits.
Site = Literal[
    "command", "inspiratory valve", "supply", "circuit", "airway", "alveolus", "expiratory valve",
    "sensor",
]  # fmt: skip


@dataclass(frozen=True)
class Description:
    """What is known of a mechanism, for people and for machines.

    Attributes:
        name: public name, also that of its module.
        title: in a few words.
        site: where in the physics it sits.
        equation: in plain text.
        parameters: in the order of reports; the first is its strength.
        source: of the equation and the ranges.
        signature: where in a recording it shows.
        confusable: names of mechanisms, or of other things, that look alike.
        detectable: smallest strength found in about 20 breaths of one lung, in the strength's unit,
            or None if it was not measured.
        equivalents: names of other structures, in or outside the library, that have the same
            impedance, so that pressure alone can never tell them from this mechanism.
        interchangeable: pairs of its parameters whose values can be exchanged without any effect,
            as the time constants of two lags in series. Reports give the larger value first.
        special_case_of: basis terms (of ``ventbench.physics.nonparametric``) that contain this
            mechanism, exactly or nearly.
    """

    name: str
    title: str
    site: Site
    equation: str
    parameters: tuple[Parameter, ...]
    source: str
    signature: str
    confusable: tuple[str, ...] = ()
    detectable: float | None = None
    equivalents: tuple[str, ...] = ()
    interchangeable: tuple[tuple[str, str], ...] = ()
    special_case_of: tuple[str, ...] = ()

    @property
    def strength(self) -> Parameter:
        """The parameter that is neutral if and only if the mechanism is off."""
        return self.parameters[0]

    def as_dict(self) -> dict[str, Any]:
        """JSON values."""
        return asdict(self)


class Mechanism:
    """Base of all mechanisms: does nothing. A mechanism overrides what it changes.

    All methods are pure and elementwise over arrays ``(...)``; at the neutral strength each must
    return what the base class returns, as fits skip it where all its parameters are neutral.
    Mechanisms at the same place act in the order of ``rank``.
    """

    description: Description
    #: Order among the mechanisms that change the same quantity.
    rank: int = 0
    #: True if it keeps a continuous state, which starts as :meth:`rest` says.
    stateful: bool = False
    #: True if it remembers something from sample to sample; it starts as the resting command.
    remembers: bool = False
    #: True if it looks at the breath's position in the recording.
    positioned: bool = False

    def command(self, values: Values, u_in: Array, memory: Array) -> tuple[Array, Array]:
        """What opens the inspiratory valve, %, and what is remembered, once a sample."""
        return u_in, memory

    def dead_time(self, values: Values) -> Array | float:
        """Seconds by which the inspiratory valve answers late."""
        return 0.0

    def outlet_dead_time(self, values: Values, u_out: Array) -> Array | float:
        """Seconds by which the expiratory valve answers late to the command ``u_out``."""
        return 0.0

    def rest(self, values: Values, flow: Array, pressure: Array) -> Array:
        """Its state at the start of a breath, from the resting inflow, L/s, and cmH2O.

        One that keeps several states stacks them along a first axis, ``(K, ...)``.
        """
        return flow * 0.0

    def inflow(
        self, values: Values, flow: Array, state: Array, length: Array
    ) -> tuple[Array, Array]:
        """What becomes of the inspiratory valve's flow, L/s; and its own state after the step."""
        return flow, state

    def network(self, values: Values, network: Network, view: View) -> Network:
        """What it adds where the flows meet, by :meth:`Network.plus`."""
        return network

    def settle(self, values: Values, state: Array, flow: Array, view: View) -> Array:
        """Its own state after a step with this flow into the lung, L/s."""
        return state

    def reading(
        self, values: Values, pressure: Array, state: Array, length: Array
    ) -> tuple[Array, Array]:
        """What the sensor makes of the pressure, cmH2O; and its own state after the step."""
        return pressure, state

    def shown(self, values: Values, pressure: Array, position: Array) -> Array:
        """What is recorded of the sensor's pressure, cmH2O: without memory, invertible."""
        return pressure

    def meant(self, values: Values, shown: Array, position: Array) -> Array:
        """Inverse of :meth:`shown`."""
        return shown
