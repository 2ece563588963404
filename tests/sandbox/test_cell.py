import subprocess
import sys

import pytest

from ventbench.interfaces import Observation, Task
from ventbench.sandbox.child.cell import ROW, Cell, Failed, controller_class, unpack

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
