"""Comparisons of variants: what differs, what is kept on disk, what the tables say."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from proofs.__main__ import app
from proofs.paper.paper import load_stored
from proofs.studies import BASE, controllers, networks
from proofs.studies.stitched import Architecture, Training
from submissions.residual_mlp.train import ResidualConfig
from tests.train.conftest import synthetic
from ventbench.base.errors import InputError
from ventbench.plants.single_compartment import single_compartment
from ventbench.plants.stacking import stack
from ventbench.recordings import write
from ventbench.task.lungs import LUNGS

SMALL = ResidualConfig(
    updates=2, copies=1, widths=(8,), pressures=2, commands=2, ahead=2, members=2
)
GAINS = (2.0, 4.0, 0.3)
TINY = Architecture(pressures=2, controls=2, width=4, depth=2, boundaries=1, boundary_width=4)


@dataclass(frozen=True)
class Textbook:
    """R-C lungs in place of the frozen ones: they compile in a moment."""

    scale: float = 1.0

    @property
    def ensemble(self) -> Any:
        made = stack([single_compartment(lung) for lung in LUNGS])
        other = made.vary(jnp.full(6, 1.2 * self.scale), jnp.ones(6))
        return jax.tree.map(np.asarray, stack([made, other]))

    @property
    def plants(self) -> Any:
        return jax.tree.map(lambda leaf: leaf[0], self.ensemble)

    def about(self) -> dict[str, Any]:
        return {"scale": self.scale}


def test_each_variant_differs_in_one_thing():
    config = ResidualConfig()
    found = controllers.variants(config)
    assert found[BASE] == controllers.Variant(found["base"].meaning, config)
    for name, one in found.items():
        changed = [k for k, v in asdict(one.config).items() if v != asdict(config)[k]]
        wanted = 0 if name in ("base", "direct") else 2 if name == "twice as far back" else 1
        assert len(changed) == wanted
        assert one.direct == (name == "direct")
    base = networks.ARCHITECTURE
    for name, one in networks.variants(base).items():
        changed = [k for k, v in asdict(one).items() if v != asdict(base)[k]]
        assert len(changed) == (name != BASE)
        if changed:
            assert name.endswith(f" {getattr(one, changed[0])}")


def test_controllers_are_compared(tmp_path):
    told = []

    def compare(simulators: Any = Textbook(), config: ResidualConfig = SMALL) -> pd.DataFrame:
        return controllers.compare(
            simulators,
            tmp_path,
            (0, 1),
            config=config,
            only=["direct"],
            draws=1,
            gains=GAINS,
            progress=lambda *x: told.append(x),
        )

    runs: Any = compare()
    assert runs["variant"].tolist() == ["base", "base", "direct", "direct"]
    assert runs["seed"].tolist() == [0, 1, 0, 1]
    # Two updates from nothing do not reach a PID, nor do they spoil one.
    by_name = runs.groupby("variant")["nominal"].mean()
    assert by_name["direct"] > by_name["base"] + 1.0
    assert np.all(np.isfinite(runs[list(controllers.FIGURES)]))
    assert [share for _, share in told] == sorted(share for _, share in told)
    assert not list(tmp_path.glob("rows/*.npz"))
    assert runs.columns.tolist() == ["variant", "seed", *controllers.FIGURES]
    told.clear()
    pd.testing.assert_frame_equal(compare(), runs)
    assert len(told) == 4  # nothing was trained
    with pytest.raises(InputError, match="choose another folder"):
        compare(config=replace(SMALL, learning_rate=0.1))
    with pytest.raises(InputError, match="choose another folder"):
        compare(simulators=Textbook(2.0))


def test_a_training_in_another_process_is_that_in_this_one(tmp_path):
    def compare(folder: str, workers: int) -> pd.DataFrame:
        lungs: Any = Textbook()
        return controllers.compare(
            lungs,
            tmp_path / folder,
            (0,),
            config=SMALL,
            only=[],
            draws=1,
            gains=GAINS,
            workers=workers,
        )

    pd.testing.assert_frame_equal(compare("there", 1), compare("here", 0))


def test_the_table_of_controllers_pairs_seeds():
    figures = {"draws": 3.0, "exploitation": 0.4}
    runs = pd.DataFrame(
        [
            {"variant": name, "seed": seed, "nominal": nominal} | figures
            for name, seed, nominal in (
                ("base", 0, 2.0),
                ("base", 1, 2.4),
                ("wide", 0, 1.9),
                ("wide", 1, 2.6),
            )
        ]
    )
    rows: Any = controllers.summary(runs).set_index("variant")
    assert rows.loc["wide", "nominal"] == pytest.approx(2.25)
    assert rows.loc["wide", "nominal_change_low"] == pytest.approx(-0.1)
    assert rows.loc["wide", "nominal_change_high"] == pytest.approx(0.2)
    assert rows.loc["base", "nominal_change_high"] == 0.0
    assert rows.loc["wide", "draws_change_low"] == 0.0
    stored, known = controllers.stored(runs, SMALL), load_stored()["controllers"]
    assert stored["variants"][1]["nominal"] == pytest.approx(2.25)
    assert stored["variants"][0].keys() == known["variants"][0].keys()


def test_networks_of_another_process_are_those_of_this_one(tmp_path):
    folder = tmp_path / "recordings"
    folder.mkdir()
    write(synthetic(each=2), folder / networks.MEASURED)
    write(synthetic(each=1, seed=1, first_id=1000), folder / networks.RECONSTRUCTED)

    def compare(out: str, workers: int) -> pd.DataFrame:
        return networks.compare(
            folder,
            tmp_path / out,
            base=TINY,
            config=Training(steps=1, batch=2),
            members=2,
            only=[],
            workers=workers,
        )

    pd.testing.assert_frame_equal(compare("there", 1), compare("here", 0))


def test_networks_are_compared(tmp_path):
    folder, out = tmp_path / "recordings", tmp_path / "out"
    folder.mkdir()
    write(synthetic(each=4), folder / networks.MEASURED)
    more = synthetic(each=2, seed=1, first_id=1000)
    write(more, folder / networks.RECONSTRUCTED)
    told = []

    def compare() -> pd.DataFrame:
        return networks.compare(
            folder,
            out,
            base=TINY,
            config=Training(steps=2, batch=2),
            members=2,
            only=["H_p 1"],
            progress=lambda *x: told.append(x),
        )

    breaths: Any = compare()
    assert breaths["variant"].unique().tolist() == ["base", "H_p 1"]
    assert np.all(np.isfinite(breaths["error"]))
    assert told[-1][1] == pytest.approx(1.0)
    rows: Any = networks.summary(breaths).set_index("variant")
    mean = breaths[breaths["variant"] == "H_p 1"]["error"].mean()
    assert rows.loc["H_p 1", "mean"] == pytest.approx(mean)
    assert rows.loc["H_p 1", "change"] == pytest.approx(mean - rows.loc["base", "mean"])
    assert rows.loc["base", "low95"] == rows.loc["base", "high95"] == 0.0
    stored, known = networks.stored(breaths), load_stored()["networks"]
    assert stored["base"] == known["base"]
    assert stored["variants"][0].keys() <= known["variants"][0].keys()
    told.clear()
    pd.testing.assert_frame_equal(compare(), breaths)
    assert len(told) == 2


def test_unknown_variants_are_refused(tmp_path):
    for command in (["controllers"], ["networks", "--recordings", str(tmp_path)]):
        asked = ["study", *command, "--only", "H_p 7", "--out", str(tmp_path / "out")]
        result = CliRunner().invoke(app, asked)
        assert isinstance(result.exception, InputError)
        assert "--only H_p 7: there is no such variant; choose from base" in str(result.exception)


def test_networks_need_recordings(tmp_path):
    asked = ["study", "networks", "--recordings", str(tmp_path / "none")]
    result = CliRunner().invoke(app, asked)
    assert isinstance(result.exception, InputError)
    assert "give --recordings DIR" in str(result.exception)


def test_controllers_by_the_command(tmp_path, monkeypatch):
    asked = {}

    def compare(simulators, out, seeds, **options):
        asked.update(options, seeds=list(seeds))
        names = ("base", "deep")
        figures = dict.fromkeys(controllers.FIGURES, 2.0)
        return pd.DataFrame([{"variant": name, "seed": 0} | figures for name in names])

    monkeypatch.setattr("ventbench.plants.frozen.load", Textbook)
    monkeypatch.setattr(controllers, "compare", compare)
    given = ["study", "controllers", "--seeds", "1", "--updates", "7", "--only", "deep"]
    paths = ["--out", str(tmp_path / "out"), "--json", str(tmp_path / "x")]
    result = CliRunner().invoke(app, [*given, *paths])
    assert result.exit_code == 0, result.output
    assert "deep" in result.output
    assert (asked["seeds"], asked["only"]) == ([0], ["deep"])
    assert asked["config"].updates == 7
    found = json.loads((tmp_path / "x").read_text())
    assert [row["variant"] for row in found["variants"]] == ["base", "deep"]
