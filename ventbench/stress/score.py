"""The stress score: every run under every condition, beside the same run without a stressor.

:mod:`ventbench.stress.results` says what the figures are.
"""

from __future__ import annotations

import dataclasses
import html
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ventbench.base import files
from ventbench.entries.errors import Failure, SubmissionError
from ventbench.entries.folder import Submission, as_submission
from ventbench.entries.result import package_versions
from ventbench.entries.runner import (
    CountingRunner,
    InProcessRunner,
    Progress,
    Runner,
    runner_of,
)
from ventbench.plants.catalog import Given
from ventbench.plants.rigs import load_rigs
from ventbench.stress.results import DRAWS, StressTables
from ventbench.stress.run import TRACK, StressDraws, StressRun, draw_cells, step_through
from ventbench.stress.stressors import VERSION, Condition, conditions, stressor
from ventbench.task import protocol
from ventbench.task.draws import Draws
from ventbench.task.metrics.figures import time_above_alarm
from ventbench.task.metrics.score import passes_safety_gate, run_error
from ventbench.task.metrics.step_response import steady_error

if TYPE_CHECKING:
    import pandas as pd

Floats = NDArray[np.float64]

#: Tolerance of the plateau, cmH2O and share of PIP: "2 cmH2O + 4 % of the actual reading", as data
#: sheets of intensive-care ventilators declare for airway pressure.
PLATEAU_TOLERANCE, PLATEAU_SHARE = 2.0, 0.04

#: Conditions that a printed score shows, the worst first.
_SHOWN = 10


@dataclass(frozen=True, eq=False, repr=False)
class StressScore(StressTables):
    """Result of one submission on the stress track; S conditions, L lungs, n draws.

    ``print(score)`` shows the conditions that cost most. Errors, safety and survival are those of
    :class:`~ventbench.stress.results.StressTables`.

    Attributes:
        submission: what was scored.
        drawn: the draws: rig and member of each lung and draw.
        plateau_error: |mean of the last 0.3 s - PIP| of the last breath, cmH2O, ``(S, L, n)``.
        requested: all commands, %, ``(S, L, n, BREATHS, INSPIRATION_STEPS)``.
        failures: what failed, by (condition, lung, draw).
        sandbox: the runner's layers; None in this process.
        simulators: what is known of the plants.
        timing: seconds, by name.
    """

    submission: Submission
    drawn: Draws
    plateau_error: Floats
    requested: Floats
    failures: Mapping[tuple[int, int, int], Failure]
    sandbox: Mapping[str, Any] | None
    simulators: Mapping[str, Any] | None
    timing: Mapping[str, float]

    track = TRACK

    def to_frame(self) -> pd.DataFrame:
        """One row a run: condition, severity, lung, PIP, draw and all figures."""
        import pandas as pd

        shape = self.error.shape
        s, lung, draw = (axis.ravel() for axis in np.indices(shape))
        return pd.DataFrame(
            {
                "condition": np.array([c.id for c in self.conditions])[s],
                "lung": np.array(self.lungs)[lung],
                "pip_cmH2O": self.pips[lung, draw],
                "rig": self.rig[lung, draw],
                "member": self.member[lung, draw],
                "draw": draw + 1,
                "error_cmH2O": self.error.ravel(),
                "rise_cmH2O": self.rise.ravel(),
                "plateau_error_cmH2O": self.plateau_error.ravel(),
                "survived": self.survived.ravel(),
                "safe": self.safe.ravel(),
                "above_alarm_s": self.alarm_s.ravel(),
                "peak_cmH2O": self.peak.ravel(),
                "volume_mL": self.volume.ravel(),
                "volume_ratio": self.volume_ratio.ravel(),
            }
        )

    def to_json(self) -> dict[str, Any]:
        """Return the score as JSON values, in the order in which a person reads it."""
        manifest = self.submission.manifest
        return {
            "track": TRACK,
            "stressors_version": VERSION,
            "name": manifest.name,
            **self.headline(),
            "draws": self.drawn.about() | {"count": int(self.pips.shape[1])},
            "failures": [
                {
                    "condition": self.conditions[s].id,
                    "lung": self.lungs[lung],
                    "draw": draw + 1,
                    **failure.to_json(),
                }
                for (s, lung, draw), failure in sorted(self.failures.items())
            ],
            "sandbox": None if self.sandbox is None else dict(self.sandbox),
            "submission": {"sha256": self.submission.sha256, **dataclasses.asdict(manifest)},
            "simulators": None if self.simulators is None else dict(self.simulators),
            "versions": package_versions(),
            "timing": dict(self.timing),
        }

    def save(self, folder: Path) -> None:
        """Write ``stress.json`` and, one row a run, ``stress.csv`` to a folder.

        Raises:
            OSError: if they cannot be written.
        """
        files.write_json(folder / "stress.json", self.to_json())
        table = self.to_frame().to_csv(index=False, lineterminator="\n").encode()
        files.write_atomically(folder / "stress.csv", lambda file: file.write(table))

    def _headline(self) -> str:
        name = self.submission.manifest.name
        if math.isnan(self.score):
            return f"{name}, stress: failed in {len(self.failures)} runs"
        low, high = self.interval(self.error[1:].mean(axis=0))
        return (
            f"{name}, stress: {self.score:.3f} cmH2O [{low:.3f}, {high:.3f}], "
            f"{self.unstressed:.3f} without stressors; {100 * self.survived_share:.0f} % survived, "
            f"{int(np.sum(~self.safe[1:]))} of {self.safe[1:].size} runs unsafe"
        )

    def _rows(self) -> pd.DataFrame:
        columns = ["error_cmH2O", "rise_cmH2O", "survived", "unsafe_runs", "volume_ratio"]
        table = self.summary().iloc[1:].sort_values("error_cmH2O", ascending=False)
        return table[columns].head(_SHOWN).reset_index()

    def __repr__(self) -> str:
        return f"<StressScore of {self._headline()}>"

    def __str__(self) -> str:
        rows = self._rows().to_string(index=False, float_format="{:.2f}".format)
        return f"{self._headline()}\nWhat costs most:\n{rows}"

    def _repr_html_(self) -> str:
        rows = self._rows().to_html(index=False, float_format="{:.2f}".format)
        return f"<div><p>{html.escape(self._headline())}</p>{rows}</div>"


def score_stress(
    submission: Any,
    *,
    simulator: Given = "frozen",
    draws: int = DRAWS,
    drawn: Draws | None = None,
    only: Sequence[str] = (),
    sandbox: bool = True,
    progress: Progress | None = None,
) -> StressScore:
    """Score a controller under missing physics that it is not told of.

    Args:
        submission: as for :func:`ventbench.score`.
        simulator: ``"frozen"`` for the official rigs; else simulators with
            plants, see :func:`ventbench.load_simulators`.
        draws: cells of each lung under each condition.
        drawn: other draws than the development ones.
        only: stressors to run; all conditions if empty.
        sandbox: run a folder in locked-down processes, as for :func:`ventbench.score`.
        progress: called after each round of commands with rounds done and all rounds.

    Raises:
        SubmissionError: if there is no such submission, or it cannot be run at all.
        SandboxError: if this machine cannot run submissions apart.
        InputError: if there are no such simulators, draws or stressors.
        FloatingPointError: if a plant answers with NaN or infinity.

    Example:
        >>> from ventbench.stress.score import score_stress
        >>> def proportional(observation):
        ...     return 5.0 + 2.0 * (observation.target - observation.pressure)
        >>> some = ["leak", "sensor_low", "disconnection"]
        >>> result = score_stress(proportional, draws=1, only=some)
        >>> result.complete
        False
    """
    entry = as_submission(submission)
    runner: Runner = runner_of(entry, sandbox=sandbox)
    rigs = load_rigs(simulator)
    cells = draw_cells(rigs, draws, drawn=drawn)
    if progress is not None:  # one session a draw
        runner = CountingRunner(runner, progress, sessions=cells.nominal_pip.shape[1])
    return run_stress(entry, cells, chosen_conditions(only), runner=runner, simulators=rigs.about)


def chosen_conditions(only: Sequence[str]) -> tuple[Condition, ...]:
    """All conditions, or no stressor and those of some stressors alone.

    Raises:
        InputError: if there is no such stressor.
    """
    names = {stressor(name).name for name in only}
    return tuple(c for c in conditions() if not names or set(c.stressors) <= names)


def run_stress(
    submission: Submission,
    draws: StressDraws,
    chosen: Sequence[Condition],
    *,
    runner: Runner | None = None,
    simulators: Mapping[str, Any] | None = None,
) -> StressScore:
    """Run a submission on drawn cells, by any runner; see :func:`score_stress`.

    Args:
        submission: from :func:`ventbench.entries.folder.open_submission`.
        draws: from :func:`ventbench.stress.run.draw_cells`.
        chosen: conditions; the first must be none.
        runner: runs the controllers; in this process if not given.
        simulators: what is known of the plants.
    """
    started = time.perf_counter()
    runner = runner or InProcessRunner()
    if submission.controller is not None and runner.sandbox is not None:
        raise SubmissionError(f"{submission.label}: only a folder can run in a sandbox")
    if "robustness" not in submission.manifest.tracks:
        raise SubmissionError(
            f"{submission.label}: submission.toml, key tracks: enters performance only; the stress "
            "track does not tell the lung and needs an entry of the robustness track"
        )
    if not chosen or chosen[0].stressors:
        raise ValueError("the first condition must be none")
    run = step_through(draws, chosen, runner, submission)
    timing = {"seconds": time.perf_counter() - started}
    return assess(
        run,
        draws,
        tuple(chosen),
        submission=submission,
        sandbox=runner.sandbox,
        simulators=simulators,
        timing=timing,
    )


def assess(
    run: StressRun,
    draws: StressDraws,
    chosen: tuple[Condition, ...],
    *,
    submission: Submission,
    sandbox: Mapping[str, Any] | None = None,
    simulators: Mapping[str, Any] | None = None,
    timing: Mapping[str, float] | None = None,
) -> StressScore:
    """Compute all figures of a run; arguments as of :class:`StressScore`."""
    pip, dt = np.asarray(draws.scenario.pip), np.asarray(draws.scenario.dt)
    by_breath = (run.pressure, pip[..., None], dt[..., None])
    safe = np.all(passes_safety_gate(*by_breath), axis=(-1,))
    plateau = steady_error(run.pressure[..., -1, :], pip)
    error = run_error(run.pressure, pip[..., None, None])
    survived = safe & (plateau <= PLATEAU_TOLERANCE + PLATEAU_SHARE * pip)
    for cell in run.failures:
        error[cell], plateau[cell], survived[cell] = np.nan, np.nan, False
    return StressScore(
        submission=submission,
        conditions=chosen,
        lungs=tuple(lung.id for lung in draws.lungs),
        pips=draws.nominal_pip,
        rig=draws.drawn.rig,
        member=draws.drawn.member,
        drawn=draws.drawn,
        error=error,
        safe=safe,
        plateau_error=plateau,
        survived=survived,
        alarm_s=time_above_alarm(*by_breath).max(axis=-1),
        peak=run.pressure.max(axis=(-2, -1)),
        volume=run.volume[..., protocol.SCORED_BREATHS, -1].mean(axis=-1),
        requested=run.requested,
        failures=run.failures,
        sandbox=sandbox,
        simulators=simulators,
        timing=timing or {},
    )
