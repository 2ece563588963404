"""The second generator: its physics against exact solutions, its cases, and its challenge."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from hardware_eval.emulation.cases import Base, Effect
from proofs.challenge.folder import ChallengeFolder
from proofs.challenge.generators import STRANGER
from proofs.challenge.make import make
from proofs.challenge.questions import DrawnCase
from proofs.challenge.stranger import effects as stranger
from proofs.challenge.stranger.effects import SAME, StrangerCase
from proofs.challenge.stranger.laboratory import record, replay
from proofs.challenge.stranger.rig import Rig
from proofs.challenge.truth import concealed, is_right, true_values
from ventbench.base.errors import InputError
from ventbench.plants.catalog import load_simulators
from ventbench.recordings.breaths import Breaths, make_breaths

QUIET = StrangerCase(
    "",
    20.0,
    20.0,
    (),
    Base(20.0, 20.0, 5.0, 5.0, 22.8),
    noise=0.0,
    step=0.0,
    jitter=3e-4,
    breaths=4,
    samples=40,
    dead_space=0.002,
)


def held(u_in: np.ndarray, u_out: np.ndarray) -> Breaths:
    """One breath of given commands at 31.25 Hz."""
    time = 0.032 * np.arange(len(u_in))
    return make_breaths([1], [20.0], [20.0], [time], [u_in], [u_out], [np.full(len(u_in), 5.0)])


def replayed(effect: Effect | None, u_in: float = 20.0, samples: int = 40) -> np.ndarray:
    """Pressures of one breath from rest at PEEP: small commands, ``u_in``, shut at sample 30."""
    effects = () if effect is None else (effect,)
    k = np.arange(samples)
    small = np.where(k < 3, 1.2, 2.5)
    u = np.where(k < 6, small, np.where(k < 30, u_in, 0.0))
    given = held(u, (k >= 30).astype(np.int8))
    case = replace(QUIET, effects=effects, breaths=1)
    return replay(case, given, np.array([5.0]), 0)[0]


def test_without_effects_it_is_the_exact_solution():
    breaths = record(QUIET, np.random.default_rng(0))
    exact = load_simulators("physics").pressures(breaths)
    inspired = breaths.inspiratory & (breaths.time > 0)
    assert np.abs(exact - breaths.pressure)[inspired].max() < 0.05
    assert breaths.pressure.max() > 15.0


@pytest.mark.parametrize(
    ("effect", "friction"),
    [
        (Effect("turbulent_resistance", "strong", SAME, {"quadratic": 10.0}), lambda q: 10 * q * q),
        (
            Effect("turbulent_resistance", "strong", "Blasius", {"quadratic": 10.0}),
            lambda q: 10 * 0.6**0.25 * q**1.75,
        ),
    ],
)
def test_friction_adds_its_drop(effect, friction):
    extra = replayed(effect) - replayed(None)
    np.testing.assert_allclose(extra[8:29], friction(0.456), rtol=0.02)


def test_a_leak_and_a_circuit_against_solve_ivp():
    """The stiff circuit and the orifice, by an integrator of scipy."""
    circuit, orifice, R, C = 0.003, 0.01, 20.0, 0.02
    leak = replace(QUIET, dead_space=1e3 * circuit)
    effect = Effect("leak", "strong", SAME, {"conductance": 1e3 * orifice})
    given = held(np.full(40, 20.0), np.zeros(40, np.int8))
    found = replay(replace(leak, effects=(effect,), breaths=1), given, np.array([5.0]), 0)[0]

    def slope(t, y):
        p, v = y
        q = (p - 5.0 - v / C) / R
        return (0.456 - q - orifice * np.sqrt(max(p, 0.0))) / circuit, q

    exact = solve_ivp(slope, (0.0, 1.4), (5.0, 0.0), t_eval=given.time[0], rtol=1e-8, method="BDF")
    np.testing.assert_allclose(found, exact.y[0], atol=0.25)


def stiffening(form: str, capacity: float, *pressures: float) -> Rig:
    """Breaths of a stiffening lung, at rest at airway pressures, cmH2O."""
    stiff = Effect("nonlinear_compliance", "strong", form, {"capacity": capacity})
    zero = np.zeros(len(pressures))
    assert QUIET.base is not None
    rig = Rig(QUIET.base, {stiff.name: stiff}, zero, 0.05, zero, np.stack([zero, zero]))
    rig.start(np.array(pressures))
    return rig


@pytest.mark.parametrize("form", ["Salazar-Knowles", "Venegas"])
def test_a_full_lung_takes_no_more_at_the_same_pressure(form):
    """Its recoil goes on rising beyond what the curve is followed to."""
    full = stiffening(form, 10.0, 5.0, 5.0, 5.0)
    full.v = np.array([0.9, 1.2, 1.5]) * full.C * 10.0
    recoil, slope = full._recoil()
    least = 10.0 * (1.47 if form == "Venegas" else 2.30)  # at 0.9 of the capacity
    assert recoil[0] == pytest.approx(full.rest + least, abs=0.1)
    assert np.all(np.diff(recoil) > 0.3 * 10.0 * 15.0)
    assert slope[1] == slope[2] > slope[0]


@pytest.mark.parametrize("form", ["Salazar-Knowles", "Venegas"])
def test_a_breath_starts_on_the_curve_of_the_lung(form):
    """From another pressure than PEEP, the curve is the same and the volume another."""
    rig = stiffening(form, 25.0, 4.0, 5.0, 9.0)
    np.testing.assert_allclose(rig._recoil()[0], [4.0, 5.0, 9.0])
    if form == "Salazar-Knowles":  # it stiffens from PEEP on
        assert np.all(np.diff(rig._recoil()[1]) > 0.0)


def test_what_leaves_the_reservoir_empties_it():
    """The deficit of the supply follows the flow that is drawn, so that more is never less."""
    drop, recovery, R, C, asked = 0.3, 1.0, 20.0, 0.02, 1.14
    effect = Effect(
        "supply_droop", "strong", "regulator and reservoir", {"drop": drop, "recovery": recovery}
    )
    given = held(np.full(25, 50.0), np.zeros(25, np.int8))
    case = replace(QUIET, effects=(effect,), breaths=1)
    shown = replay(case, given, np.array([5.0]), 0)[0]

    def slope(t, y):
        deficit, _ = y
        drawn = asked * (1.0 - deficit)
        return (drop * drawn / 0.5 - deficit) / recovery, drawn

    at = given.time[0]
    exact = solve_ivp(slope, (0.0, at[-1]), (0.0, 0.0), t_eval=at, rtol=1e-8)
    pressure = 5.0 + exact.y[1] / C + R * asked * (1.0 - exact.y[0])
    np.testing.assert_allclose(shown[2:], pressure[2:], rtol=0.01)


def test_every_effect_acts_and_a_strong_one_more():
    quiet = replayed(None, 37.4)
    for name, family in stranger.EFFECTS.items():
        for form in family.forms:
            sizes = []
            for size in (family.mild, family.strong):
                further = {key: 0.5 * (low + high) for key, (low, high) in family.ranges}
                effect = Effect(name, "mild", form, {family.parameter: size} | further)
                sizes.append(float(np.abs(replayed(effect, 37.4) - quiet).mean()))
            if name in ("sensor_drift", "compliance_change", "resistance_change"):
                assert sizes == [0.0, 0.0], "the first breath is not yet changed"
                continue
            assert sizes[0] > 0.01, (name, form)
            if name != "inertance" and family.mild != family.strong:  # its circuit changes more
                assert sizes[1] > sizes[0], (name, form)


def test_cases_cover_the_laboratory():
    cases = STRANGER.draw("all", 120, np.random.default_rng(0))
    assert set(Counter(drawn.kind for drawn in cases)) == set(stranger.SHARES)
    lungs = Counter(drawn.case.lung for drawn in cases)
    assert len(lungs) == 9
    breaths = [drawn.case.breaths for drawn in cases]
    assert min(breaths) < 20
    assert max(breaths) > 150
    off = [drawn.case.base.R / drawn.case.lung_R for drawn in cases if drawn.case.base]
    assert max(off) > 1.4
    strangers = [d.case for d in cases if isinstance(d.case, StrangerCase)]
    assert max(case.proportional for case in strangers) > 9.0
    for drawn in cases:
        names = {effect.name for effect in drawn.case.effects}
        assert len(names) == {"pair": 2, "four": 4, "null": 0}.get(drawn.kind, 1)
    with pytest.raises(InputError, match="no kind form"):
        STRANGER.draw("form", 9, np.random.default_rng(0))


def test_a_recording_has_the_nuisances_of_its_case():
    case = replace(
        QUIET,
        breaths=30,
        samples=60,
        noise=0.2,
        step=0.1,
        outliers=0.01,
        missing=0.02,
        clock_step=1e-3,
        jitter=1e-3,
        proportional=10.0,
    )
    breaths = record(case, np.random.default_rng(1))
    known = breaths.pressure[np.isfinite(breaths.pressure)]
    assert 0.005 < np.isnan(breaths.pressure).mean() < 0.05
    assert np.isfinite(breaths.pressure[:, 0]).all()
    np.testing.assert_allclose(np.round(breaths.time, 3), breaths.time, atol=1e-9)
    residual = replay(case, breaths, breaths.pressure[:, 0], 0) - breaths.pressure
    far = np.abs(residual[np.isfinite(residual)]) > 1.6
    assert 0.003 < far.mean() < 0.05
    assert known.max() < 80.0
    again = record(case, np.random.default_rng(1))
    np.testing.assert_array_equal(breaths.pressure, again.pressure)


def test_judged_by_what_pressure_can_tell():
    def case(*effects: Effect) -> StrangerCase:
        return replace(QUIET, effects=effects)

    heavy = case(Effect("inertance", "strong", SAME, {"inertance": 0.1, "circuit": 0.8}))
    seen = concealed(DrawnCase("single", heavy), [100.0])
    assert is_right(frozenset({"inertance", "circuit_compliance"}), seen)
    assert is_right(frozenset({"inertance"}), seen)
    assert not is_right(frozenset({"circuit_compliance"}), seen)
    hidden = concealed(DrawnCase("single", heavy), [1.0])
    assert is_right(frozenset({"circuit_compliance"}), hidden)
    assert is_right(frozenset(), hidden)
    two = case(Effect("second_compartment", "strong", "Otis", {"share": 0.3, "time": 1.0}))
    both = concealed(DrawnCase("outside", two), [100.0])
    assert is_right(frozenset({"viscoelasticity"}), both)
    assert is_right(frozenset({"unknown:lung"}), both)
    assert not is_right(frozenset({"leak"}), both)
    assert not is_right(frozenset(), both)
    assert true_values(case(Effect("sensor_lag", "mild", SAME, {"tau": 0.05}))) == {
        "sensor_lag.tau": 0.05
    }
    assert true_values(case(Effect("sensor_lag", "mild", "second order", {"tau": 0.05}))) == {}
    # The circuit that every rig has is part of the circuit that a fit sees.
    tube = Effect("circuit_compliance", "mild", SAME, {"compliance": 1.2})
    assert true_values(replace(case(tube), dead_space=0.05)) == {
        "circuit_compliance.compliance": pytest.approx(1.25)
    }
    assert true_values(case(Effect("resistance_change", "mild", "secretions", {"c": 0.3}))) == {}
    # A ratio to the lung's elastance, which the library states at zero pressure: of an exponential
    # curve from PEEP, C there is exp(PEEP / capacity) times C at PEEP.
    creep = Effect("viscoelasticity", "mild", SAME, {"ratio": 0.3, "time": 1.0})
    stiff = Effect("nonlinear_compliance", "strong", "Salazar-Knowles", {"capacity": 25.0})
    assert true_values(case(stiff, creep)) == {
        "viscoelasticity.ratio": pytest.approx(0.3 * np.exp(5.0 / 25.0)),
        "viscoelasticity.time": 1.0,
    }
    assert true_values(case(replace(stiff, form="Venegas"), creep)) == {"viscoelasticity.time": 1.0}


def test_a_challenge_of_strangers_keeps_its_seal(tmp_path, monkeypatch):
    small = replace(QUIET, breaths=6, effects=())
    lag = Effect("sensor_lag", "strong", SAME, {"tau": 0.1})

    def few(kind, count, rng):
        return iter([small, replace(small, effects=(lag,))])

    from proofs.challenge import generators

    listed = dict(generators.GENERATORS)
    listed["stranger"] = replace(generators.STRANGER, shares={"single": 1.0}, of_kind=few)
    monkeypatch.setattr(generators, "GENERATORS", listed)
    hashed = make("words", tmp_path / "a", "all", 2, source="stranger")
    assert hashed == make("words", tmp_path / "b", "all", 2, source="stranger")
    folder = ChallengeFolder(tmp_path / "a")
    cases = [drawn.case for drawn, _ in folder.truth("words")]
    assert [type(case) for case in cases] == [StrangerCase] * 2
    (lagging,) = [case for case in cases if case.effects == (lag,)]
    assert folder.open(lagging.name, "words").nats[0] > 100.0, "a strong lag is detectable"
    with pytest.raises(InputError, match="published"):
        ChallengeFolder(tmp_path / "a").truth("other words")
    public = json.loads((tmp_path / "a" / "cases.json").read_text())
    assert "stranger" not in json.dumps(public)


def test_an_inertance_is_judged_beside_its_circuit():
    """What is detectable is the mass of the gas, not the tubing that came with it."""
    from proofs.challenge.detectability import LIMIT, log_likelihood_loss

    def loss(inertance: float, rig: StrangerCase = QUIET, circuit: float = 0.7) -> float:
        effect = Effect("inertance", "strong", SAME, {"inertance": inertance, "circuit": circuit})
        case = replace(rig, effects=(effect,), breaths=12, noise=0.1)
        return log_likelihood_loss(case, record(case, np.random.default_rng(2)), 0)

    assert loss(1e-4) < 1.0
    assert loss(0.13) > LIMIT
    behind = replace(QUIET, base=Base(45.0, 10.0, 5.0, 5.0, 22.8))
    assert loss(0.14, behind, circuit=0.35) < LIMIT, "a little less circuit does what the mass does"
