"""The closed loop: parts, and the whole of it on the virtual clock."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest

from hardware_eval.demo import demo
from hardware_eval.emulation.simulated import reveal

#: Words of the manual's table, and what they conceal.
WORDS = {
    "monday": "leak",
    "february": "sensor_lag",
    "wednesday": "supply_droop",
    "black": "turbulent_resistance",
    "friday": "nonlinear_compliance",
    "thursday": "valve_delay",
    "sunday": "valve_delay",
    "april": "valve_lag",
}


@pytest.mark.slow
@pytest.mark.skipif("VENTBENCH_LONG" not in os.environ, reason="minutes for each of the words")
@pytest.mark.parametrize("words", WORDS)
def test_the_loop_closes(words: str, tmp_path: Path) -> None:
    out = tmp_path / "demo"
    done = demo(words, out, real_time=False, sandbox=False, tell=print)
    lung, effect = reveal(out / "seal.json", words)
    assert (lung.id, effect.name) == (done.lung, WORDS[words])
    figures = json.loads((out / "demo.json").read_text())
    assert figures["truth"]["name"] == effect.name
    assert figures["steps"] == list(done.steps)
    assert effect.name.replace("_", " ") in done.steps[-1]
    mean = {x: np.mean(list(getattr(done, x).values())) for x in ("simulated", "measured")}
    assert mean["measured"] > mean["simulated"]
    # The sensor's noise and converter alone give 0.08.
    assert done.open_loop[2] < min(0.2, done.open_loop[1])
    assert done.better
    assert done.right
    assert len(done.named) <= 2
