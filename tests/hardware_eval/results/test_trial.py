"""Trials: coverage of the intervals with a simulated truth, and a log whose answer is known."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

from hardware_eval.bench.plan import make_plan
from hardware_eval.bench.raw_log import RawLog
from hardware_eval.commands import show
from hardware_eval.results.trial import (
    CORRELATIONS,
    Floats,
    agreement,
    analyse,
    correlation,
    with_error,
)
from ventbench.base.errors import InputError
from ventbench.task import protocol

LUNGS, PIPS, REPEATS = 6, 6, 5

#: Standard deviations of mounting, of a lung's PIPs in it, and of repeats, by PIP, cmH2O.
MOUNTING, CELL, REPEAT = 0.10, 0.05, np.linspace(0.02, 0.2, PIPS)


def trials(count: int, draw: np.random.Generator, mean: Floats) -> tuple[Floats, Floats]:
    """Gaps ``(count, L, P, K)`` and the means of their cells, ``(count, L, P)``."""
    mounted = mean + MOUNTING * draw.standard_normal((count, LUNGS, 1))
    cells = mounted + CELL * draw.standard_normal((count, LUNGS, PIPS))
    noise = REPEAT[:, None] * draw.standard_normal((count, LUNGS, PIPS, REPEATS))
    return cells[..., None] + noise, cells


def covered(found: tuple[Floats, Floats, Floats], truth: Any) -> float:
    mean, error, freedom = found
    return float(np.mean(np.abs(mean - truth) <= stats.t.ppf(0.975, freedom) * error))


def test_intervals_cover_the_truth_in_nineteen_of_twenty_trials() -> None:
    gaps, cells = trials(2000, np.random.default_rng(0), np.array(0.3))
    anew = covered(with_error(gaps.mean(axis=(2, 3))[:, None]), 0.3)
    mounted = covered(with_error(gaps.reshape(2000, -1, REPEATS)), cells.mean(axis=(1, 2)))
    by_lung = covered(with_error(gaps), cells.mean(axis=2))
    # 95 % of 2000 have a standard error of 0.5 %; of few degrees of freedom t is an approximation.
    for share in (anew, mounted, by_lung):
        assert 0.935 <= share <= 0.965
    # Who takes runs for independent covers a new mounting far too rarely.
    assert covered(with_error(gaps.reshape(2000, -1, REPEATS)), 0.3) < 0.5


def test_the_interval_of_rank_agreement_covers_that_of_the_true_means() -> None:
    draw, count = np.random.default_rng(1), 100
    simulated = np.array([1.0, 1.1, 1.15, 1.4])
    wrong = np.array([0.3, 0.15, 0.3, 0.2])  # what the bench adds: it swaps two entries
    each = [trials(count, draw, gap)[0].mean(axis=(2, 3)) for gap in wrong]
    measured = simulated[:, None, None] + np.stack(each)
    by_lung = np.repeat(simulated[:, None], LUNGS, axis=1)
    every = [agreement(by_lung, measured[:, k], draws=100) for k in range(count)]
    for name in CORRELATIONS:
        truth = correlation(name, simulated, simulated + wrong)
        found = [one[name] for one in every]
        assert np.mean([x.low <= truth <= x.high for x in found]) >= 0.93
        assert np.mean([x.high - x.low for x in found]) < 1.5  # it says something


def test_rank_correlations_count_pairs_and_ranks() -> None:
    one, other = np.array([1.0, 2.0, 3.0, 4.0]), np.array([1.0, 3.0, 2.0, 4.0])
    assert correlation("kendall", one, other) == pytest.approx(4 / 6)
    assert correlation("spearman", one, other) == pytest.approx(1 - 6 * 2 / (4 * 15))
    assert correlation("spearman", one, 0.0 * other) == 0.0


ERRORS = {"slow": [[1.0, 1.2], [2.0, 2.4]], "fast": [[0.5, 0.7], [1.0, None]]}


def write(path: Path, seed: int, errors: dict[str, Any]) -> Path:
    """A finished session on one lung: two PIPs, two repeats; in simulation 1 and 2 cmH2O."""
    plan = make_plan(
        sorted(errors), ["R5C20"], pips=(10.0, 20.0), repeats=2, control_every=0, seed=seed
    )
    told = [[name, "R5C20", pip, pip / 10.0] for name in errors for pip in plan.pips]
    with RawLog(path / "raw.jsonl") as log:
        log.append({"type": "plan", "plan": plan.as_dict()})
        log.append({"type": "session", "entries": dict.fromkeys(errors, "0"), "simulated": told})
        for run in plan.runs:
            error = errors[run.entry][plan.pips.index(run.pip)][run.repeat - 1]
            status = "failed" if error is None else "complete"
            about = {"run": run.number, "attempt": 0, "entry": run.entry, "kind": run.kind}
            about |= {"lung": run.lung, "pip": run.pip, "repeat": run.repeat}
            for breath in range(protocol.BREATHS):
                pressure = [run.pip] * protocol.BREATH_STEPS
                log.append({"type": "breath", **about, "breath": breath, "pressure": pressure})
            log.append({"type": "run", "status": status, "error": error, **about})
    return path


def test_a_log_gives_gaps_success_and_what_is_missing(tmp_path: Path) -> None:
    done = analyse([write(tmp_path, 0, ERRORS)])
    slow, fast = done.entries["slow"], done.entries["fast"]
    assert slow.score.value == pytest.approx(1.65)
    # Variances 0.02 and 0.08 of repeats: SE sqrt(0.05) / 2, 25/17 degrees of freedom (Welch).
    half = stats.t.ppf(0.975, 25 / 17) * np.sqrt(0.05) / 2.0
    assert slow.score.high - slow.score.value == pytest.approx(half)
    assert slow.gaps["R5C20"].value == pytest.approx(0.15)
    assert slow.repeat_sd == pytest.approx(np.sqrt(0.05))
    assert slow.success.low == pytest.approx(0.025**0.25)  # Clopper and Pearson, all of four
    assert fast.successes == {"R5C20": (3, 4)}
    assert np.isnan(fast.score.value)
    assert any("fast has no score" in text for text in done.missing)
    assert any("mounted anew" in text for text in done.missing)
    assert done.agreement == {}
    path = tmp_path / "trial.json"
    show(done, path)
    assert json.loads(path.read_text())["entries"]["fast"]["score"]["value"] is None


def test_sessions_of_one_trial_are_mountings_and_others_are_refused(tmp_path: Path) -> None:
    whole = ERRORS | {"fast": [[0.5, 0.7], [1.0, 1.2]]}
    first = write(tmp_path / "one", 1, whole)
    more = {name: (np.array(x) + 0.1).tolist() for name, x in whole.items()}
    done = analyse([first, write(tmp_path / "two", 2, more)])
    gap = done.entries["slow"].gap
    assert gap.value == pytest.approx(0.2)
    assert gap.high - gap.value == pytest.approx(12.706 * 0.05, rel=1e-4)
    # In simulation both are alike; on the bench the order is the same in every mounting.
    assert done.agreement["kendall"].value == 0.0
    with pytest.raises(InputError, match="another trial"):
        analyse([first, write(tmp_path / "three", 3, {"slow": whole["slow"]})])
