"""Recordings of the RespiraWorks ventilator: another schema, 100 Hz; the mechanics of each run.

Its valves are not those of the ventilator that ventbench simulates: its commands are kept as they
are and not converted to u_in and u_out. Lung mechanics follow from pressure and flow.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ventbench.mechanics.identify import Mechanics, identify, share_faults
from ventbench.mechanics.labels import label_texts, value_text
from ventbench.recordings.breaths import Breaths, arranged
from ventbench.recordings.schema import fail
from ventbench.recordings.sources import kind_of

#: Signals of a run and their units.
SIGNALS = {"pressure": "cmH2O", "flow": "mL/s", "volume": "mL", "target": "cmH2O"} | dict.fromkeys(
    ("cmd_inh_valve", "cmd_exh_valve", "cmd_psol", "dp_inhale", "dp_exhale"), "as logged"
)
_LABELS = ("run", "test", "breath", "time_step", "R", "C", "drive")

#: Shortest breath that is kept, s.
_SHORTEST = 0.5

#: Start of a breath before its inspiration, s, so that the breath includes the whole steep rise.
_LEAD = 0.25


@dataclass(frozen=True, eq=False)
class RespiraWorksRun:
    """One test of one day: consecutive breaths on one lung."""

    name: str  #: name of the test day or gas supply.
    test: int  #: number of the ISO test condition.
    drive: str  #: source of the gas, such as a blower.
    R: float  #: resistance that the operators noted, cmH2O/(L/s).
    C: float  #: compliance that the operators noted, mL/cmH2O.
    breath: np.ndarray  #: number of each sample's breath, int64, (T,).
    time: np.ndarray  #: s, float64, (T,).
    #: signals by the names of `SIGNALS`, float64, NaN where not logged, each (T,).
    signals: dict[str, np.ndarray]


def load_respiraworks(path: str | os.PathLike[str]) -> tuple[RespiraWorksRun, ...]:
    """Read the runs of a RespiraWorks Parquet file, in its order.

    Raises:
        RecordingError: if the file cannot be read, lacks a column, or its times do not increase.
    """
    import pyarrow as pa
    from pyarrow import parquet

    name = str(path)
    if kind_of(path) != "parquet":
        raise fail(name, "this is not a Parquet file", "RespiraWorks recordings are Parquet.")
    try:
        frame = parquet.read_table(name).to_pandas()
    except (pa.ArrowException, OSError) as error:
        raise fail(name, f"the Parquet file cannot be read ({error})", "Copy it again.") from None
    missing = [column for column in (*_LABELS, *SIGNALS) if column not in frame.columns]
    if missing:
        advice = "Name a RespiraWorks file; other recordings are read with load."
        raise fail(name, f"missing columns {', '.join(missing)}", advice)
    runs = []
    for (run, test), rows in frame.groupby(["run", "test"], sort=False):
        time = rows["time_step"].to_numpy(np.float64)
        if not (np.diff(time) > 0.0).all():
            what = f"time_step does not increase in run {run}, test {test}"
            raise fail(name, what, "Write the file again in time order.")
        signals = {column: rows[column].to_numpy(np.float64) for column in SIGNALS}
        first = rows.iloc[0]
        label, breath = (float(first["R"]), float(first["C"])), rows["breath"].to_numpy(np.int64)
        drive = str(first["drive"])
        runs.append(RespiraWorksRun(str(run), int(str(test)), drive, *label, breath, time, signals))
    return tuple(runs)


@dataclass(frozen=True, eq=False)
class SurveyedRun:
    """A run and the mechanics of its lung."""

    run: RespiraWorksRun  #: the run as recorded.
    mechanics: Mechanics | None  #: None if the run has neither flow nor volume.


def breaths_of(run: RespiraWorksRun) -> Breaths:
    """Split a run into breaths; breaths shorter than 0.5 s are left out.

    Commands of this ventilator's valves are unknown: u_in is 0, and u_out is 1 where the target is
    in the lower half of its range. Signals that were never logged are None.
    """
    edges = np.flatnonzero(np.diff(run.breath)) + 1
    edges = np.searchsorted(run.time, run.time[edges] - _LEAD)
    pieces = np.split(np.arange(len(run.time)), edges)
    pieces = [p for p in pieces if len(p) and run.time[p[-1]] - run.time[p[0]] >= _SHORTEST]
    lengths = np.array([len(p) for p in pieces])
    rows = np.concatenate(pieces)
    target = run.signals["target"]
    shut = target > 0.5 * (np.nanmin(target) + np.nanmax(target))
    samples = {"u_in": np.zeros(len(rows)), "u_out": (~shut[rows]).astype(np.int8)}
    samples["pressure"] = run.signals["pressure"][rows]
    for name in ("flow", "volume"):
        if np.isfinite(run.signals[name]).any():
            samples[name] = run.signals[name][rows]
    starts = np.concatenate([run.time[p] - run.time[p[0]] for p in pieces])
    ids, n = np.array([run.breath[p[-1]] for p in pieces]), len(pieces)
    R, C = np.full(n, run.R), np.full(n, run.C)
    return arranged(lengths, starts, samples, breath_id=ids, R=R, C=C)


def survey(
    path: str | os.PathLike[str], progress: Callable[[int, int], object] | None = None
) -> tuple[SurveyedRun, ...]:
    """Identify the lung of every run of a RespiraWorks file; the runs of a day are one session.

    Args:
        path: the file.
        progress: called with how many runs have been identified and how many there are.

    Raises:
        RecordingError: if the file cannot be read.
    """
    found: list[Mechanics | None] = []
    runs = load_respiraworks(path)
    for run in runs:
        breaths = breaths_of(run)
        measured = breaths.flow is not None or breaths.volume is not None
        found.append(identify(breaths)[0] if measured else None)
        if progress is not None:
            progress(len(found), len(runs))
    for day in {run.name for run in runs}:
        own = {i: lung for i, lung in enumerate(found) if lung and runs[i].name == day}
        for i, lung in zip(own, share_faults(list(own.values())), strict=True):
            found[i] = lung
    return tuple(map(SurveyedRun, runs, found))


def survey_table(surveyed: tuple[SurveyedRun, ...]) -> str:
    """Return a Markdown table with one run a line."""
    lines = [
        "| day or gas | test | label | R at its flow | C | label holds | may be | also needs |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for entry in surveyed:
        run, lung = entry.run, entry.mechanics
        head = f"| {run.name} | {run.test} | R{run.R:g}C{run.C:g} |"
        if lung is None:
            lines.append(f"{head} | | no flow, no volume | | |")
            continue
        match = lung.match
        R, C = value_text(match.fitted_R, match.ci95_R), value_text(match.fitted_C, match.ci95_C)
        holds, may = label_texts(match)
        needs = ", ".join(term.name for term in lung.terms)
        holds = "**no**" if holds == "no" else holds
        lines.append(f"{head} {R} | {C} | {holds} | {may} | {needs} |")
    return "\n".join(lines)
