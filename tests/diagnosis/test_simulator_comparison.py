"""A simulator compared with a recording: what is missing, and what both share."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ventbench.base import compilation
from ventbench.diagnosis import estimates
from ventbench.diagnosis.conclusion import Conclusion
from ventbench.diagnosis.evaluator import fit_with_noise
from ventbench.diagnosis.experiment import held_out
from ventbench.diagnosis.hypothesis import Hypothesis
from ventbench.diagnosis.identification import IdentifiedModel, identify
from ventbench.diagnosis.settings import DEFAULT
from ventbench.diagnosis.simulator_comparison import (
    describe_otherwise,
    identify_both,
    missing_mechanisms,
    refit_at_simulator_parameters,
    refit_base_parameters,
    with_mechanisms_of,
    with_sensor_noise,
)
from ventbench.mechanics.labels import Estimate
from ventbench.physics import library, mechanism, physics
from ventbench.plants.catalog import load_simulators
from ventbench.recordings.breaths import Breaths
from ventbench.system_id import Noise, make_data
from ventbench.task.lungs import lung

from . import made, small

NAME = "turbulent_resistance"


def model(strengths: dict[str, tuple[float, float]], **nats: float) -> Any:
    """A model of mechanisms with nats, whose fit has strengths with half their intervals."""
    return SimpleNamespace(
        conclusion=SimpleNamespace(names=tuple(nats), held_out_gains=nats),
        fit=strengths,
        evaluator=SimpleNamespace(settings=DEFAULT),
    )


@pytest.fixture(autouse=True)
def strengths_of_models(monkeypatch: pytest.MonkeyPatch) -> None:
    """Take estimates from the fits of :func:`model`."""
    of_fits = estimates.parameter_estimates

    def parameters(fit: Any, name: str) -> dict[str, Estimate]:
        if not isinstance(fit, dict):
            return of_fits(fit, name)
        value, half = fit[name]
        strength = mechanism(name).description.strength.name
        return {strength: Estimate(value, "", (value - half, value + half))}

    monkeypatch.setattr(estimates, "parameter_estimates", parameters)


@pytest.mark.parametrize(
    ("recorded", "simulated", "otherwise"),
    [
        ({"sensor_lag": 9.0, "circuit_compliance": 9.0}, {"valve_lag": 9.0}, True),
        ({"sensor_lag": 9.0, "valve_lag": 9.0}, {"valve_lag": 9.0}, False),  # one is missing
        ({"valve_lag": 9.0}, {"sensor_lag": 9.0, "valve_lag": 9.0}, False),  # nothing is
        ({"valve_lag": 9.0}, {}, False),
    ],
)
def test_two_descriptions_of_one_rig(recorded, simulated, otherwise):
    assert describe_otherwise(model({}, **recorded), model({}, **simulated)) is otherwise


def test_the_base_model_lacks_all_of_it_the_most_important_first():
    missing, notes = missing_mechanisms(model({}, leak=8.0, valve_delay=90.0, inertance=20.0), None)
    assert list(missing) == ["valve_delay", "inertance", "leak"]
    assert not any(missing.values())
    assert notes == []


def test_what_the_simulator_has_is_not_missing():
    recording = model(
        {"leak": (5.0, 1.0), "valve_delay": (0.040, 0.003)}, leak=8.0, valve_delay=90.0
    )
    simulator = model({"valve_delay": (0.043, 0.001)}, valve_delay=50.0)
    assert missing_mechanisms(recording, simulator) == ({"leak": False}, [])


@pytest.mark.parametrize(("value", "missing"), [(0.046, False), (0.048, True), (0.032, True)])
def test_another_strength_is_missing_too(value, missing):
    # Intervals of 4 and 3 ms each way: both together allow 5 ms, and 7 with a margin.
    recording = model({"valve_delay": (0.040, 0.004)}, valve_delay=90.0)
    simulator = model({"valve_delay": (value, 0.003)}, valve_delay=90.0)
    wanted = {"valve_delay": True} if missing else {}
    assert missing_mechanisms(recording, simulator) == (wanted, [])


def test_efforts_are_each_breaths_own_and_not_compared():
    both = model({}, patient_effort=90.0)
    assert missing_mechanisms(both, both) == ({}, [])


def test_what_only_the_simulator_has_is_said():
    missing, notes = missing_mechanisms(model({}), model({"leak": (5.0, 1.0)}, leak=9.0))
    assert missing == {}
    assert len(notes) == 1
    assert notes[0].startswith("The simulator has ")
    assert "which the recording does not show" in notes[0]
    assert mechanism("leak").description.title in notes[0]


def test_the_sensors_noise_is_the_recordings():
    breaths = made.breaths(n=60, samples=60)
    pressure = breaths.pressure.copy()
    pressure[:, 20] = np.nan
    data = make_data(dataclasses.replace(breaths, pressure=pressure))
    answer = np.full(pressure.shape, 7.0)
    found = with_sensor_noise(data, answer, Noise((0.3, 20.0), (0.6, 0.0)))
    error = found.measured[:, 0] - 7.0
    seen = found.weight[:, 0] > 0
    assert np.array_equal(seen, np.isfinite(pressure))
    for part in (error[:, :1], error[seen]):
        assert np.std(part) == pytest.approx(0.3, rel=0.15 if part is error[:, :1] else 0.25)
    product = np.mean(error[:, 30:-1] * error[:, 31:]) / np.mean(error[:, 30:] ** 2)
    assert product == pytest.approx(0.6, abs=0.06)
    # The same commands, and the same noise each time.
    assert found.u_in is data.u_in
    again = with_sensor_noise(data, answer, Noise((0.3, 20.0), (0.6, 0.0)))
    assert np.array_equal(again.measured, found.measured)
    still = with_sensor_noise(
        data, np.where(np.isnan(pressure), np.nan, 7.0), Noise((1e-9,), (0.0,))
    )
    np.testing.assert_allclose(still.measured[:, 0][seen], 7.0, atol=1e-6)


def strange(breaths: Breaths) -> np.ndarray:
    """What each breath does in its own way, cmH2O, ``(n, T)``: nothing at its first sample."""
    phase = np.random.default_rng(4).uniform(0.0, 2.0 * np.pi, (len(breaths), 1))
    return 1.5 * (np.sin(6.0 * breaths.time + phase) - np.sin(phase))


def test_a_simulator_is_described_by_the_recordings_mechanisms_that_it_needs():
    valve = small.effect("valve_curve", loss=0.4)
    both = [small.effect(NAME, quadratic=10.0), valve]
    evaluator = small.split(small.made(*both, seed=1))

    def identified(*names: str) -> Any:
        full = fit_with_noise(evaluator, Hypothesis(names))
        conclusion = Conclusion(full, full, full, None, full.noise, {}, {})
        return IdentifiedModel(evaluator, conclusion, None, evaluator.training)  # type: ignore[arg-type]

    stopped_short, recording = identified(), identified(NAME, "valve_curve", "sensor_lag")
    simulator = with_mechanisms_of(stopped_short, recording)
    assert set(simulator.conclusion.names) == {NAME, "valve_curve"}
    assert simulator.conclusion.full is simulator.conclusion.named
    fitted = simulator.conclusion.full
    assert fitted.column(f"{NAME}.quadratic")[0] == pytest.approx(10.0, rel=0.2)
    assert fitted.column("valve_curve.loss")[0] == pytest.approx(0.4, rel=0.2)
    assert simulator.fit.problem.unknowns.paths
    # Nothing is added that the simulator has, or that it does not need.
    assert with_mechanisms_of(simulator, simulator) is simulator
    assert with_mechanisms_of(simulator, identified("sensor_lag")) is simulator


#: The search is not what is tested: what both do is no mechanism, and would fit each a little. Few
#: mechanisms make few sets, so that it takes seconds and not minutes.
KEPT = (NAME, "circuit_compliance", "valve_curve", "valve_lag", "leak", "sensor_lag")
EXCLUDED = tuple(name for name in library() if name not in KEPT)


def test_what_recording_and_simulator_share_is_no_mismatch():
    effect = small.made(small.effect(NAME, quadratic=10.0))
    with compilation.float64():
        plant = physics(lung(small.LABEL), {}).having(
            R=small.RIG.R, C=small.RIG.C, PEEP=small.RIG.peep
        )
    before = load_simulators({small.LABEL: plant}).pressures(effect) + strange(effect)
    breaths = dataclasses.replace(effect, pressure=effect.pressure + strange(effect))
    data, held = make_data(breaths), held_out(breaths)
    alone = identify(data, held, EXCLUDED, lambda what: None, small.SETTINGS)
    told: list[str] = []
    recording_model, simulator_model = identify_both(
        data, held, before, alone, EXCLUDED, told.append
    )
    assert simulator_model.conclusion.names == ()
    assert recording_model.conclusion.names == (NAME,)
    assert any(what.startswith("recording less the simulator's part: ") for what in told)
    strength = recording_model.fit.value(f"{NAME}.quadratic")
    assert float(strength[0]) == pytest.approx(10.0, rel=0.1)
    # The noise is the sensor's again.
    assert recording_model.conclusion.noise.sigma[0] < 0.5 * alone.conclusion.noise.sigma[0]
    assert recording_model.conclusion.noise.sigma[0] == pytest.approx(0.2, rel=0.2)
    steady = refit_at_simulator_parameters(
        data, held, before, recording_model, simulator_model, [NAME, "circuit_compliance"]
    )
    assert steady is not None, "nothing but the effect asks for another lung"
    recording_model, names = steady
    assert names == (NAME,), "what is idle beside the simulator's own lung is not missing"
    assert float(recording_model.fit.value(f"{NAME}.quadratic")[0]) == pytest.approx(10.0, rel=0.1)
    np.testing.assert_allclose(
        recording_model.fit.column("R"), simulator_model.conclusion.full.column("R")[0]
    )
    first = breaths.pressure[:, 0]
    own = simulator_model.pressures(simulator_model.conclusion.full, data, first)
    after = before + recording_model.pressures(recording_model.conclusion.full, data, first) - own
    inside = breaths.inspiratory & (breaths.time > 0) & held[:, None]

    def error(answer: np.ndarray) -> float:
        return float(np.sqrt(np.mean((answer - breaths.pressure)[inside] ** 2)))

    refitted = refit_base_parameters(simulator_model, recording_model.evaluator.training.data)
    refit = before + simulator_model.pressures(refitted, data, first) - own
    assert error(after) < 0.6 * error(refit)
    assert error(after) < 0.4 * error(before)
