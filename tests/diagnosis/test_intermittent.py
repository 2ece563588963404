"""Effects of some breaths, from recordings of other code: found, with their breaths, or not."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Collection
from typing import Any

import numpy as np
import pytest

from hardware_eval.emulation.cases import Base
from proofs.challenge.faults.effects import FaultsCase
from proofs.challenge.faults.laboratory import _OPEN_TUBE, record
from ventbench.diagnosis.conclusion import Conclusion
from ventbench.diagnosis.evaluator import Evaluator, fit_with_noise, make_evaluator
from ventbench.diagnosis.evidence import COMMANDS, EVENTS, MUSCLES, Posterior, search
from ventbench.diagnosis.hypothesis import Hypothesis, all_parameter_paths
from ventbench.diagnosis.identification import IdentifiedModel
from ventbench.diagnosis.in_time import Paths, ask_for_little
from ventbench.diagnosis.intermittent import Intermittent, find
from ventbench.pages.diagnosis import report
from ventbench.physics import paths
from ventbench.physics.catalogue import intermittent
from ventbench.recordings.breaths import Breaths
from ventbench.system_id import make_data

from . import made, small

BREATHS = 24
AFFECTED = np.array([3, 4, 9, 12, 16, 17, 22])


def session(name: str = "", affected: np.ndarray = AFFECTED, **values: float) -> Breaths:
    """Breaths of the world of faults, of which some are from a rig with the fault."""
    base = Base(R=20.0, C=20.0, R_ex=5.0, peep=5.0, gain=22.8)
    case = FaultsCase(
        "",
        20.0,
        20.0,
        (),
        base=base,
        noise=0.15,
        breaths=BREATHS,
        samples=50,
        step=0.05,
        jitter=1e-4,
        interval=0.04,
        choice=5,
    )
    plain = record(case, np.random.default_rng(3))
    if not name:
        return plain
    values = {"affected": 1.0} | values
    if name == "disconnection":
        values["share"] = 1.0
    faulty = dataclasses.replace(case, effects=(small.effect(name, "plain", **values),))
    other = record(faulty, np.random.default_rng(3))
    chosen = np.isin(plain.breath_id, affected)[:, None]
    return dataclasses.replace(
        plain,
        u_in=np.where(chosen, other.u_in, plain.u_in),
        pressure=np.where(chosen, other.pressure, plain.pressure),
    )


def found(
    breaths: Breaths, likely: Collection[str] = (*EVENTS, *COMMANDS), **changed: Any
) -> Intermittent | None:
    """What is found beside the base model, where the search was sure of some effects."""
    data, held = make_data(breaths), np.arange(len(breaths)) % 3 == 1
    settings = dataclasses.replace(
        small.SETTINGS, data=dataclasses.replace(small.SETTINGS.data, batch_size=BREATHS)
    )
    evaluator: Evaluator = make_evaluator(data, held, paths(intermittent()), settings=settings)
    evaluator = dataclasses.replace(evaluator, **changed)
    base = fit_with_noise(evaluator, Hypothesis())
    posterior = Posterior((), {frozenset(likely): 1.0})
    conclusion = Conclusion(base, base, base, None, base.noise, {}, {}, posterior=posterior)
    model = IdentifiedModel(evaluator, conclusion, None, evaluator.training)  # type: ignore[arg-type]
    return find(model, data, breaths.breath_id)


@pytest.mark.parametrize(
    ("name", "values", "strength"),
    [
        ("intermittent_leak", {"conductance": 15.0}, ("conductance", 15.0)),
        ("secretions", {"increase": 0.8}, ("increase", 0.8)),
        ("cough", {"pressure": 9.0}, None),
        ("disconnection", {}, ("conductance", _OPEN_TUBE)),
    ],
)
def test_an_effect_of_some_breaths_is_named_with_them(name, values, strength):
    """Its breaths are set aside, and no others."""
    breaths = session(name, **values)
    effect = found(breaths)
    assert effect is not None
    assert effect.missing.name == name
    assert effect.missing.affected == tuple(AFFECTED)
    assert breaths.breath_id[effect.affected].tolist() == AFFECTED.tolist()
    assert effect.u_in is None
    if strength is not None:
        estimate = effect.missing.parameters[strength[0]]
        assert estimate.value == pytest.approx(strength[1], rel=0.2)


def test_what_acts_in_no_held_out_breath_is_named_by_the_others():
    few = np.array([4, 10])
    assert not np.any((few - 1) % 3 == 1)
    effect = found(session("disconnection", few), ("cough",))  # for which the search may take it
    assert effect is not None
    assert (effect.missing.name, effect.missing.affected) == ("disconnection", (4, 10))


@pytest.mark.parametrize("likely", [(*EVENTS, *COMMANDS), ()])
def test_nothing_is_found_in_breaths_that_are_alike(likely):
    assert found(session(), likely) is None


def test_breaths_at_one_end_are_a_change_of_the_session():
    late = np.arange(13, BREATHS + 1)
    assert found(session("intermittent_leak", late, conductance=15.0)) is None


@pytest.mark.slow
def test_a_test_lung_does_not_cough():
    breaths = session("cough", pressure=9.0)
    settings = dataclasses.replace(
        small.SETTINGS, data=dataclasses.replace(small.SETTINGS.data, batch_size=BREATHS)
    )
    names = all_parameter_paths(settings)
    asked = []
    for excluded in ((), MUSCLES):
        evaluator = make_evaluator(
            make_data(breaths), np.arange(BREATHS) % 3 == 1, names, excluded, settings
        )
        posterior = search(evaluator).weights
        asked.append(any("cough" in terms for terms in posterior))
    assert asked == [True, False]


@pytest.mark.parametrize(
    ("share", "fewest", "likely"), [(0.12, 11, (*EVENTS, *COMMANDS)), (0.01, 1, ())]
)
def test_commands_that_were_lost_are_found_and_followed(share, fewest, likely):
    """Lost and late commands are one answer: at most samples, both act alike.

    Rare ones are asked about where the search of some breaths finds nothing.
    """
    breaths = session("lost_commands", np.arange(BREATHS + 1), share=share)
    effect = found(breaths, likely)
    assert effect is not None
    assert effect.u_in is not None
    names = {effect.missing.name, *effect.missing.alternatives}
    assert names == {"lost_commands", "late_commands"}
    fate = np.random.default_rng((5, 2)).uniform(size=breaths.u_in.shape)
    valve, kept = np.zeros(BREATHS), []
    for k in range(breaths.u_in.shape[1] - 1):
        valve = np.where(fate[:, k] < share, valve, breaths.u_in[:, k])
        kept.append(valve)
    true, told = np.stack(kept, axis=1), effect.u_in[:, :-1]
    lost = np.abs(true - breaths.u_in[:, :-1]) > 4.0  # as many % as the pressure shows
    assert lost.sum() >= fewest
    assert np.mean(np.abs(told - true)[lost] < 1.0) > 0.9
    assert np.mean(np.abs(told - true)[~lost] < 4.0) > 0.98


def test_a_valve_that_sticks_or_has_play_has_lost_no_command():
    """It does not follow what asks for little; chance does not ask, and small losses are unseen."""
    rng = np.random.default_rng(4)
    u_in = rng.uniform(0.0, 25.0, (BREATHS, 40))
    u_in[:, 1::2] = u_in[:, :-1:2] + rng.normal(0.0, 3.0, u_in[:, 1::2].shape)  # many small moves
    chance = rng.uniform(size=u_in.shape)

    def reached(stays: Any) -> Paths:
        valve, way = np.zeros(BREATHS), []
        for k in range(u_in.shape[1]):
            valve = np.where(stays(u_in[:, k] - valve, chance[:, k]), valve, u_in[:, k])
            way.append(valve)
        kept = np.stack(way, axis=1) != u_in
        return Paths(np.zeros(BREATHS), np.stack(way, axis=1), kept.sum(axis=1), np.ones(BREATHS))

    assert ask_for_little(reached(lambda away, chance: np.abs(away) < 4.0), u_in) < 1e-9
    for share in (0.05, 0.3, 0.6):
        assert ask_for_little(reached(lambda away, chance, s=share: chance < s), u_in) > 0.01
        seen = reached(lambda away, chance, s=share: (chance < s) & (np.abs(away) > 2.0))
        assert ask_for_little(seen, u_in) > 0.01


def test_the_affected_breaths_stand_in_the_first_sentence_the_json_and_the_page(tmp_path):
    """Commands that are lost or late are one answer with two members."""
    about = dataclasses.replace(
        made.diagnosis(12).mechanisms[0],
        name="lost_commands",
        parameters={},
        alternatives=("late_commands",),
        affected=(2, 3, 4, 9, 12),
    )
    told = dataclasses.replace(made.diagnosis(12), mechanisms=(about,), plants={})
    first = str(told).splitlines()[0]
    assert "never reach the valve, or commands that reach the valve late" in first
    assert "in breaths 2 to 4, 9 and 12" in first
    assert told.as_dict()["mechanisms"][0]["affected_breaths"] == [2, 3, 4, 9, 12]
    page = report.write(tmp_path / "r.html", told).read_text()
    drawn = re.findall(r'<rect x="([\d.]+)" width="([\d.]+)" height="4"/>', page)
    # Three runs among twelve breaths, as % of the session.
    expected = [(100 / 12, 300 / 12), (800 / 12, 100 / 12), (1100 / 12, 100 / 12)]
    np.testing.assert_allclose(np.array(drawn, float), expected, atol=0.01)
