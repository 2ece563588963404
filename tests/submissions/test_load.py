import sys

import pytest

from ventbench.sandbox.child.cell import controller_class
from ventbench.submissions.errors import SubmissionError, printable


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
