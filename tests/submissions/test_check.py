"""`ventbench check` by reading: every problem at once, with its place and what to do."""

import os
import pickle
import zipfile

import numpy as np
import pytest

from ventbench.submissions import contract
from ventbench.submissions.file_checks import check_files, weights_problems
from ventbench.submissions.folder import MAX_BYTES
from ventbench.submissions.manifest import check_manifest
from ventbench.submissions.scaffold import create
from ventbench.submissions.static_checks import check_sources

from .conftest import MANIFEST

RESET = "    def reset(self, task): pass\n"
GOOD = f"class Controller:\n{RESET}    def act(self, observation): return 1.0\n"


@pytest.fixture
def demo(tmp_path):
    return create("demo", "ppo", tmp_path)


def found(findings):
    return {(f.file, f.line): f.what for f in findings}


def files(folder):
    return {f.file: f.what for f in check_files(folder) if f.problem}


def test_scaffold_has_nothing(demo):
    assert check_files(demo) == []
    assert check_sources(demo) == []


def test_everything_at_once(demo):
    (demo / "README.md").unlink()
    (demo / "weights.npz").write_bytes(pickle.dumps([1]))
    (demo / "link").symlink_to("/etc/passwd")
    (demo / ".hidden").write_text("")
    manifest = demo / "submission.toml"
    manifest.write_text(manifest.read_text().replace('"ppo"', '"pop"').replace("name", "nam", 1))
    (demo / "network.py").write_text("import torch\nimport socket\n")
    (demo / "controller.py").write_text("from network import x\nclass Controler: pass\n")
    report = contract.check(str(demo))
    assert not report.ok
    assert report.left_out == ("run", "repeat", "time")
    where = {(f.file, f.line, f.group) for f in report.problems}
    assert where == {
        ("README.md", None, "files"),
        ("weights.npz", None, "files"),
        ("link", None, "files"),
        (".hidden", None, "files"),
        ("submission.toml", 1, "manifest"),
        ("submission.toml", None, "manifest"),
        ("submission.toml", 5, "manifest"),
        ("network.py", 1, "source"),
        ("network.py", 2, "source"),
        ("controller.py", 2, "source"),
    }
    assert all(finding.advice for finding in report.problems)
    text = "\n".join(report.lines())
    assert "10 problems; not ready to submit" in text
    assert "did you mean Controler?" in text
    assert "'pop' is not one of pid, residual, ppo, dqn, other; did you mean ppo?" in text


def test_files_that_are_refused(demo):
    (demo / "sub").mkdir()
    (demo / "sub" / "a.so").write_bytes(b"\x7fELF")
    (demo / "w.pkl").write_bytes(b"")
    (demo / "data.bin").write_bytes(b"\0")
    (demo / "Makefile").write_text("all:\n")
    (demo / "con.txt").write_text("")
    (demo / "-rf.txt").write_text("")
    (demo / "m\u0456ne.py").write_text("")
    (demo / "lfs.npz").write_text("version https://git-lfs.github.com/spec/v1\n")
    (demo / "latin.txt").write_bytes(b"\xe9")
    (demo / ".git").mkdir()
    (demo / ".git" / "config").write_text("")
    os.mkfifo(demo / "pipe")
    kind = "is of a kind that is not accepted"
    letters = "may have only letters, digits, '_', '-' and '.' in its name, '-' not first"
    assert files(demo) == {
        "sub/a.so": kind,
        "w.pkl": kind,
        "data.bin": kind,
        "Makefile": kind,
        "con.txt": "has a name that some systems cannot store",
        "-rf.txt": letters,
        "m\u0456ne.py": r"has other than ASCII characters in its name, 'm\u0456ne.py'",
        "lfs.npz": "is a pointer of git LFS, not the file",
        "latin.txt": "is not UTF-8 text",
        ".git": "is a hidden folder",
        "pipe": "is neither a file nor a folder",
    }


def test_what_is_noted_but_accepted(demo):
    (demo / ".DS_Store").write_bytes(b"\0")
    (demo / "__pycache__").mkdir()
    (demo / "__pycache__" / "network.cpython-311.pyc").write_bytes(b"\0")
    (demo / "controller.py").chmod(0o755)
    notes = check_files(demo)
    assert {note.file: note.what for note in notes} == {
        ".DS_Store": "was written by macOS",
        "controller.py": "is executable",
    }
    assert not any(note.problem for note in notes)


def test_names_that_differ_in_case_only(demo):
    (demo / "Network.py").write_text("")
    if not (demo / "network.py").read_text():
        pytest.skip("this file system ignores case")
    assert files(demo) == {"network.py": "differs from Network.py only in upper and lower case"}


def test_size_names_the_largest(demo):
    with open(demo / "notes.txt", "wb") as file:
        file.truncate(MAX_BYTES + 1)
    (problem,) = (f for f in check_files(demo) if f.problem)
    assert problem.what == "has 5.0 MB; at most 5 MB are accepted"
    assert "the largest are notes.txt (5.0 MB)" in problem.advice


def test_too_many_files(demo):
    for k in range(1000):
        (demo / f"f{k}.txt").touch()
    assert files(demo)["the folder"] == "has more than 1000 files"


def test_a_file_called_almost_right(demo):
    (demo / "README.md").rename(demo / "readme.md")
    if (demo / "README.md").exists():
        pytest.skip("this file system ignores case")
    assert files(demo) == {"README.md": "is missing; readme.md is there: rename it"}


class Evil:
    def __reduce__(self):
        return (os.mkdir, ("pwned",))


def test_pickles_in_weights_are_not_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    np.savez("objects.npz", w=np.array([Evil()], object), allow_pickle=True)
    (tmp_path / "raw.npz").write_bytes(pickle.dumps(Evil()))
    np.save("one.npy", np.array([Evil()], object), allow_pickle=True)
    for name in ("objects.npz", "raw.npz", "one.npy"):
        (problem,) = weights_problems(tmp_path / name)
        assert problem.startswith("cannot be read without pickle"), name
    assert not (tmp_path / "pwned").exists()


@pytest.mark.parametrize(
    ("values", "said"),
    [
        (np.array([1.0, np.nan]), "array 'w' holds NaN or infinity"),
        (np.array([np.inf], np.float16), "array 'w' holds NaN or infinity"),
        (np.array(["a"]), "array 'w' does not hold numbers"),
        (np.array([1j]), "array 'w' does not hold numbers"),
    ],
)
def test_arrays_must_be_finite_numbers(values, said, tmp_path):
    np.savez(tmp_path / "w.npz", w=values, b=np.zeros(3))
    assert weights_problems(tmp_path / "w.npz") == [said]


def test_bombs_and_disguises(tmp_path):
    bomb = tmp_path / "bomb.npz"
    with zipfile.ZipFile(bomb, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("w.npy", bytes(200_000_000))
    assert bomb.stat().st_size < 1_000_000
    assert weights_problems(bomb) == ["unpacks to 200 MB; at most 100 MB are accepted"]
    stowed = tmp_path / "stowed.npz"
    with zipfile.ZipFile(stowed, "w") as archive:
        archive.writestr("code.py", "import os")
    assert weights_problems(stowed) == ["holds 'code.py', which is no array"]
    huge = tmp_path / "huge.npz"
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,), }"
    header = header.ljust(117) + b"\n"
    with zipfile.ZipFile(huge, "w") as archive:
        magic = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little")
        archive.writestr("w.npy", magic + header)
    (problem,) = weights_problems(huge)
    assert problem.startswith("cannot be read")


def test_safetensors(tmp_path):
    import json

    def write(header, data):
        text = json.dumps(header).encode()
        (tmp_path / "w.safetensors").write_bytes(len(text).to_bytes(8, "little") + text + data)
        return weights_problems(tmp_path / "w.safetensors")

    def about(dtype, shape, *offsets):
        return {"w": {"dtype": dtype, "shape": shape, "data_offsets": offsets}}

    numbers = np.array([1.0, 2.0], np.float32).tobytes()
    assert write(about("F32", [2], 0, 8) | {"__metadata__": {"a": "b"}}, numbers) == []
    nan = np.array([np.nan], np.float32).tobytes()
    assert write(about("F32", [1], 0, 4), nan) == ["array 'w' holds NaN or infinity"]
    assert write(about("F32", [9], 0, 8), numbers)[0].endswith("the size of its shape")
    assert write(about("F32", [2], 0, 80), numbers)[0].endswith("outside of the file")
    assert write([], b"")[0].startswith("cannot be read")
    (tmp_path / "w.safetensors").write_bytes(b"\x80\x04K\x01.")
    assert weights_problems(tmp_path / "w.safetensors") == ["is not a safetensors file"]


def manifest_of(demo, text):
    (demo / "submission.toml").write_text(text)
    findings, read = check_manifest(demo)
    return findings, read


def test_manifest_problems_have_lines(demo):
    text = MANIFEST.replace('"other"', '"pdi"').replace("licence", "license")
    findings, read = manifest_of(demo, f'{text}\n[training]\ndata = "x"\nseeds = 3\n"se\'ed" = 1\n')
    assert read is None
    assert [(f.line, f.what) for f in findings] == [
        (3, "key license is not known; did you mean licence?"),
        (5, "key family 'pdi' is not one of pid, residual, ppo, dqn, other; did you mean pid?"),
        (None, "key licence is missing"),
        (11, "key training.seeds must be a list"),
        (12, "key training.se'ed is not known; did you mean seeds?"),
    ]
    assert findings[2].advice == 'write licence = "Apache-2.0"'


def test_broken_toml_has_line_and_column(demo):
    (finding,), _ = manifest_of(demo, MANIFEST + "training = = 1\n")
    assert (finding.line, finding.column) == (8, 12)
    assert finding.what == "not TOML: Invalid value"


def test_what_a_manifest_says_is_looked_at(demo):
    text = MANIFEST.replace('"Apache-2.0"', '"Apache 2"') + "[training]\nper_lung = true\n"
    findings, read = manifest_of(demo, text.replace('"other"', '"ppo"'))
    assert read is not None
    assert [(f.problem, f.line, f.what.split(" ")[1]) for f in findings] == [
        (True, 3, "licence"),
        (False, 1, "name"),
        (False, 9, "training.per_lung"),
        (False, None, "training.data"),
    ]
    assert "did you mean Apache-2.0?" in findings[0].what


def sources(demo, text, **others):
    (demo / "controller.py").write_text(text)
    for name, content in others.items():
        (demo / f"{name}.py").write_text(content)
    return check_sources(demo)


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


ACT = "    def act(self, observation): return 1.0\n"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("x = 1\n", "defines no class Controller"),
        ("class MyController: pass\n", "defines no class Controller; did you mean MyController?"),
        ("class Controller:\n" + ACT, "class Controller has no method reset"),
        ("class Controller:\n" + RESET, "class Controller has no method act"),
        (
            f"class Controller:\n{RESET}    def act(self): return 1\n",
            "act cannot be called as act(",
        ),
        (f"class Controller:\n{RESET}    def act(self, a, b): return 1\n", "act cannot be called"),
        (
            f"class Controller:\n{RESET}    def act(self, a, *, b): return 1\n",
            "act cannot be called",
        ),
        (f"class Controller:\n{RESET}    async def act(self, o): return 1\n", "act is async"),
        (f"class Controller:\n{RESET}    def act(self, o): yield 1\n", "act is a generator"),
        (f"class Controller:\n{RESET}    def act(self, o): 1.0\n", "act returns nothing"),
        (f"class Controller:\n    def reset(self): pass\n{ACT}", "reset cannot be called"),
        (f"class Controller:\n    def __init__(self, n): pass\n{RESET}{ACT}", "Controller() needs"),
    ],
)
def test_the_class_and_its_methods(demo, text, said):
    (finding,) = sources(demo, text)
    assert finding.what.startswith(said)
    assert finding.problem


@pytest.mark.parametrize(
    "text",
    [
        "from network import *\n",
        "from other import Mine as Controller\n",
        "Controller = type('Controller', (), {})\n",
        "if True:\n    class Controller: pass\n",
        "class Base: pass\nclass Controller(Base): pass\n",
        f"class Controller:\n{RESET}    def act(self, o, gain=1, *more): return 1\n",
        f"class Controller:\n{RESET}    @staticmethod\n    def act(o): return 1\n",
        f"class Controller:\n{RESET}    def f(self, o): return 1\n    act = f\n",
        f"class Controller:\n    def __init__(self, n=1): pass\n{RESET}{ACT}",
        f"class Controller:\n{RESET}    def act(self, o):\n        raise NotImplementedError\n",
    ],
)
def test_what_only_a_run_can_tell_is_left_to_it(demo, text):
    assert sources(demo, text, other="") == []


def test_inner_functions_are_their_own(demo):
    text = (
        f"class Controller:\n{RESET}    def act(self, o):\n        def f(): return 1\n        f()\n"
    )
    (finding,) = sources(demo, text)
    assert finding.what == "act returns nothing"
    inner = "        def f(): yield 1\n        return next(f())\n"
    assert sources(demo, f"class Controller:\n{RESET}    def act(self, o):\n{inner}") == []


def test_nothing_is_run_or_imported(demo, tmp_path):
    bomb = f"open({str(tmp_path / 'ran')!r}, 'w')\n"
    sources(demo, bomb + GOOD, network=bomb)
    contract._opened(str(demo))
    check_files(demo)
    assert not (tmp_path / "ran").exists()


def test_output_cannot_disguise_itself(demo):
    (demo / "a\x1b[31m\u202e.txt").write_text("")
    (demo / "submission.toml").write_text('name = "\\u001b[2J"')
    text = "\n".join(contract.check(str(demo)).lines())
    assert "\x1b" not in text
    assert "\u202e" not in text


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
