"""Shape parameters that a recording asks for, and other dead times."""

from __future__ import annotations

import numpy as np
import pytest

from ventbench.diagnosis.hypothesis import Hypothesis
from ventbench.diagnosis.selection.candidate_comparison import fit_with_noise
from ventbench.diagnosis.selection.shape_parameters import (
    fit_with_shape,
    free_shape_parameters,
    other_dead_times,
    shapes_at_default,
)
from ventbench.system_id import Noise

from . import small


@pytest.mark.parametrize("form", ["linear", "library"])
def test_a_shape_parameter_is_freed_if_the_recording_asks_for_it(form):
    effect = small.effect("leak", form, conductance=20.0)
    evaluator = small.split(small.made(effect, noise=0.1, seed=5))
    found = free_shape_parameters(
        evaluator, evaluator.fit(Hypothesis(("leak",)), Noise((0.1,), (0.0,)))
    )
    # The library's is an orifice.
    assert found.hypothesis.free == (("leak.exponent",) if form == "linear" else ())
    wanted = 1.0 if form == "linear" else 0.5
    assert found.column("leak.exponent")[0] == pytest.approx(wanted, abs=0.05)


@pytest.mark.parametrize(
    ("effect", "path", "wanted"),
    [
        (small.effect("valve_lag", "two lags", tau=0.1), "valve_lag.second", 0.05),
        (small.effect("valve_hysteresis", "soft play", width=5.0), "valve_hysteresis.give", 1.0),
        (
            small.effect("turbulent_resistance", "exponent 1.75", quadratic=10.0),
            "turbulent_resistance.exponent",
            1.75,
        ),
        (small.effect("sensor_drift", "warming", drift=3.0), "sensor_drift.warming", 3.0),
    ],
)
def test_another_form_is_found_by_a_shape_parameter(effect, path, wanted):
    evaluator = small.split(small.made(effect, noise=0.03, seed=5))
    found = free_shape_parameters(evaluator, fit_with_noise(evaluator, Hypothesis((effect.name,))))
    assert found.hypothesis.free == (path,)
    assert found.column(path)[0] == pytest.approx(wanted, rel=0.15)


def test_a_sigmoid_of_a_stranger_is_found_by_a_shape_parameter():
    effect = small.effect("nonlinear_compliance", "Venegas", capacity=22.0)
    evaluator = small.split(small.strange(effect, seed=5))
    found = free_shape_parameters(evaluator, fit_with_noise(evaluator, Hypothesis((effect.name,))))
    assert found.hypothesis.free == ("nonlinear_compliance.sigmoid",)
    # The stranger's capacity and middle are those above PEEP; the library's above zero pressure.
    level = np.tanh(evaluator.training.data.measured[:, 0, 0].mean() / 22.0)
    sigmoid, stiffening = (
        found.column(f"nonlinear_compliance.{path}")[0] for path in ("sigmoid", "stiffening")
    )
    assert sigmoid == pytest.approx((1.0 + level) / (1.0 - level), rel=0.25)
    assert stiffening == pytest.approx((1.0 - level) / 22.0, rel=0.1)


def test_an_effort_that_relaxes_is_found_from_the_other_end_of_its_grid():
    """Half a sine is fitted to other onsets, from which no small change leads on."""
    effort = small.effect("patient_effort", "exponential", amplitude=5.0, duration=0.7)
    evaluator = small.split(small.strange(effort, seed=4))
    sine = fit_with_noise(evaluator, Hypothesis(("patient_effort",)))
    found = free_shape_parameters(evaluator, sine)
    assert found.hypothesis.free == ("patient_effort.relaxing",)
    assert found.column("patient_effort.relaxing")[0] > 0.5


def test_a_better_fit_of_the_default_frees_no_shape():
    effort = small.effect("patient_effort", "half sine", amplitude=5.0, duration=0.7)
    evaluator = small.split(small.strange(effort, seed=4))
    sine = fit_with_noise(evaluator, Hypothesis(("patient_effort",)))
    assert free_shape_parameters(evaluator, sine).hypothesis.free == ()


def test_a_second_lag_behind_a_dead_time_is_found_from_half_of_the_first():
    late = small.effect("valve_delay", delay=0.05)
    slow = small.effect("valve_lag", "two lags", tau=0.1)
    evaluator = small.split(small.made(late, slow, noise=0.03, seed=5))
    alone = fit_with_noise(evaluator, Hypothesis(("valve_delay", "valve_lag")))
    freer = fit_with_shape(evaluator, alone, "valve_lag.second", alone.noise)
    assert freer.column("valve_lag.second")[0] == pytest.approx(0.05, rel=0.2)
    assert freer.column("valve_delay.delay")[0] == pytest.approx(0.05, abs=0.005)


def test_shapes_that_are_not_fitted_are_listed(turbulent, both):
    named, _ = both
    assert shapes_at_default(named) == ["turbulent_resistance.exponent"]
    free = Hypothesis(named.names, ("turbulent_resistance.exponent",))
    assert shapes_at_default(turbulent.fit(free, Noise((0.2,), (0.0,)), named)) == []


def test_other_dead_times_are_a_sample_away(plain):
    late = plain.evaluator.fit(
        Hypothesis(("valve_delay",)), plain.base.noise, plain.base, {"valve_delay.delay": 0.05}
    )
    value = late.column("valve_delay.delay")[0]
    near = [start["valve_delay.delay"] for start in other_dead_times(late)]
    assert near
    assert all(other != value and 0.0 <= other <= 0.15 for other in near)
    assert other_dead_times(plain.base) == []
