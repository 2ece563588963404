"""Sandbox and plain process answer alike, and nothing is left behind."""

import dataclasses
import os
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from ventbench.base import compilation
from ventbench.entries.cells import InProcessRunner, protocol_of
from ventbench.entries.folder import open_submission
from ventbench.entries.scoring import run_protocol
from ventbench.plants.rigs import Rigs
from ventbench.plants.single_compartment import single_compartment
from ventbench.plants.stacking import stack
from ventbench.sandbox import runner as runner_module
from ventbench.sandbox.child.cell import ROW, SubmissionError
from ventbench.sandbox.pipes import Allowance, SandboxError
from ventbench.sandbox.runner import SandboxRunner, layers
from ventbench.task import protocol
from ventbench.task.interfaces import Task
from ventbench.task.lungs import LUNGS

from .conftest import PATIENT

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="no processes to fork here")

ROOT = Path(runner_module.__file__).parents[2]


def started(submission, lungs=(None,), **options):
    tasks = [Task("robustness", lung, protocol.DT, protocol.INSPIRATION_STEPS) for lung in lungs]
    return SandboxRunner(allowance=PATIENT, **options).start(submission, tasks)


def test_scores_are_those_of_the_plain_process():
    with compilation.float64():
        plants = stack([single_compartment(lung) for lung in LUNGS])
    for name in ("pid_best", "pid_robust"):
        submission = open_submission(name)
        runner = SandboxRunner(allowance=PATIENT)
        apart = run_protocol(
            submission, protocol_of(Rigs(LUNGS, plants), draws=1, pips=(20.0,)), runner=runner
        )
        plain = run_protocol(
            submission,
            protocol_of(Rigs(LUNGS, plants), draws=1, pips=(20.0,)),
            runner=InProcessRunner(),
        )
        assert not apart.failures
        np.testing.assert_array_equal(apart.nominal, plain.nominal)
        np.testing.assert_array_equal(apart.drawn, plain.drawn)


@pytest.mark.parametrize(
    ("source", "kind"),
    [
        ("raise ValueError('no')", "import"),
        ("x = 1", "import"),
        ("x = (", "import"),
        ("class Controller:\n def act(self, o): return 0.0", "import"),
        ("class Controller:\n def reset(self, t): 1 / 0\n def act(self, o): return 0.0", "reset"),
        ("class Controller:\n def reset(self, t): pass\n def act(self, o): return [1.0]", "type"),
        ("class Controller:\n def reset(self, t): pass\n def act(self, o): return o[9]", "act"),
    ],
)
def test_failures_are_those_of_the_plain_process(written, source, kind):
    submission = written(source)
    task = Task("robustness", None, protocol.DT, protocol.INSPIRATION_STEPS)
    found = []
    for runner in (InProcessRunner(), SandboxRunner(allowance=PATIENT)):
        try:
            session = runner.start(submission, [task])
        except SubmissionError as error:
            found.append(("import", str(error)))
            continue
        session.act(np.ones((1, ROW)))
        failure = session.failures[0]
        found.append((failure.kind, failure))
        session.close()
    assert found[0] == found[1]
    assert found[0][0] == kind


def test_weights_modules_and_prints(written):
    weights = b"2.5"
    submission = written(
        "import numpy as np, helper\n"
        "class Controller:\n"
        "    def reset(self, task):\n"
        "        self.w = np.loadtxt(__file__.replace('controller.py', 'w'))\n"
        "        print('loaded')\n"
        "    def act(self, o):\n"
        "        return float(self.w * helper.TWO) if o.time == 1 else 1 / 0\n",
        w=weights,
        **{"helper.py": b"TWO = 2"},
    )
    session = started(submission)
    row = np.ones((1, ROW))
    assert session.act(row) == [5.0]
    assert session.act(0 * row) == [0.0]
    failure = session.failures[0]
    assert failure.what == "controller.py line 7 raised ZeroDivisionError"
    assert failure.detail.endswith(r"; it printed loaded\n")
    assert (failure.breath, failure.step) == (1, 2)
    assert session.act(row) == [0.0], "a failed cell stays failed"
    session.close()
    session.close()


def test_official_fails_closed(monkeypatch):
    monkeypatch.setattr(runner_module, "layers", lambda: ("landlock", "seccomp"))
    with pytest.raises(SandboxError, match=r"missing here: .*empty-root"):
        SandboxRunner(require_official=True)
    assert SandboxRunner().sandbox["official"] is False


def test_cells_must_show_what_was_promised(written, monkeypatch):
    monkeypatch.setattr(runner_module, "layers", lambda: (*layers(), "more"))
    still = "class Controller:\n def reset(self, t): pass\n def act(self, o): return 0.0"
    with pytest.raises(SandboxError, match="a cell lacks more"):
        started(written(still))


def test_too_few_descriptors_is_said(written, monkeypatch):
    monkeypatch.setattr(resource, "getrlimit", lambda _: (256, 256))
    runner = SandboxRunner()
    with pytest.raises(SandboxError, match="ulimit -Hn"):
        runner.start(written(""), [Task("robustness", None, 0.03, 34)] * 200)


def test_the_zygote_loads_nothing_heavy():
    code = (
        "import sys; from ventbench.sandbox.child import zygote; "
        "print(sorted({m.split('.')[0] for m in sys.modules} & {'jax', 'numpy', 'pandas'}), "
        "sorted(m for m in sys.modules if m.startswith('ventbench') and 'sandbox' not in m))"
    )
    run = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    heavy, _, light = run.stdout.partition("] ")
    assert heavy == "["
    assert "environment" not in light
    assert "plants" not in light


def test_allowances_are_positive():
    with pytest.raises(ValueError, match="memory is 0"):
        dataclasses.replace(Allowance(), memory=0)


@pytest.mark.slow
def test_a_jax_controller(written):
    session = started(
        written(
            "import jax\n"
            "class Controller:\n"
            "    def reset(self, task): self.f = jax.jit(lambda a, b: 2 * (a - b))\n"
            "    def act(self, o): return float(self.f(o.target, o.pressure))\n"
        ),
        [None] * 2,
    )
    rows = np.tile(np.arange(float(ROW)), (2, 1))
    assert session.act(rows).tolist() == [2.0, 2.0]
    session.close()
