"""The record of an entry that ran on a physical lung: its form and its checks.

The same score as in simulation, mean |pressure - target| over the inspirations of breaths 2 and 3,
computed from measured pressures. A record holds those pressures, so that every reader computes the
score again; the raw recording of all breaths is named by its hash. There are no commands to
replay: a lung answers differently every time.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from ventbench import protocol
from ventbench.board import schema
from ventbench.errors import InputError

Floats = NDArray[np.float64]

#: What the key ``track`` says of every such record.
TRACK = "hardware"

#: Recorded errors may differ from those of the pressures, which are rounded to 0.001, cmH2O.
_TOLERANCE = 0.001

#: Most repetitions of one cell.
MAX_REPEATS = 100

_Run = list[list[schema.SmallInt]] | None


class Device(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What ran: the ventilator's own computer, as it says of itself, and what the host knows.

    Attributes:
        name: identity of the device.
        firmware: its version.
        calibration: hash of its calibration, as the device reports it.
        emulated: whether software stood in for valves and lung: by the port that the host opened,
            or by the device's own word.
        about: what else it says.
    """

    name: schema.Text
    firmware: schema.Text
    calibration: schema.Text
    emulated: bool
    about: schema.FreeForm


class Stop(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A run that a safety check or a failure of the controller ended; it has no error."""

    lung: schema.LungId
    pip: float
    repeat: schema.Count
    reason: schema.Text


class HardwareTrace(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Scored inspirations of every run, ``(L, P, K)``; null for a stopped run.

    Each run is ``(scored breaths, INSPIRATION_STEPS)``.
    """

    pressure_milli_cmH2O: list[list[list[_Run]]]
    u_in_tenths_percent: list[list[list[_Run]]]


class Recording(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The raw recording: a file of the laboratory that the record names by its hash."""

    sha256: schema.Sha256
    bytes: schema.Count
    breaths: schema.Count


class HardwareContent(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="kind", tag="hardware"
):
    """The content of a hardware record; L lungs, P PIPs, K repetitions."""

    format: Literal[1]
    protocol: schema.Version
    created: schema.Time
    track: Literal["hardware"]
    simulated_track: schema.Track
    submission: schema.RecordedSubmission
    device: Device
    operator: schema.Text
    notes: schema.Text
    lungs: Annotated[list[schema.LungId], msgspec.Meta(min_length=1, max_length=6)]
    pips: Annotated[list[float], msgspec.Meta(min_length=1, max_length=12)]
    repeats: Annotated[int, msgspec.Meta(ge=1, le=MAX_REPEATS)]
    errors: list[list[list[schema.Error]]]
    stops: list[Stop]
    safe: list[bool]
    peak_pressure_cmH2O: list[float]
    trace: HardwareTrace
    recording: Recording
    plan: schema.FreeForm
    control: schema.FreeForm
    safety: schema.FreeForm
    timing: schema.FreeForm
    sandbox: schema.FreeForm | None
    provenance: schema.FreeForm
    versions: schema.FreeForm
    machine: schema.FreeForm


@dataclass(frozen=True)
class HardwareRecord(schema.Submitted):
    """A checked hardware record; L lungs, P PIPs, K repetitions.

    Attributes:
        sha256: of its bytes: its name.
        header: its content.
        errors: error of every run, cmH2O, shape ``(L, P, K)``; NaN for a stopped one.
    """

    sha256: str
    header: HardwareContent
    errors: Floats

    @property
    def track(self) -> str:
        """Track whose task the controller was given; ``"performance"`` tells it the lung."""
        return self.header.simulated_track

    @property
    def emulated(self) -> bool:
        """Whether software stood in for the ventilator and its lung."""
        return self.header.device.emulated

    @cached_property
    def score(self) -> float:
        """Mean error over all runs, cmH2O; NaN if one was stopped."""
        return float(self.errors.mean())

    @cached_property
    def by_repeat(self) -> Floats:
        """Score of each repetition, cmH2O, shape ``(K,)``; NaN if one of its runs was stopped."""
        return self.errors.mean(axis=(0, 1))

    @cached_property
    def by_lung(self) -> Floats:
        """Mean error on each lung, cmH2O, shape ``(L,)``; NaN if a run was stopped."""
        return self.errors.mean(axis=(1, 2))

    @cached_property
    def spread(self) -> float:
        """Standard deviation of the score from repetition to repetition, cmH2O; or NaN."""
        return float(np.std(self.by_repeat, ddof=1)) if self.header.repeats > 1 else float("nan")


def checked(content: HardwareContent, sha256: str, label: str) -> HardwareRecord:
    """Check what ties the keys of a hardware record together.

    Args:
        content: types and ranges are right.
        sha256: of its bytes.
        label: names the file in messages.

    Raises:
        InputError: naming the first key that is wrong.
    """
    _check_tables(content, label)
    errors = np.array(content.errors, float)
    pressures = content.trace.pressure_milli_cmH2O
    for lung, pip, repeat in np.ndindex(*errors.shape):
        run = pressures[lung][pip][repeat]
        recorded = errors[lung, pip, repeat]
        place = f"{content.lungs[lung]}, PIP {content.pips[pip]:g}, repetition {repeat + 1}"
        if (run is None) != np.isnan(recorded):
            raise InputError(f"{label}, key errors: {place} has an error without pressures")
        if run is None:
            continue
        given = float(np.mean(np.abs(np.array(run) / 1000.0 - content.pips[pip])))
        if abs(given - recorded) > _TOLERANCE:
            raise InputError(
                f"{label}, key errors: {place} says {recorded:.4f} cmH2O, its pressures give "
                f"{given:.4f}"
            )
    stopped = {(stop.lung, stop.pip, stop.repeat) for stop in content.stops}
    missing = {
        (content.lungs[lung], content.pips[pip], repeat + 1)
        for lung, pip, repeat in np.argwhere(np.isnan(errors)).tolist()
    }
    if stopped != missing or len(stopped) != len(content.stops):
        raise InputError(f"{label}, key stops: do not fit the errors")
    return HardwareRecord(sha256, content, errors)


def _check_tables(content: HardwareContent, label: str) -> None:
    size = (len(content.lungs), len(content.pips), content.repeats)
    if len(set(content.lungs)) != size[0] or len(set(content.pips)) != size[1]:
        raise InputError(f"{label}, keys lungs and pips: name one twice")
    if not set(content.pips) <= set(protocol.PIPS):
        raise InputError(f"{label}, key pips: are not those of the protocol")
    run = (len(protocol.SCORED_BREATHS), protocol.INSPIRATION_STEPS)
    tables: tuple[tuple[str, Any], ...] = (
        ("errors", content.errors),
        ("trace.pressure_milli_cmH2O", content.trace.pressure_milli_cmH2O),
        ("trace.u_in_tenths_percent", content.trace.u_in_tenths_percent),
    )
    for key, table in tables:
        if not schema.has_shape(table, size):
            raise InputError(f"{label}, key {key}: does not have the shape {size}")
        if key == "errors":
            continue
        runs = [cell for row in table for cells in row for cell in cells if cell is not None]
        if not all(schema.has_shape(cell, run) for cell in runs):
            raise InputError(f"{label}, key {key}: a run does not have the shape {run}")
    for key, values in (
        ("safe", content.safe),
        ("peak_pressure_cmH2O", content.peak_pressure_cmH2O),
    ):
        if len(values) != size[0]:
            raise InputError(f"{label}, key {key}: does not have one value a lung")
    if content.simulated_track not in content.submission.manifest.tracks:
        raise InputError(f"{label}, key simulated_track: the submission does not enter it")
