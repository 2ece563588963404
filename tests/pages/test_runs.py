from __future__ import annotations

import dataclasses
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ventbench import pages
from ventbench.base.errors import InputError
from ventbench.pages import panels as shared
from ventbench.trajectories import Trajectories

WRITERS = (pages.write_rerun, pages.write_report)
Writer = Callable[[Path, Sequence[Trajectories]], Path]


def altered(run: Trajectories, **changes: Any) -> Trajectories:
    return dataclasses.replace(run, **changes)


@pytest.mark.parametrize("write", WRITERS)
def test_no_run(write: Writer, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no run to show"):
        write(tmp_path / "out", [])
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("write", WRITERS)
def test_mismatching_runs(write: Writer, best: Trajectories, tmp_path: Path) -> None:
    fewer = altered(
        best,
        lungs=best.lungs[:5],
        **{k: getattr(best, k)[:5] for k in ("target", "pressure", "u_in", "u_out")},
    )
    for other, message in (
        (fewer, "has lungs"),
        (altered(best, pips=(10.0, 15.0, 20.0, 25.0, 30.0, 36.0)), "has pips"),
        (altered(best, pressure=best.pressure[:, :, :200]), "pressure has shape"),
        (altered(best, time=best.time[:200]), "300 steps"),
        (altered(best, time=best.time * 2), "other times"),
    ):
        with pytest.raises(InputError, match=message):
            write(tmp_path / "out", [best, other])
    assert not list(tmp_path.iterdir())


def test_errors_by_hand(best: Trajectories, failed: Trajectories) -> None:
    total = 0.0
    for breath in (1, 2):
        for step in range(34):
            t = 100 * breath + step
            total += abs(best.pressure[3, 4, t] - 30.0)
    assert best.errors().to_numpy()[3, 4] == pytest.approx(total / 68, rel=1e-12)
    errors = failed.errors().to_numpy()
    assert np.isnan(errors[1, 2])
    # The infinite pressure lies in an expiration, which is not scored.
    assert np.isfinite(errors[1, 3])
    assert np.isnan(errors).sum() == 1


def test_scored_steps() -> None:
    scored = shared.scored()
    assert scored.sum() == 68
    assert np.flatnonzero(scored)[[0, 33, 34, -1]].tolist() == [100, 133, 200, 233]


def test_labels_are_short_printable_and_distinct(best: Trajectories) -> None:
    names = ["a", "a", "", "\x00\x1b[31m\n", "x" * 500]
    labels = shared.labels([altered(best, name=name) for name in names])
    assert labels[:3] == ["a", "a (2)", "unnamed"]
    assert all(label.isprintable() and len(label) <= 40 for label in labels)


@pytest.mark.parametrize(
    ("write", "module"),
    list(zip(WRITERS, ("rerun", "jinja2"), strict=True)),
)
def test_missing_extra(
    write: Writer,
    module: str,
    best: Trajectories,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(InputError, match=rf"need {module}: install ventbench\[view\]"):
        write(tmp_path / "out", [best])
    assert not list(tmp_path.iterdir())


def test_import_loads_no_extra() -> None:
    code = (
        "import sys, ventbench.pages; "
        "print([m for m in ('rerun', 'matplotlib', 'jinja2', 'jax') if m in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=600
    )
    assert done.stdout.strip() == "[]"


def test_open_viewer_without_display(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("ventbench.pages.report.has_display", lambda: False)
    path = tmp_path / "run.rrd"
    with pytest.raises(FileNotFoundError):
        pages.open_viewer(path)
    path.write_bytes(b"RRF2")
    assert pages.open_viewer(path) is False
    said = capsys.readouterr().out
    assert f"rerun {path}" in said
    assert "--web-viewer" in said


def test_open_viewer_with_display(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[list[str]] = []
    monkeypatch.setattr("ventbench.pages.report.has_display", lambda: True)
    monkeypatch.setattr(
        "ventbench.pages.report.subprocess.Popen", lambda command, **_: started.append(command)
    )
    path = tmp_path / "run.rrd"
    path.write_bytes(b"RRF2")
    assert pages.open_viewer(path) is True
    assert started == [[sys.executable, "-m", "rerun", str(path)]]
