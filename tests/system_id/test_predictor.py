"""Pressures at several parameters at once, and their derivatives."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.physics import cases
from ventbench.base.compilation import float64
from ventbench.physics import parameter, paths
from ventbench.system_id import START, Predictor, make_data, parameter_values
from ventbench.system_id import predictor as predictor_module
from ventbench.task.rollouts import open_loop

ORDER = (*paths(), START)

#: None at a kink.
ACTING = {
    "R": 11.0,
    "C": 23.0,
    "PEEP": 5.0,
    "gain": 21.0,
    "R_ex": 4.0,
    "valve_lag.tau": 0.03,
    "valve_curve.loss": 0.2,
    "valve_dead_band.width": 1.23,
    "circuit_compliance.compliance": 1.0,
    "leak.conductance": 5.0,
    "inertance.inertance": 0.04,
    "turbulent_resistance.quadratic": 3.0,
    "nonlinear_compliance.stiffening": 0.02,
    "viscoelasticity.ratio": 0.3,
    "sensor_lag.tau": 0.03,
    "sensor_drift.drift": 1.0,
    "supply_droop.drop": 0.1,
}

LATE = ("valve_delay.delay", "exhalation_valve_delay.opening", "exhalation_valve_closing.closing")

#: Dead times, s; what closes late by a millisecond or two changes less than the integrator errs.
AT = [(path, first) for path in LATE for first in (0.0, 0.041) if (path, first) != (LATE[2], 0.0)]


@pytest.fixture(scope="module")
def data():
    return make_data(cases.recording(6, {}))


@pytest.mark.parametrize(
    ("ids", "positions"),
    [([3, 4, 8], (0.0, 0.2, 1.0)), ([8, 3, 4], (0.0, 0.5, 1.0)), ([7], (0.0,))],
    ids=["breaths left out", "ids that do not rise", "one breath"],
)
def test_breaths_that_were_left_out_keep_their_places(ids, positions):
    breaths = replace(cases.recording(len(ids), {}), breath_id=np.array(ids))
    assert make_data(breaths).position == pytest.approx(positions)


@pytest.fixture(scope="module")
def predictor(data):
    return Predictor(data, paths())


@pytest.fixture(scope="module")
def values(data):
    return parameter_values(data, paths(), ACTING)


def columns(names):
    return tuple(ORDER.index(name) for name in names)


@pytest.fixture(scope="module")
def exact(predictor):
    """Slopes along a direction, by automatic differentiation of the same model."""
    commands = predictor._commands

    @jax.jit
    def slope(values, direction):
        def run(values):
            static = predictor._static | {"skip_idle": False}
            divisions = jnp.asarray(4)  # an inertance acts
            return predictor_module._run(values, commands, divisions, **static)

        return jax.jvp(run, (values,), (jnp.broadcast_to(direction, values.shape),))[1]

    def slopes(values, column):
        direction = np.zeros(len(ORDER))
        direction[column] = 1.0
        with float64():
            return np.asarray(slope(jnp.asarray(values), jnp.asarray(direction)))

    return slopes


@pytest.mark.slow
def test_are_those_of_automatic_differentiation(predictor, values, exact):
    names = (*ACTING, START)
    seen, slopes = predictor.derivatives(values, columns(names))
    np.testing.assert_allclose(seen, predictor.predict(values), rtol=0, atol=1e-10)
    for k, name in enumerate(names):
        other = exact(values, ORDER.index(name))
        assert np.abs(other).max() > 0.01, name
        size = np.sqrt(np.mean(other**2))
        assert np.sqrt(np.mean((slopes[:, k] - other) ** 2)) < 1e-4 * size, name


@pytest.mark.parametrize(("path", "first"), AT)
def test_of_dead_times_are_those_of_milliseconds(predictor, values, path, first):
    """At zero too, where the smallest one moves the integrator's cuts."""
    (column,) = columns([path])
    ends = np.stack([values, values])
    ends[0, :, column], ends[1, :, column] = first, first + 2e-3
    there, beyond = predictor.predict_all(ends)
    moved = (beyond - there) / 2e-3
    slope = predictor.derivatives(ends[0], (column,))[1][:, 0]
    assert np.sqrt(np.mean(moved**2)) > 1.0
    assert np.sqrt(np.mean((slope - moved) ** 2)) < 0.2 * np.sqrt(np.mean(moved**2))


def test_are_zero_where_the_point_beside_cannot_be_simulated(predictor, data, values, monkeypatch):
    def predict_all(points):
        seen = np.zeros((len(points), *data.measured.shape))
        seen[1, 2, :, 7:], seen[1, 2, :, 8] = np.inf, np.nan
        return seen

    monkeypatch.setattr(predictor, "predict_all", predict_all)
    assert np.array_equal(predictor.derivatives(values, (0, 1))[1], np.zeros_like(seen_of(data, 2)))
    monkeypatch.setattr(predictor, "predict_all", lambda points: predict_all(points)[::-1])
    assert not np.isfinite(predictor.derivatives(values, (0,))[1]).all(), "nor at the point itself"


def seen_of(data, count):
    return np.zeros((len(data), count, *data.measured.shape[1:]))


def test_look_within_the_bounds_alone(predictor, data, monkeypatch):
    asked = []

    def predict_all(points):
        asked.append(points)
        return np.zeros((len(points), *data.measured.shape))

    monkeypatch.setattr(predictor, "predict_all", predict_all)
    low = np.array([parameter(name).low for name in paths()])
    high = np.array([parameter(name).high for name in paths()])
    for bound in (low, high):
        values = np.tile(np.append(bound, 5.0), (len(data), 1))
        predictor.derivatives(values, tuple(range(len(ORDER))))
        points = asked.pop()
        assert np.all((points[:, :, :-1] >= low) & (points[:, :, :-1] <= high))
        moved = points[1:] != points[:1]
        assert len(moved) == len(ORDER)
        assert np.array_equal(moved, np.eye(len(ORDER), dtype=bool)[:, None].repeat(len(data), 1))


@pytest.mark.parametrize("count", [1, 2, 3, 5, 6, 13])
def test_several_points_are_each_by_itself(predictor, values, count):
    points = np.repeat(values[None], count, axis=0)
    points[:, :, ORDER.index("leak.conductance")] += np.arange(count)[:, None]
    alone = np.stack([predictor.predict(point) for point in points])
    np.testing.assert_allclose(predictor.predict_all(points), alone, rtol=0, atol=1e-10)
    assert count == 1 or np.abs(np.diff(alone, axis=0)).max() > 0.01


def test_points_that_ring_are_each_by_themselves(predictor, values):
    """They take smaller steps, and the others of the same call do not."""
    points = np.repeat(values[None], 3, axis=0)
    points[::2, :, ORDER.index("inertance.inertance")] = 0.0
    points[:, 0, ORDER.index("inertance.inertance")] = 0.0  # one breath of each
    alone = np.stack([predictor.predict(point) for point in points])
    np.testing.assert_allclose(predictor.predict_all(points), alone, rtol=0, atol=1e-10)
    assert np.abs(alone[1] - alone[0]).max() > 0.01


def test_a_plant_predicts_what_the_predictor_does(predictor, values, data):
    """Of a rig that rings, too."""
    row = values[0].copy()
    row[ORDER.index("inertance.tubing")] = 0.5
    plant = predictor.plant(dict(zip(ORDER[:-1], row[:-1], strict=True)))
    assert plant.divisions > 1
    with float64():
        commands = (data.u_in[:1], data.u_out[:1], data.dt[:1])
        pressure = open_loop(plant, *(jnp.asarray(x) for x in (row[-1:], *commands)))
    seen = predictor.predict(np.repeat(row[None], len(data), axis=0))[0, 0]
    np.testing.assert_allclose(np.asarray(pressure)[0], seen, rtol=0, atol=1e-9)


@pytest.mark.parametrize("count", [1, 39, 40, 119, 120, 320, 321, 700, 1300])
def test_blocks_hold_every_simulation_once(count):
    blocks = predictor_module._blocks(count, 40)
    ends = [0, *(last for _, last, _ in blocks)]
    assert [first for first, _, _ in blocks] == ends[:-1]
    assert ends[-1] == count
    assert all(width in (40, 320) and last - first <= width for first, last, width in blocks)
    # None computes more than eight times the small size for less than three of it.
    assert all(last - first >= 120 for first, last, width in blocks if width == 320)
