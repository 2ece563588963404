"""Whatever readings and steps a session lacks, its figures stay in bounds, or a word says why."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import Phase, example, given, settings
from hypothesis import strategies as st

from hardware_eval.bench.loop import Operator
from hardware_eval.bench.plan import Procedure, make_plan
from hardware_eval.bench.raw_log import RECORDING, read_session
from hardware_eval.commands import show
from hardware_eval.results import acceptance, page
from hardware_eval.results import evaluate as ev
from hardware_eval.results import record as records
from hardware_eval.results.evaluate import Line
from hardware_eval.results.trial import analyse
from hardware_eval.wire.client import Client
from ventbench.base.errors import InputError
from ventbench.board.record import HardwareRecord
from ventbench.entries.folder import open_submission
from ventbench.recordings.breaths import write
from ventbench.recordings.read import load
from ventbench.task import protocol
from ventbench.task.metrics import measured

LUNG, PIPS, REPEATS = "R5C20", (10.0, 15.0), 2

HOW = Procedure(fallback=False, dry_run=False, selftest=False, rest=1.0)


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory, shared_device: Any) -> ev.Evaluation:
    client = Client(shared_device, shared_device.clock)
    client.hello()
    return ev.evaluate(
        [open_submission("pid_best")],
        Line(client, shared_device.clock),
        tmp_path_factory.mktemp("bench"),
        Operator(),
        plan=make_plan(["pid_best"], [LUNG], pips=PIPS, repeats=REPEATS, control_every=2),
        sandbox=False,
        how=HOW,
    )


def without(log: Path, out: Path, share: float, cut: float, unscored: float, seed: int) -> Path:
    """A copy of a log that lacks readings of scored and unscored breaths, and ends of breaths."""
    random = np.random.default_rng(seed)
    rows = []
    for text in log.read_text().splitlines():
        line = json.loads(text)
        if line["type"] == "breath":
            steps = len(line["pressure"])
            scored = line["kind"] == "scored" and line["breath"] in protocol.SCORED_BREATHS
            missing = random.random(steps) < (share if scored else unscored)
            for name in ("pressure", "flow", "requested"):
                line[name] = [
                    None if gone else x for x, gone in zip(line[name], missing, strict=True)
                ]
            if random.random() < cut:
                end = int(random.integers(0, steps))
                line |= {name: x[:end] for name, x in line.items() if isinstance(x, list)}
        rows.append(json.dumps(line))
    out.mkdir(exist_ok=True)
    (out / "raw.jsonl").write_text("\n".join(rows) + "\n")
    return out / "raw.jsonl"


def read(log: Path) -> HardwareRecord:
    return records.hardware_record(log, open_submission("pid_best"))[1]


@pytest.fixture(scope="module")
def whole(done: ev.Evaluation) -> tuple[HardwareRecord, str]:
    """Record and page of the session that lacks nothing."""
    return read(done.log), page.page(read_session(done.log))


@settings(max_examples=20, phases=[Phase.explicit, Phase.reuse, Phase.generate])
@example(share=0.0, cut=0.1, unscored=0.5, seed=525797660)  # a breath without any reading
@given(
    share=st.sampled_from([0.0, 0.02, 0.05, 0.3]),
    cut=st.sampled_from([0.0, 0.0, 0.1]),
    unscored=st.sampled_from([0.0, 0.03, 0.5]),
    seed=st.integers(0, 2**32 - 1),
)
def test_figures_stay_within_bounds_or_a_word_says_why(
    done: ev.Evaluation,
    whole: tuple[HardwareRecord, str],
    tmp_path_factory: pytest.TempPathFactory,
    share: float,
    cut: float,
    unscored: float,
    seed: int,
) -> None:
    record_of_all, complete = whole
    folder = tmp_path_factory.mktemp("lacking")
    log = without(done.log, folder, share, cut, unscored, seed)
    shown = page.page(read_session(log))
    assert not re.search(r"\bnan\b", shown, re.IGNORECASE)
    assert shown.count("<figure>") == complete.count("<figure>") == len(PIPS)
    try:
        left = read(log)
    except InputError as error:
        assert "run the same command again, it continues" in str(error)  # noqa: PT017
        with pytest.raises(InputError, match="continues"):
            analyse([log])
        assert "runs are left" in shown
        return
    given = np.array(record_of_all.header.trace.pressure_milli_cmH2O, float) / 1000.0
    # A gap of two lies between its neighbours: it is off by three steps of the pressure at most.
    bound = measured.MISSING_SHARE * 3.0 * np.abs(np.diff(given, axis=-1)).max()
    assert np.abs(left.errors - record_of_all.errors).max() <= bound
    assert left.header.safe == record_of_all.header.safe
    assert given.max() - 3.0 <= left.header.peak_pressure_cmH2O[0] + 1e-9
    assert left.header.peak_pressure_cmH2O[0] <= record_of_all.header.peak_pressure_cmH2O[0]
    made = records.save(folder, records.hardware_record(log, open_submission("pid_best"))[0])
    assert records.replay(log, record=made).problems == ()
    told = acceptance.report(read_session(log))
    assert "This is no certification" in told
    assert not re.search(r"\bnan\b", told, re.IGNORECASE)
    show(analyse([log]), folder / "trial.json")  # which may hold no NaN
    breaths = records.recorded_breaths(log)
    write(breaths, folder / RECORDING)
    assert np.isnan(load(folder / RECORDING).pressure[np.isnan(breaths.pressure)]).all()


@given(st.lists(st.floats(5.0, 60.0), min_size=34, max_size=34), st.integers(0, 2**32 - 1))
def test_what_is_seen_above_the_limit_counts_whatever_is_missing(
    pressure: list[float], seed: int
) -> None:
    given = np.array(pressure)
    random, lacking = np.random.default_rng(seed), given.copy()
    for at in range(1, 34, 3):  # gaps of one and two
        lacking[at : at + random.integers(0, 3)] = np.nan
    assert measured.is_safe(given, 10.0, protocol.DT) == measured.passes_safety_gate(
        given, 10.0, protocol.DT
    )
    if not measured.passes_safety_gate(np.nan_to_num(lacking, nan=5.0), 10.0, protocol.DT):
        assert not measured.is_safe(lacking, 10.0, protocol.DT)
    assert np.isfinite(measured.filled(lacking)).all()
