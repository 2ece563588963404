"""The 100 of rounds: the best PID of each lung, without a grid's edge."""

from __future__ import annotations

import numpy as np

from ventbench.entries.reference import PID_GAINS
from ventbench.plants.rigs import load_rigs
from ventbench.task.draws import COUNT
from ventbench.train import pid_search
from ventbench.train.pid_search import errors_on_draws


def test_no_neighbour_of_the_published_gains_and_no_pid_of_the_paper_is_better():
    rigs = load_rigs().of_training
    drawn = rigs.draws(COUNT)
    corners = np.array(
        [[1.5**k if at == axis else 1.0 for at in range(3)] for axis in range(3) for k in (-1, 1)]
    )
    paper = np.stack(np.meshgrid([2.0, 5.0, 10.0], [1.0, 4.0, 10.0], [0.0, 5.0]), -1).reshape(-1, 3)
    for lung, gains in enumerate(np.array(PID_GAINS)):
        tried = np.concatenate([gains[None], gains * corners, paper])
        errors = errors_on_draws(rigs, drawn, lung, tried).mean(axis=-1)
        assert errors[0] <= errors.min() + pid_search.AGREEMENT, lung


def test_a_search_finds_what_it_is_told_of(monkeypatch):
    """On a made-up error whose optimum is beyond the grid of the paper."""
    optimum = np.log([40.0, 3.0, 0.5])

    def errors(rigs, rig_draws, lung, gains, together=None):
        away = np.log(np.maximum(np.asarray(gains, float), 1e-9)) - optimum
        return np.sum(away**2, axis=-1)[..., None]

    monkeypatch.setattr(pid_search, "errors_on_draws", errors)
    found = pid_search.best_pids(load_rigs(), rig_draws=load_rigs().of_training.draws(1))
    assert found.agree.all()
    np.testing.assert_allclose(np.log(found.gains), np.tile(optimum, (6, 1)), atol=0.03)
    result = pid_search.tune_beyond(["R5C10", "R20C50"], draws=1)
    assert list(result["lungs"]) == ["R5C10", "R20C50"]
    for entry in (*result["lungs"].values(), result["single"]):
        np.testing.assert_allclose(np.log(entry["gains"]), optimum, atol=0.03)
