"""What a controller is: as a pure function here, as a plain class in a submission."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol, runtime_checkable

#: Version of the submission interface (:class:`Task`, :class:`Observation`, ``reset``, ``act``).
API_VERSION = 1


class Task(NamedTuple):
    """What a submission is told before a run.

    Attributes:
        track: ``"performance"`` or ``"robustness"``.
        lung: id of the lung in the performance track, None in the robustness track.
        dt: nominal control step, s.
        inspiration_steps: steps of one inspiration; ``act`` is called once for each.
    """

    track: str
    lung: str | None
    dt: float
    inspiration_steps: int


class Observation(NamedTuple):
    """What a controller at a bench could see, at one step of an inspiration.

    In a submission every field is a Python float (``targets_ahead`` a tuple of floats); in pure
    controllers every field is an array with the batch shape ``(...)``.

    Attributes:
        time: since the start of the breath, s.
        dt: control step, s.
        pressure: measured airway pressure, cmH2O.
        target: target pressure now, cmH2O.
        targets_ahead: the next 10 targets, cmH2O; shape ``(..., 10)``.
        previous_u_in: command of the step before as applied, %; at the start of a breath the bias
            flow of the expiration, 5 %.
    """

    time: Any
    dt: Any
    pressure: Any
    target: Any
    targets_ahead: Any
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


@runtime_checkable
class SubmittedController(Protocol):
    """The class ``Controller`` of a submission's ``controller.py``; needs no import of ours."""

    def reset(self, task: Task) -> None:
        """Prepare for a run of three breaths."""
        ...

    def act(self, observation: Observation) -> float:
        """Return ``u_in``, %, for the next step."""
        ...
