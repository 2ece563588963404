"""Calibration: the line against scipy and a simulated truth; each part on an emulated bench."""

from __future__ import annotations

import datetime
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from hardware_eval.bench import calibrate, dated
from hardware_eval.bench.calibrate import Calibration, fit, load, measure
from hardware_eval.bench.identity import Baseline
from hardware_eval.bench.loop import Bench, Operator
from hardware_eval.bench.safety import DEFAULT
from hardware_eval.bench.selftest import Finding, selftest
from hardware_eval.emulation.emulator import LoopbackDevice
from hardware_eval.results.evaluate import Line
from hardware_eval.wire.client import Client
from tests.hardware_eval import stand_in
from tests.hardware_eval.faults import Fault, FaultKind
from ventbench.base.errors import InputError

LUNG = "R5C20"
DAY = datetime.datetime(2026, 1, 10, tzinfo=datetime.UTC)


def test_the_line_is_that_of_scipy_and_its_intervals_cover() -> None:
    draw, inside = np.random.default_rng(0), []
    x = np.array([0.0, 10.0, 20.0, 40.0, 20.0, 10.0, 0.0])
    for _ in range(400):
        y = 0.3 + 0.97 * x + 0.1 * draw.standard_normal(7)
        found = fit(x, y, np.full(7, 1e-3))  # the scatter is more than they say
        inside.append(found.slope.low <= 0.97 <= found.slope.high)
    assert 0.92 <= np.mean(inside) <= 0.98
    plain: Any = stats.linregress(x, y)
    assert found.slope.value == pytest.approx(plain.slope)
    half = stats.t.ppf(0.975, 5) * plain.stderr
    assert found.slope.high - found.slope.value == pytest.approx(half)


class Applies(Operator):
    """A person who puts what is asked for on a sensor that reads 5 % too much, and 0.4 more."""

    def __init__(self, hal: stand_in.Bench) -> None:
        self._hal = hal

    def confirm(self, question: str) -> bool:
        words = question.split()
        self._hal.pressure = 0.4 + 1.05 * float(words[1] if words[0] == "apply" else 0.0)
        return True


def test_zero_and_span_find_a_sensor_that_is_off() -> None:
    hal = stand_in.Bench(noise=0.2)
    device = LoopbackDevice(hal)
    client = Client(device, device.clock)
    client.hello()
    bench = Bench(client, device.clock, DEFAULT, Applies(hal))
    zero = measure(bench, "zero", lung=LUNG).fit.intercept
    assert zero.low < 0.4 < zero.high < 0.5
    span = measure(bench, "span", lung=LUNG, reference=(0.0, 20.0, 40.0, 20.0, 0.0)).fit
    assert span.slope.low < 1.05 < span.slope.high
    assert span.slope.low > 1.04
    assert all(u_in == 0.0 for _, u_in, _ in hal.valves)
    with pytest.raises(InputError, match="two references"):
        measure(bench, "span", lung=LUNG, reference=(20.0,))
    with pytest.raises(InputError, match="measures none"):
        measure(bench, "flow", lung=LUNG, reference=(0.0, 500.0))
    with pytest.raises(InputError, match="nobody is there"):
        measure(bench, "valve", lung=LUNG)


def test_a_meter_is_read_where_the_device_measures_no_flow() -> None:
    hal = stand_in.Bench(pressure=0.5)
    device = LoopbackDevice(hal)
    client = Client(device, device.clock)
    client.hello()
    shown = iter((228.0, 456.0, 240.0))

    class Reads(Operator):
        def number(self, question: str) -> float:
            return next(shown)

    bench = Bench(client, device.clock, DEFAULT, Reads())
    part = measure(bench, "valve", lung=LUNG, reference=(10.0, 20.0, 10.0))
    assert part.by_hand
    assert part.reading == (228.0, 456.0, 240.0)
    openings = [u_in for _, u_in, _ in hal.valves if u_in]
    assert list(dict.fromkeys(openings)) == [10.0, 20.0, 15.0]  # from above: by 15 to 10
    assert all(u_out == 1 for _, _, u_out in hal.valves)


def test_the_emulated_bench_is_calibrated_and_the_file_is_kept_for_it(
    bench: Bench, device: LoopbackDevice, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dated, "today", lambda: DAY)
    openings = (10.0, 30.0, 10.0)
    parts = {"valve": measure(bench, "valve", lung=LUNG, reference=openings)}
    slope = parts["valve"].fit.slope
    assert slope.value == pytest.approx(22.8, rel=0.02)  # the paper's valve
    parts["peep"] = measure(bench, "peep", lung=LUNG, reference=(5.0,))
    assert parts["peep"].fit.intercept.value == pytest.approx(5.0, abs=0.05)
    parts["leak"] = measure(bench, "leak", lung=LUNG)
    assert calibrate.lost_flow(parts["leak"], LUNG).low < 5.0
    parts["lung"] = measure(bench, "lung", lung=LUNG)
    hal: Any = device.service.hal
    hal.faults = (Fault(FaultKind.LEAK, device.clock.now(), strength=0.006),)
    leaking = calibrate.lost_flow(measure(bench, "leak", lung=LUNG), LUNG)
    assert leaking.low > 10.0
    hal.faults = (Fault(FaultKind.LEAK, device.clock.now(), strength=0.02),)
    with pytest.raises(InputError, match="mL/s are lost: look for the leak"):
        measure(bench, "leak", lung=LUNG)
    hal.faults = ()
    path, own = tmp_path / "calibration.json", bench.client.identity.device
    saved = Calibration(own, parts).save(path)
    monkeypatch.setattr(dated, "today", lambda: DAY + datetime.timedelta(days=29))
    kept = load(path, own)
    assert kept == saved
    baseline = kept.baseline()
    assert baseline.lung is not None
    assert baseline.lung.lung == LUNG
    assert np.exp(baseline.lung.logarithms) == pytest.approx([5.0, 1000.0 / 20.0], rel=0.2)
    assert f"it is {LUNG}" in str(parts["lung"])
    sheet = selftest(bench, LUNG, simulator=None, baseline=baseline, skip=("leak", "sweep"))
    found = {x.name: x for x in sheet.findings}
    assert found["sensor_span"].ok
    assert found["sensor_span"].value == pytest.approx(1.0, abs=0.005)
    assert found["peep"].ok
    assert not judged_at(bench, replace(baseline, peep=5.7))["peep"].ok
    assert kept.valve is not None
    assert kept.valve.openings == (10.0, 30.0)
    assert kept.valve.flows == pytest.approx([228.0, 684.0], rel=0.01)
    assert kept.valve.error < 0.01
    bent = replace(parts["valve"], reading=(220.0, 500.0, 236.0))  # not linear, and it sticks
    curve = Calibration(own, {"valve": bent}).valve
    assert curve is not None
    assert curve.flow(np.array([0.0, 5.0, 20.0, 40.0])).tolist() == [0.0, 114.0, 364.0, 636.0]
    assert curve.error < 0.01
    assert curve.scatter == pytest.approx((2.0 / 3.0) ** 0.5 * 8.0 / 228.0, rel=0.05)
    assert kept.about()["dates"]["peep"] == DAY.isoformat()
    monkeypatch.setattr(dated, "today", lambda: DAY + datetime.timedelta(days=31))
    with pytest.raises(InputError, match=r"31 days old.*calibrate valve"):
        load(path, own)
    assert load(path, own, stale=True) == saved
    with pytest.raises(InputError, match="not of this 00"):
        load(path, own | {"device_id": "00"})
    content = json.loads(path.read_text())
    content["parts"]["valve"]["reading"][0] += 1.0
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match="was changed"):
        load(path, own)


def judged_at(bench: Bench, baseline: Baseline) -> dict[str, Finding]:
    sheet = selftest(bench, LUNG, baseline=baseline, skip=("leak", "sweep", "lung"))
    return {x.name: x for x in sheet.findings}


class Shows(Operator):
    """A person whose references a sensor shows by a function."""

    def __init__(self, hal: stand_in.Bench, shown: Callable[[float], float]) -> None:
        self._hal, self._shown = hal, shown

    def confirm(self, question: str) -> bool:
        words = question.split()
        self._hal.pressure = self._shown(float(words[1]) if words[0] == "apply" else 0.0)
        return True


@pytest.mark.parametrize(
    ("kind", "shown", "message"),
    [
        ("span", lambda p: 3.0 - 0.0008 * p, "span: slope .*dead, swapped"),
        ("span", lambda p: -p, "dead, swapped"),
        ("span", lambda p: 2.77 * p, "another part's"),
        ("span", lambda p: min(p, 30.0), "slope|saturates"),
        ("span", lambda p: p + 3.0, "its offset"),
        ("zero", lambda p: p + 3.0, "not open to air"),
    ],
)
def test_a_sensor_that_cannot_be_is_refused_with_a_sentence(
    kind: str, shown: Callable[[float], float], message: str
) -> None:
    hal = stand_in.Bench(noise=0.1)
    device = LoopbackDevice(hal)
    client = Client(device, device.clock)
    client.hello()
    bench = Bench(client, device.clock, DEFAULT, Shows(hal, shown))
    with pytest.raises(InputError, match=message):
        measure(bench, kind, lung=LUNG, reference=(0.0, 20.0, 40.0, 20.0, 0.0))


@settings(max_examples=20)
@given(st.floats(-1.5, 1.5), st.floats(0.92, 1.08), st.floats(5.0, 45.0), st.booleans())
def test_readings_and_limits_are_corrected_by_what_was_calibrated(
    offset: float, slope: float, pressure: float, again: bool
) -> None:
    """Whatever a sensor of the expected range shows, the corrected reading is the pressure."""
    hal = stand_in.Bench()
    device = LoopbackDevice(hal, 50.0)
    client = Client(device, device.clock)
    client.hello(40.0)
    bench = Bench(client, device.clock, DEFAULT, Shows(hal, lambda p: offset + slope * p))
    own = client.identity.device
    parts = {
        kind: measure(bench, kind, lung=LUNG, reference=references)
        for kind, references in (("span", (0.0, 20.0, 40.0)), ("zero", ()))
    }
    correction = Calibration(own, parts).correction()
    client.calibrate(correction)
    if again:
        client.hello(40.0)
    hal.pressure = offset + slope * pressure
    assert client.heartbeat().pressure == pytest.approx(pressure, abs=0.03)
    limit = device.service.state.pressure_limit  # the sensor's reading at the true limit
    assert limit == pytest.approx(offset + slope * 40.0, abs=0.03)
    assert 0.0 < correction.error < 0.3  # by three references


def test_a_part_that_was_not_confirmed_is_not_measured(line: Line) -> None:
    class Refuses(Operator):
        def confirm(self, question: str) -> bool:
            return False

    bench = Bench(line.client, line.clock, DEFAULT, Refuses())
    for kind in calibrate.PARTS:
        with pytest.raises(InputError, match="not confirmed"):
            measure(bench, kind, lung=LUNG, reference=(0.0, 1.0))
