"""The runs of the RespiraWorks recordings as breaths, and the mechanics of each run."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ventbench.mechanics.identify import Mechanics, identify, share_faults
from ventbench.mechanics.labels import label_texts, value_text
from ventbench.recordings.breaths import FILL, Breaths, stack, stack_times, valid_mask
from ventbench.recordings.respiraworks import RespiraWorksRun, load_respiraworks

#: Shortest breath that is kept, s.
_SHORTEST = 0.5

#: Start of a breath before its inspiration, s, so that the breath includes the whole steep rise.
_LEAD = 0.25


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
    arrays = {name: stack(values, lengths, FILL[name]) for name, values in samples.items()}
    starts = np.concatenate([run.time[p] - run.time[p[0]] for p in pieces])
    time, dt = stack_times(starts, lengths)
    n = len(pieces)
    return Breaths(
        breath_id=np.array([run.breath[p[-1]] for p in pieces]), R=np.full(n, run.R),
        C=np.full(n, run.C), time=time, dt=dt, valid=valid_mask(lengths),
        time_inferred=np.zeros(n, bool), u_in=arrays["u_in"], u_out=arrays["u_out"],
        pressure=arrays["pressure"], flow=arrays.get("flow"), volume=arrays.get("volume"),
    )  # fmt: skip


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
        holds, may = label_texts(match, lung.settings)
        needs = ", ".join(term.name for term in lung.terms)
        holds = "**no**" if holds == "no" else holds
        lines.append(f"{head} {R} | {C} | {holds} | {may} | {needs} |")
    return "\n".join(lines)
