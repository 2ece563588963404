"""Slots: shapes without a name, each at its place in the physics."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from ventbench.base.compilation import float64
from ventbench.physics import library, mechanism, parameter, paths, strength_path
from ventbench.physics.catalogue import basis_terms, special_cases
from ventbench.physics.characteristics import characteristic
from ventbench.physics.nonparametric import NONPARAMETRIC_COMPONENTS, BasisTerm
from ventbench.plants.plant_files import load_plant, save_plant
from ventbench.system_id import Predictor, fit, make_data, parameter_values
from ventbench.system_id.data import Noise
from ventbench.system_id.problem import free_paths, make_unknowns
from ventbench.task.rollouts import open_loop

from . import cases

NAMES = {
    "f(u)",
    "memory of u",
    "f(p)",
    "f(Q)",
    "R(V)",
    "R(direction)",
    "f(V)",
    "memory of p",
    "exhalation path",
    "measurement",
}

ALL = paths((*library(), *basis_terms()))

#: Elements that are fitted together here; as many unknowns as one compiled function takes.
TOGETHER = (
    ("valve_shape",),
    ("leak_shape",),
    ("flow_shape",),
    ("recoil_shape",),
    ("volume_resistance",),
    ("direction_resistance", "recoil_memory"),
    ("command_memory",),
    ("command_plays", "supply_memory"),
    ("outlet_shape", "outlet_memory"),
    ("sensor_shape",),
    ("sensor_memory", "drift_shape"),
)

#: Gaussian: with exponential tails, an edge that is far off would count for little.
NOISE = Noise((0.1,), (0.0,), np.inf)


class Bench:
    """Twelve breaths, and what the model says of them with anything in it."""

    def __init__(self):
        self.data = make_data(cases.recording(12, {}))
        self.predictor = Predictor(self.data, ALL)
        self.error = np.random.default_rng(0).normal(0.0, 0.1, self.data.u_in.shape)

    def values(self, given, names=ALL):
        return parameter_values(self.data, names, {"PEEP": 5.0, "R": 11.0, "C": 23.0} | given)

    def predict(self, given):
        return self.predictor.predict(self.values(given))[:, 0]

    def fit(self, pressure, names, **options):
        noisy = self.data.with_pressure(pressure + self.error)
        return fit(noisy, names, noise=NOISE, predictor=self.predictor, **options)


@pytest.fixture(scope="module")
def bench():
    return Bench()


def drawn_coefficients(names, seed, share=0.3):
    """Random coefficients of some terms, in shares of what is plausible."""
    rng, given = np.random.default_rng(seed), {}
    for name in names:
        for item in mechanism(name).description.parameters:
            value = share * item.prior()[1] * rng.normal()
            given[f"{name}.{item.name}"] = float(np.clip(value, item.low, item.high))
    return given


def rms(x):
    return float(np.sqrt(np.mean(np.asarray(x) ** 2)))


def test_components_are_complete_and_outside_the_library():
    assert set(NONPARAMETRIC_COMPONENTS) == NAMES
    terms = [name for component in NONPARAMETRIC_COMPONENTS.values() for name in component.terms]
    assert sorted(terms) == list(basis_terms())
    assert not set(basis_terms()) & set(library())
    assert paths() == paths(tuple(library()))
    for name, component in NONPARAMETRIC_COMPONENTS.items():
        assert component.name == name
        assert len(component.meaning) > 20
        for term in component.terms:
            described = mechanism(term).description
            assert described.title.startswith(f"{name}: ")
            assert len(described.equation) > 8
            assert len(described.source) > 8
            assert set(described.confusable) <= set(library())
            assert all(p.neutral == p.mild == 0.0 for p in described.parameters)


def test_coefficients_tend_to_zero_and_strengths_of_the_library_do_not(bench):
    layout = make_unknowns(bench.data, free_paths(("leak", "recoil_shape")))
    _, precision = layout.prior()
    assert np.all(precision[layout.of("leak.conductance")] == 0.0)
    for k in range(1, 6):
        path = f"recoil_shape.c{k}"
        assert parameter(path).prior() == (0.0, 1.0)
        assert precision[layout.of(path)] == pytest.approx(1.0)
    assert strength_path("recoil_shape") == "recoil_shape.c1"


@pytest.mark.slow
def test_all_at_zero_are_off(bench):
    """Beside others, of which none may be moved."""
    given = {
        "valve_lag.tau": 0.03,
        "viscoelasticity.ratio": 0.3,
        "turbulent_resistance.quadratic": 3.0,
        "circuit_compliance.compliance": 1.0,
        "exhalation_valve_delay.opening": 0.05,
        "valve_hysteresis.width": 3.0,
        "sensor_drift.drift": 2.0,
        "leak.conductance": 5.0,
    }
    without = Predictor(bench.data, paths()).predict(bench.values(given, paths()))[:, 0]
    np.testing.assert_allclose(bench.predict(given), without, atol=1e-12, rtol=0)


@pytest.mark.parametrize("name", basis_terms())
def test_derivatives(bench, name):
    """Against differences, at zero and away from it; on the way each coefficient is seen to act."""
    items = mechanism(name).description.parameters
    columns = tuple(ALL.index(f"{name}.{item.name}") for item in items)
    filled = columns + tuple(range(9 - len(columns)))  # a size that is compiled already
    for share in (0.0, 0.3):
        values = bench.values(drawn_coefficients([name], 3, share))
        _, slopes = bench.predictor.derivatives(values, filled)
        for k, (column, item) in enumerate(zip(columns, items, strict=True)):
            step = 1e-6 * item.prior()[1]
            ends = []
            for sign in (1.0, -1.0):
                moved = values.copy()
                moved[:, column] += sign * step
                ends.append(bench.predictor.predict(moved))
            moved = (ends[0] - ends[1]) / (2.0 * step)
            np.testing.assert_allclose(slopes[:, k], moved, atol=1e-4 * (1 + np.abs(moved).max()))
        assert np.abs(slopes[:, : len(columns)]).max() * items[0].prior()[1] > 0.3


@pytest.mark.parametrize("names", TOGETHER, ids="+".join)
def test_shapes_are_recovered(bench, names):
    given = drawn_coefficients(names, 11, 0.5)
    truth = bench.predict(given)
    base = bench.fit(truth, ())
    found = bench.fit(truth, names)
    assert base.log_likelihood.sum() < found.log_likelihood.sum() - 15.0
    assert rms(found.residual) < 0.105
    # The noise is averaged out: the answer is nearer to the truth than any sample.
    assert rms(bench.predictor.predict(found.values)[:, 0] - truth) < 0.025


#: Where the data say something of a term, and what base parameters could produce there.
SEEN = {
    "valve_shape": (3.0, 20.0),
    "flow_shape": (-0.4, 0.4),
    "recoil_shape": (120.0, 350.0),
    "leak_shape": (6.0, 20.0),
    "sensor_shape": (6.0, 20.0),
    "volume_resistance": (150.0, 320.0),
}


def drawn(name, values):
    """Where a term is seen, and its curve there less what base parameters absorb."""
    shown = characteristic(name, {path.rpartition(".")[2]: x for path, x in values.items()})
    assert shown is not None
    seen = (shown.x >= SEEN[name][0]) & (shown.x <= SEEN[name][1])
    x, y = shown.x[seen], (shown.acting - shown.baseline)[seen]
    term = basis_terms()[name]
    assert isinstance(term, BasisTerm)
    if term.absorbed:
        powers = np.stack([x**power for power in term.absorbed], axis=1)
        y = y - powers @ np.linalg.lstsq(powers, y, rcond=None)[0]
    return x, y


@pytest.mark.parametrize("name", SEEN)
def test_drawn_shapes_are_those_that_were_put_in(bench, name):
    given = drawn_coefficients([name], 7, 0.5)
    found = bench.fit(bench.predict(given), [name])
    x, truth = drawn(name, {"R": 11.0, "C": 23.0} | given)
    there, y = drawn(name, {path: float(found.column(path).mean()) for path in paths((name,))})
    size = np.abs(truth).max()
    assert size > 0
    assert np.abs(np.interp(x, there, y) - truth).max() < 0.3 * size


@pytest.mark.parametrize(
    ("component", "name", "level", "most"),
    [
        ("f(V)", "nonlinear_compliance", "strong", 0.03),
        ("f(V)", "nonlinear_compliance", "mild", 0.03),
        ("f(u)", "valve_curve", "strong", 0.03),
        ("f(u)", "valve_dead_band", "strong", 0.04),
        ("f(p)", "leak", "strong", 0.03),
        ("f(Q)", "turbulent_resistance", "strong", 0.03),
        ("memory of p", "viscoelasticity", "strong", 0.03),
        ("memory of u", "valve_lag", "strong", 0.04),
        ("memory of u", "valve_hysteresis", "strong", 0.04),
        ("memory of u", "supply_droop", "strong", 0.03),
        ("exhalation path", "exhalation_valve_delay", "mild", 0.06),
        ("measurement", "sensor_drift", "strong", 0.04),
    ],
)
def test_components_hold_what_they_are_said_to_hold(bench, component, name, level, most):
    """Near the noise of 0.1, where the base model is not."""
    assert any(name in special_cases(term) for term in NONPARAMETRIC_COMPONENTS[component].terms)
    items = mechanism(name).description.parameters
    truth = bench.predict({f"{name}.{p.name}": getattr(p, level) for p in items})
    terms = (
        ("drift_shape",)
        if component == "measurement"
        else NONPARAMETRIC_COMPONENTS[component].terms
    )
    found = bench.fit(truth, terms)
    assert rms(bench.fit(truth, ()).residual) > 0.11
    assert rms(bench.predictor.predict(found.values)[:, 0] - truth) < most


def test_knots_without_data_stay_at_zero(bench):
    """Commands end at 26 %, so that nothing is known of the valve at 60 and 100 %."""
    assert bench.data.u_in.max() < 35.0
    truth = bench.predict({"valve_dead_band.width": 2.0})
    found = bench.fit(truth, ["valve_shape"], start={"valve_shape.c6": 20.0, "valve_shape.c7": 9.0})
    assert abs(found.value("valve_shape.c6")[0]) < 0.1
    assert abs(found.value("valve_shape.c7")[0]) < 0.1
    low, high = found.ci95("valve_shape.c7")[0]
    assert low < -50.0
    assert high > 50.0


@pytest.mark.parametrize("name", basis_terms())
def test_each_is_stable(bench, name):
    """With two standard deviations of what is plausible."""
    for seed in range(3):
        p = bench.predict(drawn_coefficients([name], seed, 2.0))
        assert np.all(np.isfinite(p))
        assert np.abs(p).max() < 150.0


def test_all_at_once_are_stable(bench):
    for seed in range(6):
        p = bench.predict(drawn_coefficients(basis_terms(), seed, 0.2))
        assert np.all(np.isfinite(p))
        assert np.abs(p).max() < 150.0


def test_readings_are_understood(bench):
    """The pressure behind a reading is found, with a bent and drifted sensor."""
    given = drawn_coefficients(["sensor_shape", "drift_shape"], 2, 0.5)
    shown = np.linspace(-5.0, 60.0, 40)
    with float64():
        for name in ("sensor_shape", "drift_shape"):
            item = basis_terms()[name]
            own = {p.rpartition(".")[2]: jnp.asarray(x) for p, x in given.items() if name in p}
            position = jnp.asarray(0.6)
            meant = item.sensor_input(own, jnp.asarray(shown), position)
            np.testing.assert_allclose(item.sensor_output(own, meant, position), shown, atol=1e-9)
            assert np.abs(meant - shown).max() > 0.1


def test_plants_with_components_are_kept_in_files(bench, tmp_path):
    names = ["recoil_shape", "command_memory", "command_plays", "drift_shape"]
    given = drawn_coefficients(names, 4)
    truth = bench.predict(given)
    with float64():
        at = jnp.asarray(bench.data.position)
        found = bench.fit(truth, (), fixed=given)
        plant = found.plant().having(**given, position=at)
        save_plant(tmp_path / "plant.npz", plant)
        loaded = load_plant(tmp_path / "plant.npz")
        assert loaded.names == plant.names
        assert "command_plays.c4" in loaded.names
        data = bench.data
        start = jnp.asarray(found.column("start"))
        seen = open_loop(loaded, start, *(jnp.asarray(x) for x in (data.u_in, data.u_out, data.dt)))
        expected = bench.predictor.predict(found.values)[:, 0]
        np.testing.assert_allclose(seen, expected, atol=1e-9)


def test_a_fit_with_a_drift_gives_a_plant_with_positions(bench):
    truth = bench.predict({"drift_shape.c4": 1.0})
    found = bench.fit(truth, ["drift_shape", "recoil_memory"])
    with float64():
        plant = found.plant()
        np.testing.assert_allclose(plant.get("position"), bench.data.position)
        assert float(plant.get("drift_shape.c4")[0]) == pytest.approx(1.0, abs=0.1)
