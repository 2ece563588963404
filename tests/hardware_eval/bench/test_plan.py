"""Plans: order, control, resuming; and the log that they resume from."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from hardware_eval.bench import plan as plans
from hardware_eval.bench.plan import CONTROL, make_plan, progress
from hardware_eval.bench.raw_log import RawLog, lines
from ventbench.base.errors import InputError


def test_every_cell_is_repeated_and_the_control_runs_in_between() -> None:
    plan = make_plan(["a", "b"], ["R5C10", "R20C50"], pips=(10.0, 20.0), repeats=3, seed=4)
    scored = Counter((r.entry, r.lung, r.pip) for r in plan.runs if r.kind == "scored")
    assert scored == {
        (entry, lung, pip): 3
        for entry in "ab"
        for lung in ("R5C10", "R20C50")
        for pip in (10.0, 20.0)
    }
    control = [run for run in plan.runs if run.entry == CONTROL]
    assert Counter(run.lung for run in control) == {"R5C10": 3, "R20C50": 3}  # 0, 10, and the end
    assert [run.number for run in plan.runs] == list(range(len(plan.runs)))


def test_a_lung_is_mounted_once_and_pip_rises_first() -> None:
    plan = make_plan(["a"], ["R5C10", "R5C20", "R20C50"], pips=(30.0, 10.0, 20.0), repeats=1)
    order = [run.lung for run in plan.runs]
    assert [lung for i, lung in enumerate(order) if i == 0 or order[i - 1] != lung] == list(
        plan.lungs
    )
    for lung in plan.lungs:
        runs = [run for run in plan.runs if run.lung == lung]
        assert [(run.kind, run.pip) for run in runs[:3]] == [
            ("ramp", 10.0),
            ("ramp", 20.0),
            ("ramp", 30.0),
        ]


def test_the_order_depends_on_the_seed_and_not_on_how_lungs_are_listed() -> None:
    one = make_plan(["a"], ["R5C10", "R20C50"], seed=1)
    assert one == make_plan(["a"], ["R20C50", "R5C10"], seed=1)
    assert one.runs != make_plan(["a"], ["R5C10", "R20C50"], seed=2).runs


@pytest.mark.parametrize(
    "wrong",
    [
        {"entries": []},
        {"lungs": []},
        {"lungs": ["R5C10", "R5C10"]},
        {"lungs": ["R50C10"]},
        {"pips": [12.0]},
        {"repeats": 0},
        {"perturbations": ["kick"]},
        {"entries": [CONTROL]},
    ],
)
def test_wrong_plans_are_refused(wrong: dict) -> None:
    given: dict[str, Any] = {"entries": ["a"], "lungs": ["R5C10"]} | wrong
    with pytest.raises(InputError):
        make_plan(given.pop("entries"), given.pop("lungs"), **given)


def test_progress_repeats_what_the_bench_spoilt_and_keeps_what_failed() -> None:
    plan = make_plan(["a"], ["R5C10"], pips=(10.0,), repeats=2)
    begins = [{"type": "run_begins", "run": k, "attempt": 0} for k in range(4)]
    ends = [
        {"type": "run", "run": k, "attempt": 0, "status": status, "kind": "ramp"}
        for k, status in enumerate(("complete", "aborted", "failed"))
    ]
    left, attempts = progress(plan, [*begins, *ends])
    assert [run.number for run in left] == [k for k in range(len(plan.runs)) if k not in (0, 2)]
    assert attempts[3] == 1


def test_a_log_of_another_plan_is_refused() -> None:
    plan = make_plan(["a"], ["R5C10"], repeats=2)
    other = json.loads(json.dumps(make_plan(["a"], ["R5C10"], repeats=3).as_dict()))
    with pytest.raises(InputError, match="repeats"):
        progress(plan, [{"type": "plan", "plan": other}])


def test_a_line_that_a_crash_cut_off_costs_itself_alone(tmp_path: Path) -> None:
    path = tmp_path / "raw.jsonl"
    with RawLog(path) as log:
        log.append({"type": "event", "what": "one"})
        log.append({"type": "event", "what": "two"})
    whole = path.read_bytes()
    for cut in range(1, len(b'{"type":"event","what":"two"}\n')):
        path.write_bytes(whole[:-cut])
        assert [x["what"] for x in lines(path) if x["type"] == "event"] == ["one"]
        with RawLog(path) as log:
            log.append({"type": "event", "what": "three"})
        # Cut by its newline alone, the line is whole and is read.
        said = [x["what"] for x in lines(path) if x["type"] == "event"]
        assert said == (["one", "two", "three"] if cut == 1 else ["one", "three"])


def test_damage_within_a_log_is_not_taken_for_a_crash(tmp_path: Path) -> None:
    path = tmp_path / "raw.jsonl"
    with RawLog(path) as log:
        log.append({"type": "event", "what": "one"})
        log.append({"type": "event", "what": "two"})
    path.write_bytes(path.read_bytes().replace(b'"what":"one"', b'"what":"one'))
    with pytest.raises(InputError, match="line 2"):
        list(lines(path))


def test_two_sessions_cannot_write_one_log(tmp_path: Path) -> None:
    path = tmp_path / "raw.jsonl"
    with RawLog(path), pytest.raises(InputError, match="another session"):
        RawLog(path)


def test_control_gains_are_those_of_the_paper() -> None:
    assert plans.CONTROL_GAINS["R20C10"] == (8.0, 1.0)
    assert len(plans.CONTROL_GAINS) == 6
