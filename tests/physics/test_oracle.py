"""Each mechanism against its differential equation, written anew and solved by scipy."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ventbench.base.compilation import float64
from ventbench.physics import library, physics
from ventbench.task.lungs import Lung

from . import cases

#: Largest and root mean square difference, cmH2O. Dead times are averages over a substep: a sample
#: that falls within that time after an edge of the expiratory valve differs.
TOLERANCE = {
    "circuit_compliance": (0.04, 0.004),
    "exhalation_valve_delay": (0.04, 0.008),
    # Its slope has a step where it opens.
    "relief_leak": (0.008, 0.003),
    # It begins to open within a step.
    "airway_opening": (0.008, 0.003),
    "sensor_hysteresis": (0.04, 0.008),
    "pressure_line": (0.01, 0.002),
    "valve_rate": (0.01, 0.002),
    "exhalation_valve_closing": (0.04, 0.008),
    "clock_offset": (0.04, 0.008),
    "clock_skew": (0.04, 0.008),
    "inertance": (0.01, 0.002),
    # Rings at 30 Hz; without smaller steps the error is 0.1 in the mean.
    "inertance.tubing": (0.05, 0.01),
    # The power is rounded off at small flow, where one below 1.75 is steep.
    "exhalation_valve_delay.slow": (0.04, 0.008),
    "turbulent_resistance.exponent": (0.008, 0.003),
}
EXACT = (0.004, 0.001)


def assert_close(found, solved, tolerance):
    error = np.abs(found - solved)
    assert error.max() < tolerance[0]
    assert np.sqrt(np.mean(error**2)) < tolerance[1]


@pytest.mark.parametrize("level", [pytest.param("mild", marks=pytest.mark.slow), "strong"])
@pytest.mark.parametrize("name", library())
def test_each_mechanism(name, level, predicted):
    m = cases.strengths(name, level)
    breaths = cases.recording(2, m)
    assert_close(predicted(breaths, m), breaths.pressure, TOLERANCE.get(name, EXACT))


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("command_rounding.bias", 0.5),
        ("command_rounding.step", 1.7),
        ("valve_lag.second", 0.06),
        ("sensor_lag.second", 0.06),
        ("inertance.tubing", 0.5),
        ("turbulent_resistance.exponent", 1.75),
        ("turbulent_resistance.exponent", 1.5),
        ("valve_hysteresis.give", 1.0),
        ("valve_hysteresis.give", 0.4),
        ("valve_hysteresis.smooth", 1.0),
        ("valve_hysteresis.smooth", 0.4),
        ("valve_dead_band.crack", 1.0),
        ("valve_dead_band.crack", 0.3),
        ("valve_dead_band.driver", 1.0),
        ("valve_dead_band.driver", 0.4),
        ("supply_droop.linear", 1.0),
        ("supply_droop.linear", 0.4),
        ("nonlinear_compliance.sigmoid", 1.0),
        ("nonlinear_compliance.sigmoid", 0.4),
        ("nonlinear_compliance.sigmoid", 2.5),
        ("patient_effort.relaxing", 1.0),
        ("patient_effort.relaxing", 0.3),
        ("sensor_drift.warming", 3.0),
        ("gain_drift.warming", 3.0),
        ("resistance_drift.warming", 3.0),
        ("compliance_drift.warming", 3.0),
        ("exhalation_valve_delay.slow", 1.0),
        ("exhalation_valve_delay.slow", 0.5),
    ],
)
def test_each_shape(path, value, predicted):
    name, _, parameter = path.partition(".")
    m = {name: cases.strengths(name)[name] | {parameter: value}}
    breaths = cases.recording(2, m)
    assert_close(predicted(breaths, m), breaths.pressure, TOLERANCE.get(path, EXACT))


@pytest.mark.parametrize("driver", [0.0, 0.5, 1.0])
def test_a_dead_band_before_and_behind_the_play(driver, predicted):
    m = cases.strengths("valve_hysteresis", "strong") | cases.strengths("valve_dead_band", "strong")
    m["valve_dead_band"] |= {"driver": driver}
    breaths = cases.recording(2, m)
    assert_close(predicted(breaths, m), breaths.pressure, EXACT)


def test_a_lung_that_stiffens_and_becomes_softer_by_the_breath(predicted):
    """The curve is that of the lung as it has become."""
    m = cases.strengths("compliance_drift") | cases.strengths("nonlinear_compliance")
    breaths = cases.recording(2, m)
    assert_close(predicted(breaths, m), breaths.pressure, EXACT)


@pytest.mark.parametrize(("R", "C"), [(5.0, 10.0), (20.0, 50.0), (50.0, 20.0)])
def test_base(R, C, predicted):
    breaths = cases.recording(2, {}, R=R, C=C, gain=15.0, R_ex=8.0)
    assert_close(predicted(breaths, {}, gain=15.0, R_ex=8.0), breaths.pressure, EXACT)


def test_all_together(predicted):
    m = {}
    for name in library():
        m |= cases.strengths(name, "mild")
    breaths = cases.recording(2, m)
    assert_close(predicted(breaths, m), breaths.pressure, (0.15, 0.02))


def test_a_valve_that_opens_and_closes_late(predicted):
    m = cases.strengths("exhalation_valve_closing") | cases.strengths("exhalation_valve_delay")
    breaths = cases.recording(2, m)
    assert_close(predicted(breaths, m), breaths.pressure, (0.1, 0.03))


def test_flow_and_volume():
    m = cases.strengths("leak") | cases.strengths("viscoelasticity")
    breaths = cases.recording(2, m)
    assert breaths.flow is not None
    assert breaths.volume is not None
    with float64():
        plant = physics(Lung(10.0, 25.0), m, PEEP=5.0)
        commands = [jnp.asarray(x.T[:-1] * 1.0) for x in (breaths.u_in, breaths.u_out, breaths.dt)]
        state, _ = plant.init(jnp.asarray(breaths.pressure[:, 0]))
        _, seen = jax.lax.scan(lambda s, c: plant.step(s, *c), state, commands)
    pressure, _, flow, volume = (np.asarray(x).T for x in seen)
    np.testing.assert_allclose(pressure, breaths.pressure[:, 1:], atol=0.01)
    np.testing.assert_allclose(flow, breaths.flow[:, 1:], atol=1.0)
    np.testing.assert_allclose(volume, breaths.volume[:, 1:], atol=0.3)
