"""Judging breaths are sealed: what is reported of them is what fresh breaths of the world show.

The worlds are plain numpy: a lung behind a valve that does not always do what it is told.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest

from ventbench.diagnosis import diagnose as module
from ventbench.diagnosis.diagnose import diagnose
from ventbench.diagnosis.experiment import Judge, open_loop_error, prepare
from ventbench.diagnosis.intermittent import Intermittent
from ventbench.diagnosis.result import Diagnosis
from ventbench.plants.catalog import load_simulators
from ventbench.recordings.breaths import Breaths
from ventbench.system_id import Noise

from . import made, small

Floats = np.ndarray

#: Breaths of a recording, of which a sixth judges; samples of each, s of inspiration are one.
BREATHS, SAMPLES = 48, 45

SETTINGS = dataclasses.replace(
    small.SETTINGS, data=dataclasses.replace(small.SETTINGS.data, batch_size=BREATHS)
)


def lost(sent: Floats, rng: np.random.Generator) -> Floats:
    """The valve stays where it is at 12 % of the commands."""
    return _held(sent, rng.uniform(size=sent.shape) < 0.12)


def late(sent: Floats, rng: np.random.Generator) -> Floats:
    """A quarter of the breaths is three samples late."""
    after = np.concatenate([np.zeros((len(sent), 3)), sent[:, :-3]], axis=1)
    return np.where(rng.uniform(size=(len(sent), 1)) < 0.25, after, sent)


def stiction(sent: Floats, rng: np.random.Generator) -> Floats:
    """The valve rests until the command is 4 % away, then jumps to it."""
    valve, reached = np.zeros(len(sent)), []
    for command in sent.T:
        valve = np.where(np.abs(command - valve) > 4.0, command, valve)
        reached.append(valve)
    return np.stack(reached, axis=1)


def gains(sent: Floats, rng: np.random.Generator) -> Floats:
    """Each breath has a gain and an offset of the opening of its own."""
    gain = np.exp(0.07 * rng.standard_normal((len(sent), 1)))
    return np.where(sent > 0.0, gain * sent + 0.6 * rng.standard_normal((len(sent), 1)), 0.0)


def nothing(sent: Floats, rng: np.random.Generator) -> Floats:
    return sent


def _held(sent: Floats, misses: Floats) -> Floats:
    valve, reached = np.zeros(len(sent)), []
    for command, missed in zip(sent.T, misses.T, strict=True):
        valve = np.where(missed, valve, command)
        reached.append(valve)
    return np.stack(reached, axis=1)


def recorded(
    valve: Callable[[Floats, np.random.Generator], Floats],
    seed: int,
    *,
    low: float = 0.0,
    step: float = 0.0,
    rows: float = 0.0,
    n: int = BREATHS,
) -> Breaths:
    """A recording of a world.

    Args:
        valve: what reaches the valve of the commands that were sent, %.
        seed: of everything.
        low: share of the breaths whose inspirations are 15 % low, as by a leak.
        step: change of the valve's gain from the middle of the session on, as a share.
        rows: share of the rows that are missing in the file.
        n: number of breaths.
    """
    u_in, u_out, time, dt = made.commands(n, SAMPLES, seed)
    rng = np.random.default_rng((seed, 1))
    # Pressure control: the command moves all the time, as a controller's does.
    u_in = np.where(u_out == 1, 0.0, u_in * (1.0 + 0.25 * np.sin(9.0 * time + rng.uniform(0, 6))))
    reached = valve(u_in, rng)
    reached = reached * np.where(np.arange(n) >= n // 2, 1.0 + step, 1.0)[:, None]
    leaking = rng.uniform(size=n) < low
    pressure = made.answer(reached, u_out, dt, 22.0, 19.0)[0]
    out = np.where(leaking[:, None] & (u_out == 0), 0.15 * (pressure - made.PEEP), 0.0)
    pressure = pressure - out + 0.15 * rng.standard_normal(pressure.shape)
    kept = rng.uniform(size=pressure.shape) >= rows
    kept[:, 0] = True
    valid = np.ones(pressure.shape, bool)
    if rows:  # the rest moves up, as a reader of the file has it
        order = np.argsort(~kept, axis=1, kind="stable")
        length = kept.sum(axis=1)
        valid = np.arange(SAMPLES) < length[:, None]

        def closed(values: Floats) -> Floats:
            return np.take_along_axis(values, order, axis=1)

        last = np.take_along_axis(closed(time), length[:, None] - 1, axis=1)
        beyond = last + 0.033 * (np.arange(SAMPLES) - length[:, None] + 1)
        time = np.where(valid, closed(time), beyond)
        u_in, u_out = np.where(valid, closed(u_in), 0.0), np.where(valid, closed(u_out), 1)
        pressure = np.where(valid, closed(pressure), np.nan)
        dt = np.diff(time, axis=1, append=2.0 * time[:, -1:] - time[:, -2:-1])
    one = np.ones(n)
    return Breaths(
        1 + np.arange(n),
        20.0 * one,
        20.0 * one,
        time,
        dt,
        u_in,
        u_out.astype(np.int8),
        pressure,
        valid,
        np.zeros(n, bool),
    )


WORLDS: dict[str, dict[str, Any]] = {
    "lost commands": {"valve": lost},
    "late commands": {"valve": late},
    "stiction": {"valve": stiction},
    "gains": {"valve": gains},
    "some breaths low": {"valve": nothing, "low": 0.2},
    "step": {"valve": nothing, "step": 0.2},
    "rows_missing": {"valve": nothing, "rows": 0.1},
}


@cache
def found(world: str) -> Diagnosis:
    return diagnose(recorded(**WORLDS[world], seed=3), settings=SETTINGS)


def test_readings_of_judging_breaths_are_blank_but_for_the_first():
    breaths = recorded(nothing, 0)
    experiment = prepare(breaths, load_simulators("physics"))
    judging = experiment.uses.judging
    assert judging.sum() == BREATHS // 6
    for sealed in (experiment.breaths, experiment.recorded):
        assert np.isnan(sealed.pressure[judging, 1:]).all()
        np.testing.assert_array_equal(sealed.pressure[judging, 0], breaths.pressure[judging, 0])
        np.testing.assert_array_equal(sealed.pressure[~judging], breaths.pressure[~judging])
    assert experiment.data.weight[judging, 0, 1:].sum() == 0.0
    assert not experiment.data.measured[judging, 0, 1:].any()


def test_the_judge_answers_with_errors_of_its_breaths_alone():
    breaths = recorded(nothing, 0)
    judging = np.arange(BREATHS) % 6 == 5
    judge = Judge(breaths, judging)
    off = np.where(judging[:, None], 0.5, 9.0)
    error = judge.error(breaths.pressure + off, breaths.valid)
    assert (error.mae, error.rmse) == pytest.approx((0.5, 0.5))
    assert judge.ids == tuple(breaths.breath_id[judging])
    noise = Noise((0.2,), (0.0,))
    right, wrong = (judge.log_likelihood(breaths.pressure + x, noise, 0.0) for x in (0.0, off))
    expected = (noise.loss(np.array(2.5)) - 0.0) * judging.sum() * SAMPLES
    assert right - wrong == pytest.approx(float(expected))


def test_breaths_with_an_effect_that_nobody_predicts_do_not_outvote_the_others():
    """A name that halves the error of five breaths, and misses an open circuit by more."""
    breaths = recorded(nothing, 0)
    judging, noise = np.arange(BREATHS) % 6 == 5, Noise((0.2,), (0.0,), tail=3.0)
    judge, off = Judge(breaths, judging), np.full(BREATHS, 0.4)
    off[np.flatnonzero(judging)[0]] = 40.0
    better = np.where(off > 1.0, 120.0, 0.2)

    def gain(share: float) -> float:
        with_it, without = (
            judge.log_likelihood(breaths.pressure + x[:, None], noise, share) for x in (better, off)
        )
        return with_it - without

    assert gain(0.0) < 0.0 < gain(0.2)


@pytest.mark.parametrize("n", [48, 16], ids=["apart", "few breaths, which test as well"])
def test_breaths_that_judge_keep_their_commands_and_are_never_set_aside(n):
    experiment = prepare(recorded(nothing, 0, n=n), load_simulators("physics"))
    judging, given = experiment.uses.judging, experiment.data.u_in
    reached = experiment.set_aside(np.ones(n, bool), given + 1.0)
    assert reached is not None
    np.testing.assert_array_equal(reached.data.u_in, given + ~judging[:, None])
    np.testing.assert_allclose(
        reached.identification_data.u_in, given[experiment.uses.identifying] + 1.0
    )
    affected = np.arange(n) % 5 == 1
    assert (affected & judging).any()
    left = experiment.set_aside(affected, None)
    assert left is not None
    assert left.judge is experiment.judge
    assert not (left.uses.identifying & affected).any()
    assert not (left.uses.fitted & affected).any()
    assert np.array_equal(left.uses.judging, judging)
    assert experiment.set_aside(np.arange(n) > 3, None) is None, "too little is left"


@pytest.mark.slow
def test_no_stage_sees_the_readings_of_judging_breaths(monkeypatch):
    """Whatever they are, the same is found and fitted, and only errors and their verdict differ."""
    breaths = recorded(**WORLDS["lost commands"], seed=3)
    one = found("lost commands")
    asked: list[Intermittent | None] = []
    find = module.find

    def watched(*given: Any) -> Intermittent | None:
        asked.append(find(*given))
        return asked[-1]

    monkeypatch.setattr(module, "find", watched)
    pressure = breaths.pressure.copy()
    judging = one.traces.held_out
    pressure[judging, 1:] += np.random.default_rng(0).normal(0.0, 0.05, pressure[judging, 1:].shape)
    other = diagnose(dataclasses.replace(breaths, pressure=pressure), settings=SETTINGS)
    assert asked
    assert other.open_loop.after != one.open_loop.after
    assert other.posterior == one.posterior
    assert [m.parameters for m in other.mechanisms] == [m.parameters for m in one.mechanisms]
    assert [m.affected for m in other.mechanisms] == [m.affected for m in one.mechanisms]
    np.testing.assert_array_equal(other.traces.after, one.traces.after)
    np.testing.assert_array_equal(other.traces.breaths.u_in, one.traces.breaths.u_in)
    np.testing.assert_array_equal(one.traces.breaths.u_in[judging], breaths.u_in[judging])


def chance(squares: Floats, count: int) -> tuple[float, float]:
    """Errors that 99 % of draws of so many breaths have, of mean squares by breath, ``(k,)``."""
    rng = np.random.default_rng(0)
    drawn = squares[rng.integers(0, len(squares), (5000, count))]
    low, high = np.sqrt(np.quantile(drawn.mean(axis=1), [0.005, 0.995]))
    return float(low), float(high)


@pytest.mark.slow
@pytest.mark.parametrize("world", WORLDS)
def test_reported_and_fresh_error_agree(world):
    """A second recording of the same world, under its recorded commands, from another seed."""
    one = found(world)
    fresh = recorded(**WORLDS[world], seed=4)
    if world == "step":  # corrected is the rig at the end of the session
        fresh = fresh.select(np.arange(BREATHS) >= BREATHS // 2)
        before = recorded(**WORLDS[world], seed=4).select(np.arange(BREATHS) < BREATHS // 2)
        earlier = load_simulators(one.plants_at(0.0)).pressures(before)
        now = load_simulators(one.plants).pressures(before)
        inside = before.inspiratory & (before.time > 0)
        was, changed = (open_loop_error(before.pressure, p, inside).rmse for p in (earlier, now))
        assert was < 0.3 * changed
    answer = load_simulators(one.plants).pressures(fresh)
    inside = fresh.inspiratory & (fresh.time > 0)
    error = open_loop_error(fresh.pressure, answer, inside).rmse
    reported = one.open_loop.after.rmse
    count = len(one.open_loop.held_out_breaths)
    assert count == BREATHS // 6
    squares = np.nanmean(np.where(inside, (answer - fresh.pressure) ** 2, np.nan), axis=1)
    low, high = chance(squares, count)
    by_chance = f"{count} of these [{low:.2f}, {high:.2f}]"
    print(f"{world}: reported {reported:.2f}, fresh {error:.2f}, {by_chance}")
    assert 0.8 <= error / reported <= 1.25 or low <= reported <= high
