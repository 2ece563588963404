"""Fits of hypotheses, and what held-out breaths say of them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from ventbench.diagnosis import patient_effort
from ventbench.diagnosis.evaluator import (
    Evaluator,
    cross_validated_gain,
    delay_restarts,
    fit_with_noise,
    make_evaluator,
)
from ventbench.diagnosis.hypothesis import Hypothesis, Partition
from ventbench.physics import paths
from ventbench.system_id import START, Data, Noise, make_data, parameter_values

from . import small

#: Without tails, so that sums of squares are all there is.
GAUSSIAN = Noise((0.2,), (0.0,), np.inf)
DELAY, LAG = Hypothesis(("valve_delay",)), Hypothesis(("sensor_lag",))


def shifted(partition: Partition, by: float) -> Partition:
    """The breaths with higher readings."""
    data = partition.data
    return Partition(dataclasses.replace(data, measured=data.measured + by), partition.predictor)


@pytest.fixture(scope="module")
def late() -> Evaluator:
    return small.split(small.made(small.effect("valve_delay", delay=0.05)))


@pytest.fixture(scope="module")
def lagging() -> Evaluator:
    return small.split(small.made(small.effect("sensor_lag", tau=0.05)))


def test_breaths_are_split_and_none_is_lost():
    breaths = small.made()
    made = small.split(breaths)
    assert np.array_equal(made.training.data.u_in, breaths.u_in[~small.HELD])
    assert np.array_equal(made.held_out.data.measured[:, 0], breaths.pressure[small.HELD])


def test_a_fit_recovers_the_parameters(lagging):
    fitted = lagging.fit(LAG, GAUSSIAN)
    assert fitted.column("sensor_lag.tau") == pytest.approx(0.05, rel=0.05)
    # The valve's gain is 22.8 here and there, so that R and C are the rig's.
    assert fitted.column("R") == pytest.approx(small.RIG.R, rel=0.03)
    assert fitted.column("C") == pytest.approx(small.RIG.C, rel=0.03)
    assert np.std(fitted.residual) == pytest.approx(0.2, rel=0.15)


def test_dead_time_is_known_up_to_what_resistance_can_take_over(late):
    fitted = late.fit(DELAY, GAUSSIAN)
    delay, R, C = (fitted.column(p)[0] for p in ("valve_delay.delay", "R", "C"))
    # Between the two samples; later gas changes the pressure as less resistance does.
    assert 0.034 < delay < 0.064
    assert R - 1e3 * (delay - 0.05) / C == pytest.approx(small.RIG.R, rel=0.01)
    assert pytest.approx(small.RIG.C, rel=0.01) == C


def test_another_start_ends_at_the_same_place(lagging):
    near = lagging.fit(LAG, GAUSSIAN)
    for start in (0.01, 0.12):
        other = lagging.fit(LAG, GAUSSIAN, start={"sensor_lag.tau": start, "R": 30.0})
        assert other.column("sensor_lag.tau")[0] == pytest.approx(
            near.column("sensor_lag.tau")[0], rel=0.01
        )
    again = lagging.fit(LAG, GAUSSIAN, near)
    assert again.minimum.cost <= near.minimum.cost + 1e-6


def test_fixed_parameters_keep_their_value(late):
    held = Hypothesis(("leak",), ("leak.exponent",), (("leak.exponent", 1.0),))
    fitted = late.fit(held, GAUSSIAN, iterations=3)
    assert np.all(fitted.column("leak.exponent") == 1.0)
    assert "leak.exponent" not in fitted.problem.unknowns.paths


def test_held_out_breaths_do_not_change_a_fit(late):
    one = late.fit(DELAY, GAUSSIAN)
    other = dataclasses.replace(late, held_out=shifted(late.held_out, 3.0)).fit(DELAY, GAUSSIAN)
    assert np.array_equal(one.values, other.values)


def test_shared_parameters_are_transferred_and_breaths_start_at_their_first_reading(late):
    fitted = late.fit(DELAY, GAUSSIAN)
    values = late.transferred_values(fitted, late.held_out)
    order = (*late.held_out.predictor.names, START)
    for path in ("R", "C", "R_ex", "PEEP", "valve_delay.delay"):
        assert np.all(values[:, order.index(path)] == fitted.column(path)[0])
    assert np.array_equal(values[:, -1], late.held_out.data.measured[:, 0, 0])
    assert np.array_equal(values[:, order.index("position")], late.held_out.data.position)
    seen = late.predict(fitted, late.held_out)
    assert np.array_equal(seen, late.held_out.predictor.predict(values))
    error = (seen - late.held_out.data.measured)[:, 0, :30]
    assert np.sqrt(np.mean(error**2)) < 0.5


def test_breaths_to_come_have_the_median_gain_of_their_lung(late):
    own = dataclasses.replace(late, gain_sd=0.1)
    fitted = own.fit(DELAY, GAUSSIAN)
    assert len(np.unique(fitted.column("gain"))) == len(own.training.data)
    order = own.held_out.predictor.names
    usual = own.transferred_values(fitted, own.held_out)[:, order.index("gain")]
    np.testing.assert_allclose(usual, np.median(fitted.column("gain")))
    # Held-out breaths are fitted with a gain each, and can only be likelier.
    assert np.all(
        own.held_out_log_likelihood(fitted)
        > late.held_out_log_likelihood(late.fit(DELAY, GAUSSIAN)) - 1.0
    )


def test_a_better_hypothesis_is_likelier_on_other_breaths(late):
    base, named = (late.fit(one, GAUSSIAN) for one in (Hypothesis(), DELAY))
    gained = late.held_out_log_likelihood(named) - late.held_out_log_likelihood(base)
    assert gained.shape == (8,)
    assert np.all(gained > 20.0)
    assert late.criterion(named) < late.criterion(base) - 100.0
    # A term that does nothing costs the logarithm of the samples.
    more = late.fit(DELAY.plus(Hypothesis(("sensor_drift",))), GAUSSIAN, named)
    lost = late.criterion(more) - late.criterion(named)
    fallen = 2.0 * (more.log_likelihood - named.log_likelihood).sum()
    fallen += 2.0 * (late.label_log_density(more) - late.label_log_density(named))
    assert lost == pytest.approx(np.log(8 * small.SAMPLES) - fallen, abs=1e-6)


def test_the_criterion_is_that_of_gaussian_residuals(late):
    fitted = late.fit(DELAY, GAUSSIAN)
    size, square = fitted.residual.size, np.sum(fitted.residual**2)

    def density(sd: float) -> float:
        return -0.5 * square / sd**2 - size * (np.log(sd) + 0.5 * np.log(2 * np.pi))

    assert fitted.log_likelihood.sum() == pytest.approx(density(GAUSSIAN.sigma[0]), rel=1e-9)
    shared = 5  # R, C, R_ex, PEEP and the delay
    penalty = shared * np.log(size) - 2.0 * late.label_log_density(fitted)
    want = -2.0 * density(GAUSSIAN.sigma[0]) + penalty
    assert late.criterion(fitted) == pytest.approx(want, rel=1e-9)


def test_labels_count_once_for_each_lung(late):
    """Twice the label is unlikely, but not much less so than three times it."""
    data = late.training.data
    held = [
        late.fit(Hypothesis(DELAY.names, (), (("R", k * data.R[0]), ("C", data.C[0]))), GAUSSIAN)
        for k in (1.0, 2.0, 3.0)
    ]
    nats = [late.label_log_density(each) for each in held]
    tolerance = late.settings.data.label_tolerance
    assert nats[0] == pytest.approx(0.0, abs=1e-12)
    assert nats[1] == pytest.approx(-np.log1p((np.log(2.0) / tolerance) ** 2))
    assert nats[1] - 1.0 < nats[2] < nats[1]


def brute_force(made: Evaluator, values: np.ndarray, duration: float, which: int) -> float:
    """Log-likelihood of a breath, its effort integrated out by sums over true simulations.

    A start is fitted to each effort, by a derivative that is a difference.
    """
    partition = made.held_out
    order = (*partition.predictor.names, START)
    columns = [order.index(f"patient_effort.{p}") for p in ("amplitude", "onset", "duration")]
    measured = partition.data.measured[which, 0]

    def seen(amplitude: float, onset: float, start: float) -> np.ndarray:
        trial = values.copy()
        trial[:, columns] = amplitude, onset, duration
        trial[:, -1] = start
        return partition.predictor.predict(trial)[which, 0]

    def likelihood(amplitude: float, onset: float) -> float:
        first = values[which, -1]
        error = seen(amplitude, onset, first) - measured
        slope = (seen(amplitude, onset, first + 0.01) - measured - error) / 0.01
        error = error - slope * (slope @ error) / (slope @ slope)
        size = GAUSSIAN.sigma[0]
        return float(-0.5 * np.sum((error / size) ** 2 + np.log(2 * np.pi * size**2)))

    grid = np.linspace(-4.0, 4.0, 33)
    prior = np.exp(-0.5 * (grid / patient_effort.AMPLITUDE_SD) ** 2) / (
        patient_effort.AMPLITUDE_SD * np.sqrt(2 * np.pi)
    )
    logs = np.array([[likelihood(a, onset) for a in grid] for onset in patient_effort.ONSETS])
    top = logs.max()
    mixed = np.mean(np.sum(np.exp(logs - top) * prior, axis=1)) * (grid[1] - grid[0])
    return float(
        np.logaddexp(
            np.log1p(-patient_effort.PROBABILITY) + likelihood(0.0, 0.0),
            np.log(patient_effort.PROBABILITY * mixed) + top,
        )
    )


@pytest.mark.parametrize("which", [2, 3])
def test_efforts_are_integrated_out(which):
    made = small.split(small.made(small.effect("patient_effort", amplitude=0.5, duration=0.8)))
    fitted = made.fit(Hypothesis(("patient_effort",)), GAUSSIAN)
    problem, x = made.refit_breath_parameters(fitted)
    duration = float(fitted.column("patient_effort.duration")[0])
    want = brute_force(made, problem.values(x), duration, which)
    assert made.held_out_log_likelihood(fitted)[which] == pytest.approx(want, abs=0.15)
    assert abs(want - problem.log_likelihood(x)[which]) > 0.3


def two_lungs() -> Data:
    one = small.made(seed=1)
    R = np.where(np.arange(16) < 8, 20.0, 5.0)
    return make_data(dataclasses.replace(one, R=R))


def test_what_belongs_to_R_is_one_for_each_label():
    data = two_lungs()
    made = make_evaluator(data, small.HELD, paths(), settings=small.SETTINGS)
    fitted = made.fit(Hypothesis(("turbulent_resistance", "leak")), GAUSSIAN, iterations=2)
    layout = fitted.problem.unknowns
    sizes = {path: len(layout.of(path)) for path in layout.paths}
    assert sizes["R"] == sizes["C"] == sizes["turbulent_resistance.quadratic"] == 2
    assert sizes["leak.conductance"] == sizes["R_ex"] == 1
    which = layout.index[:, layout.paths.index("turbulent_resistance.quadratic")]
    assert np.array_equal(which == which.max(), made.training.data.R == 20.0)
    # A held-out breath takes the values of its own label.
    carried = made.transferred_values(fitted, made.held_out)[:, paths().index("R")]
    wanted = [fitted.column("R")[made.training.data.R == R][0] for R in made.held_out.data.R]
    assert np.array_equal(carried, wanted)


def test_a_lung_without_training_breaths_takes_the_first_ones(late):
    fitted = late.fit(DELAY, GAUSSIAN)
    other = dataclasses.replace(late.held_out.data, R=np.full(8, 5.0))
    carried = late.transferred_values(fitted, Partition(other, late.held_out.predictor))
    assert np.all(carried[:, paths().index("R")] == fitted.column("R")[0])


def test_fit_with_noise_recovers_the_noise():
    loud = small.split(small.made(noise=0.4, coloured=1.0, correlation=0.7, seed=2))
    fitted = fit_with_noise(loud, Hypothesis())
    assert fitted.noise.sigma[0] == pytest.approx(0.4, rel=0.2)
    # The breaths' starts take some of what is slow.
    assert fitted.noise.ar[0] == pytest.approx(0.65, abs=0.12)
    neutral = parameter_values(loud.training.data, paths(), {})
    assert np.array_equal(
        fitted.values[:, paths().index("gain")], neutral[:, paths().index("gain")]
    )


PATH = "exhalation_valve_delay.opening"


@pytest.fixture(scope="module")
def exhaling_late() -> Evaluator:
    return small.split(small.made(small.effect("exhalation_valve_delay", opening=0.1), noise=0.1))


def test_a_dead_time_on_the_wrong_side_of_a_sample_is_moved(exhaling_late):
    late_by = Hypothesis(("exhalation_valve_delay",))
    stuck = exhaling_late.fit(
        late_by, fit_with_noise(exhaling_late, late_by).noise, start={PATH: 0.02}
    )
    moved = delay_restarts(stuck.problem, stuck.minimum.x)
    there = moved[stuck.problem.unknowns.of(PATH)]
    assert there == pytest.approx(0.1, abs=0.025)
    fitted = fit_with_noise(exhaling_late, late_by, stuck)
    assert fitted.column(PATH)[0] == pytest.approx(0.1, abs=0.02)
    assert exhaling_late.estimate_noise(fitted).sigma[0] == pytest.approx(0.1, rel=0.3)


def test_a_dead_time_at_the_optimum_stays(exhaling_late):
    fitted = fit_with_noise(exhaling_late, Hypothesis(("exhalation_valve_delay",)))
    assert delay_restarts(fitted.problem, fitted.minimum.x) == pytest.approx(fitted.minimum.x)


def test_without_dead_times_nothing_is_moved(exhaling_late):
    fitted = exhaling_late.fit(
        Hypothesis(("sensor_lag",)), fit_with_noise(exhaling_late, Hypothesis()).noise
    )
    assert delay_restarts(fitted.problem, fitted.minimum.x) is fitted.minimum.x


def test_every_breath_is_held_out_once(turbulent, both):
    assert len(turbulent.folds) == 2
    seen = [turbulent.held_out, *(held_out for _, held_out in turbulent.folds)]
    pressures = np.concatenate([partition.data.measured[:, 0] for partition in seen])
    assert len(np.unique(pressures, axis=0)) == small.BREATHS
    for training, held_out in turbulent.folds:
        assert len(training.data) + len(held_out.data) == small.BREATHS
    gained = cross_validated_gain(turbulent, *both)
    assert gained.shape == (small.BREATHS,)
    assert gained[: len(turbulent.held_out.data)] == pytest.approx(
        turbulent.held_out_log_likelihood(both[0]) - turbulent.held_out_log_likelihood(both[1])
    )
    assert gained.sum() > 50.0


def test_one_batch_of_a_long_recording_ranks_candidates(turbulent):
    assert turbulent.for_ranking is turbulent
    few = dataclasses.replace(
        turbulent.settings, data=dataclasses.replace(turbulent.settings.data, batch_size=4)
    )
    long = dataclasses.replace(turbulent, settings=few)
    assert long.for_ranking.training.data.lung.shape == (4,)
    assert set(long.for_ranking.training.data.position) < set(turbulent.training.data.position)
