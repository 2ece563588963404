import errno
import json
import os
import stat
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from ventbench.base import files
from ventbench.base.errors import InputError
from ventbench.trajectories import Trajectories, load


def test_creates_folders_and_replaces(tmp_path):
    path = tmp_path / "a" / "b.txt"
    files.write_text(path, "eins")
    files.write_text(path, "zwei ü\n")
    assert path.read_bytes() == "zwei ü\n".encode()
    assert [p.name for p in path.parent.iterdir()] == ["b.txt"]


def test_never_half_written(tmp_path):
    path = tmp_path / "a.txt"
    files.write_text(path, "old")

    def fail(file):
        file.write(b"ne")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        files.write_atomically(path, fail)
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_mode_is_that_of_an_ordinary_file(tmp_path):
    path = tmp_path / "a.txt"
    files.write_text(path, "x")
    plain = tmp_path / "plain"
    plain.touch()
    assert stat.S_IMODE(os.stat(path).st_mode) == stat.S_IMODE(os.stat(plain).st_mode)


def test_folder_in_the_way(tmp_path):
    with pytest.raises(OSError, match="directory"):
        files.write_text(tmp_path, "x")
    assert list(tmp_path.iterdir()) == []


def test_symbolic_link_is_followed(tmp_path):
    target, link = tmp_path / "target.txt", tmp_path / "link.txt"
    target.write_text("old")
    link.symlink_to(target)
    files.write_text(link, "new")
    assert link.is_symlink()
    assert target.read_text() == "new"


def test_symbolic_link_to_a_file_not_there_yet(tmp_path):
    link = tmp_path / "link.txt"
    link.symlink_to(tmp_path / "later" / "target.txt")
    files.write_text(link, "new")
    assert link.is_symlink()
    assert (tmp_path / "later" / "target.txt").read_text() == "new"


def test_pipe_is_written_to(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    files.write_text(pipe, "through")
    assert os.read(reader, 100) == b"through"
    os.close(reader)
    assert stat.S_ISFIFO(os.stat(pipe).st_mode)
    assert [p.name for p in tmp_path.iterdir()] == ["pipe"]


def test_device_stays_a_device():
    with pytest.raises(OSError, match="/dev/full"):
        files.write_text(Path("/dev/full"), "x")
    assert stat.S_ISCHR(os.stat("/dev/full").st_mode)
    assert not list(Path("/dev").glob(".full*"))


def test_error_names_the_target(tmp_path):
    def full(file):
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OSError, match=r"answer\.json"):
        files.write_atomically(tmp_path / "answer.json", full)


CLAIM = """
import sys
from pathlib import Path
from ventbench.base import files
from ventbench.base.errors import InputError
try:
    files.claim_folder(Path(sys.argv[1]))
except InputError as error:
    print(error)
"""


def test_two_processes_cannot_claim_a_folder(tmp_path):
    def other():
        command = [sys.executable, "-c", CLAIM, str(tmp_path / "out")]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout

    assert other() == ""  # its claim ended with it
    files.claim_folder(tmp_path / "out")
    files.claim_folder(tmp_path / "out")
    assert "another ventbench writes to this folder" in other()
    assert not (tmp_path / "out").exists()


def test_a_file_cannot_be_claimed(tmp_path):
    file = tmp_path / "recording.csv"
    file.touch()
    with pytest.raises(InputError, match=r"recording\.csv is a file, not a folder"):
        files.claim_folder(file)
    with pytest.raises(InputError, match="cannot be written to"):
        files.claim_folder(file / "below")


def test_json(tmp_path):
    path = tmp_path / "a.json"
    files.write_json(path, {"a": [1, None, 0.1]})
    assert json.loads(path.read_text()) == {"a": [1, None, 0.1]}
    with pytest.raises(ValueError, match="JSON"):
        files.write_json(path, float("nan"))
    assert json.loads(path.read_text()) == {"a": [1, None, 0.1]}


def test_sha256(tmp_path):
    path = tmp_path / "a"
    path.write_bytes(b"abc")
    assert files.sha256(path) == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"


@pytest.fixture
def run():
    arrays = {k: np.random.default_rng(0).normal(size=(2, 1, 300)) for k in ("target", "pressure")}
    return Trajectories(
        "mine",
        "robustness",
        ("R5C10", "R20C50"),
        (10.0,),
        np.linspace(0, 8.97, 300),
        **arrays,
        u_in=arrays["target"],
        u_out=arrays["pressure"],
    )


def test_trajectories_round_trip(run, tmp_path):
    run.save(tmp_path / "run.npz")
    found = load(tmp_path / "run.npz")
    for name, value in vars(run).items():
        np.testing.assert_array_equal(getattr(found, name), value)


def test_trajectories_that_are_none(run, tmp_path):
    path = tmp_path / "run.npz"
    run.save(path)
    content = path.read_bytes()
    broken = bytearray(content)
    broken[len(content) // 2] ^= 255
    plain = tmp_path / "plain.npy"
    np.save(plain, np.zeros(3))
    other = tmp_path / "other.npz"
    np.savez(other, a=np.zeros(3))
    contents = [b"", b"text", content[:200], content[:-50], bytes(broken), plain.read_bytes()]
    for wrong in (*contents, other.read_bytes()):
        path.write_bytes(wrong)
        with pytest.raises(InputError, match=r"run.npz is not a trajectory file of ventbench"):
            load(path)
    with pytest.raises(FileNotFoundError):
        load(tmp_path / "none.npz")


def test_missing_file_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "_PACKAGE", tmp_path / "ventbench")
    with pytest.raises(InputError, match=r"data/bounds-v2.npz is missing"):
        files.data_path("bounds-v2.npz")


def test_wheel_comes_before_a_folder_beside_it(tmp_path, monkeypatch):
    package = tmp_path / "ventbench"
    (package / "_data").mkdir(parents=True)
    (package / "_data" / "x").touch()
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "x").touch()
    monkeypatch.setattr(files, "_PACKAGE", package)
    assert files.data_path("x") == package / "_data" / "x"
