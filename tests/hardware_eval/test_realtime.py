"""Real-time scheduling must not take a machine away from everybody else."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

#: Asks for priority, computes for up to 20 s, and tells the scheduling that it ends with.
IN_A_LOOP = """
import os, time
from hardware_eval import realtime
realtime.LONGEST_RUN_S = 1
ask = {"device": realtime.prefer, "host": realtime.take_priority}[os.environ["WHO"]]
ask()
assert realtime.has_priority()
end = time.process_time() + 20.0
while realtime.has_priority() and time.process_time() < end:
    pass
print(os.sched_getscheduler(0))
"""


@pytest.mark.parametrize("who", ["device", "host"])
def test_a_process_in_a_loop_loses_its_priority(who: str) -> None:
    try:
        before = os.sched_getscheduler(0)
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
        os.sched_setscheduler(0, before, os.sched_param(0))
    except (AttributeError, PermissionError):
        pytest.skip("this user may not ask for real-time scheduling")
    ended = subprocess.run(
        [sys.executable, "-c", IN_A_LOOP],
        env={**os.environ, "WHO": who},
        capture_output=True,
        text=True,
        check=True,
    )
    assert int(ended.stdout) == os.SCHED_OTHER
