"""`ventbench check` by reading: sources, each problem with its place and what to do."""

import pytest

from ventbench.entries.review import check_sources

RESET = "    def reset(self, task): pass\n"


GOOD = f"class Controller:\n{RESET}    def act(self, observation): return 1.0\n"


def found(findings):
    return {(f.file, f.line): f.what for f in findings}


def sources(demo, text, **others):
    (demo / "controller.py").write_text(text)
    for name, content in others.items():
        (demo / f"{name}.py").write_text(content)
    return [f for f in check_sources(demo) if not f.advice.startswith("for the reviewer")]


def test_syntax_errors_have_line_and_column(demo):
    (finding,) = sources(demo, GOOD + "def f(:\n")
    assert (finding.file, finding.line, finding.column) == ("controller.py", 4, 7)
    (finding,) = sources(demo, GOOD, other="x = (\n")
    assert (finding.file, finding.line) == ("other.py", 1)
    (finding,) = sources(demo, "x = 1\0", other="")
    assert finding.what.startswith("is not Python")
    assert sources(demo, GOOD + "x = '\\d'\n") == []  # doubtful, and a warning, but Python


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("import torch", "imports torch, which is neither in the folder nor among the packages"),
        ("from torch import nn", "imports torch"),
        ("import numpy, torch.nn", "imports torch"),
        ("if True:\n    import torch", "imports torch"),
        ("def f():\n    import torch", "imports torch"),
        ("import socket", "imports socket, but the sandbox closes the network"),
        ("from ctypes import c_int", "imports ctypes"),
        ("from ventbench.plants import frozen", "imports ventbench, which a submission does not"),
        ("from . import network", "uses a relative import"),
        ("def f():\n    import network", "imports network inside a function"),
        ("import network", ""),
        ("import numpy.linalg, jax, json, math, threading\nfrom flax import nnx", ""),
        ("from __future__ import annotations", ""),
    ],
)
def test_imports(demo, text, said):
    findings = sources(demo, f"{text}\n{GOOD}")
    assert [f.what.startswith(said) for f in findings] == [True] * bool(said)
    assert all(f.problem for f in findings)


def test_imports_that_may_fail_are_noted(demo):
    text = "try:\n    import torch\nexcept ImportError:\n    torch = None\n"
    (note,) = sources(demo, text + GOOD)
    assert not note.problem
    text = "try:\n    x = 1\nexcept ImportError:\n    import torch\n"
    (finding,) = sources(demo, text + GOOD)
    assert finding.problem


def test_only_what_the_controller_imports_must_be_there(demo):
    (demo / "pack").mkdir()
    (demo / "pack" / "__init__.py").write_text("from . import a\n")
    (demo / "pack" / "a.py").write_text("from .b import x\n")
    (demo / "pack" / "b.py").write_text("import scipy\nx = 1\n")
    findings = sources(demo, "import pack\n" + GOOD, train="import torch\nimport ventbench\n")
    assert found(findings) == {
        ("pack/b.py", 1): "imports scipy, which is neither in the folder nor among the packages "
        "it may use"
    }
    assert sources(demo, GOOD) == []


@pytest.mark.parametrize(
    "text",
    [
        "x = " + "(" * 5000,
        "x = " + "-" * 100_000 + "1\n" + GOOD,
        f"class Controller:\n{RESET}    def act(self, o): return o" + ".a" * 20_000 + "\n",
        "if 0: pass\n" + "elif 0: import json\n" * 3000 + GOOD,
    ],
    ids=["brackets", "signs", "attributes", "branches"],
)
def test_endless_sources_are_refused(demo, text):
    (finding,) = sources(demo, text)
    assert finding.problem
    assert finding.what.startswith(("is not Python", "is nested too deeply"))
