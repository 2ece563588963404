"""Plant and controller: the two interfaces on which everything else is built.

Standard library only: processes that run submissions import this module too.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, TypeVar, runtime_checkable

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jax import Array

#: Version of the submission interface (:class:`Task`, :class:`Observation`, ``reset``, ``act``).
API_VERSION = 1

State = Any
PlantT = TypeVar("PlantT")


class Signals(NamedTuple):
    """What a plant shows at one instant; every array has shape ``(...)``.

    A signal that a kind of plant does not have is None, for all of its plants and at all times.
    """

    reading: Any  #: airway pressure as the sensor shows it, cmH2O.
    #: true pressure at the airway, cmH2O; None if only readings were learned.
    airway_pressure: Any = None
    flow: Any = None  #: flow into the lung, mL/s.
    volume: Any = None  #: gas in the lung above a level that stays the same within a breath, mL.

    @property
    def scored(self) -> Any:
        """Pressure that is scored, cmH2O: the airway's; the reading where nothing else is known."""
        return self.reading if self.airway_pressure is None else self.airway_pressure


@runtime_checkable
class Plant(Protocol):
    """Answers to valve commands with airway pressures.

    A plant is a pytree (its parameters are leaves), so that it can be an argument of ``jit``,
    stacked over lungs and ensemble members, and differentiated. All methods are pure; every array
    argument may have any leading batch shape ``(...)``, which the parameters must broadcast with.
    Plants contain no ``cond`` or ``switch``: under ``vmap`` those copy weights per element.

    Time: the command of a sample is held for ``dt`` after that sample, and ``step`` returns the
    signals at the end of that time, which is the next sample.
    """

    def init(self, pressure: Array, peep: Array | None = None) -> tuple[State, Signals]:
        """Lung at rest.

        Args:
            pressure: airway and alveolar pressure, cmH2O, shape ``(...)``.
            peep: pressure behind the expiratory valve, cmH2O; ``pressure`` if not given.

        Returns:
            The state, and the signals at rest.
        """
        ...

    def step(self, state: State, u_in: Array, u_out: Array, dt: Array) -> tuple[State, Signals]:
        """Hold one command.

        Args:
            state: state from ``init`` or ``step``.
            u_in: inspiratory valve, 0..100 %, shape ``(...)``.
            u_out: expiratory valve, 0 closed, 1 open, shape ``(...)``.
            dt: time for which the command is held, s, shape ``(...)`` or scalar.

        Returns:
            The next state, and the signals at the end of ``dt``.
        """
        ...

    def vary(self, r_scale: Array, c_scale: Array, gain: Array | float = 1.0) -> Plant:
        """Return the same lung with resistance, compliance and the valve's flow times factors."""
        ...

    def parameters(self) -> Mapping[str, Any] | None:
        """What the physics of :mod:`ventbench.physics` can say of this plant.

        Returns:
            Parameters by path, of the shape of the plant's own; None where nothing is known.
        """
        ...


class Task(NamedTuple):
    """Information that a submission gets before a run."""

    track: str  #: ``"performance"`` or ``"robustness"``.
    lung: str | None  #: id of the lung in the performance track, None in the robustness track.
    dt: float  #: nominal control step, s.
    inspiration_steps: int  #: steps of one inspiration; ``act`` is called once for each.


class Observation(NamedTuple):
    """Observation that a real ventilator could give a controller, at one step of an inspiration.

    In a submission every field is a Python float (``targets_ahead`` a tuple of floats); in pure
    controllers every field is an array with the batch shape ``(...)``.
    """

    time: Any  #: since the start of the breath, s.
    dt: Any  #: control step, s.
    pressure: Any  #: measured airway pressure, cmH2O.
    target: Any  #: target pressure now, cmH2O.
    targets_ahead: Any  #: the next 10 targets, cmH2O; shape ``(..., 10)``.
    #: command of the step before as applied, %; at the start of a breath the bias flow of the
    #: expiration, 5 %.
    previous_u_in: Any


@runtime_checkable
class Controller(Protocol):
    """A pure controller: a pytree whose parameters are leaves, run inside ``lax.scan``."""

    def init(self, shape: tuple[int, ...]) -> Any:
        """State at the start of a run, for a batch of this shape."""
        ...

    def step(self, state: Any, observation: Observation) -> tuple[Any, Any]:
        """Return the next state and ``u_in``, %, shape ``(...)``; clipping is the caller's."""
        ...
