import subprocess
import sys

import pytest

from ventbench.sandbox.child.cell import (
    ROW,
    Cell,
    Failed,
    SubmissionError,
    controller_class,
    printable,
    unpack,
)
from ventbench.task.interfaces import Observation, Task

ROBUSTNESS = Task("robustness", None, 0.03, 34)
ROWS = [float(i) for i in range(ROW)]


def asked(folder, times=1):
    cell = Cell(controller_class(folder), ROBUSTNESS, folder)
    return [cell.act(ROWS) for _ in range(times)][-1]


def test_observation():
    found = unpack(ROWS)
    assert found == Observation(0.0, 1.0, 2.0, 3.0, tuple(ROWS[4:14]), 14.0)
    assert all(type(x) is float for x in (*found[:4], *found.targets_ahead, found.previous_u_in))


@pytest.mark.parametrize(
    ("expression", "value"),
    [
        ("1.5", 1.5),
        ("3", 3.0),
        ("-1e300", -1e300),
        ("np.float64(1.5)", 1.5),
        ("np.float32(1.5)", 1.5),
        ("np.int8(3)", 3.0),
        ("np.array(1.5)", 1.5),
        ("jnp.asarray(1.5)", 1.5),
    ],
)
def test_numbers(make, expression, value):
    found = asked(make(act=f"import numpy as np, jax.numpy as jnp\nreturn {expression}"))
    assert found == value
    assert type(found) is float


@pytest.mark.parametrize(
    ("expression", "kind", "what"),
    [
        ("None", "type", "act returned None; it must return one number"),
        ("True", "type", "act returned a bool (True); it must return one number"),
        ("'5'", "type", "act returned a str ('5'); it must return one number"),
        ("np.bool_(True)", "type", "act returned a bool; it must return one number"),
        (
            "np.array([1.0])",
            "type",
            "act returned an array of shape (1,); it must return one number",
        ),
        ("np.array('5')", "type", "act returned a ndarray; it must return one number"),
        ("[1.0]", "type", "act returned a list; it must return one number"),
        ("1j", "type", "act returned a complex; it must return one number"),
        ("float('nan')", "value", "act returned nan"),
        ("-np.inf", "value", "act returned -inf"),
        ("np.float32('inf')", "value", "act returned inf"),
        ("10**400", "value", "act returned an integer too large for a float"),
        ("type('F', (float,), {'__float__': lambda s: 1 / 0})(3)", "type", "act returned a F; "),
        ("type('F', (), {'__float__': lambda s: 3.0})()", "type", "act returned a F; "),
        ("type('numpy', (), {'item': lambda s: 3.0, 'shape': ()})()", "type", "act returned a nu"),
    ],
)
def test_not_numbers(make, expression, kind, what):
    with pytest.raises(Failed) as caught:
        asked(make(act=f"import numpy as np\nreturn {expression}"))
    failure = caught.value.failure
    assert failure.kind == kind
    assert failure.what.startswith(what)
    assert (failure.breath, failure.step) == (1, 1)


def test_exceptions_name_file_line_and_step(make):
    folder = make(
        """
        import helper
        class Controller:
            def reset(self, task): self.calls = 0
            def act(self, observation):
                self.calls += 1
                return helper.divide(1.0, 37 - self.calls)
        """,
        helper="def divide(a, b):\n    return a / b\n",
    )
    with pytest.raises(Failed) as caught:
        asked(folder, 102)
    failure = caught.value.failure
    assert failure.message("submissions/mine", None) == (
        "submissions/mine: helper.py line 2 raised ZeroDivisionError at step 3 of breath 2 "
        "(lung hidden): float division by zero; the entry is not ranked."
    )
    assert failure.kind == "act"


@pytest.mark.parametrize("method", ["__init__", "reset"])
@pytest.mark.parametrize("raised", ["KeyError('R5C10')", "SystemExit(0)"])
def test_before_the_first_step(make, method, raised):
    source = f"""
        class Controller:
            def act(self, observation): return 0.0
            def reset(self, task): pass
            def {method}(self, *a): raise {raised}
        """
    with pytest.raises(Failed) as caught:
        asked(make(source))
    failure = caught.value.failure
    assert failure.kind == {"__init__": "construct", "reset": "reset"}[method]
    name = raised.partition("(")[0]
    where = {"__init__": "Controller()", "reset": "reset"}[method]
    message = failure.message("mine", "R5C10")
    assert message.startswith(f"mine: controller.py line 5 raised {name} in {where} (lung R5C10): ")
    assert failure.step is None


def test_needs_the_standard_library_alone():
    # A sandbox's child must come up without numpy and JAX.
    code = (
        "import sys, ventbench.sandbox.child.cell\n"
        "heavy = {'numpy', 'jax', 'flax', 'pandas'} & set(sys.modules)\n"
        "assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def load(folder):
    return controller_class(folder, "submissions/mine")


def test_loads_and_leaves_no_trace(make):
    path = make(
        """
        from __future__ import annotations
        import dataclasses
        import helper

        @dataclasses.dataclass
        class Controller:
            gain: float = helper.GAIN
            def reset(self, task): pass
            def act(self, observation): return self.gain
        """,
        helper="GAIN = 3.5\n",
    )
    before = list(sys.path), set(sys.modules), sys.dont_write_bytecode
    controller = load(path)()
    assert controller.act(None) == 3.5
    assert sys.path == before[0]
    assert sys.dont_write_bytecode == before[2]
    new = set(sys.modules) - before[1]
    assert [name for name in new if not name.startswith("_ventbench_submission_")] == []
    assert not (path / "__pycache__").exists()


def test_submissions_do_not_share_their_helpers(make):
    source = """
        import helper
        class Controller:
            def reset(self, task): pass
            def act(self, observation): return helper.GAIN
        """
    first = load(make(source, name="a", helper="GAIN = 1.0"))
    second = load(make(source, name="b", helper="GAIN = 2.0"))
    assert (first().act(None), second().act(None)) == (1.0, 2.0)


def test_a_helper_may_be_called_like_a_module_in_use(make):
    import json

    source = """
        import json
        class Controller:
            def reset(self, task): pass
            def act(self, observation): return json.GAIN
        """
    assert load(make(source, json="GAIN = 1.0"))().act(None) == 1.0
    assert sys.modules["json"] is json
    import json as again

    assert again is json


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("x = (\n", "submissions/mine: controller.py line 1: '(' was never closed"),
        ("\ndef f(:\n", "submissions/mine: controller.py line 2: invalid syntax"),
        ("x = 1\n", "submissions/mine: controller.py defines no class Controller"),
        ("Controller = 3\n", "submissions/mine: Controller in controller.py is a int, no class"),
        (
            "class Controller:\n    act = 3\n",
            "submissions/mine: class Controller in controller.py has no method reset(task)\n"
            "submissions/mine: class Controller in controller.py has no method act(observation)",
        ),
        (
            "\nimport not_installed\n",
            "submissions/mine: controller.py line 2 raised ModuleNotFoundError while it was "
            "imported: No module named 'not_installed'",
        ),
        (
            "import helper\n",
            "submissions/mine: helper.py line 2 raised KeyError while it was imported: 'gains'",
        ),
        (
            "import sys\nsys.exit('bye')\n",
            "submissions/mine: controller.py line 2 raised SystemExit while it was imported: bye",
        ),
    ],
)
def test_named_problems(make, source, message):
    before = list(sys.path), set(sys.modules)
    with pytest.raises(SubmissionError) as caught:
        load(make(source, helper="x = {}\nx['gains']\n"))
    assert str(caught.value) == message
    assert (list(sys.path), set(sys.modules)) == before


@pytest.mark.parametrize("content", [b"x = '\xff'\n", b"x = 1\x00\n"])
def test_not_python(make, content):
    path = make()
    (path / "controller.py").write_bytes(content)
    with pytest.raises(SubmissionError, match=r"submissions/mine: controller.py"):
        load(path)


def test_hostile_text_is_shown_plainly(make):
    with pytest.raises(SubmissionError) as caught:
        load(make("raise ValueError('\\x1b[2J\\n' + 'x' * 10_000)\n"))
    assert r"\x1b[2J\n" in str(caught.value)
    assert len(str(caught.value)) < 500


def test_exception_that_cannot_be_shown(make):
    source = "class E(Exception):\n    def __str__(self): raise E()\nraise E()\n"
    with pytest.raises(SubmissionError, match="its text cannot be shown"):
        load(make(source))


def test_printable():
    assert printable("a\tbü") == r"a\tbü"
    assert printable("x" * 400) == "x" * 297 + "..."
