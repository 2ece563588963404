"""The official simulators: each lung is a set of rigs that passed a test."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ventbench.base.compilation import float64
from ventbench.plants import frozen
from ventbench.plants.hybrid import RELIEF, RELIEF_ROOM, Hybrid
from ventbench.task import protocol
from ventbench.task.lungs import LUNGS, RECORDED_LUNGS
from ventbench.task.rollouts import open_loop
from ventbench.train.rigs.fit import LAMINAR_SHARE
from ventbench.train.rigs.label_test import label_tests


@pytest.fixture(scope="module")
def official():
    return frozen.load()


def test_rigs_are_sessions_of_their_lung_that_passed(official):
    assert len(official.rigs) == len(LUNGS)
    for lung, rigs in zip(LUNGS, official.rigs, strict=True):
        assert len(rigs) >= 2
        assert len(set(rigs)) == len(rigs)
        assert all(official.sessions.table[rig].lung == lung.id for rig in rigs)
        assert not official.rejected.keys() & set(rigs)
        everything = {i for i, row in enumerate(official.sessions.table) if row.lung == lung.id}
        assert everything == set(rigs) | (everything & official.rejected.keys())
    assert all(reason for reason in official.rejected.values())


def test_the_reference_rig_has_the_most_measured_breaths(official):
    measured = {test["session"]: test["measured"] for test in official.manifest["label_tests"]}
    for rigs in official.rigs:
        assert measured[rigs[0]] == max(measured[rig] for rig in rigs)


def test_a_third_of_the_rigs_of_each_lung_is_held_out(official):
    everything = zip(official.rigs, official.held_out_rigs, official.training_rigs, strict=True)
    for rigs, apart, training in everything:
        assert 3 * len(apart) >= len(rigs) > len(apart)
        assert set(apart) <= set(rigs[1:])
        assert set(training) == set(rigs) - set(apart)
        assert training[0] == rigs[0]


def test_what_was_trained_on_before_it_was_held_out_is_marked(official):
    pairs = zip(official.seen_rigs, official.held_out_rigs, strict=True)
    assert all(set(seen) <= set(apart) for seen, apart in pairs)
    assert sum(map(len, official.seen_rigs)) == 4


def test_fitted_resistance_and_compliance_are_those_of_the_label(official):
    plants = official.sessions_plants
    for lung, rigs in zip(LUNGS, official.rigs, strict=True):
        compliance = 1000.0 / plants.E[:, list(rigs)]
        np.testing.assert_allclose(np.median(compliance, axis=0), lung.C, rtol=0.2)


def test_what_the_absolute_test_of_labels_says_of_the_scored_rigs(official):
    """As docs/simulators.md has it; the labels' errors are those of the manifest."""
    rows = official.manifest["label_tests"]
    members = [jax.tree.map(lambda leaf, k=k: leaf[k], official.members) for k in range(6)]
    errors = {}
    for row in rows:
        others = {row["lung"]: row["error_own_label"]}
        others[row["best_other_label"]] = row["error_best_other_label"]
        errors[row["session"]] = [others.get(lung.id, np.inf) for lung in RECORDED_LUNGS]
    measured, breaths = (np.array([row[key] for row in rows]) for key in ("measured", "breaths"))
    counts = (measured, breaths)
    tests = label_tests(
        members[0], members[1:], errors, official.sessions, RECORDED_LUNGS, counts, LAMINAR_SHARE
    )
    scored = [tests[rig] for rigs in official.rigs for rig in rigs]
    assert sorted(test.session for test in scored if test.label_true) == [16, 17, 18]
    failed = {test.session: test.reasons for test in scored if test.reasons}
    assert sorted(failed) == [3, 4, 6, 13, 14]
    assert all("too high for the label 20" in reasons[0] for reasons in failed.values())
    above = {t.session: round(100 * (t.C / 20 - 1)) for t in scored if t.lung.C == 20}
    assert above == {3: 27, 4: 27, 5: 19, 6: 23, 13: 26, 14: 26}
    R = {label: [t.R for t in scored if label == t.lung.R] for label in (5, 20)}
    assert 2.3 < min(R[5]) < max(R[5]) < 3.65
    assert 10.0 < min(R[20]) < max(R[20]) < 13.5


def test_reference_plants_are_the_first_rigs(official):
    first = np.array([rigs[0] for rigs in official.rigs])
    for plants, sessions in zip(
        jax.tree.leaves(official.ensemble), jax.tree.leaves(official.sessions_plants), strict=True
    ):
        np.testing.assert_array_equal(plants, sessions[:, first])
    for plants, member in zip(
        jax.tree.leaves(official.plants), jax.tree.leaves(official.ensemble), strict=True
    ):
        np.testing.assert_array_equal(plants, member[0])


def test_airway_pressure_is_the_reading_without_sensor(official):
    """Without lag and shift the sensor shows the airway pressure."""
    with float64():
        plant = jax.tree.map(jnp.asarray, official.plants)
        zero = jnp.zeros(len(LUNGS))
        ideal: Hybrid = plant.replace(sensor_lag=zero + 1e-6, rising=zero, falling=zero)
        states = [p.init(zero + 5.0)[0] for p in (plant, ideal)]
        rest = plant.init(zero + 5.0)[1]
        np.testing.assert_allclose(rest.airway_pressure, 5.0, rtol=1e-12)
        for u_in in (30.0, 60.0, 10.0):
            states[0], shown = plant.step(states[0], zero + u_in, zero, zero + 0.03)
            states[1], ideally = ideal.step(states[1], zero + u_in, zero, zero + 0.03)
            np.testing.assert_allclose(shown.airway_pressure, ideally.reading, rtol=1e-9)
            assert float(jnp.abs(shown.airway_pressure - shown.reading).max()) > 0.01


@pytest.fixture(scope="module")
def all_rigs(official):
    """Scored plants of every scored rig, leaves ``(rigs, ...)``."""
    at = [rig for rigs in official.rigs for rig in rigs]
    return jax.tree.map(lambda leaf: leaf[0, at], official.sessions_plants)


STEPS = 40
_roll = jax.jit(jax.vmap(open_loop, in_axes=(0, None, None, None, None)))


def answers(plants: Hybrid, u_in: np.ndarray) -> np.ndarray:
    """Pressures of all rigs under rows of commands, the outlet closed: ``(rigs, n, STEPS)``."""
    rows = len(u_in)
    with float64():
        start, closed = np.full(rows, protocol.PEEP), np.zeros((rows, STEPS))
        return np.asarray(_roll(plants, start, u_in, closed, closed + protocol.DT))


def test_pressure_rises_with_the_command(all_rigs):
    levels = np.arange(0.0, 101.0, 5.0)
    pressure = answers(all_rigs, np.repeat(levels[:, None], STEPS, axis=1))
    assert np.isfinite(pressure).all()
    assert pressure.max() < RELIEF + RELIEF_ROOM
    below = pressure[:, 1:, 1:] <= RELIEF
    assert np.diff(pressure, axis=1)[:, :, 1:][below].min() > -1e-9


def test_no_rig_oscillates_by_itself(all_rigs):
    """A command held: the pressure never turns once the outlet has closed."""
    held = np.repeat([[15.0], [30.0], [60.0]], STEPS, axis=1)
    closing = np.where(np.arange(STEPS) < 10, 30.0, 0.0)
    pressure = answers(all_rigs, np.vstack([held, closing]))
    rises = np.diff(pressure[:, :-1], axis=2)[:, :, 4:]
    assert rises[pressure[:, :-1, 5:] < RELIEF].min() > -1e-9
    # The valve closes: what went in stays in.
    assert np.ptp(pressure[:, -1, 25:], axis=1).max() < 1e-3


def test_members_differ_most_where_nothing_was_recorded(official):
    """The wide-open valve is hardly recorded; the ensemble says so."""
    with float64():
        plants = jax.tree.map(jnp.asarray, official.ensemble)
        flow = np.asarray([plants.valve(jnp.full((), u)) for u in (20.0, 100.0)])
    spread = np.std(np.log(flow), axis=1).mean(axis=1)
    assert spread[1] > 2.0 * spread[0]
