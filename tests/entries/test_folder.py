import hashlib
import os

import pytest

from ventbench.base import files
from ventbench.entries import folder
from ventbench.entries.folder import bundled, open_submission, resolve
from ventbench.sandbox.child.cell import SubmissionError


def test_bundled_by_name_and_by_path(monkeypatch):
    assert {"pid_best", "pid_robust"} <= set(bundled())
    by_name = open_submission("pid_best")
    monkeypatch.chdir(files.submissions_folder().parent)
    by_path = open_submission("submissions/pid_best/")
    assert by_name.folder == by_path.folder
    assert by_name.sha256 == by_path.sha256
    assert (by_name.label, by_path.label) == ("pid_best", "submissions/pid_best")


def test_a_folder_comes_before_a_bundled_name(make, tmp_path, monkeypatch):
    make(name="pid_best")
    monkeypatch.chdir(tmp_path)
    assert resolve("pid_best") == tmp_path / "pid_best"


def test_every_bundled_submission_is_in_order():
    for name in bundled():
        assert open_submission(name).manifest.name == name


def test_unknown():
    with pytest.raises(
        SubmissionError, match=r"pid_bset: no such folder .* did you mean pid_best\?"
    ):
        open_submission("pid_bset")
    with pytest.raises(SubmissionError, match=r"bundled are .*pid_best, .*pid_robust"):
        open_submission("x/y")


def test_file_instead_of_folder(make):
    path = make() / "controller.py"
    with pytest.raises(SubmissionError, match=r"is a file; give the folder that holds controller"):
        open_submission(str(path))


def test_missing_files_are_all_named(tmp_path):
    with pytest.raises(SubmissionError) as caught:
        open_submission(str(tmp_path))
    assert [p.split(": ")[1] for p in caught.value.problems] == [
        "controller.py is missing",
        "submission.toml is missing",
    ]


def test_symbolic_links_are_refused(make, tmp_path):
    path = make()
    (tmp_path / "secret").write_text("x")
    (path / "weights").symlink_to(tmp_path / "secret")
    (path / "more").symlink_to(tmp_path)
    with pytest.raises(SubmissionError) as caught:
        open_submission(str(path))
    assert [p.split(": ")[1][:20] for p in caught.value.problems] == [
        "more is a symbolic l",
        "weights is a symboli",
    ]


def test_pipes_are_refused(make):
    path = make()
    os.mkfifo(path / "pipe")
    with pytest.raises(SubmissionError, match="pipe is neither a file nor a folder"):
        open_submission(str(path))


def test_too_large(make):
    path = make()
    with open(path / "weights.npz", "wb") as file:
        file.truncate(6_000_000)
    with pytest.raises(SubmissionError, match=r"6\.0 MB; at most 5 MB"):
        open_submission(str(path))


def test_too_many_files(make, monkeypatch):
    monkeypatch.setattr(folder, "MAX_FILES", 3)
    with pytest.raises(SubmissionError, match="more than 3 files"):
        open_submission(str(make(a="", b="")))


def test_hash_is_that_of_sha256sum(make):
    path = make(helper="x = 1\n")
    lines = ""
    for name in ("controller.py", "helper.py", "submission.toml"):
        lines += f"{hashlib.sha256((path / name).read_bytes()).hexdigest()}  {name}\n"
    expected = hashlib.sha256(lines.encode()).hexdigest()
    assert open_submission(str(path)).sha256 == expected
    (path / "__pycache__").mkdir()
    (path / "__pycache__" / "helper.pyc").write_bytes(b"x")
    assert open_submission(str(path)).sha256 == expected
    (path / "helper.py").write_text("x = 2\n")
    assert open_submission(str(path)).sha256 != expected
