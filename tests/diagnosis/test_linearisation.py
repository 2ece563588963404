"""What the parameters absorb is projected out; the rest tells what a refit would gain."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np
import pytest

from ventbench.diagnosis.evaluator import Evaluator
from ventbench.diagnosis.hypothesis import FittedModel, Hypothesis, Linearisation, linearise
from ventbench.system_id import START, Noise

from . import small

#: Coloured, and without tails.
NOISE = Noise((0.2,), (0.5,), np.inf)


class Linear(NamedTuple):
    evaluator: Evaluator
    base: FittedModel
    place: Linearisation


@pytest.fixture(scope="module")
def bent() -> Linear:
    """The base model of a recording with weak turbulence."""
    evaluator = small.split(
        small.made(small.effect("turbulent_resistance", quadratic=1.0), noise=0.1)
    )
    exact = dataclasses.replace(evaluator.settings.fit, tolerance=1e-6, iterations=30)
    settings = dataclasses.replace(evaluator.settings, fit=exact)
    evaluator = dataclasses.replace(evaluator, settings=settings)
    base = evaluator.fit(Hypothesis(), NOISE)
    return Linear(evaluator, base, linearise(base.problem, base.minimum.x, clip=np.inf))


def whitened(difference: np.ndarray) -> np.ndarray:
    """By the definition of the noise: each sample given the one before, ``(n, T)``."""
    sigma, ar = NOISE.sigma[0], NOISE.ar[0]
    white = difference / sigma
    white[:, 1:] = (difference[:, 1:] - ar * difference[:, :-1]) / (sigma * np.sqrt(1 - ar**2))
    return white


def changed(found: Linear, path: str, breath: int | None = None) -> np.ndarray:
    """Whitened change of the prediction by a small change of a parameter, by a difference."""
    problem = found.base.problem
    column = (*problem.predictor.names, START).index(path)
    rows = slice(None) if breath is None else slice(breath, breath + 1)
    ends = []
    for sign in (1.0, -1.0):
        values = found.base.values.copy()
        values[rows, column] *= 1.0 + 1e-5 * sign
        ends.append(problem.predictor.predict(values)[:, 0])
    return whitened((ends[0] - ends[1]) * 1e4)


@pytest.mark.parametrize("path", ["R", "C", "R_ex", "PEEP"])
def test_residual_and_templates_are_orthogonal_to_refitted_parameters(bent, path):
    slope = changed(bent, path)
    scale = np.linalg.norm(slope) * np.linalg.norm(bent.place.residual)
    assert abs(np.sum(slope * bent.place.residual)) < 1e-4 * scale
    # A template of the same change is absorbed nearly whole.
    values = bent.base.values.copy()
    values[:, bent.base.problem.predictor.names.index(path)] *= 1.001
    seen = bent.base.problem.predictor.predict(values)
    raw = bent.place.whiten(seen - bent.place.prediction)
    assert np.linalg.norm(bent.place.template(seen)) < 0.01 * np.linalg.norm(raw)


@pytest.mark.parametrize("breath", [0, 5])
def test_each_breath_absorbs_its_own_start(bent, breath):
    slope = changed(bent, START, breath)
    assert np.count_nonzero(np.abs(slope).sum(axis=1)) == 1
    scale = np.linalg.norm(slope) * np.linalg.norm(bent.place.residual)
    assert abs(np.sum(slope * bent.place.residual)) < 1e-4 * scale


def test_bases_are_orthonormal(bent):
    own, shared = bent.place.breath_basis, bent.place.shared_basis
    np.testing.assert_allclose(own @ own.swapaxes(1, 2), np.ones((8, 1, 1)), atol=1e-6)
    np.testing.assert_allclose(shared @ shared.T, np.eye(4), atol=1e-6)
    again = bent.place.project_out_shared(
        bent.place.project_out_breath(bent.place.residual[:, None])
    )
    np.testing.assert_allclose(again[:, 0], bent.place.residual, atol=1e-6)


def test_gain_is_the_decrease_of_the_cost_after_a_refit(bent):
    values = bent.base.values.copy()
    names = bent.base.problem.predictor.names
    values[:, names.index("turbulent_resistance.quadratic")] = 0.2
    seen = bent.base.problem.predictor.predict(values)
    template = bent.place.template(seen)
    power = np.sum(template**2)
    share = -np.sum(bent.place.residual * template) / power  # the best multiple
    refitted = bent.evaluator.fit(Hypothesis(("turbulent_resistance",)), NOISE, bent.base)
    fallen = bent.base.minimum.cost - refitted.minimum.cost
    assert fallen > 8.0
    assert 0.5 * share**2 * power == pytest.approx(fallen, rel=0.1)
    found = refitted.column("turbulent_resistance.quadratic")[0]
    assert 0.2 * share == pytest.approx(found, rel=0.1)


def test_outlying_samples_are_clipped(bent):
    seen = bent.base.problem.data.measured.copy()
    seen[2, 0, 10] += 5.0  # 25 standard deviations
    problem = dataclasses.replace(
        bent.base.problem, data=dataclasses.replace(bent.base.problem.data, measured=seen)
    )
    at = bent.base.minimum.x
    free, cut = (linearise(problem, at, clip=clip).residual for clip in (np.inf, 4.0))
    assert np.abs(free).max() > 15.0
    assert np.abs(cut).max() < 5.0


def test_a_valve_gain_of_each_breath_is_absorbed_by_the_breath(bent):
    evaluator = dataclasses.replace(bent.evaluator, gain_sd=0.1)
    fitted = evaluator.fit(Hypothesis(), NOISE, iterations=2)
    place = linearise(fitted.problem, fitted.minimum.x)
    assert place.breath_basis.shape[1] == 2
    assert place.shared_basis.shape[0] == 4
