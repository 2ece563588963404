"""Mechanisms: parameters, description, the network that they change, and several at once."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal, TypeVar

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.extend.core import jaxpr_as_fun
from numpy.typing import ArrayLike

from ventbench.base.arrays import Floats

#: Flow of the PVP's inspiratory valve, mL/s per % (137 L/min fully open).
VALVE_GAIN = 22.8

#: Resistance of the expiratory path, cmH2O/(L/s).
EXPIRATORY_RESISTANCE = 5.0


@dataclass(frozen=True)
class Parameter:
    """A scalar parameter, and how a fit is to treat it."""

    name: str  #: short, such as ``delay``.
    unit: str  #: unit of its values, ``1`` if there is none.
    meaning: str  #: what it is, in words.
    low: float  #: lowest plausible and permitted value.
    high: float  #: highest plausible and permitted value.
    neutral: float  #: value at which its mechanism does nothing; of a shape parameter, the default.
    mild: float  #: a small effect that occurs, and where a fit starts.
    strong: float  #: a large effect that occurs.
    #: ``"log"`` for what is positive and known to a factor; else ``"linear"``.
    scale: Literal["linear", "log"] = "linear"
    #: ``"shared"`` by all breaths, or one for each ``"breath"``.
    scope: Literal["shared", "breath"] = "shared"
    #: True for what only shapes the effect (an exponent, a recovery time): it stays at ``neutral``
    #: unless a fit is asked to free it.
    shape: bool = False
    follows: str | None = None  #: ``"R"`` or ``"C"`` if it scales with the lung's R or C.
    #: values that a search must also try, as it may end in the wrong minimum; of the strength of an
    #: event of some breaths, all that it tries.
    scan: tuple[float, ...] = ()
    #: True for a dead time or a threshold: the likelihood is flat between two samples, or commands,
    #: and falls off steeply where an edge passes one, so that its interval is a profile's.
    kinked: bool = False
    #: standard deviation before any data, in coordinates, around ``neutral``; given for what must
    #: stay there where no data bear on it, be it a strength.
    spread: float | None = None
    #: values at which a search tries the mechanism, for a parameter other than the strength that
    #: changes the shape of the effect much; only the neutral value if empty.
    grid: tuple[float, ...] = ()
    #: True if the response has no useful derivative with respect to it, such as a choice between
    #: two rules. A fit holds it at the grid value that a search chose.
    discrete: bool = False
    #: True for a shape parameter whose default is a guess. Final estimates free it, so that the
    #: interval of the strength allows for it.
    uncertain: bool = False
    #: True for a discrete parameter of a rule on commands whose grid is too fine to simulate: the
    #: response to first order chooses of it.
    screened: bool = False
    share: bool = False  #: True for a dimensionless share, which reports show in percent.
    #: True for the position in the recording, 0..1, from which on a change has set in. The
    #: likelihood is constant between two breaths: a fit tries all of them.
    change_point: bool = False

    def __post_init__(self) -> None:
        """Check what the transforms rely on.

        Raises:
            ValueError: if the bounds are out of order or the scale does not fit.
        """
        values = (self.neutral, self.mild, self.strong, *self.grid)
        if not self.low < self.high or not all(self.low <= x <= self.high for x in values):
            raise ValueError(f"{self.name}: {values} must lie within {self.low}..{self.high}")
        if self.scale == "log" and self.low <= 0:
            raise ValueError(f"{self.name}: a log scale needs a positive lower bound")

    def coordinate(self, value: ArrayLike) -> Floats:
        """Coordinate of a physical value in a fit: its logarithm on a log scale, else the value.

        A linear scale lets a fit reach ``neutral`` at a bound, with a derivative that is not zero.
        """
        value = np.asarray(value, float)
        return np.log(value) if self.scale == "log" else value

    def physical(self, coordinate: ArrayLike) -> Floats:
        """Inverse of :meth:`coordinate`."""
        coordinate = np.asarray(coordinate, float)
        return np.exp(coordinate) if self.scale == "log" else coordinate

    def slope(self, value: ArrayLike) -> Floats:
        """Derivative of the physical value with respect to the coordinate."""
        value = np.asarray(value, float)
        return value if self.scale == "log" else np.ones_like(value)

    def prior(self) -> tuple[float, float]:
        """Mean and standard deviation, in coordinates, of what is plausible before any data.

        On a log scale the bounds are two standard deviations off; on a linear one, values are
        likeliest near ``neutral``, and half the range off is one standard deviation. ``spread``, if
        it is given, overrules both.
        """
        if self.spread is not None:
            return float(self.coordinate(self.neutral)), self.spread
        low, high = float(self.coordinate(self.low)), float(self.coordinate(self.high))
        if self.scale == "log":
            return 0.5 * (low + high), 0.25 * (high - low)
        return self.neutral, 0.5 * (high - low)


#: Base parameters that every fit frees, so that a wrong label cannot pass for a mechanism.
REFITTED = ("R", "C", "R_ex", "PEEP")

#: Parameters of the base model: the lung, the valves, and how a breath begins. ``neutral`` is the
#: value in a model that does not name the parameter; a model without ``PEEP`` takes the pressure
#: that a breath starts from. R and C stand for a label that must be given.
BASE_PARAMETERS = (
    Parameter(
        "R",
        "cmH2O/(L/s)",
        "resistance of the airway",
        0.5,
        200.0,
        20.0,
        20.0,
        50.0,
        "log",
        follows="R",
    ),
    Parameter(
        "C",
        "mL/cmH2O",
        "compliance of the lung at low volume",
        2.0,
        250.0,
        20.0,
        20.0,
        50.0,
        "log",
        follows="C",
    ),
    Parameter(
        "gain",
        "mL/s per %",
        "flow of the inspiratory valve",
        2.0,
        100.0,
        VALVE_GAIN,
        VALVE_GAIN,
        VALVE_GAIN,
        "log",
    ),
    Parameter(
        "R_ex",
        "cmH2O/(L/s)",
        "resistance of the expiratory path",
        0.3,
        100.0,
        EXPIRATORY_RESISTANCE,
        EXPIRATORY_RESISTANCE,
        EXPIRATORY_RESISTANCE,
        "log",
    ),
    Parameter("PEEP", "cmH2O", "pressure behind the expiratory valve", -10.0, 30.0, 5.0, 5.0, 5.0),
    Parameter(
        "rest",
        "%",
        "command before the first sample of a breath",
        0.0,
        100.0,
        0.0,
        0.0,
        0.0,
        shape=True,
    ),
    Parameter(
        "offset",
        "cmH2O",
        "recoil minus airway pressure at the first sample",
        -10.0,
        10.0,
        0.0,
        0.0,
        0.0,
        shape=True,
    ),
    Parameter(
        "initial_flow",
        "mL/s",
        "flow into the lung at the first sample",
        -10_000.0,
        10_000.0,
        0.0,
        0.0,
        0.0,
        scope="breath",
        shape=True,
    ),
    Parameter(
        "position",
        "1",
        "of the breath in its recording, 0 first, 1 last",
        0.0,
        1.0,
        0.0,
        0.0,
        1.0,
        "linear",
        "breath",
        shape=True,
    ),
)


#: Values of a mechanism's parameters, by short name.
Values = Mapping[str, Array]

#: What a hook changes and what it keeps, an array each.
Pair = tuple[Array, Array]

#: What a mechanism changes: any pytree of arrays.
Before = TypeVar("Before")

#: Where in the physics a mechanism sits.
Site = Literal[
    "command",
    "inspiratory valve",
    "supply",
    "circuit",
    "airway",
    "alveolus",
    "expiratory valve",
    "sensor",
]


@flax.struct.dataclass
class View:
    """Quantities that a mechanism may use while it changes the network; every array ``(...)``."""

    time: Array  #: time since the start of the breath, s.
    #: volume of the lung before the step, L; a linear lung has the recoil ``volume / C``.
    volume: Array
    pressure: Array  #: last known pressure at the airway, cmH2O.
    flow: Array  #: last known flow into the lung, L/s.
    #: own state of the mechanism before the step (0 if it has none), ``(K, ...)`` for one with
    #: several states.
    state: Array
    length: Array  #: length of the implicit step, s.
    elastance: Array  #: elastance 1/C of the lung, cmH2O/L.
    peep: Array  #: pressure behind the expiratory valve, cmH2O.
    position: Array  #: position of the breath in the recording, 0..1.
    resistance: Array  #: resistance R of the airway, cmH2O/(L/s).
    outlet: Array  #: conductance of the open expiratory valve, 1 / R_ex, L/s per cmH2O.
    opened: Array  #: expiratory valve, 0 closed, 1 open.


@flax.struct.dataclass
class Network:
    """Coefficients of one step; every array has shape ``(...)``.

    Flow balance at the airway, L/s, with ``p`` and ``Q`` after the step and ``p0``, ``Q0`` before::

        circuit (p - p0) / h = inflow - Q - leak p - leak_flow - outlet max(p - behind, 0)

    Pressure along the way into the lung, cmH2O::

        p = recoil + elastance h Q + resistance Q + quadratic Q |Q| + inertance (Q - Q0) / h

    Any of ``circuit``, ``inertance``, ``quadratic``, ``leak`` and ``outlet`` may be zero.
    """

    inflow: Array  #: flow out of the inspiratory valve, L/s.
    circuit: Array  #: compliance of tubing and connectors, L/cmH2O.
    leak: Array  #: slope of the leak, L/s per cmH2O.
    leak_flow: Array  #: leak at zero pressure on that slope, L/s.
    outlet: Array  #: conductance of the expiratory valve, L/s per cmH2O.
    behind: Array  #: pressure behind the expiratory valve, cmH2O.
    resistance: Array  #: resistance of the airway, cmH2O/(L/s).
    quadratic: Array  #: quadratic resistance of the airway, cmH2O s2/L2.
    inertance: Array  #: inertance of the gas, cmH2O s2/L.
    recoil: Array  #: recoil of the lung without flow, less the pressure of the muscles, cmH2O.
    elastance: Array  #: slope of the recoil, cmH2O/L.

    def plus(self, **terms: Array) -> Network:
        """Add to coefficients, so that the order of mechanisms does not matter."""
        return self.replace(  # type: ignore[attr-defined]
            **{name: getattr(self, name) + term for name, term in terms.items()}
        )

    def solve(self, pressure: Array, flow: Array, length: Array) -> tuple[Array, Array]:
        """Pressure at the airway, cmH2O, and flow into the lung, L/s, after a step of a length, s.

        Takes both as they were before it.
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


@dataclass(frozen=True)
class Description:
    """Description of a mechanism, for people and for programs.

    All that other packages need to know about a mechanism stands here, so that a new one is a
    single file.
    """

    name: str  #: public name.
    title: str  #: the mechanism in a few words.
    site: Site  #: part of the physics in which the mechanism acts.
    equation: str  #: equation of the mechanism in plain text.
    #: parameters in the order of reports; the first one is the strength.
    parameters: tuple[Parameter, ...]
    source: str  #: publications behind the equation and the ranges.
    signature: str  #: what it changes in a recording.
    #: names of mechanisms, or of other effects, with a similar signature.
    confusable: tuple[str, ...] = ()
    #: smallest strength that a diagnosis names, in the unit of the strength. Even where the data
    #: ask for less, such a strength is within the integrator, the clock, or the form of another
    #: mechanism.
    least: float = 0.0
    least_reason: str = ""  #: why less is no statement about a rig, in words.
    #: names of other structures, in or outside the library, that have the same impedance, so that
    #: pressure alone can never tell them from this mechanism.
    equivalents: tuple[str, ...] = ()
    #: pairs of parameters whose values can be exchanged without any effect, such as the time
    #: constants of two lags in series. Reports give the larger value first.
    interchangeable: tuple[tuple[str, str], ...] = ()
    #: basis terms (of ``ventbench.physics.nonparametric``) that contain this mechanism, exactly or
    #: nearly.
    special_case_of: tuple[str, ...] = ()
    #: standard deviation, as a share of a parameter, of what the forms of other mechanisms shift
    #: where it acts beside them.
    beside_error: float = 0.0
    ubiquitous: bool = False  #: whether every rig has a little of it, which is no finding.

    @property
    def strength(self) -> Parameter:
        """The parameter that is neutral if and only if the mechanism is off."""
        return self.parameters[0]

    def as_dict(self) -> dict[str, Any]:
        """All fields as JSON values."""
        return asdict(self)


class Mechanism:
    """Base class of all mechanisms, which does nothing. A mechanism overrides what it changes.

    All methods are pure and elementwise over arrays ``(...)``. At the neutral strength each method
    must return what the base class returns, because fits skip a mechanism whose parameters are all
    neutral. Mechanisms that change the same quantity act in the order of ``rank``.
    """

    description: Description
    #: Order among the mechanisms that change the same quantity.
    rank: int = 0
    #: True if it has a continuous state, which starts at :meth:`initial_state`.
    stateful: bool = False
    #: Where a stage of the integrator takes its state from: ``"line"``, on which stages lie;
    #: ``"substep"``, where that began, of what follows its input however fast that moves, as of
    #: play; ``"stage"``, where the one before ended, of steps that are exact. But for the first, a
    #: reading is given the time since the substep began.
    begins: Literal["line", "substep", "stage"] = "line"
    #: True if it keeps a memory from sample to sample, which starts as the resting command.
    has_memory: bool = False
    #: Steps of the integrator in a substep that a fit needs where the mechanism acts. One that
    #: rings needs several, or the method damps what the rig does not.
    divisions: int = 1
    #: True if its effect depends on the position of the breath in the recording.
    uses_position: bool = False

    def has(self, hook: str) -> bool:
        """Whether it overrides one of the methods below."""
        return getattr(type(self), hook) is not getattr(Mechanism, hook)

    def of_breath(self, values: Values, base: Values) -> Values:
        """Base parameters as they are in a breath, given those of the model, by name."""
        return base

    def driven(self, values: Values, u_in: Array) -> Array:
        """What a valve's driver makes of a command, %, before any part of the valve moves."""
        return u_in

    def command(self, values: Values, u_in: Array, memory: Array) -> tuple[Array, Array]:
        """Effective command of the inspiratory valve, %, and the new memory, once a sample."""
        return u_in, memory

    def dead_time(self, values: Values, time: Array) -> Array | float:
        """Dead time that it adds to the inspiratory valve, s, at a time in the breath, s."""
        return 0.0

    def outlet_dead_time(self, values: Values, u_out: Array, time: Array) -> Array | float:
        """Dead time that it adds to the expiratory valve for the command ``u_out``, s."""
        return 0.0

    def initial_state(self, values: Values, flow: Array, pressure: Array) -> Array:
        """State at the start of a breath, given the resting flow, L/s, and pressure, cmH2O.

        A mechanism with several states stacks them along a first axis, ``(K, ...)``.
        """
        return flow * 0.0

    def inflow(self, values: Values, flow: Array, state: Array, length: Array) -> Pair:
        """Flow that arrives at the airway, L/s, and the own state after the step."""
        return flow, state

    def network(self, values: Values, network: Network, view: View) -> Network:
        """Network with its contribution, made by :meth:`Network.plus`."""
        return network

    def next_state(self, values: Values, state: Array, flow: Array, view: View) -> Array:
        """Own state after a step with this flow into the lung, L/s."""
        return state

    def reading(
        self, values: Values, pressure: Array, flow: Array, state: Array, length: Array
    ) -> Pair:
        """Pressure behind a part of the sensor, cmH2O, and the own state after the step.

        ``flow`` goes into the lung, L/s; ``length`` is that of the step, s.
        """
        return pressure, state

    def sensor_output(self, values: Values, pressure: Array, position: Array) -> Array:
        """Recorded pressure, cmH2O: a static and invertible function of the sensor's pressure."""
        return pressure

    def sensor_input(self, values: Values, recorded: Array, position: Array) -> Array:
        """Inverse of :meth:`sensor_output`."""
        return recorded


def is_active(mechanism: Mechanism, values: Values) -> Array:
    """Whether any parameter differs from its neutral value in any element, ``()``.

    All parameters count: the strength of a basis term is the set of its coefficients.
    """
    differs = [jnp.any(values[p.name] != p.neutral) for p in mechanism.description.parameters]
    return jnp.any(jnp.stack(differs))


def apply_if_active(
    active: Array | None, change: Callable[[Before], Before], before: Before
) -> Before:
    """Return ``change(before)``, or ``before`` if the mechanism is inactive.

    Only the leaves that the change replaces pass through the branch; XLA would copy the others.

    Args:
        active: whether the mechanism is active, from :func:`is_active`; None computes the change
            unconditionally.
        change: keeps the shapes of the leaves, and returns a leaf that it does not change itself.
        before: any pytree of arrays.
    """
    if active is None:
        return change(before)
    leaves, tree = jax.tree.flatten(before)
    traced = jax.make_jaxpr(change)(before)
    ends = zip(traced.jaxpr.invars, traced.jaxpr.outvars, strict=True)
    replaced = [k for k, (old, new) in enumerate(ends) if new is not old]
    if not replaced:
        return before
    after = jaxpr_as_fun(traced)  # calling the change again would trace it twice

    def changed(*operands: Array) -> tuple[Array, ...]:
        current = list(leaves)
        for k, leaf in zip(replaced, operands, strict=True):
            current[k] = leaf
        values = after(*current)
        return tuple(values[k] for k in replaced)

    operands = [leaves[k] for k in replaced]
    for k, leaf in zip(replaced, jax.lax.cond(active, changed, _same, *operands), strict=True):
        leaves[k] = leaf
    return jax.tree.unflatten(tree, leaves)


def _same(*operands: Array) -> tuple[Array, ...]:
    return operands


_NEUTRAL_BASE = {parameter.name: parameter.neutral for parameter in BASE_PARAMETERS}


@dataclass(frozen=True)
class Assembly:
    """The mechanisms of a model in order of rank, and all parameter values by owner."""

    base: Values  #: values of the base model's parameters.
    mechanisms: dict[str, Mechanism]  #: mechanisms that have a named parameter.
    values: dict[str, Values]  #: parameter values of each of them.
    #: whether each of them is active; empty if inactive ones are computed as well.
    active: dict[str, Array]

    def change(
        self, name: str, hook: Callable[..., Before], before: Before, *arguments: Any
    ) -> Before:
        """Return ``hook(mechanism, its values, before, *arguments)``, or ``before`` if inactive."""

        def changed(before: Before) -> Before:
            return hook(self.mechanisms[name], self.values[name], before, *arguments)

        return apply_if_active(self.active.get(name), changed, before)

    def total(self, term: Callable[[Mechanism, Values], Array | float]) -> Array | float:
        """Sum of a term over all mechanisms."""
        return sum(
            term(mechanism, self.values[name]) for name, mechanism in self.mechanisms.items()
        )


def assemble(
    named: Mapping[str, Array], library: Mapping[str, Mechanism], skip_idle: bool = False
) -> Assembly:
    """Sort values that are given by path, and give all other parameters their neutral value."""
    # A dead time is recognised by the type jax.Array; files give numpy arrays.
    named = {path: jnp.asarray(value) for path, value in named.items()}
    owners = {path.rpartition(".")[0] for path in named}
    chosen = sorted((n for n in library if n in owners), key=lambda n: (library[n].rank, n))
    values = {}
    for name in chosen:
        parameters = library[name].description.parameters
        values[name] = {
            p.name: named.get(f"{name}.{p.name}", jnp.asarray(p.neutral)) for p in parameters
        }
    base = {name: named.get(name, jnp.asarray(value)) for name, value in _NEUTRAL_BASE.items()}
    for name in chosen:
        base = dict(library[name].of_breath(values[name], base))
    active = {name: is_active(library[name], values[name]) for name in chosen if skip_idle}
    return Assembly(base, {name: library[name] for name in chosen}, values, active)
