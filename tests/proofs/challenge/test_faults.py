"""The third generator: what each fault does to a recording, and where it acts."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hardware_eval.emulation.cases import Base, Effect
from proofs.challenge.contract import PARAMETERS, VOCABULARY
from proofs.challenge.detectability import LIMIT, log_likelihood_loss
from proofs.challenge.faults.effects import FAULTS, PARTIAL, SHARES, FaultsCase
from proofs.challenge.faults.laboratory import active, record, replay
from proofs.challenge.folder import decode_answers, encode_answers
from proofs.challenge.generators import FAULTS as GENERATOR
from proofs.challenge.truth import true_values
from ventbench.base.errors import InputError

QUIET = FaultsCase(
    "x",
    20.0,
    20.0,
    (),
    Base(20.0, 20.0, 5.0, 5.0, 22.8),
    noise=0.0,
    step=0.0,
    jitter=0.0,
    breaths=8,
    samples=60,
    choice=4,
)


def case(name: str, form: str = "plain", **parameters: float) -> FaultsCase:
    return replace(QUIET, effects=(Effect(name, "strong", form, parameters),))


def answered(rig: FaultsCase, u_in: float = 15.0) -> np.ndarray:
    """Pressures of a rig under the same commands for all, from rest at PEEP."""
    plain = record(QUIET, np.random.default_rng(0))
    held = np.where(plain.u_out == 0, u_in, 0.0)
    given = replace(plain, u_in=held)
    return replay(rig, given, np.full(len(plain), 5.0), 0)


PLAIN = answered(QUIET)
INSIDE, END = slice(1, 33), 32


def test_a_plain_lung_answers_as_the_textbook_says():
    flow, time = 15.0 * 22.8e-3, 0.03 * np.arange(33)
    expected = 5.0 + 20.0 * flow + flow * time / 20e-3
    np.testing.assert_allclose(PLAIN[0, 4:33], expected[4:33], atol=0.15)
    assert PLAIN[0, -1] < PLAIN[0, END] - 10.0


@pytest.mark.parametrize(
    ("rig", "what"),
    [
        (case("saturation", level=15.0), lambda p: p.max() == 15.0),
        (
            case("clock_offset", offset=0.06),
            lambda p: np.allclose(p[:, 2:], PLAIN[:, :-2], atol=0.01),
        ),
        (case("clock_skew", skew=0.03), lambda p: (PLAIN - p)[:, 30].min() > 0.3),
        (
            case("gain_step", change=0.2, breath=5.0),
            lambda p: np.allclose(p[:4], PLAIN[:4]) and (p - PLAIN)[4:, END].min() > 2.0,
        ),
        (
            case("gain_drift", "linear", change=0.2),
            lambda p: np.all(np.diff(p[:, END]) > 0.0) and p[0, END] == PLAIN[0, END],
        ),
        (
            case("zero_step", change=-1.5, breath=3.0),
            lambda p: np.allclose(p[:2], PLAIN[:2]) and np.allclose(p[2:], PLAIN[2:] - 1.5),
        ),
        (
            case("sensor_drift", "warm-up", drift=2.0),
            lambda p: (p - PLAIN)[4, 3] > 1.5 and (p - PLAIN)[7, 3] == pytest.approx(2.0),
        ),
        (case("resistance_step", change=0.5, breath=4.0), lambda p: (p - PLAIN)[3:, 6].min() > 2.0),
        (case("resistance_drift", "linear", change=0.5), lambda p: (p - PLAIN)[7, 6] > 2.0),
        (
            case("compliance_step", change=-0.3, breath=4.0),
            lambda p: (p - PLAIN)[3:, END].min() > 2.0,
        ),
        (case("compliance_drift", "linear", change=0.4), lambda p: (p - PLAIN)[7, END] < -2.0),
        (
            case("lost_commands", share=0.3),
            lambda p: (
                np.allclose(p[:, END], PLAIN[:, END], atol=3.0)
                and not np.allclose(p, PLAIN, atol=0.5)
            ),
        ),
        (case("late_commands", share=0.5, delay=0.09), lambda p: (p - PLAIN)[:, 2].min() < -2.0),
        (
            case("relief_leak", opening=14.0, conductance=30.0),
            lambda p: np.allclose(p[:, :5], PLAIN[:, :5]) and (p - PLAIN)[:, END].max() < -2.0,
        ),
        (case("trapped_gas", pressure=4.0), lambda p: (p - PLAIN)[:, 5].min() > 2.0),
        (case("command_rounding", "nearest", step=2.0), lambda p: (p - PLAIN)[:, 6].min() > 0.5),
        (
            case("supply_ripple", amplitude=0.2, frequency=5.0),
            lambda p: np.std((p - PLAIN)[:, 5:33]) > 0.5,
        ),
        (
            case("circuit_water", amplitude=1.5, frequency=4.0),
            lambda p: 1.2 < np.abs((p - PLAIN)[:, 5:33]).max() < 1.6,
        ),
    ],
    ids=lambda value: value.effects[0].name if isinstance(value, FaultsCase) else "",
)
def test_a_fault_does_what_it_is_called(rig, what):
    assert what(answered(rig))


@pytest.mark.parametrize(
    ("rig", "sign"),
    [
        (case("intermittent_leak", conductance=25.0, affected=0.4), -1),
        (case("disconnection", share=0.25), -1),
        (case("secretions", increase=1.0, affected=0.5), 1),
        (case("cough", pressure=10.0, affected=0.3), 1),
    ],
    ids=lambda value: value.effects[0].name if isinstance(value, FaultsCase) else "",
)
def test_a_fault_of_some_breaths_leaves_the_others_alone(rig, sign):
    recorded = record(rig, np.random.default_rng(0))
    flags: Any = active(rig, recorded)
    hit: Any = flags.any(axis=1)
    assert 0 < hit.sum() < len(hit)
    change = answered(rig) - PLAIN
    np.testing.assert_allclose(change[~hit], 0.0, atol=1e-9)
    assert (sign * change)[hit].max() > 1.0


def test_where_a_fault_acts_that_is_everywhere_has_no_flags():
    assert active(QUIET, record(QUIET, np.random.default_rng(0))) is None
    both = replace(
        QUIET,
        effects=(
            *case("cough", pressure=9.0, affected=0.3).effects,
            *case("clock_offset", offset=0.05).effects,
        ),
    )
    assert active(both, record(both, np.random.default_rng(0))) is None


def test_names_and_parameters_are_those_of_the_vocabulary():
    drawn = GENERATOR.draw("all", 80, np.random.default_rng(0))
    assert {d.kind for d in drawn} == set(SHARES)
    names = {e.name for d in drawn for e in d.case.effects}
    assert names == set(FAULTS) <= set(VOCABULARY)
    assert set(PARTIAL) <= set(FAULTS)
    for d in drawn:
        values = true_values(d.case)
        assert values
        assert set(values) <= PARAMETERS
    text = encode_answers("s", drawn)
    assert [d for d, _ in decode_answers(text)] == drawn
    with pytest.raises(InputError, match="no kind outside"):
        GENERATOR.draw("outside", 3, np.random.default_rng(0))


def test_a_faint_fault_is_below_detection_and_a_strong_one_above():
    noisy = replace(QUIET, noise=0.2, step=0.07)
    for share, seen in ((0.005, False), (0.25, True)):
        rig = replace(noisy, effects=case("gain_step", change=share, breath=5.0).effects)
        recorded = record(rig, np.random.default_rng(3))
        assert (log_likelihood_loss(rig, recorded, 0) > LIMIT) == seen
