"""The benchmark of a rig of one's own: what is finished is kept, and shown in tables."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest

from ventbench.base import files

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def benchmark():
    return runpy.run_path(str(ROOT / "benchmarks" / "own_rig.py"))


def kept(folder: Path, promised: float, error: float, apart: float) -> None:
    draws = (error + apart + 0.01 * np.arange(20)).tolist()
    files.write_json(folder, {"promised": promised, "rig": error, "draws": draws, "gains": [1.0]})


def test_finished_parts_are_read_and_shown(benchmark, tmp_path):
    settings = {"rig": "late", "words": benchmark["RIGS"]["late"].words, "breaths": 8}
    settings |= {"iterations": 0, "updates": 7}
    folder = benchmark["WorkFolder"](tmp_path / "parts", settings).folder
    files.write_json(folder / "missing.json", ["sensor_lag"])
    for number, error in ((0, 4.0), (3, 2.5)):
        kept(folder / f"pid-{number}.json", 2.5, error, 0.1)
        for seed in (0, 1):
            kept(folder / f"residual-{number}-{seed}.json", 1.5, error - 1.0, 0.1 + seed)
    # Nothing is left to compute, so that this ends at once.
    result = benchmark["run"]("late", tmp_path, 8, 0, (0, 1), 7)
    lines = benchmark["table"]("late", result).splitlines()
    assert lines[0].startswith("**A valve that answers 60 ms late")
    assert lines[0].endswith("The diagnosis names `sensor_lag`.")
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[4:]]
    assert [row[0] for row in cells] == ["R-C lung at the label", "the rig itself"]
    assert cells[0][1:4] == ["2.500", "4.000", "4.195"]
    assert cells[1][4:7] == ["1.500", "1.500", "2.195"]


def test_networks_that_were_not_trained_are_not_shown(benchmark):
    part = {"promised": 1.0, "rig": 1.0, "draws": [1.0] * 20}
    rows = {label: {"pid": part, "residual": []} for label in benchmark["SIMULATORS"][:2]}
    text = benchmark["table"]("leak", {"missing": [], "trained_on": rows})
    assert text.startswith("**A leak of 15 mL/s")
    assert "network" not in text
