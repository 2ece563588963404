"""Whole diagnoses of small recordings, by a rig that shares no code with what is fitted."""

from __future__ import annotations

import dataclasses
import json
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ventbench.base import compilation
from ventbench.base.errors import InputError
from ventbench.diagnosis.diagnose import _Comparison, _helps, diagnose
from ventbench.diagnosis.hypothesis import Hypothesis
from ventbench.diagnosis.result import Diagnosis
from ventbench.physics import physics
from ventbench.plants.catalog import load_simulators
from ventbench.plants.plant_files import save_plants
from ventbench.recordings import join
from ventbench.recordings.breaths import Breaths
from ventbench.task.interfaces import Plant
from ventbench.task.lungs import lung

from . import small

NAME = "turbulent_resistance"


@pytest.fixture(scope="module")
def breaths() -> Breaths:
    return small.made(small.effect(NAME, quadratic=10.0))


@pytest.fixture(scope="module")
def found(breaths) -> Diagnosis:
    return diagnose(breaths, settings=small.SETTINGS)


def turbulent(quadratic: float) -> dict[str, Plant]:
    """A user's plant that is the rig, more or less."""
    with compilation.float64():
        plant = physics(lung(small.LABEL), {NAME: {"quadratic": quadratic}})
        return {small.LABEL: plant.having(R=small.RIG.R, C=small.RIG.C, PEEP=small.RIG.peep)}


@pytest.fixture(scope="module")
def own(breaths) -> Diagnosis:
    """Of a user's simulator that has the effect."""
    return diagnose(breaths, simulator=turbulent(10.0), settings=small.SETTINGS)


@pytest.fixture(scope="module")
def strange() -> Diagnosis:
    """Of a recording with an effect that has no name."""
    return diagnose(
        small.made(small.effect("volume_resistance", "R(V)", change=0.65)), settings=small.SETTINGS
    )


def test_the_effect_is_named_with_its_strength(found):
    assert found.verdict == "named"
    (one,) = found.mechanisms
    assert (one.name, one.changed, one.alternatives) == (NAME, False, ())
    strength = one.parameters["quadratic"]
    assert strength.ci95[0] < 10.0 < strength.ci95[1]
    assert strength.value == pytest.approx(10.0, rel=0.1)
    assert one.confidence > 0.95  # unknown physics in its place competes with it: 0.990 for 1
    assert one.nats > 50.0
    assert found.nonparametric is None
    assert found.request is None
    assert found.noise[0] == pytest.approx(0.2, rel=0.15)
    assert found.simulator == "physics"


def test_the_lung_is_the_rigs(found):
    (match,) = found.lungs
    assert match.label == small.LABEL
    assert match.fitted_R == pytest.approx(small.RIG.R, rel=0.03)
    assert match.fitted_C == pytest.approx(small.RIG.C, rel=0.03)
    assert match.ci95_R[0] < match.fitted_R < match.ci95_R[1]
    assert match.label_matches


def test_distances_fall_on_breaths_that_no_fit_has_seen(found, breaths):
    held = found.traces.held_out
    assert held.tolist() == [k % 3 == 1 for k in range(small.BREATHS)]
    line = found.open_loop
    assert line.held_out_breaths == tuple(breaths.breath_id[held])
    assert line.before.rmse > line.refit.rmse > 2.0 * line.after.rmse
    # Each breath starts from its first reading, which has noise itself.
    assert line.after.rmse < 2.5 * line.noise_floor
    inside = breaths.inspiratory & (breaths.time > 0) & held[:, None]
    for stage in ("before", "refit", "after"):
        error = (getattr(found.traces, stage) - breaths.pressure)[inside]
        assert getattr(line, stage).rmse == pytest.approx(np.sqrt(np.mean(error**2)))
        assert getattr(line, stage).mae == pytest.approx(np.mean(np.abs(error)))


def test_traces_start_at_the_first_reading(found, breaths):
    for stage in ("before", "refit", "after"):
        trace = getattr(found.traces, stage)
        assert trace.shape == breaths.pressure.shape
        np.testing.assert_allclose(trace[:, 0], breaths.pressure[:, 0], atol=1e-9)
    np.testing.assert_array_equal(
        found.traces.before, load_simulators("physics").pressures(breaths)
    )
    flow, volume = found.traces.flow, found.traces.volume
    assert flow is not None
    assert volume is not None
    np.testing.assert_allclose(flow[:, 1:30], 22.8 * breaths.u_in[:, :29], rtol=1e-9)
    gained = np.cumsum(flow[:, 1:] * breaths.dt[:, :-1], axis=1)
    np.testing.assert_allclose(volume[:, 1:], gained, atol=1e-6)


def test_the_file_has_all_that_was_promised(found):
    plain = json.loads(json.dumps(found.as_dict(), allow_nan=False))
    assert plain["verdict"] == "named"
    (one,) = plain["mechanisms"]
    assert {"name", "parameters", "confidence", "alternatives"} <= set(one)
    assert {"value", "unit", "ci95"} == set(one["parameters"]["quadratic"])
    assert plain["slot"] is None
    for place in plain["location"]:
        assert {"axis", "range", "unit", "mean_error", "p_value"} <= set(place)
    line = plain["open_loop"]
    assert line["unit"] == "cmH2O"
    assert line["held_out_breaths"] == list(found.open_loop.held_out_breaths)
    for stage in ("before", "refit", "after"):
        assert set(line[stage]) == {"mae", "rmse"}
    assert line["noise_floor"] > 0
    assert {"label", "fitted_R", "fitted_C", "label_matches"} <= set(plain["lung"])


def shaken(breaths: Breaths, held: np.ndarray) -> Breaths:
    """Other readings of the held-out breaths, but for the first of each."""
    pressure = breaths.pressure.copy()
    noise = np.random.default_rng(5).normal(0.0, 0.05, pressure[held].shape)
    noise[:, 0] = 0.0
    pressure[held] += noise
    return dataclasses.replace(breaths, pressure=pressure)


@pytest.fixture(scope="module")
def other(breaths, found) -> Diagnosis:
    return diagnose(shaken(breaths, found.traces.held_out), settings=small.SETTINGS)


def test_held_out_readings_change_no_answer(found, other):
    assert other.mechanisms[0].nats != found.mechanisms[0].nats
    assert np.array_equal(other.traces.refit, found.traces.refit)
    assert np.array_equal(other.traces.after, found.traces.after)
    assert other.noise == found.noise
    assert other.open_loop.after != found.open_loop.after


@pytest.mark.parametrize("which", ["found", "own", "strange"])
def test_the_corrected_plant_in_its_file_gives_the_same_answers(which, request, tmp_path):
    diagnosis: Diagnosis = request.getfixturevalue(which)
    path = tmp_path / "corrected.json"
    save_plants(path, diagnosis.plants)
    answer = load_simulators(path).pressures(diagnosis.traces.breaths)
    np.testing.assert_allclose(answer, diagnosis.traces.after, atol=1e-3)


def test_nothing_is_missing_where_the_simulator_has_it(own):
    assert own.verdict == "nothing_missing"
    assert own.mechanisms == ()
    assert own.simulator == "given"
    assert own.open_loop.before.rmse < 2.5 * own.open_loop.noise_floor


def test_a_simulator_that_lacks_nothing_is_not_made_worse(own):
    assert own.open_loop.after.rmse < 1.2 * own.open_loop.before.rmse
    np.testing.assert_allclose(own.traces.after[:, 0], own.traces.before[:, 0], atol=1e-9)


@pytest.mark.parametrize("which", ["found", "own"])
def test_the_corrected_plant_answers_as_the_report_says(which, request, breaths):
    diagnosis: Diagnosis = request.getfixturevalue(which)
    answer = load_simulators(diagnosis.plants).pressures(breaths)
    np.testing.assert_allclose(answer, diagnosis.traces.after, atol=1e-3)


def test_another_strength_than_the_simulators_is_missing(breaths):
    much = diagnose(breaths, simulator=turbulent(20.0), settings=small.SETTINGS)
    assert much.verdict == "named"
    (one,) = much.mechanisms
    assert (one.name, one.changed) == (NAME, True)
    assert one.parameters["quadratic"].value == pytest.approx(10.0, rel=0.1)
    assert much.open_loop.after.rmse < 0.6 * much.open_loop.before.rmse


def test_what_has_no_name_is_drawn_where_it_is(strange):
    assert strange.verdict == "unnamed"
    assert strange.mechanisms == ()
    assert strange.nonparametric is not None
    assert strange.nonparametric.name == "R(V)"
    assert strange.nonparametric.x.shape == strange.nonparametric.y.shape
    assert strange.open_loop.after.rmse < 0.7 * strange.open_loop.refit.rmse
    plain = json.loads(json.dumps(strange.as_dict(), allow_nan=False))
    assert {"name", "explains"} <= set(plain["slot"])


def test_gaps_and_other_lungs_are_left_out():
    one = small.made(seed=1)
    pressure = one.pressure.copy()
    pressure[3, 0] = np.nan
    pressure[5:7, 12:16] = np.nan
    pressure[8, 34:] = np.nan
    other = small.numbered(small.made(seed=2, breaths=2), 101)
    other = dataclasses.replace(other, R=np.full(2, 5.0))
    both = join([dataclasses.replace(one, pressure=pressure), other])
    told: list[float] = []
    found = diagnose(
        both,
        lung=small.LABEL,
        progress=lambda what, share: told.append(share),
        settings=small.SETTINGS,
    )
    assert found.verdict == "nothing_missing"
    assert found.mechanisms == ()
    assert len(found.traces.breaths) == small.BREATHS - 1
    assert set(found.traces.breaths.lung_ids) == {small.LABEL}
    assert any("breath_id 4" in note for note in found.notes)
    assert list(found.plants) == [small.LABEL]
    assert [match.label for match in found.lungs] == [small.LABEL]
    assert np.isfinite(found.traces.after).all()
    assert np.isfinite(found.open_loop.after.rmse)
    assert found.open_loop.after.rmse < 2.5 * found.open_loop.noise_floor
    assert told == sorted(told)
    json.dumps(found.as_dict(), allow_nan=False)


def test_what_cannot_be_diagnosed_is_refused(breaths):
    with pytest.raises(InputError, match=r"3 usable breaths; a diagnosis needs at least 4"):
        diagnose(breaths.select(np.arange(3)), settings=small.SETTINGS)
    with pytest.raises(InputError, match=r"no breath of lung R50C50; choose one of R20C20"):
        diagnose(breaths, lung="R50C50", settings=small.SETTINGS)
    with pytest.raises(InputError, match=r"nor a simulator of that name"):
        diagnose(breaths, simulator="phisics", settings=small.SETTINGS)
    other = {"R5C10": turbulent(1.0)[small.LABEL]}
    with pytest.raises(InputError, match=r"no lung R20C20 of the recording .*; it has R5C10"):
        diagnose(breaths, simulator=other, settings=small.SETTINGS)


def test_simulated_pressures_are_diagnosed_as_their_simulator_is(own, breaths):
    """Only a plant cannot be made of them."""
    found = diagnose(breaths, simulator=own.traces.before, settings=small.SETTINGS)
    assert found.simulator == "given"
    assert found.plants == {}
    assert any("no corrected.json" in note for note in found.notes)
    assert (found.verdict, found.mechanisms) == (own.verdict, own.mechanisms)
    np.testing.assert_allclose(found.corrected_pressures, own.traces.after, rtol=0, atol=1e-9)
    with pytest.raises(InputError, match=r"array of simulated pressures, shape \(1, 40\)"):
        diagnose(breaths, simulator=own.traces.before[:1], settings=small.SETTINGS)


def test_a_description_is_judged_by_what_it_corrects():
    """By the testing breaths, where pressure was measured."""
    measured = np.zeros((3, 1, 2))
    weight = np.ones_like(measured)
    weight[1, 0, 1] = 0.0
    given = SimpleNamespace(measured=measured, weight=weight)
    given.select = lambda mask: SimpleNamespace(measured=measured[mask], weight=weight[mask])
    data: Any = given
    after = np.array([[9.0, 9.0], [1.0, np.nan], [2.0, -3.0]])
    correction: Any = SimpleNamespace(pressures={"after": after})
    nothing: Any = None
    comparison = _Comparison(nothing, {}, [], correction)
    assert comparison.error(data, np.array([False, True, True])) == pytest.approx(2.0)


def test_efforts_that_differ_are_neither_doubted_nor_unexplained():
    """Efforts of breaths to come are unknown, so that their errors object to nothing."""
    effort = small.effect("patient_effort", amplitude=5.0, duration=0.8)
    active = diagnose(small.made(effort, seed=4), patient=True, settings=small.SETTINGS)
    (name,) = active.mechanisms
    assert (name.name, name.explains) == ("patient_effort", 1.0)
    errors = active.open_loop
    assert errors.scatter_error > errors.noise_floor
    assert errors.unexplained < 0.5 * errors.after.rmse
    assert "patient_effort is worth" not in str(active)


@pytest.mark.parametrize(
    ("names", "nats", "helps"),
    [(("patient_effort",), {}, True)]
    + [(("patient_effort", "leak"), {("patient_effort",): x}, x < 5.0) for x in (4.0, 6.0)],
)
def test_what_acts_beside_efforts_is_judged_beside_them(names, nats, helps):
    """Nobody knows the efforts of the judging breaths: held-out breaths told of these."""
    worse = SimpleNamespace(rmse=2.0)
    open_loop: Any = SimpleNamespace(after=worse, refit=worse)
    full = SimpleNamespace(hypothesis=Hypothesis(names), noise=None)
    evaluator = SimpleNamespace(fit=lambda other, noise: SimpleNamespace(hypothesis=other))
    model: Any = SimpleNamespace(
        evaluator=evaluator,
        conclusion=SimpleNamespace(full=full),
        pressures=lambda model, *_: model.hypothesis.names,
    )
    judge = SimpleNamespace(
        log_likelihood=lambda names, *_: {full.hypothesis.names: 5.0, **nats}[names]
    )
    experiment: Any = SimpleNamespace(
        judge=judge,
        data=None,
        breaths=SimpleNamespace(pressure=np.zeros((1, 1))),
        uses=SimpleNamespace(share_aside=0.0),
    )
    for unchanged in (False, True):
        correction: Any = SimpleNamespace(unchanged=unchanged, helps=False)
        told = _helps(experiment, correction, model, open_loop, by_breath=False)
        assert told is (helps and not unchanged)
