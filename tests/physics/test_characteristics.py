"""Characteristics of mechanisms against formulas."""

from __future__ import annotations

import numpy as np
import pytest

from ventbench.physics import library, mechanism
from ventbench.physics.catalogue import basis_terms
from ventbench.physics.characteristics import characteristic


@pytest.mark.parametrize("name", [*library(), *basis_terms()])
def test_every_mechanism_has_one_that_vanishes_with_its_strength(name: str) -> None:
    about = mechanism(name).description
    strong = {about.strength.name: about.strength.strong}
    shown = characteristic(name, {"R": 10.0, "C": 30.0} | strong)
    assert shown is not None
    assert shown.x.shape == shown.baseline.shape == shown.acting.shape
    assert np.isfinite([shown.x, shown.baseline, shown.acting]).all()
    assert np.max(np.abs(shown.acting - shown.baseline)) > 1e-3
    off = characteristic(name, {"R": 10.0, "C": 30.0, about.strength.name: about.strength.neutral})
    if off is not None:
        later = off.x > 0  # a step has two values at zero
        np.testing.assert_allclose(off.acting[later], off.baseline[later], atol=1e-6)


def test_they_are_the_formulas() -> None:
    drop = characteristic("turbulent_resistance", {"R": 5.0, "quadratic": 8.0})
    assert drop is not None
    np.testing.assert_allclose(drop.baseline, 5.0 * drop.x)
    np.testing.assert_allclose(drop.acting, 5.0 * drop.x + 8.0 * drop.x * np.abs(drop.x))
    leak = characteristic("leak", {"conductance": 6.0, "exponent": 1.0})
    assert leak is not None
    np.testing.assert_allclose(leak.acting, 6.0 * leak.x, atol=1e-9)
    lag = characteristic("sensor_lag", {"tau": 0.04})
    assert lag is not None
    later = lag.x > 0  # ms
    exact = 20.0 - 15.0 * np.exp(-lag.x[later] / 40.0)
    np.testing.assert_allclose(lag.acting[later], exact, atol=0.15)
    for ms in (0.2, 20.0):  # exact, be the step longer than the period or not
        line = characteristic("pressure_line", {"time": 1e-3 * ms, "damping": 0.3})
        assert line is not None
        later = line.x > 0
        t, speed = line.x[later] / ms, np.sqrt(1.0 - 0.3**2)
        rings = np.exp(-0.3 * t) * (np.cos(speed * t) + 0.3 / speed * np.sin(speed * t))
        np.testing.assert_allclose(line.acting[later], 20.0 - 15.0 * rings, atol=1e-9)
    late = characteristic("valve_delay", {"delay": 0.03})
    assert late is not None
    assert late.x[np.argmax(late.acting > 0)] == pytest.approx(30.0, abs=0.5)
    stiff = characteristic("nonlinear_compliance", {"C": 40.0, "stiffening": 0.02})
    assert stiff is not None
    np.testing.assert_allclose(stiff.baseline, stiff.x / 40.0, rtol=1e-9)
    np.testing.assert_allclose(
        stiff.acting, -np.log(1.0 - 0.02 * stiff.x / 40.0) / 0.02, rtol=1e-6, atol=1e-9
    )
    relaxing = characteristic("viscoelasticity", {"C": 40.0, "ratio": 0.5, "time": 0.5})
    assert relaxing is not None
    held = relaxing.x > 0.2  # s: the stress of a lung that is held fades at its own time
    stress = relaxing.acting[held] - relaxing.baseline[held]
    np.testing.assert_allclose(
        np.polyfit(relaxing.x[held], np.log(stress), 1)[0], -1.0 / 0.5, rtol=0.03
    )


def test_a_small_dead_band_is_shown_large() -> None:
    shown = characteristic("valve_dead_band", {"width": 1.0}, largest_command=60.0)
    assert shown is not None
    assert shown.x[-1] == pytest.approx(6.0)
    assert shown.acting[-1] == pytest.approx(5.0)
    loop = characteristic("valve_hysteresis", {"width": 4.0}, largest_command=60.0)
    assert loop is not None
    same = np.flatnonzero(np.isclose(loop.x, loop.x[60]))
    assert loop.acting[same[-1]] - loop.acting[same[0]] == pytest.approx(4.0, abs=0.1)
