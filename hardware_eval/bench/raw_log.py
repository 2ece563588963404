"""The raw recording: JSON lines, only ever appended to, on the disk after every breath.

A crash, a power cut or ``kill -9`` loses at most the breath under way. A line that was cut off by
one stays where it is; the next session says so in the line that follows, and readers skip it.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from hardware_eval.bench.loop import BreathLog
from hardware_eval.bench.plan import LogLine, Plan, PlannedRun, complete_runs, make_plan, progress
from ventbench.base.errors import InputError
from ventbench.recordings.breaths import Breaths, make_breaths, write
from ventbench.task.lungs import LUNG_IDS
from ventbench.task.lungs import lung as parse_lung

#: Files of a session or a collection in its folder.
LOG, RECORDING = "raw.jsonl", "recording.csv.gz"

#: First line of every log.
FORMAT = "ventbench-hardware-log-1"

#: What follows a line that was cut off.
_CUT = {"type": "cut_off"}


class RawLog:
    """Appends to a log.

    Args:
        path: of the file; its folder is made if missing.

    Raises:
        InputError: if another process appends to it, or it is no log.
    """

    def __init__(self, path: Path) -> None:
        import fcntl

        path.parent.mkdir(parents=True, exist_ok=True)
        self.path = path
        self._file = open(path, "ab+")  # noqa: SIM115 - it stays open as long as the log
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            self._file.close()
            raise InputError(
                f"{path} is being written by another session; end that first"
            ) from None
        if not self._file.seek(0, os.SEEK_END):
            self.append({"type": "log", "format": FORMAT})
            return
        self._file.seek(-1, os.SEEK_END)
        if self._file.read(1) != b"\n":  # it was cut off
            self._file.write(b"\n")
            self.append(_CUT)

    def append(self, line: LogLine) -> None:
        """Append one line and wait until it is on the disk; an OSError names the file."""
        try:
            self._file.write(json.dumps(line, separators=(",", ":")).encode() + b"\n")
            self._file.flush()
            os.fsync(self._file.fileno())
        except OSError as error:
            error.filename = str(self.path)
            raise

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __enter__(self) -> RawLog:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def log_of(session: Path) -> Path:
    """The log of a session, which is named by its folder or by the log itself.

    Raises:
        InputError: if it is not there.
    """
    path = session / LOG if session.is_dir() else session
    if not path.is_file():
        raise InputError(f"{path} is not there: give the folder of a session")
    return path


def lines(path: Path) -> list[LogLine]:
    """Read a log; a line that was cut off is left out.

    Raises:
        InputError: if it is no log, or a line is damaged otherwise.
        OSError: if it cannot be read.
    """
    with open(path, "rb") as file:
        raw = file.read().split(b"\n")
    complete, tail, read = raw[:-1], raw[-1], list[LogLine]()
    for number, text in enumerate(complete):
        try:
            line = json.loads(text)
        except ValueError:
            after = complete[number + 1] if number + 1 < len(complete) else b""
            if after == json.dumps(_CUT, separators=(",", ":")).encode():
                continue
            raise InputError(
                f"{path} line {number + 1} is damaged and was not cut off by a crash; restore the "
                "file from a copy"
            ) from None
        if number == 0 and (not isinstance(line, dict) or line.get("format") != FORMAT):
            raise InputError(f"{path} is no log of ventbench-hardware")
        if line != _CUT:
            read.append(line)
    if not complete and tail:
        raise InputError(f"{path} is no log of ventbench-hardware")
    return read


@dataclass(frozen=True, eq=False)
class LoggedBreath:
    """One breath of a log."""

    run: PlannedRun  #: what ran.
    attempt: int  #: how often the run had been begun before, from 0.
    breath: int  #: its place in the run, from 0.
    complete: bool  #: whether its run was finished, no check had tripped, and it can be scored.
    log: BreathLog  #: what happened.


@dataclass(frozen=True)
class Session:
    """What the log of a plan says, of all of its sessions."""

    path: Path  #: of the log.
    logged: list[LogLine]  #: its lines.
    plan: Plan  #: what was to run.

    @cached_property
    def breaths(self) -> list[LoggedBreath]:
        """All breaths, in order."""
        return breaths(self.logged)

    @cached_property
    def ended(self) -> list[LogLine]:
        """Last lines of runs that need not run again, failed or complete."""
        complete = complete_runs(self.logged)
        return [
            line
            for line in self.of_type("run")
            if line["status"] == "failed" or (line["run"], line["attempt"]) in complete
        ]

    @property
    def left(self) -> list[PlannedRun]:
        """Runs that are still to do."""
        return progress(self.plan, self.logged)[0]

    @property
    def lungs(self) -> list[str]:
        """Lungs of the plan, in the protocol's order."""
        return [lung for lung in LUNG_IDS if lung in self.plan.lungs]

    def of_type(self, kind: str, /, **about: Any) -> list[LogLine]:
        """Lines of a type, with these values."""
        wanted = {"type": kind, **about}.items()
        return [line for line in self.logged if all(line.get(k) == v for k, v in wanted)]

    @property
    def about(self) -> LogLine:
        """The last session's line: device, operator, notes."""
        return self.of_type("session")[-1]


def read_session(folder: Path) -> Session:
    """Read a session's folder, or its log.

    Raises:
        InputError: if there is no log, or it holds no plan.
    """
    path = log_of(folder)
    logged = lines(path)
    for line in logged:
        if line["type"] == "plan":
            return Session(path, logged, make_plan(**line["plan"]))
    raise InputError(f"{path} holds no plan: no session has begun")


def breaths(logged: list[LogLine]) -> list[LoggedBreath]:
    """All breaths of a log's lines, in order."""
    finished = complete_runs(logged)
    return [
        LoggedBreath(
            PlannedRun.of_line(line),
            line["attempt"],
            line["breath"],
            (line["run"], line["attempt"]) in finished,
            BreathLog.of_line(line),
        )
        for line in logged
        if line["type"] == "breath"
    ]


def write_recording(folder: Path, kinds: Sequence[str]) -> Breaths:
    """Write the recording of a folder's log, which is returned; see :func:`recording`."""
    taken = recording(folder / LOG, kinds)
    write(taken, folder / RECORDING)
    return taken


def recording(path: Path, kinds: Sequence[str]) -> Breaths:
    """Breaths of a log as a recording in the public schema.

    Args:
        path: of the log.
        kinds: kinds of runs that are taken.

    Returns:
        Breaths of equally many samples, those of most breaths: without what a check cut short or
        what begins without a reading; later readings that are missing are blank.

    Raises:
        InputError: if there is no such breath.
    """
    taken = [b for b in breaths(lines(path)) if b.run.kind in kinds and len(b.log.time) > 1]
    lengths = [len(b.log.time) for b in taken]
    usual = max(set(lengths), key=lengths.count, default=0)
    taken = [b for b in taken if len(b.log.time) == usual and math.isfinite(b.log.pressure[0])]
    if not taken:
        raise InputError(f"{path} holds no whole breath of {', '.join(kinds)}")
    labels = [parse_lung(b.run.lung) for b in taken]

    def stacked(name: str) -> np.ndarray:
        return np.array([getattr(b.log, name) for b in taken], float)

    time, flow = stacked("time"), stacked("flow")
    return make_breaths(
        np.arange(len(taken)) + 1,
        [x.R for x in labels],
        [x.C for x in labels],
        time - time[:, :1],
        np.clip(stacked("u_in"), 0.0, 100.0),
        stacked("u_out"),
        stacked("pressure"),
        flow=flow if np.isfinite(flow[np.isfinite(stacked("pressure"))]).all() else None,
    )
