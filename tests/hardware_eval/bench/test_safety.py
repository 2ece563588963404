"""Every check of the host trips on what it is for, within its duration, and on nothing healthy."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hardware_eval.bench import safety
from hardware_eval.bench.drive import BenchVentilator
from hardware_eval.bench.loop import Bench
from hardware_eval.bench.safety import DEFAULT, SafetySample, SafetyState
from ventbench.base.errors import InputError
from ventbench.task import protocol
from ventbench.task.lungs import lung
from ventbench.task.metrics import measured
from ventbench.task.metrics.score import passes_safety_gate

DT = protocol.DT
LUNG = lung("R20C20")


def healthy(breaths: int = 2, pip: float = 20.0) -> Iterator[SafetySample]:
    """A lung of R and C under commands that hold a plateau, with sensor noise of two values."""
    volume, pressure, command = 0.0, 5.0, (0.0, 1)
    for index in range(breaths * protocol.BREATH_STEPS):
        step = index % protocol.BREATH_STEPS
        reading = pressure + 0.01 * (index % 2)
        yield SafetySample(index * DT, reading, math.nan, *command, pip, 0.0, command[0])
        if step < protocol.INSPIRATION_STEPS:
            flow = max(pip - 5.0 - volume / LUNG.C, 0.0) / LUNG.R * 1000.0  # mL/s
            command = (flow / safety.VALVE_GAIN, 0)
            volume += flow * DT
            pressure = 5.0 + volume / LUNG.C + LUNG.R * flow / 1000.0
        else:
            command = (0.0, 1)
            volume *= math.exp(-DT / (1e-3 * LUNG.C * (LUNG.R + 5.0)))
            pressure = 5.0 + volume / LUNG.C / 5.0


def looked_at(change: Callable[[int, SafetySample], SafetySample]) -> SafetyState:
    """State after the healthy breaths with a change, until the first trip."""
    state = SafetyState(LUNG)
    for index, sample in enumerate(healthy()):
        state = safety.step(DEFAULT, state, change(index, sample))
        if state.trips:
            break
    return state


def test_healthy_breaths_trip_nothing() -> None:
    assert not looked_at(lambda index, sample: sample).trips


FAULTS: dict[str, tuple[Callable[[int, SafetySample], SafetySample], float]] = {
    "over_pressure": (lambda i, s: s._replace(pressure=36.0 + 0.01 * (i % 3)), 0.1),
    "peak_pressure": (lambda i, s: s._replace(pressure=66.0), 0.0),
    "over_volume": (lambda i, s: s._replace(flow=4000.0 if s.u_out == 0 else 0.0), 0.3),
    "disconnected": (
        lambda i, s: s._replace(
            pressure=5.0 + 0.01 * (i % 3), u_in=90.0 if s.u_out == 0 else 0.0, applied=math.nan
        ),
        0.4,
    ),
    "software_delay": (lambda i, s: s._replace(late=0.11), 0.0),
    "missed_deadlines": (lambda i, s: s._replace(late=0.012), 0.12),
    "stuck_sensor": (lambda i, s: s._replace(pressure=12.0), 1.5),
    "no_reading": (lambda i, s: s._replace(pressure=math.nan), 0.09),
    "no_answer": (lambda i, s: s._replace(pressure=math.nan, answered=False), 0.06),
    "low_pressure": (lambda i, s: s._replace(pressure=0.5 + 0.01 * (i % 3)), 0.5),
    "expiratory_valve": (
        lambda i, s: s._replace(pressure=24.0 + 0.01 * (i % 3) if s.u_out else s.pressure),
        1.0,
    ),
    "applied_command": (lambda i, s: s._replace(applied=s.u_in + 5.0), 0.1),
}


@pytest.mark.parametrize("name", sorted(FAULTS))
def test_a_fault_trips_its_check_within_its_time(name: str) -> None:
    change, within = FAULTS[name]
    began = 145 if name == "low_pressure" else 110  # in the second expiration, or inspiration
    state = looked_at(lambda index, sample: change(index, sample) if index >= began else sample)
    assert name in [trip.check for trip in state.trips]
    trip = next(trip for trip in state.trips if trip.check == name)
    phase = 24 * DT if name == "expiratory_valve" else 0.0  # until it is told to open
    assert trip.time - began * DT <= phase + within + DT + 1e-9
    assert f"{trip.value:.3g}" in trip.message


@pytest.mark.parametrize("lacking", [2, 3, 5])
@pytest.mark.parametrize("name", sorted(set(FAULTS) - {"no_reading", "no_answer"}))
@pytest.mark.parametrize("phase", [0, 1])
def test_missing_readings_hide_no_fault_and_raise_no_alarm(
    name: str, lacking: int, phase: int
) -> None:
    change, within = FAULTS[name]
    began = 145 if name == "low_pressure" else 110

    def seen(index: int, sample: SafetySample) -> SafetySample:
        sample = change(index, sample) if index >= began else sample
        if index % lacking == phase:
            return sample._replace(pressure=math.nan, answered=False)
        return sample

    state = looked_at(seen)
    assert name in [trip.check for trip in state.trips]
    trip = next(trip for trip in state.trips if trip.check == name)
    until = 24 * DT if name == "expiratory_valve" else 0.0
    assert trip.time - began * DT <= until + within + 3 * DT + 1e-9
    healthy_ones = looked_at(
        lambda i, s: s._replace(pressure=math.nan, answered=False) if i % lacking == phase else s
    )
    assert not healthy_ones.trips


@settings(max_examples=60, deadline=None)
@given(
    st.lists(
        st.sampled_from([9.0, 24.9, 25.1, 40.0, 69.0, 71.0, math.nan]), min_size=1, max_size=40
    ),
    st.integers(1, protocol.BREATH_STEPS - 1),
)
def test_over_pressure_is_the_gate_of_scoring(readings: list[float], inspired: int) -> None:
    # A breath so far trips the check as soon as scoring would refuse it. The
    # expiration counts, and a breath before it does not.
    pip, state = 10.0, SafetyState(LUNG)
    before = [SafetySample(k * DT, 26.0, math.nan, 0.0, 1, pip, 0.0, 0.0) for k in (0, 1)]
    for k, pressure in enumerate([9.0, *readings]):
        u_out = int(k == 0 or k > inspired)
        sample = SafetySample((2 + k) * DT, pressure, math.nan, 0.0, u_out, pip, 0.0, 0.0)
        before.append(sample)
    for k, sample in enumerate(before):
        state = safety.step(DEFAULT, state, sample)
        breath = [x.pressure for x in before[2 : k + 1]]
        tripped = "over_pressure" in [trip.check for trip in state.trips]
        assert tripped == (k > 2 and not measured.is_safe(breath, pip, DT))


def test_a_valve_that_opens_again_and_again_stays_within_the_gate(bench: Bench) -> None:
    ventilator, pip = BenchVentilator(bench, "R5C20", 10.0), 10.0
    shown = [float(ventilator.start(protocol.PEEP)[0])]
    for _ in range(protocol.INSPIRATION_STEPS):  # as exploring does
        wanted = protocol.U_MAX if shown[-1] <= pip + protocol.SAFETY_MARGIN else 0.0
        shown.append(float(ventilator.step(np.array([wanted]), np.zeros(1))[0]))
    ventilator.vent()
    assert not ventilator.trips
    assert passes_safety_gate(shown, pip, DT)
    assert max(shown) > pip + protocol.SAFETY_MARGIN


def test_a_jump_that_no_valve_can_make_trips() -> None:
    state = looked_at(lambda i, s: s._replace(pressure=105.0) if i == 98 else s)
    assert "implausible_slope" in [trip.check for trip in state.trips]


def test_pressure_that_rises_behind_closed_valves_trips() -> None:
    state = SafetyState(LUNG)
    for index in range(20):
        sample = SafetySample(index * DT, 5.0 + 1.2 * index, math.nan, 0.0, 0, 35.0, 0.0, 0.0)
        state = safety.step(DEFAULT, state, sample)
    assert [trip.check for trip in state.trips] == ["inspiratory_valve"]


def test_a_reading_that_stands_still_at_rest_trips_after_five_seconds() -> None:
    state = SafetyState(LUNG)
    for index in range(180):
        sample = SafetySample(index * DT, 5.0, math.nan, 0.0, 1, 20.0, 0.0, 0.0)
        state = safety.step(DEFAULT, state, sample)
    (trip,) = state.trips
    assert trip.check == "still_sensor"
    assert trip.time == pytest.approx(5.15, abs=2 * DT)


def test_trips_stay_when_the_fault_is_gone() -> None:
    state = looked_at(lambda i, s: s._replace(late=0.2) if i == 5 else s)
    for index in range(10):
        sample = SafetySample(1.0 + index * DT, 5.0 + 0.01 * index, math.nan, 0.0, 1, 20.0, 0.0)
        state = safety.step(DEFAULT, state, sample)
    assert [trip.check for trip in state.trips] == ["software_delay"]


def test_over_pressure_blames_the_controller_and_a_loose_tube_the_bench() -> None:
    checks = safety.CHECKS
    assert not checks["over_pressure"].bench
    assert checks["disconnected"].bench
    assert all(check.reason for check in checks.values())
    assert checks["over_pressure"].threshold == protocol.SAFETY_TIME
    assert checks["peak_pressure"].threshold == protocol.SAFETY_PRESSURE + 5.0


@pytest.mark.parametrize("value", [0.0, -1.0, 101.0, math.nan])
@pytest.mark.parametrize("name", ["largest_u_in", "largest_rise"])
def test_a_limit_that_is_none_is_refused(name: str, value: float) -> None:
    with pytest.raises(InputError, match=f"{name} is .* above 0 and at most 100"):
        replace(DEFAULT, **{name: value})


def test_commands_are_cut_to_range_size_and_rise() -> None:
    settings = safety.SafetySettings(largest_u_in=50.0, largest_rise=20.0)
    assert safety.limit_command(settings, 10.0, 25.0) == (25.0, False)
    assert safety.limit_command(settings, 10.0, 45.0) == (30.0, True)
    assert safety.limit_command(settings, 45.0, 90.0) == (50.0, True)
    assert safety.limit_command(settings, 45.0, -5.0) == (0.0, False)
    assert safety.limit_command(DEFAULT, 0.0, 140.0) == (100.0, False)
