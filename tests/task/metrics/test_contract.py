"""What every secondary figure must hold. The cases are made from the registry of figures.

A new figure is one function and one line in the registry, as the last test shows.
"""

from __future__ import annotations

import numpy as np
import pytest

from ventbench.entries.cells import protocol_of
from ventbench.entries.folder import submission_of
from ventbench.entries.scoring import run_protocol
from ventbench.plants.rigs import Rigs
from ventbench.plants.single_compartment import single_compartment
from ventbench.plants.stacking import stack
from ventbench.task.lungs import LUNGS
from ventbench.task.metrics.score import FIGURES, Figure, InspirationSignals, figures

#: Lungs, PIPs, breaths and steps of the signals.
SHAPE = (2, 3, 4, 34)
UNITS = ("_s", "_cmH2O", "_percent", "_percent_per_step", "swings", "_share")


def signals(seed: int = 0) -> InspirationSignals:
    """Made-up inspirations towards their PIPs, with swings and commands beyond the valve."""
    random = np.random.default_rng(seed)
    pip = random.uniform(15.0, 35.0, SHAPE[:2])[..., None] * np.ones(SHAPE[:3])
    rise = 1.0 - np.exp(-np.arange(SHAPE[-1]) / 4.0)
    swing = random.normal(0.0, 1.0, SHAPE)
    requested = random.uniform(-20.0, 120.0, SHAPE)
    return InspirationSignals(
        pressure=5.0 + (pip[..., None] - 5.0) * rise + swing,
        u_in=np.clip(requested, 0.0, 100.0),
        requested=requested,
        peep=np.full(SHAPE[:3], 5.0),
        pip=pip,
        dt=np.full(SHAPE[:3], 0.03),
    )


def check(name: str, figure: Figure) -> None:
    """Raise AssertionError unless the figure keeps the contract."""
    assert name.endswith(UNITS), f"{name} does not end in its unit"
    given = signals()
    before = [array.copy() for array in given]
    whole = figure(given)
    assert whole.shape == SHAPE[:3]
    assert np.any(np.isfinite(whole)), "it exists nowhere"
    assert np.all(whole[np.isfinite(whole)] >= 0.0)
    for array, old in zip(given, before, strict=True):
        np.testing.assert_array_equal(array, old)
    # Inspirations do not see each other.
    one = figure(InspirationSignals(*(array[1, 2, 3] for array in given)))
    np.testing.assert_array_equal(one, whole[1, 2, 3])
    # NaN does not hide: where nothing is known there is no figure.
    broken = given._replace(
        **{key: getattr(given, key).copy() for key in ("pressure", "u_in", "requested")}
    )
    for array in (broken.pressure, broken.u_in, broken.requested):
        array[0, 1, 2, -3] = np.nan
    partly = figure(broken)
    assert np.isnan(partly[0, 1, 2])
    others = np.ones(SHAPE[:3], bool)
    others[0, 1, 2] = False
    np.testing.assert_array_equal(partly[others], whole[others])


@pytest.mark.parametrize("name", FIGURES)
def test_a_figure_keeps_the_contract(name):
    check(name, FIGURES[name])


def test_one_line_in_the_registry_brings_a_figure_into_scores_and_under_the_contract(monkeypatch):
    monkeypatch.setitem(FIGURES, "peak_cmH2O", lambda s: s.pressure.max(axis=-1))
    check("peak_cmH2O", FIGURES["peak_cmH2O"])
    assert figures(signals())["peak_cmH2O"].shape == SHAPE[:3]
    plants = stack([single_compartment(LUNGS[0])])
    score = run_protocol(
        submission_of(lambda seen: 2.0 * (seen.target - seen.pressure)),
        protocol_of(Rigs(LUNGS[:1], plants), pips=(20.0,)),
    )
    assert list(score.figures) == list(FIGURES)
    assert score.figures["peak_cmH2O"].shape == (1, 1, 2)
