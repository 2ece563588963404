from __future__ import annotations

from ventbench.recordings import recordings_dir


def test_the_variable_names_the_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("VENTBENCH_RECORDINGS", str(tmp_path))
    assert recordings_dir() == tmp_path
    monkeypatch.setenv("VENTBENCH_RECORDINGS", str(tmp_path / "none"))
    assert recordings_dir() is None


def test_else_a_folder_beside_the_current_one(tmp_path, monkeypatch):
    monkeypatch.delenv("VENTBENCH_RECORDINGS", raising=False)
    (tmp_path / "shared" / "recordings").mkdir(parents=True)
    (tmp_path / "checkout" / "deep").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "checkout" / "deep")
    assert recordings_dir() == tmp_path / "shared" / "recordings"


def test_none_if_there_is_no_folder(tmp_path, monkeypatch):
    monkeypatch.delenv("VENTBENCH_RECORDINGS", raising=False)
    monkeypatch.setattr("pathlib.Path.is_dir", lambda self: False)
    assert recordings_dir() is None
