"""`ventbench check` by reading: files and weights, each problem with what to do."""

import os
import pickle
import shutil
import zipfile

import numpy as np
import pytest

from ventbench.entries.folder import (
    MAX_BYTES,
    MAX_SEEDS,
    check_files,
    open_submission,
    weights_problems,
)
from ventbench.sandbox.child.cell import SubmissionError


def files(folder):
    return {f.file: f.what for f in check_files(folder) if f.problem}


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


def test_too_many_seeds(demo):
    for seed in range(MAX_SEEDS + 1):
        assert files(demo) == {}
        (demo / "seeds" / f"{seed}").mkdir(parents=True)
        shutil.copy(demo / "weights.npz", demo / "seeds" / f"{seed}")
    assert files(demo) == {"seeds": "has more than 10 folders"}
    with pytest.raises(SubmissionError, match="seeds has more than 10 folders"):
        open_submission(str(demo))


@pytest.mark.parametrize("name", ["controller.py", "sub/helper.py", "other.npz", "note.txt"])
def test_seeds_hold_weights_and_nothing_else(demo, name):
    path = demo / "seeds" / "0" / name
    path.parent.mkdir(parents=True)
    shutil.copy(demo / ("weights.npz" if name.endswith("npz") else "controller.py"), path)
    expected = "stands for no weights of the submission"
    assert expected in files(demo)[f"seeds/0/{name}"]
    with pytest.raises(SubmissionError, match=f"seeds/0/{name} {expected}"):
        open_submission(str(demo))


def test_a_file_called_almost_right(demo):
    (demo / "README.md").rename(demo / "readme.md")
    if (demo / "README.md").exists():
        pytest.skip("this file system ignores case")
    assert files(demo) == {"README.md": "is missing"}


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
