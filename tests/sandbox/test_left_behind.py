"""Neither processes nor descriptors nor settings stay behind, also in mid-run."""

import os
import resource
from multiprocessing import resource_tracker
from pathlib import Path

import pytest

from ventbench.sandbox.child import kernel
from ventbench.sandbox.runner import SandboxRunner
from ventbench.task import protocol
from ventbench.task.interfaces import Task

from .conftest import PATIENT

pytestmark = pytest.mark.skipif(not kernel.LINUX, reason="looks into /proc")


def started(submission, lungs=(None,), **options):
    tasks = [Task("robustness", lung, protocol.DT, protocol.INSPIRATION_STEPS) for lung in lungs]
    return SandboxRunner(allowance=PATIENT, **options).start(submission, tasks)


def _descriptors():
    return sorted(os.listdir("/proc/self/fd"))


def test_nothing_is_left_behind(written):
    hang = "class Controller:\n def reset(self, t): pass\n def act(self, o):\n  while True: pass"
    # A process of ours that other tests may have started, and that lives as long as this one.
    resource_tracker.ensure_running()
    others = set(_descendants(os.getpid()))
    SandboxRunner()
    before = _descriptors(), resource.getrlimit(resource.RLIMIT_NOFILE)
    session = started(written(hang), [None] * 3)
    processes = set(_descendants(os.getpid())) - others
    assert len(processes) >= 4  # the zygote, three cells
    session.close()  # in mid-run
    assert (_descriptors(), resource.getrlimit(resource.RLIMIT_NOFILE)) == before
    assert not [process for process in processes if Path(f"/proc/{process}").exists()]
    assert set(_descendants(os.getpid())) == others  # nor one that has ended and waits for us


def _descendants(process):
    children = _children(process)
    return [*children, *(below for child in children for below in _descendants(child))]


def _children(process):
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text().rsplit(")", 1)[1].split()
        except OSError:
            continue
        if int(fields[1]) == process:
            found.append(int(path.parent.name))
    return found


def test_the_scorer_is_hidden_while_cells_run(written):
    still = "class Controller:\n def reset(self, t): pass\n def act(self, o): return 0.0"
    assert kernel.prctl(kernel.PR_GET_DUMPABLE) == 1
    session = started(written(still))
    other = started(written(still))
    session.close()
    assert kernel.prctl(kernel.PR_GET_DUMPABLE) == 0
    other.close()
    assert kernel.prctl(kernel.PR_GET_DUMPABLE) == 1
