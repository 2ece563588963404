"""The closed loop: parts, and the whole of it on the virtual clock."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest

from hardware_eval.bench.controllers import PIDController, SubmissionController
from hardware_eval.demo import demo, write_entry
from hardware_eval.emulation.concealed import reveal
from ventbench.interfaces import Task
from ventbench.submissions.folder import open_submission
from ventbench.submissions.runner import InProcessRunner


def test_a_written_entry_is_the_pid_with_its_gains(tmp_path: Path) -> None:
    folder = write_entry(tmp_path, "tuned", (3.0, 0.4, 0.0))
    submission = open_submission(str(folder))
    assert submission.manifest.name == "tuned"
    task = Task("performance", "R5C10", 0.03, 34)
    theirs = SubmissionController(InProcessRunner(), submission, task, real_time=False)
    ours = PIDController((3.0, 0.4, 0.0))
    for step, pressure in enumerate((5.0, 9.0, 14.0, 16.0)):
        row = np.array([[step * 0.03, 0.03, pressure, 15.0, *[15.0] * 10, 5.0]])
        assert theirs.act(row, 1.0) == ours.act(row, 1.0)
    theirs.close()


@pytest.mark.slow
@pytest.mark.skipif("VENTBENCH_LONG" not in os.environ, reason="takes more than ten minutes")
def test_the_loop_closes_on_a_leak(tmp_path: Path) -> None:
    out = tmp_path / "demo"
    done = demo("monday", out, breaths=24, real_time=False, sandbox=False)
    figures = json.loads((out / "demo.json").read_text())
    lung, effect = reveal(out / "seal.json", "monday")
    assert (lung.id, effect.name) == (done.lung, "leak")
    assert np.mean(list(done.measured.values())) > np.mean(list(done.simulated.values()))
    assert done.open_loop[2] < 0.5 * done.open_loop[0]
    assert done.better
    assert figures["truth"]["name"] == "leak"
    page = (out / "report.html").read_text()
    assert all(f"{error:.2f}" in page for error in done.retuned.values())
