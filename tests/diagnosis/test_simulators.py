"""What is under diagnosis, and its answers as a sensor would have shown them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from ventbench.diagnosis.simulators import answers, measured, plants_for
from ventbench.errors import InputError
from ventbench.lungs import lung
from ventbench.physics import physics
from ventbench.plants import frozen
from ventbench.plants.single_compartment import single_compartment
from ventbench.precision import float64
from ventbench.recordings import join
from ventbench.system_id import Noise, recorded

from . import made

NAMES = ("R20C50", "R5C10")


@pytest.fixture(scope="module")
def breaths():
    """Three breaths of each of two lungs, at rest before the first sample."""
    other = made.breaths(NAMES[1], n=3, seed=3, samples=50)
    other = dataclasses.replace(other, breath_id=other.breath_id + 100)
    return join([made.breaths(n=3, samples=50), other])


@pytest.fixture(scope="module")
def own():
    with float64():
        return {name: single_compartment(lung(name)) for name in NAMES}


def test_physics_is_the_closed_form_at_the_labels(breaths):
    quiet = dataclasses.replace(breaths, pressure=np.full_like(breaths.pressure, made.PEEP))
    found = answers("physics", quiet)
    for name in NAMES:
        here = breaths.lung_ids == name
        commands = breaths.u_in[here], breaths.u_out[here], breaths.dt[here]
        wanted = made.answer(*commands, lung(name).R, lung(name).C)[0]
        inspired = breaths.u_out[here] == 0
        error = (found[here] - wanted)[inspired]
        # What is solved in steps against what is exact.
        assert np.abs(error).max() < 0.2
        assert np.ptp(wanted[inspired]) > 10.0


def test_a_users_plants_are_taken_by_lung(breaths, own):
    found = answers(own, breaths)
    np.testing.assert_allclose(found, answers("physics", breaths), atol=1e-9)
    swapped = answers({NAMES[0]: own[NAMES[1]], NAMES[1]: own[NAMES[0]]}, breaths)
    assert np.abs(swapped - found)[breaths.inspiratory].max() > 5.0
    # Each starts at the first reading.
    assert np.array_equal(found[:, 0], breaths.pressure[:, 0])


def test_a_users_plants_may_have_other_physics_each(breaths):
    with float64():
        plants = {
            NAMES[0]: physics(lung(NAMES[0]), {"valve_delay": {"delay": 0.04}}),
            NAMES[1]: physics(lung(NAMES[1]), {"turbulent_resistance": {"quadratic": 8.0}}),
        }
    both = answers(plants, breaths)
    for name in NAMES:
        here = np.flatnonzero(breaths.lung_ids == name)
        alone = answers({name: plants[name]}, breaths.select(here))
        np.testing.assert_allclose(both[here], alone, atol=1e-9)


def test_the_official_ones_are_the_official_ones(breaths):
    found = answers("frozen", breaths)
    wanted = frozen.load().for_breaths
    assert type(plants_for("frozen")(breaths)) is type(wanted(breaths))
    assert np.all(np.isfinite(found))
    assert np.abs(found - answers("physics", breaths)).max() > 1.0


def test_what_there_is_not_is_refused(breaths, own):
    with pytest.raises(InputError, match=r"no simulator 'phisics'; choose physics, frozen"):
        plants_for("phisics")  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"the simulator has no lung R5C10; it has R20C50"):
        answers({NAMES[0]: own[NAMES[0]]}, breaths)


def test_a_breath_without_a_start_has_no_answer(breaths):
    pressure = breaths.pressure.copy()
    pressure[2, 0] = np.nan
    found = answers("physics", dataclasses.replace(breaths, pressure=pressure))
    assert np.isnan(found[2]).all()
    assert np.isfinite(np.delete(found, 2, axis=0)).all()


def test_the_sensors_noise_is_the_recordings():
    breaths = made.breaths(n=60, samples=60)
    pressure = breaths.pressure.copy()
    pressure[:, 20] = np.nan
    data = recorded(dataclasses.replace(breaths, pressure=pressure))
    answer = np.full(pressure.shape, 7.0)
    found = measured(data, answer, Noise((0.3, 20.0), (0.6, 0.0)))
    error = found.seen[:, 0] - 7.0
    seen = found.weight[:, 0] > 0
    assert np.array_equal(seen, np.isfinite(pressure))
    for part in (error[:, :1], error[seen]):
        assert np.std(part) == pytest.approx(0.3, rel=0.15 if part is error[:, :1] else 0.25)
    product = np.mean(error[:, 30:-1] * error[:, 31:]) / np.mean(error[:, 30:] ** 2)
    assert product == pytest.approx(0.6, abs=0.06)
    # The same commands, and the same noise each time.
    assert found.u_in is data.u_in
    again = measured(data, answer, Noise((0.3, 20.0), (0.6, 0.0)))
    assert np.array_equal(again.seen, found.seen)
    still = measured(data, np.where(np.isnan(pressure), np.nan, 7.0), Noise((1e-9,), (0.0,)))
    np.testing.assert_allclose(still.seen[:, 0][seen], 7.0, atol=1e-6)
