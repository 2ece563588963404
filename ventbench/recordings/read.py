"""Reading recordings: whole, or only to check, with a report; and tables of simulated pressures."""

from __future__ import annotations

import os
from collections.abc import Collection
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from ventbench.base.arrays import Columns, Floats
from ventbench.base.errors import InputError
from ventbench.base.text import few
from ventbench.recordings.bad_samples import UNUSABLE, clean, left_out
from ventbench.recordings.breaths import SUFFIXES, Breaths, arranged, join
from ventbench.recordings.roles import few_breaths, findings
from ventbench.recordings.scan import ProblemLog, Progress, Scanned, scan
from ventbench.recordings.schema import OPTIONAL, RecordingError, RecordingProblem
from ventbench.recordings.sources import Source, open_source
from ventbench.task.lungs import Lung

if TYPE_CHECKING:
    import pandas as pd

#: Names of the column of simulated pressures, in the order in which they are looked for.
COLUMNS = ("simulated", "simulated_pressure", "pressure_simulated", "pressure")

#: Commands of a table may differ from the recorded ones by rounding, %.
_SAME_COMMAND = 0.05

#: Names of the column of times.
_TIMES = ("time_step", "time")


def simulated_pressures(
    table: Columns, name: str, breaths: Breaths, *, sha256: str | None = None
) -> Floats:
    """Simulated pressures of recorded breaths.

    Rows of a breath are in time order. If it has another number of them than the recording, its
    pressures are interpolated at the recorded times; commands never are.

    Args:
        table: columns by name: ``breath_id``, or the ``id`` of each row, and one of :data:`COLUMNS`
            (``simulated`` if recorded pressures stand beside it). It may have ``time_step``; ``R``,
            ``C`` and ``u_in`` must be those of the recording.
        name: what messages call the table.
        breaths: n recorded breaths of T samples.
        sha256: hash of the table's file, by which it is known from that of the recording.

    Returns:
        cmH2O, ``(n, T)``; padding repeats the last value.

    Raises:
        InputError: if a column or a breath is missing, the rows do not cover a breath, or they are
            those of another lung or command.
    """
    import pandas as pd

    column = next((name for name in COLUMNS if name in table), None)
    if "breath_id" not in table and "id" in table:  # as the competition's submissions
        table = _by_rows(table, name, breaths)
    if "breath_id" not in table or column is None:
        raise InputError(
            f"{name}: columns breath_id and {COLUMNS[0]} are needed; it has {', '.join(table)}"
        )
    if column == COLUMNS[-1] and sha256 is not None and sha256 == breaths.sha256:
        raise InputError(f"{name} is the recording itself; it has no column {COLUMNS[0]}")
    used = [key for key in ("breath_id", column, *_TIMES, "R", "C", "u_in") if key in table]
    columns = {key: _numbers(table[key], name, key) for key in used}
    values, times = columns[column], next((columns[k] for k in _TIMES if k in columns), None)
    rows_of = pd.Series(columns["breath_id"]).groupby(columns["breath_id"]).indices
    answers = np.full(breaths.pressure.shape, np.nan)
    for i, number in enumerate(breaths.breath_id.tolist()):
        sampled = breaths.time[i, breaths.valid[i]]
        if number not in rows_of:
            raise InputError(f"{name} has no breath {number} of the recording")
        rows = rows_of[number]
        simulated, at = values[rows], None if times is None else times[rows] - times[rows][0]
        if not np.all(np.isfinite(simulated)):
            raise InputError(
                f"{name}: breath {number} has a blank or infinite {column}; simulate every sample"
            )
        for key in {"R", "C"} & columns.keys():
            if columns[key][rows[0]] != getattr(breaths, key)[i]:
                raise InputError(
                    f"{name}: breath {number} is of {key} {columns[key][rows[0]]:g}, in the "
                    f"recording of lung {breaths.lung_ids[i]}"
                )
        if len(rows) != len(sampled):
            if at is None:
                raise InputError(
                    f"{name}: breath {number} has {len(rows)} rows, the recording {len(sampled)}; "
                    "simulate the recorded samples, or add a column time_step, s"
                )
            simulated = _at_times(simulated, at, sampled, name, number)
        elif "u_in" in columns:
            command = columns["u_in"][rows]
            apart = np.abs(command - breaths.u_in[i, breaths.valid[i]])
            if np.nanmax(apart, initial=0.0) > _SAME_COMMAND:
                k = int(np.nanargmax(apart))
                raise InputError(
                    f"{name}: breath {number} has another command than the recording, u_in "
                    f"{command[k]:g} at sample {k + 1}; simulate the recorded commands"
                )
        answers[i, : len(sampled)], answers[i, len(sampled) :] = simulated, simulated[-1]
    return answers


def _by_rows(table: Columns, name: str, breaths: Breaths) -> Columns:
    """A table whose ids count the rows of the recording, with their breaths."""
    ids = _numbers(table["id"], name, "id")
    rows = int(breaths.valid.sum())
    if len(ids) != rows or len(np.unique(ids)) != rows:
        raise InputError(
            f"{name}: {len(np.unique(ids))} ids are there for the {rows} rows of the recording; "
            "give each row its pressure, or add a column breath_id"
        )
    order = np.argsort(ids)
    numbers = np.repeat(breaths.breath_id, breaths.valid.sum(axis=1))
    return {key: values[order] for key, values in table.items()} | {"breath_id": numbers}


def _at_times(
    values: Floats,
    at: Floats,
    times: Floats,
    file: str,
    number: int,
) -> Floats:
    if len(at) < 2 or not np.all(np.diff(at) > 0):
        raise InputError(f"{file}: the times of breath {number} do not increase")
    if at[-1] < times[-1] - (at[-1] - at[-2]) - 1e-9:
        raise InputError(
            f"{file}: breath {number} ends at {at[-1]:g} s, the recorded one at {times[-1]:g} s; "
            "simulate the whole breath"
        )
    return np.interp(times, at, values)


def _numbers(values: np.ndarray, file: str, name: str) -> Floats:
    try:
        return np.asarray(values, float)
    except (TypeError, ValueError) as error:
        raise InputError(f"{file}, column {name}: not all are numbers ({error})") from None


PAD_LIMIT = 10
"""Largest factor by which padding may enlarge a file in memory."""


@dataclass(frozen=True)
class RecordingReport:
    """The result of `check`."""

    file: str  #: the path as the caller wrote it.
    #: `csv`, `csv.gz` or `parquet`, or None if the file cannot be read.
    kind: str | None = None
    sha256: str | None = None  #: SHA-256 of the file, hex, or None if it cannot be read to its end.
    problems: tuple[RecordingProblem, ...] = ()  #: the first problems, in file order.
    problem_count: int = 0  #: number of all problems.
    warnings: tuple[RecordingProblem, ...] = ()  #: the first warnings.
    warning_count: int = 0  #: number of all warnings.
    #: columns that are not what they are called, though `load` takes the file.
    suspicious: tuple[RecordingProblem, ...] = ()
    rows: int = 0  #: data rows read.
    breaths: int = 0  #: breaths read.
    lengths: tuple[int, int] = (0, 0)  #: smallest and largest number of samples in a breath.
    lungs: dict[str, int] = field(default_factory=dict)  #: breaths for each lung, by R then C.
    #: `min` and `max` between two samples and `p5`, `median`, `p95` of the breaths' mean intervals,
    #: s; empty if no times are known.
    interval: dict[str, float] = field(default_factory=dict)
    #: interval, s, inferred for each breath without times, by breath_id.
    time_inferred: dict[int, float] = field(default_factory=dict)
    time_interpolated: int = 0  #: number of single blank times that are interpolated.
    time_shifted: int = 0  #: number of breaths that are shifted to start at time 0.
    blank_pressures: int = 0  #: number of samples without pressure.
    optional: tuple[str, ...] = ()  #: optional columns in the file.

    @property
    def ok(self) -> bool:
        """Whether `load` takes the file."""
        return self.problem_count == 0

    def to_dict(self) -> dict[str, Any]:
        """JSON values."""
        return msgspec.to_builtins(self, str_keys=True) | {"ok": self.ok}

    def notes(self) -> tuple[str, ...]:
        """What was inferred, changed or ignored, a sentence each."""
        notes = [str(problem) for problem in self.suspicious]
        if self.time_inferred:
            listed = [f"breath {i}: {1e3 * dt:.1f} ms" for i, dt in self.time_inferred.items()]
            notes.append(
                f"{len(listed)} breaths have no times; their sampling interval was inferred "
                f"({few(listed, 10)})."
            )
        if self.time_interpolated:
            notes.append(f"{self.time_interpolated} single blank times were interpolated.")
        if self.time_shifted:
            notes.append(f"{self.time_shifted} breaths were shifted to start at time 0.")
        if self.blank_pressures:
            notes.append(f"{self.blank_pressures} of {self.rows} pressures are blank.")
        if self.lengths[0] != self.lengths[1]:
            notes.append("Breaths have {} to {} samples.".format(*self.lengths))
        notes += [str(warning) for warning in self.warnings]
        if self.warning_count > len(self.warnings):
            notes.append(f"... and {self.warning_count - len(self.warnings)} more warnings.")
        return (*notes, *few_breaths(self.breaths))

    def lines(self) -> list[str]:
        """The report as lines of text."""
        lines = []
        if self.breaths:
            lines.append(f"{self.file}: {self.breaths} breaths, {self.rows} rows ({self.kind})")
            lungs = ", ".join(f"{name} {count}" for name, count in self.lungs.items())
            lines.append(f"breaths for each lung: {lungs}")
        if self.interval:
            ms = {name: f"{1e3 * dt:.1f}" for name, dt in self.interval.items()}
            lines.append(
                f"sampling interval: median {ms['median']} ms (5 % to 95 % of breaths: "
                f"{ms['p5']} to {ms['p95']} ms; single steps {ms['min']} to "
                f"{ms['max']} ms)"
            )
        lines += [f"note: {note}" for note in self.notes()[len(self.suspicious) :]]
        lines += [f"suspicious: {problem}" for problem in self.suspicious]
        lines += [f"error: {problem}" for problem in self.problems]
        if self.problem_count > len(self.problems):
            more = self.problem_count - len(self.problems)
            lines.append(f"... and {more} more problems ({self.problem_count} in all).")
        plural = "s" if self.problem_count > 1 else ""
        if not self.ok:
            lines.append(f"not ok: {self.problem_count} problem{plural}")
        else:
            lines.append(f"suspicious: {len(self.suspicious)}" if self.suspicious else "ok")
        return lines


#: What to do about samples that were left out.
_ADVICE = "They count as missing; --missing VALUE names further values that do."


def role_problems(
    source: Source, scanned: Scanned
) -> tuple[tuple[RecordingProblem, ...], tuple[RecordingProblem, ...]]:
    """What was left out, and what the physics of a lung says about columns: refused, suspicious."""
    shares = left_out(scanned.bad)
    levels: dict[str, list[RecordingProblem]] = {"refused": [], "suspicious": []}
    for samples in reversed(scanned.bad):
        level, advice = "suspicious", _ADVICE
        if shares.get(samples.column, 0.0) > UNUSABLE:
            level, advice = "refused", "That is too much: the recording is unusable."
        places = sorted(x for x, _ in source.locate(samples.rows[:6].tolist()).values())
        message = samples.what(f"{source.place}s", places)
        problem = RecordingProblem(source.file, message, advice, column=samples.column)
        levels[level].append(problem)
    for f in findings(scanned.figures, scanned.interval, scanned.R, scanned.C):
        value = f"{f.value:g}"
        problem = RecordingProblem(source.file, f.what, f.advice, column=f.column, value=value)
        levels[f.level].append(problem)
    return tuple(levels["refused"]), tuple(levels["suspicious"])


def _intervals(scanned: Scanned) -> dict[str, float]:
    steps = scanned.steps[np.isfinite(scanned.steps).all(axis=1)]
    means = scanned.interval[np.isfinite(scanned.interval)]
    if not (len(means) and len(steps)):
        return {}
    figures = [steps.min(), *np.quantile(means, [0.05, 0.5, 0.95]), steps.max()]
    return dict(zip(("min", "p5", "median", "p95", "max"), map(float, figures), strict=True))


def check_lengths(scanned: Scanned, log: ProblemLog, *, pad: bool) -> None:
    """Check that all breaths have as many samples as is most common.

    With ``pad`` they may be shorter, unless padding would need far more memory than the file.
    """
    lengths, ids = scanned.lengths, scanned.breath_id
    if pad:
        longest = int(lengths.max())
        size = longest * len(lengths)
        if size > max(PAD_LIMIT * int(lengths.sum()), 10_000_000):
            at = np.flatnonzero(lengths == longest)[:1]
            message = (
                f"breath {{value}} has {longest} samples, so padding {len(lengths)} breaths to it "
                f"would make {size} samples of {lengths.sum()}"
            )
            advice = "Put breaths of very different lengths into files of their own."
            log.add(scanned.starts[at], "breath_id", message, advice, values=ids[at])
        return
    usual = int(np.bincount(lengths).argmax())
    at = np.flatnonzero(lengths != usual)
    message = f"{len(at)} of {len(lengths)} breaths have not the usual {usual} samples, the first "
    message += "is breath {value}"
    advice = "Fix them, or pass --pad to fill short ones."
    log.add(scanned.starts[at[:1]], "breath_id", message, advice, values=ids[at])


def check_inferable(scanned: Scanned, log: ProblemLog) -> None:
    """Check that the interval of every breath without times can be inferred."""
    for at in (i for i, dt in scanned.inferred.items() if np.isnan(dt)):
        message = (
            f"the times of breath {scanned.breath_id[at]} are blank and cannot be inferred: no "
            "breath of the file has times, and u_out does not switch from 0 to 1 in this one"
        )
        advice = "Fill in time_step, in seconds."
        log.add(scanned.starts[at : at + 1], "time_step", message, advice)


#: Environment variable that names the folder of public recordings.
VARIABLE = "VENTBENCH_RECORDINGS"

FilePath = str | os.PathLike[str]

#: What a session on a bench calls its recording.
SESSION = "recording.csv.gz"


def load(
    path: FilePath | pd.DataFrame | Breaths,
    *,
    clip: bool = False,
    pad: bool = False,
    missing: Collection[float] = (),
    progress: Progress | None = None,
) -> Breaths:
    """Read a recording (CSV, gzipped CSV or Parquet) into memory.

    Args:
        path: the file; the folder of a session, whose recordings become one; or a table in memory
            with the same columns, such as :meth:`~ventbench.Breaths.to_frame` returns. Of Breaths
            only samples that are no readings are left out, see :mod:`~.bad_samples`.
        clip: clip u_in to 0..100 %.
        pad: accept breaths of unequal length and pad the short ones (see `Breaths`).
        missing: values of pressure, flow and volume that stand for a missing one, such as -99.
        progress: called with how much has been read, and of how much.

    Returns:
        All breaths; `notes` says what was inferred, interpolated or ignored.

    Raises:
        RecordingError: if the file cannot be used; the error carries its problems.
        InputTypeError: if ``path`` is of another type.

    Examples:
        >>> import ventbench
        >>> breaths = ventbench.load_recording(ventbench.example("concealed"))
        >>> breaths.pressure.shape, list(breaths.by_lung_index)
        ((24, 80), ['R20C50'])
    """
    if isinstance(path, Breaths):
        return clean(path, missing)
    if isinstance(path, str | os.PathLike) and Path(path).is_dir():
        first, *further = session_files(path)
        if further:
            return _joined((first, *further), clip, missing, progress)
        path = first
    source = open_source(path)
    log, scanned = _scanned(source, pad=pad, clip=clip, missing=missing, progress=progress)
    log.raise_problems()
    notes = _report(log, scanned, refuse=False).notes()
    breaths = _assemble(scanned, source.file)
    file = None if source.kind == "table" else source.file
    return replace(breaths, source=file, sha256=source.sha256, notes=notes)


def session_files(path: FilePath) -> tuple[Path, ...]:
    """The recordings of a session: those of a folder, by name; or the file itself.

    Args:
        path: a file, or a folder of recordings; that of a session on a bench has one.

    Raises:
        InputError: if a folder has none.
    """
    folder = Path(path)
    if not folder.is_dir():
        return (folder,)
    if (folder / SESSION).is_file():
        return (folder / SESSION,)
    files = (file for file in folder.iterdir() if file.name.endswith(SUFFIXES))
    if not (recordings_found := tuple(sorted(files))):
        raise InputError(
            f"{folder} has no recording; name a file, or a folder with some (`ventbench data "
            "import` reads a bag of ROS)"
        )
    return recordings_found


def _joined(
    files: tuple[Path, ...], clip: bool, missing: Collection[float], progress: Progress | None
) -> Breaths:
    """The breaths of a session, numbered in the order of its files; short ones are padded."""
    parts, first = [], 1
    for file in files:
        part = load(file, clip=clip, pad=True, missing=missing, progress=progress)
        last = first + len(part) - 1
        notes = (f"Breaths {first} to {last} are those of {file.name}.", *part.notes)
        parts.append(replace(part, breath_id=np.arange(first, last + 1), notes=notes))
        first = last + 1
    return replace(join(parts), source=str(files[0].parent))


def check(
    path: FilePath,
    *,
    clip: bool = False,
    pad: bool = False,
    missing: Collection[float] = (),
    progress: Progress | None = None,
) -> RecordingReport:
    """Check a recording.

    Args:
        path: the file.
        clip: see `load`.
        pad: see `load`.
        missing: see `load`.
        progress: see `load`.

    Returns:
        What the file holds and what is wrong with it; also for a file that cannot be read. A file
        without pressure, or whose columns are surely not what they are called, is reported as a
        problem, though `load` takes it.
    """
    source: Source | None = None
    options: dict[str, Any] = {"clip": clip, "missing": missing, "progress": progress}
    try:
        source = open_source(path)
        log, scanned = _scanned(source, pad=pad, keep=False, **options)
    except RecordingError as error:
        kind = source.kind if source else None
        warnings = source.warnings if source else ()
        return RecordingReport(
            str(path),
            kind,
            problems=error.problems,
            problem_count=error.total,
            warnings=warnings,
            warning_count=len(warnings),
        )
    return _report(log, scanned, refuse=True)


def _scanned(source: Source, *, pad: bool, **options: Any) -> tuple[ProblemLog, Scanned]:
    """Read a file, and check each row and the whole."""
    log = ProblemLog(source)
    scanned = scan(log, **options)
    check_lengths(scanned, log, pad=pad)
    check_inferable(scanned, log)
    return log, scanned


def _report(log: ProblemLog, scanned: Scanned, *, refuse: bool) -> RecordingReport:
    """What a file holds, and what is wrong; ``refuse`` makes unusable columns problems."""
    source, lengths = log.source, scanned.lengths
    problems, count, rows = log.listed("problem"), log.counts["problem"], int(lengths.sum())
    blank = rows - int(scanned.figures["pressure_count"].sum())
    refused, suspicious = ((), ()) if count else role_problems(source, scanned)
    if refuse and not count:
        if blank == rows:
            message = f"all {rows} pressures are blank"
            advice = "Fill in the pressure in cmH2O: there is nothing to compare a simulator with."
            refused = (RecordingProblem(source.file, message, advice, column="pressure"),)
        problems, count = refused, len(refused)
    elif not refuse:
        suspicious = (*refused, *suspicious)
    pairs, counts = np.unique(np.column_stack([scanned.R, scanned.C]), axis=0, return_counts=True)
    return RecordingReport(
        source.file,
        source.kind,
        source.sha256,
        problems,
        count,
        source.warnings + log.listed("warning"),
        len(source.warnings) + log.counts["warning"],
        suspicious,
        rows,
        breaths=len(lengths),
        lengths=(int(lengths.min()), int(lengths.max())),
        lungs={Lung(*pair).id: int(n) for pair, n in zip(pairs.tolist(), counts, strict=True)},
        interval=_intervals(scanned),
        time_inferred={
            int(scanned.breath_id[i]): dt for i, dt in scanned.inferred.items() if np.isfinite(dt)
        },
        time_interpolated=int(scanned.time_interpolated.sum()),
        time_shifted=int(scanned.time_shifted.sum()),
        blank_pressures=blank,
        optional=tuple(name for name in OPTIONAL if name in source.names),
    )


def _assemble(scanned: Scanned, file: str) -> Breaths:
    """Make breaths without problems; blank times are inferred."""
    samples = dict(scanned.samples)
    time = samples.pop("time").copy()
    for i, dt in scanned.inferred.items():
        start, length = scanned.starts[i], scanned.lengths[i]
        time[start : start + length] = dt * np.arange(length)
    return arranged(
        scanned.lengths,
        time,
        samples,
        breath_id=scanned.breath_id,
        R=scanned.R,
        C=scanned.C,
        time_inferred=scanned.time_blank,
        source=file,
        left_out=left_out(scanned.bad),
    )


def recordings_dir() -> Path | None:
    """Find the folder of public recordings, which are never part of the checkout.

    Returns:
        The folder that the environment variable `VENTBENCH_RECORDINGS` names. If it is not set, the
        first `shared/recordings` in the current folder, the checkout, or a folder above them. None
        if there is no such folder.
    """
    named = os.environ.get(VARIABLE)
    if named:
        return Path(named) if Path(named).is_dir() else None
    for base in (Path.cwd(), Path(__file__).resolve().parents[2]):
        for above in (base, *base.parents):
            folder = above / "shared" / "recordings"
            if folder.is_dir():
                return folder
    return None
