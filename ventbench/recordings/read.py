"""Reading recordings: whole, or only to check; and tables of simulated pressures."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ventbench.base.arrays import Floats
from ventbench.base.errors import InputError
from ventbench.recordings.breaths import Breaths, arranged
from ventbench.recordings.report import (
    RecordingReport,
    check_inferable,
    check_lengths,
    describe,
    role_problems,
)
from ventbench.recordings.scan import Progress, Scanned, scan
from ventbench.recordings.schema import ProblemLog, RecordingError, RecordingProblem
from ventbench.recordings.sources import Source, locate, open_source

if TYPE_CHECKING:
    import pandas as pd

#: Names of the column of simulated pressures, in the order in which they are looked for.
COLUMNS = ("simulated", "simulated_pressure", "pressure_simulated", "pressure")

#: Commands of a table may differ from the recorded ones by rounding, %.
_SAME_COMMAND = 0.05

#: Names of the column of times.
_TIMES = ("time_step", "time")


def simulated_pressures(
    table: Mapping[str, np.ndarray], name: str, breaths: Breaths, *, sha256: str | None = None
) -> Floats:
    """Simulated pressures of recorded breaths.

    Rows of a breath are in time order. If it has another number of them than the recording, its
    pressures are interpolated at the recorded times; commands never are.

    Args:
        table: columns by name: ``breath_id`` and one of :data:`COLUMNS` (``simulated`` if recorded
            pressures stand beside it). It may have ``time_step``; ``R``, ``C`` and ``u_in`` must be
            those of the recording.
        name: what messages call the table.
        breaths: n recorded breaths of T samples.
        sha256: hash of the table's file, by which it is known from that of the recording.

    Returns:
        cmH2O, ``(n, T)``; padding repeats the last value.

    Raises:
        InputError: if a column or a breath is missing, the rows do not cover a breath, or they are
            those of another lung or command.
    """
    names = [column for column in COLUMNS if column in table]
    if "breath_id" not in table or not names:
        raise InputError(
            f"{name}: columns breath_id and {COLUMNS[0]} are needed; it has {', '.join(table)}"
        )
    column = names[0]
    if column == COLUMNS[-1] and sha256 is not None and sha256 == breaths.sha256:
        raise InputError(f"{name} is the recording itself; it has no column {COLUMNS[0]}")
    values = _numbers(table[column], name, column)
    times = next((_numbers(table[key], name, key) for key in _TIMES if key in table), None)
    given = {key: _numbers(table[key], name, key) for key in ("R", "C", "u_in") if key in table}
    ids = _numbers(table["breath_id"], name, "breath_id")
    order = np.argsort(ids, kind="stable")
    starts = np.searchsorted(ids[order], breaths.breath_id)
    ends = np.searchsorted(ids[order], breaths.breath_id, side="right")
    answers = np.full(breaths.pressure.shape, np.nan)
    for i, number in enumerate(breaths.breath_id.tolist()):
        rows = order[starts[i] : ends[i]]
        wanted = breaths.time[i, breaths.valid[i]]
        if len(rows) == 0:
            raise InputError(f"{name} has no breath {number} of the recording")
        own, at = values[rows], None if times is None else times[rows] - times[rows][0]
        if not np.all(np.isfinite(own)):
            raise InputError(
                f"{name}: breath {number} has a blank or infinite {column}; simulate every sample"
            )
        for key in set(given) - {"u_in"}:
            if given[key][rows[0]] != getattr(breaths, key)[i]:
                raise InputError(
                    f"{name}: breath {number} is of {key} {given[key][rows[0]]:g}, in the "
                    f"recording of lung {breaths.lung_ids[i]}"
                )
        if len(rows) != len(wanted):
            if at is None:
                raise InputError(
                    f"{name}: breath {number} has {len(rows)} rows, the recording {len(wanted)}; "
                    "simulate the recorded samples, or add a column time_step, s"
                )
            own = _at_times(own, at, wanted, name, number)
        elif "u_in" in given:
            command = given["u_in"][rows]
            apart = np.abs(command - breaths.u_in[i, breaths.valid[i]])
            if np.nanmax(apart, initial=0.0) > _SAME_COMMAND:
                k = int(np.nanargmax(apart))
                raise InputError(
                    f"{name}: breath {number} has another command than the recording, u_in "
                    f"{command[k]:g} at sample {k + 1}; simulate the recorded commands"
                )
        answers[i, : len(wanted)], answers[i, len(wanted) :] = own, own[-1]
    return answers


def _at_times(
    values: Floats, at: Floats, wanted: Floats, file: str,
    number: int,
) -> Floats:  # fmt: skip
    if len(at) < 2 or not np.all(np.diff(at) > 0):
        raise InputError(f"{file}: the times of breath {number} do not increase")
    if at[-1] < wanted[-1] - (at[-1] - at[-2]) - 1e-9:
        raise InputError(
            f"{file}: breath {number} ends at {at[-1]:g} s, the recorded one at {wanted[-1]:g} s; "
            "simulate the whole breath"
        )
    return np.interp(wanted, at, values)


def read_simulated(path: Path) -> dict[str, np.ndarray]:
    """Columns of a table of simulated pressures by name, of CSV, gzipped CSV or Parquet.

    Raises:
        InputError: if it cannot be read.
    """
    import pyarrow as pa
    from pyarrow import csv, parquet

    try:
        if path.suffix in (".parquet", ".pq"):
            table = parquet.read_table(path)
        else:
            table = csv.read_csv(path)
    except (pa.ArrowException, OSError) as error:
        raise InputError(f"{path}: it cannot be read: {str(error).splitlines()[0]}") from None
    return {name: table.column(name).to_numpy() for name in dict.fromkeys(table.column_names)}


def _numbers(values: np.ndarray, file: str, name: str) -> Floats:
    try:
        return np.asarray(values, float)
    except (TypeError, ValueError) as error:
        raise InputError(f"{file}, column {name}: not all are numbers ({error})") from None


#: Environment variable that names the folder of public recordings.
VARIABLE = "VENTBENCH_RECORDINGS"

FilePath = str | os.PathLike[str]

#: What a session on a bench calls its recording, and how the names of recordings end.
SESSION, _SUFFIXES = "recording.csv.gz", (".csv", ".csv.gz", ".parquet", ".pq")


def load(
    path: FilePath | pd.DataFrame | Breaths,
    *,
    clip: bool = False,
    pad: bool = False,
    progress: Progress | None = None,
) -> Breaths:
    """Read a recording (CSV, gzipped CSV or Parquet) into memory.

    Args:
        path: the file; the folder of a session, whose recordings become one; or a table in memory
            with the same columns, such as :meth:`~ventbench.Breaths.to_frame` returns. Breaths are
            returned as they are.
        clip: clip u_in to 0..100 %.
        pad: accept breaths of unequal length and pad the short ones (see `Breaths`).
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
        return path
    if isinstance(path, str | os.PathLike) and Path(path).is_dir():
        first, *others = session_files(path)
        if others:
            return _joined((first, *others), clip=clip, progress=progress)
        path = first
    source = open_source(path)
    log = ProblemLog(source.file)
    scanned = scan(source, log, clip=clip, progress=progress)
    _check_whole(scanned, log, pad=pad)
    log.raise_problems(partial(locate, source), source.place)
    notes = _report(source, log, scanned).notes()
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
    files = (file for file in folder.iterdir() if file.name.endswith(_SUFFIXES))
    if not (found := tuple(sorted(files))):
        raise InputError(f"{folder} has no recording; name a file, or a folder with some")
    return found


def _joined(files: tuple[Path, ...], *, clip: bool, progress: Progress | None) -> Breaths:
    """The breaths of a session, numbered in the order of its files; short ones are padded."""
    import pandas as pd

    frames, notes, first = [], [], 1
    for file in files:
        part = load(file, clip=clip, pad=True, progress=progress)
        last = first + len(part) - 1
        notes += [f"Breaths {first} to {last} are those of {file.name}.", *part.notes]
        frames.append(replace(part, breath_id=np.arange(first, last + 1)).to_frame())
        first = last + 1
    whole = load(pd.concat(frames, ignore_index=True), pad=True)
    return replace(whole, source=str(files[0].parent), notes=tuple(notes))


def check(
    path: FilePath, *, clip: bool = False, pad: bool = False, progress: Progress | None = None
) -> RecordingReport:
    """Check a recording.

    Args:
        path: the file.
        clip: see `load`.
        pad: see `load`.
        progress: see `load`.

    Returns:
        What the file holds and what is wrong with it; also for a file that cannot be read. A file
        without pressure, or whose columns are surely not what they are called, is reported as a
        problem, though `load` takes it.
    """
    log = ProblemLog(str(path))
    source: Source | None = None
    try:
        source = open_source(path)
        scanned = scan(source, log, clip=clip, progress=progress)
        _check_whole(scanned, log, pad=pad)
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
    report = _report(source, log, scanned)
    if not report.ok:
        return report
    if report.blank_pressures == report.rows:
        what = f"all {report.rows} pressures are blank"
        advice = "Fill in the pressure in cmH2O: there is nothing to compare a simulator with."
        refused = (RecordingProblem(source.file, what, advice, column="pressure"),)
    else:
        refused = role_problems(source.file, scanned)["refused"]
    suspicious = tuple(found for found in report.suspicious if found not in refused)
    return replace(report, problems=refused, problem_count=len(refused), suspicious=suspicious)


def _check_whole(scanned: Scanned, log: ProblemLog, *, pad: bool) -> None:
    check_lengths(scanned, log, pad=pad)
    check_inferable(scanned, log)


def _report(source: Source, log: ProblemLog, scanned: Scanned) -> RecordingReport:
    find = partial(locate, source)
    sound = log.counts["problem"] == 0
    roles = role_problems(source.file, scanned) if sound else {}
    warnings = source.warnings + log.listed("warning", find, source.place)
    return RecordingReport(
        source.file,
        source.kind,
        source.sha256,
        log.listed("problem", find, source.place),
        log.counts["problem"],
        warnings,
        len(source.warnings) + log.counts["warning"],
        roles.get("refused", ()) + roles.get("suspicious", ()),
        **describe(scanned),
    )


def _assemble(scanned: Scanned, file: str) -> Breaths:
    """Make breaths without problems; blank times are inferred."""
    time = scanned.times.time.copy()
    for i, dt in scanned.inferred.items():
        assert dt is not None  # check_inferable
        start, length = scanned.starts[i], scanned.lengths[i]
        time[start : start + length] = dt * np.arange(length)
    return arranged(
        scanned.lengths, time, scanned.samples, breath_id=scanned.breath_id, R=scanned.R,
        C=scanned.C, time_inferred=scanned.times.blank, source=file,
    )  # fmt: skip


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
