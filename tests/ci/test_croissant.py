"""croissant.json is what the script writes, is valid, and its hashes are those that are pinned."""

import hashlib
import importlib
import json
import tomllib
import warnings
from pathlib import Path
from typing import Any

import pytest

from ci.croissant import COLUMNS, FILE, FILES, ROOT, metadata
from ventbench.plants import frozen
from ventbench.recordings import load

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")


@pytest.fixture
def mlc() -> Any:
    """The validator, which is no part of the lock: ``make test-slow`` installs it."""
    with warnings.catch_warnings(action="ignore"):
        return importlib.import_module("mlcroissant")


def test_hashes_are_those_of_the_files_and_of_the_manifests() -> None:
    written = json.loads(FILE.read_text("utf-8"))
    hashes = {file["@id"]: file["sha256"] for file in written["distribution"]}
    assert set(hashes) == set(FILES)
    for name, value in hashes.items():
        assert hashlib.sha256((ROOT / name).read_bytes()).hexdigest() == value
    for manifest in ("manifest.toml", "population.toml"):
        pinned = tomllib.loads((ROOT / "data/simulators" / manifest).read_text("utf-8"))["files"]
        for name, file in pinned.items():
            wanted = frozen.TRAINING_LIST_SHA256 if name == frozen.TRAINING_LIST else file["sha256"]
            assert hashes[f"data/simulators/{name}"] == wanted


@pytest.mark.slow
@pytest.mark.usefixtures("mlc")
def test_it_is_as_the_script_writes_it() -> None:
    written = json.loads(FILE.read_text("utf-8"))
    assert written == json.loads(json.dumps(metadata(), default=str)), "run python -m ci.croissant"


@pytest.mark.slow
def test_it_is_valid(mlc: Any) -> None:
    assert not mlc.Dataset(str(FILE)).metadata.issues.errors


@pytest.mark.slow
@pytest.mark.parametrize("case", ["concealed", "flow", "sound"])
def test_the_cases_are_read_through_it(mlc: Any, case: str) -> None:
    rows = list(mlc.Dataset(str(FILE)).records(case))
    breaths = load(Path(ROOT / f"data/examples/{case}.csv"))
    assert len(rows) == int(breaths.valid.sum())
    assert {name.partition("/")[2] for name in rows[0]} >= set(COLUMNS) - {"flow"}
    pressures = [row[f"{case}/pressure"] for row in rows]
    assert pressures == pytest.approx(breaths.pressure[breaths.valid].tolist(), abs=1e-4)
