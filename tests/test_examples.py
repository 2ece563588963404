"""The example recordings are what their manifest says, and the script makes them again."""

from __future__ import annotations

import importlib.util
import tomllib

import numpy as np
import pytest

from ventbench import recordings
from ventbench.base import files
from ventbench.base.files import example

FOLDER = example("manifest.toml").parent
MANIFEST = tomllib.loads((FOLDER / "manifest.toml").read_text("utf-8"))
NAMES = ("concealed.csv", "sound.csv", "flow.csv")


def test_the_manifest_names_every_recording():
    assert set(MANIFEST["recordings"]) == set(NAMES) == {path.name for path in FOLDER.glob("*.csv")}


@pytest.mark.parametrize("name", NAMES)
def test_each_is_small_sound_and_known_by_its_hash(name):
    path, about = example(name), MANIFEST["recordings"][name]
    assert files.sha256(path) == about["sha256"]
    assert path.stat().st_size < 300_000
    breaths = recordings.load(path)
    assert len(breaths) == about["breaths"]
    assert list(breaths.by_lung_index) == [about["label"]]
    assert (breaths.flow is not None) == (name == "flow.csv")
    assert np.all(np.isfinite(breaths.pressure))


def test_the_script_makes_them_again_to_the_byte(tmp_path):
    spec = importlib.util.spec_from_file_location("make_examples", FOLDER / "make.py")
    assert spec is not None
    assert spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    for path in script.make(tmp_path):
        assert path.read_bytes() == (FOLDER / path.name).read_bytes(), path.name


def test_flow_tells_that_the_label_is_wrong():
    from ventbench.mechanics import identify

    (lung,) = identify(recordings.load(example("flow.csv")))
    assert not lung.match.label_matches
    assert lung.match.fitted_C == pytest.approx(27.0, rel=0.03)
    assert lung.match.fitted_R == pytest.approx(20.0, rel=0.05)
