from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ventbench.base.errors import InputError
from ventbench.pages import write_rerun
from ventbench.task import protocol
from ventbench.trajectories import Trajectories

pytest.importorskip("rerun", reason="needs the extra ventbench[view]")
chunk = pytest.importorskip("rerun.chunk", reason="reads files back with rerun >= 0.41")

PARTS = ("target", "pressure", "u_in", "u_out", "error", "scored")


def read(path: Path) -> dict[str, dict[str, Any]]:
    """Entities of a recording: static columns as their first row, others as arrays, s for time."""
    entities: dict[str, dict[str, Any]] = {}
    for part in chunk.RrdReader(str(path)).store().stream():
        batch, columns = part.to_record_batch(), entities.setdefault(part.entity_path, {})
        for name in batch.schema.names:
            column = batch.column(name)
            if name == "run_time":
                columns["time"] = np.array([t.value for t in column]) / 1e9
            elif name.startswith("Scalars"):
                columns["values"] = np.array(column.to_pylist()).T
            elif part.is_static and ":" in name:
                columns[name.partition(":")[2]] = column[0].as_py()
    return entities


@pytest.fixture(scope="module")
def entities(
    best: Trajectories, robust: Trajectories, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, dict[str, Any]]:
    path = tmp_path_factory.mktemp("rerun") / "run.rrd"
    assert write_rerun(path, [best, robust]) == path
    assert [item.name for item in path.parent.iterdir()] == ["run.rrd"]
    assert path.stat().st_size < 2_000_000
    return read(path)


def test_entities(entities: dict[str, dict[str, Any]], best: Trajectories) -> None:
    expected = {f"/{lung}/{part}" for lung in best.lungs for part in PARTS}
    expected |= {
        f"/compare/pid_robust/{lung}/{part}"
        for lung in best.lungs
        for part in ("pressure", "u_in", "u_out", "error")
    }
    found = {path for path in entities if not path.startswith("/__")}
    assert found == expected | {"/about"}


def test_values(
    entities: dict[str, dict[str, Any]], best: Trajectories, robust: Trajectories
) -> None:
    for i, lung in enumerate(best.lungs):
        acting = np.arange(best.time.size) % protocol.BREATH_STEPS < protocol.INSPIRATION_STEPS
        for part, array in (
            ("target", np.where(acting, best.target, np.nan)),
            ("pressure", best.pressure),
            ("u_in", best.u_in),
            ("u_out", best.u_out),
            ("error", best.pressure - best.target),
        ):
            series = entities[f"/{lung}/{part}"]
            np.testing.assert_array_equal(series["values"], array[i])
            np.testing.assert_allclose(series["time"], best.time, atol=1e-8)
        reference = entities[f"/compare/pid_robust/{lung}/pressure"]
        np.testing.assert_array_equal(reference["values"], robust.pressure[i])
        bar = entities[f"/{lung}/scored"]["values"][0]
        assert np.flatnonzero(np.isfinite(bar))[[0, -1]].tolist() == [100, 233]


def test_styles(entities: dict[str, dict[str, Any]]) -> None:
    look = entities["/R20C50/pressure"]
    assert look["names"] == [f"PIP {pip:g}, cmH2O" for pip in protocol.PIPS]
    assert len(set(look["colors"])) == len(protocol.PIPS)
    assert look["colors"] == entities["/R5C10/u_in"]["colors"], "a PIP keeps its colour"
    assert entities["/R5C10/u_in"]["names"][0] == "PIP 10, %"
    assert entities["/R5C10/u_in"]["interpolation_mode"] == [2], "a command holds: step after"
    assert entities["/compare/pid_robust/R5C10/u_in"]["names"][0] == "pid_robust, %"


def test_one_blueprint(best: Trajectories, tmp_path: Path) -> None:
    path = write_rerun(tmp_path / "run.rrd", [best])
    reader = chunk.RrdReader(str(path))
    assert len(reader.recordings()) == len(reader.blueprints()) == 1


def test_text_panel(best: Trajectories, failed: Trajectories) -> None:
    from ventbench.pages.rerun_log import markdown

    text = markdown([best, failed], ["pid_best", failed.name])
    assert text.startswith("# pid\\_best\n")
    assert "\\!\\[i\\]\\(http\\:" in text, "a name is neither link nor image"
    assert "10 to 35 cmH2O" in text


def test_hostile_name(best: Trajectories, failed: Trajectories, tmp_path: Path) -> None:
    """The viewer ends itself over characters that its font lacks: none may reach it."""
    entities = read(write_rerun(tmp_path / "run.rrd", [failed, best, best]))
    texts = json.dumps(
        [entities["/about"]["text"], *(e.get("names", []) for e in entities.values())],
        ensure_ascii=False,
    )
    assert all(ord(c) < 0x180 for c in texts)
    assert "/compare/pid_best/R5C10/error" in entities
    assert "/compare/pid_best\\ \\(2\\)/R5C10/error" in entities


def test_overwrites_in_one_step(best: Trajectories, tmp_path: Path) -> None:
    path = tmp_path / "new" / "run.rrd"
    write_rerun(path, [best])
    write_rerun(path, [best])
    assert [item.name for item in path.parent.iterdir()] == ["run.rrd"]


def test_rerun_switched_off(
    best: Trajectories, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RERUN", "off")
    with pytest.raises(InputError, match="variable RERUN"):
        write_rerun(tmp_path / "run.rrd", [best])
    assert not list(tmp_path.iterdir())


def test_axes_of_the_overview(best: Trajectories, robust: Trajectories) -> None:
    """u_in has one axis whatever the commands, and no time label falls on the edge."""
    from ventbench.pages import rerun_log

    quiet = dataclasses.replace(best, u_in=best.u_in * 0.05)
    for shown in ([best, robust], [quiet]):
        ranges = {plot.quantity: plot.range for plot in rerun_log._plots(shown)}
        low, high = ranges["u_in"] or (0.0, 0.0)
        assert low < 0.0
        assert protocol.U_MAX < high < 1.1 * protocol.U_MAX
    end = protocol.BREATHS * protocol.BREATH_STEPS * protocol.DT
    boundary = rerun_log._last_scored_breath().view_range
    assert boundary is not None
    seconds = boundary.as_arrow_array().to_pylist()[0]["end"] / 1e9
    assert end - 0.3 < seconds < end - 0.05
