"""`import ventbench`: light, complete, documented, and every example runs."""

from __future__ import annotations

import doctest
import inspect
import pickle
import subprocess
import sys
import traceback
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

import ventbench
from ventbench.controllers.pid import PID
from ventbench.entries import scoring
from ventbench.entries.cells import protocol_of
from ventbench.entries.folder import open_submission
from ventbench.plants.rigs import load_rigs
from ventbench.sandbox.pipes import SandboxError

TESTS = Path(__file__)
ROOT = TESTS.parents[1]

#: What a name does is said by an example; these take minutes, and are tried where they are tested.
LONG = ("diagnose", "train_rigs")

FUNCTIONS = sorted(
    name for name in ventbench.__all__ if inspect.isfunction(getattr(ventbench, name))
)


def loaded_after(code: str) -> set[str]:
    """Top-level modules that a fresh interpreter has loaded after some code."""
    script = f"import sys\n{code}\nprint(*sorted({{m.partition('.')[0] for m in sys.modules}}))"
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    return set(done.stdout.split())


def test_importing_is_light():
    heavy = {"jax", "pandas", "numpy", "scipy", "flax", "pyarrow", "typer"}
    assert not heavy & loaded_after("import ventbench; dir(ventbench)")
    assert not heavy & loaded_after("import ventbench.task.interfaces")


def test_the_help_of_the_command_line_needs_nothing_heavy():
    code = "import ventbench.cli, contextlib, io\nwith contextlib.suppress(SystemExit), "
    code += "contextlib.redirect_stdout(io.StringIO()):\n    ventbench.cli.app(['--help'])"
    assert not {"jax", "pandas", "scipy", "flax", "pyarrow"} & loaded_after(code)


def test_every_name_is_there():
    assert set(ventbench._SOURCES) | {"__version__"} == set(ventbench.__all__)
    for name in ventbench.__all__:
        value = getattr(ventbench, name)
        assert not isinstance(value, ModuleType), f"a module hides ventbench.{name}"
        assert name in dir(ventbench)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = ventbench.nothing


@pytest.mark.parametrize("name", FUNCTIONS)
def test_every_function_says_types_and_gives_an_example(name):
    function = getattr(ventbench, name)
    signature = inspect.signature(function)
    assert signature.return_annotation is not inspect.Signature.empty
    for parameter in signature.parameters.values():
        assert parameter.annotation is not inspect.Parameter.empty, parameter
    assert function.__doc__ is not None
    assert ">>>" in function.__doc__ or name in LONG
    assert "Example" in function.__doc__


@pytest.mark.parametrize("name", [name for name in FUNCTIONS if name not in LONG])
def test_every_example_runs(name, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "leaderboard").symlink_to(ROOT / "leaderboard")
    function = getattr(ventbench, name)
    finder = doctest.DocTestFinder(recurse=False)
    (found,) = finder.find(function, name, globs={})
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS)
    output: list[str] = []
    runner.run(found, out=output.append)
    assert runner.tries > 0
    assert runner.failures == 0, "".join(output)


def test_results_show_themselves():
    report = ventbench.open_loop(ventbench.example("sound"), "physics")
    assert "R5C20" in str(report)
    assert "<table" in report._repr_html_()
    answer = ventbench.simulate([8.0] * 20, simulator="physics")
    assert list(answer.to_frame()) == ["time_step", "u_in", "u_out", "pressure"]
    assert "<table" in answer._repr_html_()
    run = ventbench.rollout(PID(1.0, 5.0), simulator="physics", lungs=["R20C50"], pips=[20, 30])
    assert len(run.to_frame()) == 600
    assert "<table" in run._repr_html_()


def broken(observation):
    raise ValueError("nothing works")


def two_arguments(observation, gain):
    return gain


class Reset:
    def reset(self):
        """Take no task."""

    def act(self, observation):
        return 5.0


#: The package, to which anything may be given.
DOOR: Any = ventbench

REFUSED = {
    "no such simulator": (lambda: DOOR.load_simulators("nope"), ValueError, "choose frozen"),
    "nothing": (lambda: DOOR.load_simulators(None), TypeError, "simulator is of type None"),
    "a number": (lambda: DOOR.load_simulators(3), TypeError, "give a name, a file, a plant"),
    "a dict": (lambda: DOOR.load_recording({}), TypeError, "recording is of type dict"),
    "no file": (lambda: DOOR.diagnose("x.csv"), ValueError, "x.csv: there is no such file"),
    "no drive": (
        lambda: DOOR.diagnose(DOOR.example("concealed"), drive="turbo"),
        ValueError,
        "choose auto, valve, flow",
    ),
    "no argument": (lambda: DOOR.score(lambda: 3), ValueError, "must take an observation"),
    "two arguments": (lambda: DOOR.score(two_arguments), ValueError, "'gain'"),
    "no task": (lambda: DOOR.score(Reset), ValueError, "Reset.reset.*must take a task"),
    "no track": (
        lambda: DOOR.score(lambda o: 3.0, simulator="physics", track="sprint"),
        ValueError,
        "'sprint'; choose performance or robustness",
    ),
    "no number": (
        lambda: DOOR.score(lambda o: 3.0, draws="all"),
        TypeError,
        "give a whole number",
    ),
    "no text": (lambda: DOOR.simulate([8.0], lung=3), TypeError, "lung is of type int; give text"),
    "no names": (
        lambda: DOOR.rollout(PID(1.0, 5.0), lungs=[1, "R5C10"]),
        TypeError,
        "lungs is of type list; give a list, each text or None",
    ),
    "no rate": (lambda: DOOR.import_recording("a.csv", rate="5"), TypeError, "a number or None"),
    "no mapping": (
        lambda: DOOR.import_recording("a.csv", units={"flow": 3}),
        TypeError,
        "units is of type dict; give a mapping to text or None",
    ),
    "no mark": (
        lambda: DOOR.import_recording(DOOR.example("sound"), decimal="comma"),
        ValueError,
        "decimal 'comma': give marks",
    ),
    "no commands": (lambda: DOOR.simulate({}), TypeError, "controls is of type dict"),
    "no plan": (lambda: DOOR.isolability([8.0]), TypeError, "a CSV file of them"),
    "no pytree": (lambda: DOOR.rollout(3, simulator="physics"), TypeError, "init and step"),
    "no pip": (
        lambda: DOOR.rollout(PID(1.0, 5.0), simulator="physics", lungs="R20C50", pips=[0]),
        ValueError,
        "must exceed PEEP",
    ),
    "all broken": (
        lambda: DOOR.score(broken, simulator="physics"),
        ValueError,
        "nothing works",
    ),
}


@pytest.mark.parametrize("call", REFUSED)
def test_bad_input_is_refused_in_one_line_and_at_the_door(call):
    work, kind, text = REFUSED[call]
    with pytest.raises(ventbench.InputError, match=text) as caught:
        work()
    assert isinstance(caught.value, kind)
    assert "\n" not in str(caught.value)
    # The caller's line and that of the front door; none of the package's insides.
    inside = [Path(entry.path) for entry in caught.traceback]
    assert set(inside) <= {ROOT / "ventbench" / "__init__.py", TESTS}
    assert caught.value._render_traceback_() == [f"{type(caught.value).__name__}: {caught.value}"]


def test_the_exception_of_a_controller_is_chained_with_its_traceback():
    with pytest.raises(ventbench.InputError, match="nothing works") as caught:
        ventbench.score(broken, simulator="physics")
    cause = caught.value.__cause__
    assert isinstance(cause, ValueError)
    assert broken.__code__ in {frame.f_code for frame, _ in traceback.walk_tb(cause.__traceback__)}


def test_a_folder_runs_apart_unless_told_otherwise(monkeypatch):
    class Refuses:
        def __init__(self):
            raise SandboxError("apart")

    monkeypatch.setattr("ventbench.sandbox.runner.SandboxRunner", Refuses)
    entry, rigs = open_submission("pid_best"), load_rigs("physics")
    for work in (
        lambda: DOOR.score("pid_best", simulator="physics"),
        lambda: scoring.run_protocol(entry, protocol_of(rigs)),
    ):
        with pytest.raises(SandboxError, match="apart"):
            work()


def test_a_controller_that_fails_on_one_lung_is_not_safe_there():
    class Picky:
        def reset(self, task):
            self.lung = task.lung

        def act(self, observation):
            return None if self.lung == "R5C10" else 5.0

    result = ventbench.score(Picky, simulator="physics")
    assert result.safe.tolist() == [False, True, True, True, True, True]
    assert {failure.lung for failure in result.failures} == {"R5C10"}


def test_functions_of_the_front_door_can_be_sent_to_other_processes():
    assert pickle.loads(pickle.dumps(ventbench.score)) is ventbench.score


def test_breaths_can_be_indexed_tabulated_and_shown():
    breaths = ventbench.load_recording(ventbench.example("concealed"))
    assert breaths[3].breath_id.tolist() == [breaths.breath_id[3]]
    assert len(breaths[2:5]) == 3
    assert breaths[breaths.breath_id > 2].breath_id.min() == 3
    assert len(breaths["R20C50"]) == len(breaths)
    with pytest.raises(KeyError, match="no breath of lung R5C10; there are R20C50"):
        _ = breaths["R5C10"]
    with pytest.raises(IndexError):
        _ = breaths[len(breaths)]
    again = ventbench.load_recording(breaths.to_frame())
    for name in ("breath_id", "R", "C", "time", "u_in", "u_out", "pressure", "valid"):
        np.testing.assert_array_equal(getattr(again, name), getattr(breaths, name))
    assert again.source is None
    assert ventbench.load_recording(breaths) is breaths
    shown = breaths._repr_html_()
    assert "24 breaths x 80 samples" in shown
    assert "<table" in shown
    figure = breaths.plot()
    assert len(figure.axes) == 2
    np.testing.assert_array_equal(figure.axes[0].lines[5].get_ydata(), breaths.pressure[5])


def test_a_wrong_table_says_where():
    table = ventbench.load_recording(ventbench.example("concealed")).to_frame()
    table.loc[6, "u_in"] = 104.2
    with pytest.raises(ventbench.InputError, match=r"the table row 7, column u_in: 104\.2"):
        ventbench.load_recording(table)
    with pytest.raises(ventbench.InputError, match="the table, column pressure: missing"):
        ventbench.load_recording(table.drop(columns="pressure"))


def test_names_of_the_package_are_those_of_its_users():
    assert dir(ventbench) == sorted(ventbench.__all__)
    for value in (
        ventbench.load_simulators("frozen"),
        ventbench.simulate([8.0] * 20, simulator="physics"),
        ventbench.import_recording(ventbench.example("concealed")),
    ):
        assert len(repr(value)) < 120


def test_the_package_runs_as_a_module():
    done = subprocess.run(
        [sys.executable, "-m", "ventbench", "--version"], capture_output=True, text=True
    )
    assert done.stdout.strip() == f"ventbench {ventbench.__version__}"
