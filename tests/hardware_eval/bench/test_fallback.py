"""The fallback: its bounds against integrated rigs, takeovers and handing back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from hardware_eval.bench import fallback
from hardware_eval.bench.fallback import BOUNDS
from hardware_eval.bench.loop import Bench, run_once
from ventbench.task import protocol
from ventbench.task.lungs import LUNGS, Lung
from ventbench.task.metrics.score import passes_safety_gate

from .test_session import Scripted, run

DT = protocol.DT


class Rig:
    """A lung within the bounds, integrated by scipy; slow valves mix the delays."""

    def __init__(self, label: Lung, draw: np.random.Generator) -> None:
        low, high = label.R / BOUNDS.R, label.R * BOUNDS.R + BOUNDS.apparatus
        self.R = draw.choice([low, high, draw.uniform(low, high)])
        self.C = label.C * draw.choice([1.0 / BOUNDS.C, draw.uniform(0.9, 1.15)])
        self.gain = 22.8 * draw.choice([1.0 / BOUNDS.gain, BOUNDS.gain, draw.uniform(0.9, 1.1)])
        delays, self.parabolic = np.array(BOUNDS.delays), draw.random() < 0.5
        shares = np.eye(len(delays))[draw.integers(len(delays))]
        self.mix = (shares if self.parabolic else draw.dirichlet(np.ones(len(delays)))) @ delays
        self.sent, self.volume = [0.0, 0.0, 0.0], 0.0

    def pressure(self) -> float:
        """At the end of the step under way, cmH2O."""
        flow = 1e-3 * self.gain * float(self.mix @ np.array(self.sent[::-1][:3]))
        drop = self.R * flow * (abs(flow) if self.parabolic else 1.0)
        return protocol.PEEP + 1e3 * self.volume / self.C + drop

    def hold(self, command: float) -> float:
        """Hold a command for a step; returns the pressure then."""
        self.sent.append(command)
        flow = 1e-3 * self.gain * float(self.mix @ np.array(self.sent[::-1][:3]))
        done = solve_ivp(lambda t, v: [flow], (0.0, DT), [self.volume], rtol=1e-9)
        self.volume = float(done.y[0, -1])
        return self.pressure()


@pytest.mark.parametrize("seed", range(4))
def test_no_rig_within_the_bounds_exceeds_what_is_reachable(seed: int) -> None:
    draw = np.random.default_rng(seed)
    nearest = np.inf
    for _ in range(25):
        label = LUNGS[draw.integers(len(LUNGS))]
        rig, state = Rig(label, draw), fallback.FallbackState(label)
        pressure, pip = protocol.PEEP, float(draw.uniform(10.0, 35.0))
        for step in range(int(draw.integers(1, 12))):
            answer = float(draw.uniform(0.0, 40.0))
            read = pressure + draw.uniform(-1.0, 1.0) * BOUNDS.noise
            state, command = fallback.step(state, step, read, pip, answer, 0.0)
            pressure = rig.hold(command)
        read = pressure + draw.uniform(-1.0, 1.0) * BOUNDS.noise
        state = replace(state, pressures=(*state.pressures, read))
        last = float(draw.uniform(0.0, 100.0))
        bound = fallback.reachable(state, last).max(axis=0)
        reached = [rig.hold(last), *[rig.hold(0.0) for _ in range(len(bound) - 1)]]
        assert np.all(np.array(reached) <= bound + 1e-6)
        nearest = min(nearest, float(np.min(bound - reached)))
    assert nearest < 5.0  # a bound, not a wall far away


@pytest.mark.parametrize("lung", [LUNGS[0], LUNGS[-1]], ids=str)
def test_whatever_an_entry_asks_for_the_gate_holds(lung: Lung) -> None:
    for seed in range(6):
        draw = np.random.default_rng(seed)
        rig, state, pip = Rig(lung, draw), fallback.FallbackState(lung), 15.0
        pressure, above = protocol.PEEP, 0
        for step in range(protocol.INSPIRATION_STEPS):
            answer = None if draw.random() < 0.3 else float(draw.choice([0.0, 50.0, 100.0]))
            state, command = fallback.step(state, step, pressure, pip, answer, 0.0)
            pressure = rig.hold(command)
            limit = pip + protocol.SAFETY_MARGIN
            assert protocol.PEEP + 1e3 * rig.volume / rig.C <= limit
            # What the first commands did, unseen, has passed.
            above += pressure > limit and step > 2 * BOUNDS.last
            assert above * DT <= protocol.SAFETY_TIME
        assert state.taken >= state.longest > 3


def with_fallback(bench: Bench) -> Bench:
    return Bench(bench.client, bench.clock, bench.settings, bench.operator, (), 2.0, True)


def test_it_takes_over_for_a_late_answer_and_hands_back(bench: Bench) -> None:
    result = run_once(
        with_fallback(bench), run(), Scripted(lambda step, u: None if step == 5 else u)
    )
    assert result.status == "complete", result.reason
    assert (result.late_answers, result.outside) == (1, 0)
    assert result.fallback == result.longest_fallback == 1 + BOUNDS.hand_back
    breath = result.breaths[0]
    asked = np.clip(breath.requested, 0.0, 100.0)
    by_entry = np.abs(np.array(breath.u_in) - asked) < 1e-9
    taken = [k for k in range(protocol.INSPIRATION_STEPS) if not by_entry[k]]
    assert taken[0] == 5
    assert taken[-1] <= 5 + BOUNDS.hand_back
    assert breath.u_in[5] > 0.0


def test_an_entry_outside_its_envelope_is_rescued_and_fails(bench: Bench) -> None:
    result = run_once(with_fallback(bench), run(10.0), Scripted(lambda step, u: 100.0))
    assert result.status == "failed"
    assert "were outside the envelope" in result.reason
    assert result.trips == ()
    assert result.outside > 50
    held = [breath.pressure[: protocol.INSPIRATION_STEPS] for breath in result.breaths]
    assert passes_safety_gate(held, 10.0, DT).all()
