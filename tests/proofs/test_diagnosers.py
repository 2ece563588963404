"""Rivals answer what they are asked."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from proofs.challenge.answer import answer
from proofs.challenge.first.rig import record
from proofs.challenge.folder import ChallengeFolder
from proofs.challenge.make import make
from proofs.challenge.reveal import reveal
from proofs.challenge.run import Limits, built_in, find
from proofs.diagnosers import lisdd
from proofs.diagnosers.common import Templates
from proofs.diagnosers.gaussian_process import _Process
from proofs.diagnosers.sindy import thresholded_least_squares


def test_the_project_enters_itself_and_its_rivals() -> None:
    assert built_in() == (
        "forward_search", "gaussian_process", "lisdd", "refit", "sindy", "ventbench",
    )  # fmt: skip


def test_a_process_learns_a_smooth_discrepancy_and_tells_it_from_noise() -> None:
    rng = np.random.default_rng(0)
    x = rng.standard_normal((120, 2))
    noise = 0.1 * rng.standard_normal(120)
    process = _Process(x, np.sin(x[:, 0]) + noise)
    new = rng.standard_normal((50, 2))
    assert np.abs(process.mean(new) - np.sin(new[:, 0])).mean() < 0.1
    assert process.evidence > 50.0
    assert process.scales[0] < process.scales[1], "only the first input matters"
    assert _Process(x, noise).evidence < 2.0


def test_energy_is_found_in_the_region_that_has_it() -> None:
    rng = np.random.default_rng(1)
    regions = np.tile(np.repeat(np.arange(8), 25), (40, 1))
    residual = 0.1 * rng.standard_normal(regions.shape)
    residual[regions == 5] *= 3.0
    model = Templates(
        residual, residual, residual, np.ones(regions.shape), residual[None], {"leak": residual}
    )
    guilty, noise = lisdd._energy(model, regions)
    assert guilty == {5}
    assert noise == pytest.approx(0.1, rel=0.1)


def test_sparse_regression_finds_the_terms_that_act() -> None:
    rng = np.random.default_rng(2)
    x = rng.standard_normal((400, 6))
    y = 1.5 * x[:, 1] - 0.7 * x[:, 4] + 0.05 * rng.standard_normal(400)
    found = thresholded_least_squares(x, y, 0.2)
    assert np.flatnonzero(found).tolist() == [1, 4]
    np.testing.assert_allclose(found[[1, 4]], [1.5, -0.7], atol=0.02)
    assert not thresholded_least_squares(x, y, np.inf).any()
    assert not thresholded_least_squares(x, y, 2.0).any()


@pytest.mark.slow
@pytest.mark.parametrize("name", built_in())
def test_every_diagnoser_answers_a_case(name: str, tmp_path) -> None:
    folder = ChallengeFolder(tmp_path / "c")
    make("rivals", folder.path, "masked", 1, record=partial(record, steps=8))
    assert answer(folder, find(name), limits=Limits(600.0, 16.0)) == {}
    (case,) = reveal([folder], ["rivals"], name).cases.values()
    assert case.inspiration < 5.0
