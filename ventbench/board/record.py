"""A record: the immutable result of one scored run, named by the SHA-256 of its bytes.

An entry that ran on a physical lung has a hardware record: the same score, mean |pressure - target|
over the inspirations of breaths 2 and 3, from measured pressures. It holds those pressures, so that
every reader computes the score again; the raw recording of all breaths is named by its hash. There
are no commands to replay: a lung answers differently every time.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from operator import attrgetter
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np

from ventbench.base import files
from ventbench.base.arrays import Floats
from ventbench.base.errors import InputError
from ventbench.board import canonical, schema
from ventbench.board.figures import Figures
from ventbench.task import protocol
from ventbench.task.metrics import measured

#: What the key ``track`` says of every such record.
TRACK = "hardware"

#: Recorded pressures are rounded so: errors and peaks may differ from theirs by it, cmH2O.
_ROUNDED = 0.001

#: Most of the way from PEEP to PIP that a lung may be before the first command acts.
_MAX_INITIAL_SHARE = 0.5

#: Most repetitions of one cell.
MAX_REPEATS = 100

_Run = list[list[schema.SmallInt]] | None
_MeasuredRun = list[list[schema.SmallInt | None]] | None

#: End of a record's file name, after its SHA-256.
SUFFIX = canonical.RECORD_SUFFIX


@dataclass(frozen=True)
class Record(schema.Submitted):
    """A record's content, checked, and the figures that follow from it once they are derived."""

    sha256: str  #: of its bytes: its name.
    header: schema.ScoreContent  #: its content.
    derived: Figures | None = None  #: see :func:`ventbench.board.replay.with_figures`.

    @property
    def figures(self) -> Figures:
        """What its commands give; InputError where nobody has replayed them."""
        if self.derived is None:
            raise InputError(f"record {self.sha256[:12]} ({self.name}) was not replayed")
        return self.derived

    @property
    def track(self) -> str:
        """``"performance"`` or ``"robustness"``."""
        return self.header.track

    @property
    def draws(self) -> str:
        """Name of its draws: of a round, or ``"development"``."""
        return self.header.draws.season

    @property
    def official(self) -> bool:
        """Whether it was scored in a sandbox that deserves the word."""
        return self.header.official

    @property
    def commands(self) -> tuple[schema.Commands, ...]:
        """Its files of commands; those under missing physics last."""
        stress = self.header.stress
        return (self.header.commands, *(() if stress is None else (stress.commands,)))

    @property
    def run(self) -> tuple[str, str, str]:
        """Name, track and hash of the code: what a round freezes."""
        return self.name, self.track, self.header.submission.sha256

    @property
    def key(self) -> tuple[str, str, str]:
        """Draws, track and name: what one entry of the board is known by."""
        return self.draws, self.track, self.name


class Device(schema.Table, frozen=True):
    """What ran: the ventilator's own computer, as it says of itself, and what the host knows."""

    name: schema.Text  #: identity of the device.
    firmware: schema.Text  #: its version.
    calibration: schema.Text  #: hash of its calibration, as the device reports it.
    #: whether software stood in for valves and lung: by the port that the host opened, or by the
    #: device's own word.
    emulated: bool
    about: schema.FreeForm  #: what else it says.


class Stop(schema.Table, frozen=True):
    """A run that a safety check or a failure of the controller ended; it has no error."""

    lung: schema.LungId
    pip: float
    repeat: schema.Count
    reason: schema.Text


class HardwareTrace(schema.Table, frozen=True):
    """Scored inspirations of every run, ``(L, P, K)``; null for a stopped run.

    Each run is ``(scored breaths, INSPIRATION_STEPS)``, with null where there is no reading.
    """

    pressure_milli_cmH2O: list[list[list[_MeasuredRun]]]
    u_in_tenths_percent: list[list[list[_Run]]]


class Recording(schema.Table, frozen=True):
    """The raw recording: a file of the laboratory that the record names by its hash."""

    sha256: schema.Sha256
    bytes: schema.Count
    breaths: schema.Count


class HardwareContent(schema.SubmittedContent, frozen=True, tag_field="kind", tag="hardware"):
    """The content of a hardware record; L lungs, P PIPs, K repetitions.

    ``selftest`` has the parts of the self-test that were left out on each lung.
    """

    track: Literal["hardware"]
    simulated_track: schema.Track
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
    selftest: dict[schema.LungId, list[schema.Text]] = msgspec.field(default_factory=dict)


@dataclass(frozen=True)
class HardwareRecord(schema.Submitted):
    """A checked hardware record; L lungs, P PIPs, K repetitions."""

    sha256: str  #: of its bytes: its name.
    header: HardwareContent  #: its content.
    errors: Floats  #: error of every run, cmH2O, shape ``(L, P, K)``; NaN for a stopped one.

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
    def by_lung(self) -> Floats:
        """Mean error on each lung, cmH2O, shape ``(L,)``; NaN if a run was stopped."""
        return self.errors.mean(axis=(1, 2))

    @cached_property
    def spread(self) -> float:
        """Standard deviation of the score from repetition to repetition, cmH2O; or NaN."""
        by_repeat = self.errors.mean(axis=(0, 1))
        return float(np.std(by_repeat, ddof=1)) if self.header.repeats > 1 else float("nan")


@dataclass(frozen=True)
class Withdrawal:
    """Takes a record back; its entry is not ranked until a newer one arrives."""

    sha256: str  #: of its bytes: its name.
    header: schema.WithdrawalContent  #: its content.


#: Everything that a leaderboard keeps.
AnyRecord = Record | Withdrawal | HardwareRecord

#: What their files hold.
_KINDS = schema.ScoreContent | schema.WithdrawalContent | HardwareContent


def from_bytes(content: bytes, label: str) -> AnyRecord:
    """Read and check a record; ``label`` names the file in messages.

    Raises:
        InputError: if it is not a record.
    """
    values = schema.read(content, label, _KINDS)
    sha256 = canonical.digest(content)
    if isinstance(values, schema.WithdrawalContent):
        return Withdrawal(sha256, values)
    if isinstance(values, HardwareContent):
        return _checked(values, sha256, label)
    assert isinstance(values, schema.ScoreContent)
    return Record(sha256, values)


def load(path: Path) -> AnyRecord:
    """Read a record's file, whatever it is called; see :func:`from_bytes`.

    Raises:
        InputError: if it is not a record.
        OSError: if it cannot be read.
    """
    return from_bytes(files.read_limited(path, schema.MAX_BYTES), str(path))


def withdrawal(withdraws: str, reason: str) -> bytes:
    """Return the bytes of a record that takes another one, named by its SHA-256, back."""
    header = {"format": schema.FORMAT, "kind": "withdrawal", "created": timestamp()}
    return canonical.canonical({**header, "withdraws": withdraws, "reason": reason})


def timestamp(now: datetime | None = None) -> str:
    """A time as records write it; the clock's if none is given."""
    return (now or datetime.now(UTC)).strftime(schema.TIME_FORMAT)


def _checked(content: HardwareContent, sha256: str, label: str) -> HardwareRecord:
    """Check what ties the keys of a hardware record together, and what it says of its pressures.

    Errors, highest pressure, safety, the pressure before the first command acts, and that no two
    breaths of a lung are equal to the last digit.

    Raises:
        InputError: naming the first key that is wrong.
    """
    _check_tables(content, label)
    errors, missing = np.array(content.errors, float), set()
    breath_bytes: set[bytes] = set()
    for at, lung in enumerate(content.lungs):
        highest, safe = -np.inf, True
        for j, k in np.ndindex(*errors.shape[1:]):
            pip, recorded = content.pips[j], errors[at, j, k]
            run = content.trace.pressure_milli_cmH2O[at][j][k]
            where = f"{lung}, PIP {pip:g}, repetition {k + 1}"
            if (run is None) != np.isnan(recorded):
                raise InputError(f"{label}, key errors: {where} has an error without pressures")
            if run is None:
                missing.add((lung, pip, k + 1))
                continue
            pressure = np.array(run, float) / 1000.0
            if why := measured.too_few(pressure):
                raise InputError(f"{label}, key trace: {where}: {why}")
            computed = measured.mean_error(pressure, pip)
            if abs(computed - recorded) > _ROUNDED:
                raise InputError(
                    f"{label}, key errors: {where} says {recorded:.4f} cmH2O, its pressures give "
                    f"{computed:.4f}"
                )
            highest = max(highest, measured.highest(pressure))
            safe &= bool(np.all(measured.is_safe(pressure, pip, protocol.DT)))
            first = float(np.abs(pressure[:, 0] - protocol.PEEP).max())
            if first > _MAX_INITIAL_SHARE * (pip - protocol.PEEP):
                raise InputError(
                    f"{label}, key trace: {where} begins {first:.1f} cmH2O from PEEP, before any "
                    "command acts"
                )
            for breath in pressure:
                if breath.tobytes() in breath_bytes and not content.device.emulated:
                    raise InputError(
                        f"{label}, key trace: {where} repeats a breath to the last digit"
                    )
                breath_bytes.add(breath.tobytes())
        if content.peak_pressure_cmH2O[at] < highest - _ROUNDED:
            raise InputError(
                f"{label}, key peak_pressure_cmH2O: {lung} says "
                f"{content.peak_pressure_cmH2O[at]:.3f}, its pressures reach {highest:.3f}"
            )
        if content.safe[at] and not safe:
            raise InputError(
                f"{label}, key safe: {lung} says true, its pressures are above the limit"
            )
    stopped = [(stop.lung, stop.pip, stop.repeat) for stop in content.stops]
    if set(stopped) != missing or len(stopped) != len(missing):
        raise InputError(f"{label}, key stops: do not fit the errors")
    return HardwareRecord(sha256, content, errors)


def _check_tables(content: HardwareContent, label: str) -> None:
    size = (len(content.lungs), len(content.pips), content.repeats)
    if len(set(content.lungs)) != size[0] or len(set(content.pips)) != size[1]:
        raise InputError(f"{label}, keys lungs and pips: name one twice")
    if not set(content.pips) <= set(protocol.PIPS):
        raise InputError(f"{label}, key pips: are not those of the protocol")
    run = (len(protocol.SCORED_BREATHS), protocol.INSPIRATION_STEPS)
    traces = ("trace.pressure_milli_cmH2O", "trace.u_in_tenths_percent")
    shapes = dict.fromkeys(("errors", *traces), size)
    shapes |= dict.fromkeys(("safe", "peak_pressure_cmH2O"), size[:1])
    for key, shape in shapes.items():
        if not schema.has_shape(attrgetter(key)(content), shape):
            raise InputError(f"{label}, key {key}: does not have the shape {shape}")
    for key in traces:
        table = attrgetter(key)(content)
        runs = [cell for row in table for cells in row for cell in cells if cell is not None]
        if not all(schema.has_shape(cell, run) for cell in runs):
            raise InputError(f"{label}, key {key}: a run does not have the shape {run}")
    if content.simulated_track not in content.submission.manifest.tracks:
        raise InputError(f"{label}, key simulated_track: the submission does not enter it")
