"""`import ventbench`: light, complete, documented, and every example runs."""

from __future__ import annotations

import doctest
import inspect
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

import ventbench

ROOT = Path(__file__).parents[1]

#: What a name does is said by an example; these take minutes, and are tried where they are tested.
LONG = ("diagnose", "train_dqn", "train_ppo", "train_residual", "train_rigs")

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
    from ventbench.controllers.pid import PID

    report = ventbench.open_loop(ventbench.example("sound"), "physics")
    assert "R5C20" in str(report)
    assert "<table" in report._repr_html_()
    answer = ventbench.simulate([8.0] * 20, simulator="physics")
    assert list(answer.to_frame()) == ["time_step", "u_in", "u_out", "pressure"]
    assert "<table" in answer._repr_html_()
    run = ventbench.rollout(PID(1.0, 5.0), simulator="physics", lungs=["R20C50"], pips=[20, 30])
    assert len(run.to_frame()) == 600
    assert "<table" in run._repr_html_()


def test_the_package_runs_as_a_module():
    done = subprocess.run(
        [sys.executable, "-m", "ventbench", "--version"], capture_output=True, text=True
    )
    assert done.stdout.strip() == f"ventbench {ventbench.__version__}"
