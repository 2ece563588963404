"""What a new metric, plant, mechanism, board column and controller family need, in a copy."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "ventbench"

PLANT = """
import flax.struct

from ventbench.task.interfaces import Signals


@flax.struct.dataclass
class Balloon:
    C: float

    def init(self, pressure, peep=None):
        return pressure, Signals(pressure)

    def step(self, state, u_in, u_out, dt):
        after = state + u_in * dt / self.C
        return after, Signals(after)

    def vary(self, r_scale, c_scale, gain=1.0):
        return Balloon(self.C * c_scale / gain)

    def parameters(self):
        return {"C": self.C}
"""

MECHANISM = """
from ventbench.physics.mechanism import Description, Mechanism
from ventbench.physics.mechanism import Parameter


class Chimney(Mechanism):
    description = Description(
        name="chimney", title="open chimney", site="circuit", equation="q = c p",
        parameters=(Parameter("width", "mL/s per cmH2O", "wide", 0.0, 60.0, 0.0, 10.0, 30.0),),
        source="made up", signature="less pressure", confusable=("leak",),
    )

    def network(self, values, network, view):
        return network.plus(leak=1e-3 * values["width"])


MECHANISM = Chimney()
"""

CONTROLLER = """
class Controller:
    def reset(self, task):
        pass

    def act(self, observation):
        return 50.0 if observation.pressure < observation.target else 0.0
"""

#: File, what stands there, and the line that is added before it.
LINES = (
    ("task/metrics/score.py", '    "swings":', '    "top_cmH2O": lambda s: s.pressure.max(-1),'),
    (
        "plants/plant_files.py",
        '    "hybrid":',
        '    "balloon": PlantFamily(Balloon, lambda lung: Balloon(lung.C)),',
    ),
    ("plants/plant_files.py", "import jax\n", "from ventbench.plants.balloon import Balloon"),
    (
        "board/frames.py",
        '    Column(("created",)',
        '    Column(("letters",), lambda x: len(x.row.record.name), "of the name"),',
    ),
    ("entries/manifest.py", '    "other":', '    "bang": "All or nothing.",'),
)
FILES = {
    "plants/balloon.py": PLANT,
    "physics/mechanisms/chimney.py": MECHANISM,
    "entries/templates/bang.py": CONTROLLER,
}

CHECK = """
import sys
from pathlib import Path

import numpy as np
import ventbench
from ventbench.board import frames
from ventbench.entries import manifest, scaffold
from ventbench.physics import library, physics
from ventbench.plants.catalog import load_simulators
from ventbench.task.lungs import lung
from ventbench.task.metrics.score import InspirationSignals, figures

assert ventbench.__file__.startswith(sys.argv[1])
ramp = np.linspace(5.0, 21.0, 34)
shown = figures(InspirationSignals(ramp, ramp, ramp, np.array(5.0), np.array(20.0), np.array(0.03)))
assert shown["top_cmH2O"] == 21.0
made = load_simulators("balloon").respond(
    "R5C10", np.full(3, 10.0), np.zeros(3), np.full(3, 0.03), initial_pressure=5.0
)
assert np.allclose(made, [5.0, 5.03, 5.06])
assert library()["chimney"].description.title == "open chimney"
state, before = physics(lung("R5C10"), {"chimney": {"width": 20.0}}).init(20.0)
assert "letters" in frames.csv_text([]).splitlines()[0]
made = scaffold.create("mine", "bang", Path(sys.argv[1], "out"))
assert "50.0" in (made / "controller.py").read_text()
assert manifest.read_manifest(made / "submission.toml").family == "bang"
"""


def test_each_is_a_file_or_a_line(tmp_path: Path) -> None:
    copy = shutil.copytree(
        PACKAGE, tmp_path / "ventbench", ignore=shutil.ignore_patterns("__pycache__")
    )
    for name, text in FILES.items():
        (copy / name).write_text(text)
    for name, before, line in LINES:
        text = (copy / name).read_text()
        assert text.count(before) == 1, f"{name}: {before}"
        (copy / name).write_text(text.replace(before, f"{line}\n{before}"))
    done = subprocess.run(
        [sys.executable, "-c", CHECK, str(tmp_path)],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
