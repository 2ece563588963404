"""Calibration: the line against scipy and a simulated truth; each part on an emulated bench."""

from __future__ import annotations

import datetime
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

from hardware_eval.bench import calibrate
from hardware_eval.bench.calibrate import Calibration, fit, load, measure
from hardware_eval.bench.dated import device_of
from hardware_eval.bench.loop import Bench, Operator
from hardware_eval.bench.safety import DEFAULT
from hardware_eval.bench.selftest import selftest
from hardware_eval.emulation.electronics import Fault, FaultKind
from hardware_eval.emulation.emulator import LoopbackDevice
from hardware_eval.results.evaluate import Line
from hardware_eval.wire.client import Client
from tests.hardware_eval import stand_in
from ventbench.base.errors import InputError

LUNG = "R5C20"
DAY = datetime.datetime(2026, 1, 10, tzinfo=datetime.UTC)


def test_the_line_is_that_of_scipy_and_its_intervals_cover() -> None:
    draw, inside = np.random.default_rng(0), []
    x = np.array([0.0, 10.0, 20.0, 40.0, 20.0, 10.0, 0.0])
    above = np.array([0, 0, 0, 0, 1, 1, 1])
    for _ in range(400):
        y = 0.3 + 0.97 * x + 0.1 * draw.standard_normal(7)
        found = fit(x, y, np.full(7, 1e-3), above)  # the scatter is more than they say
        inside.append(found.slope.low <= 0.97 <= found.slope.high)
    assert 0.92 <= np.mean(inside) <= 0.98
    plain: Any = stats.linregress(x, y)
    assert found.slope.value == pytest.approx(plain.slope)
    half = stats.t.ppf(0.975, 5) * plain.stderr
    assert found.slope.high - found.slope.value == pytest.approx(half)
    late = fit(x, y + 2.0 * above, np.full(7, 0.1), above).hysteresis
    assert late.low < 2.0 < late.high
    assert late.value - 2.0 == pytest.approx(np.mean(y[4:] - y[[2, 1, 0]]))


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
    assert span.hysteresis.low < 0.0 < span.hysteresis.high
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
    assert part.above == (0, 0, 1)
    assert part.reading == (228.0, 456.0, 240.0)
    openings = [u_in for _, u_in, _ in hal.valves if u_in]
    assert list(dict.fromkeys(openings)) == [10.0, 20.0, 15.0]  # from above: by 15 to 10
    assert all(u_out == 1 for _, _, u_out in hal.valves)


def test_the_emulated_bench_is_calibrated_and_the_file_is_kept_for_it(
    bench: Bench, device: LoopbackDevice, tmp_path: Path
) -> None:
    openings = (10.0, 30.0, 10.0)
    parts = {"valve": measure(bench, "valve", lung=LUNG, reference=openings, now=DAY)}
    slope = parts["valve"].fit.slope
    assert slope.value == pytest.approx(22.8, rel=0.02)  # the paper's valve
    parts["peep"] = measure(bench, "peep", lung=LUNG, reference=(5.0,), now=DAY)
    assert parts["peep"].fit.intercept.value == pytest.approx(0.0, abs=0.05)
    parts["leak"] = measure(bench, "leak", lung=LUNG, now=DAY)
    assert calibrate.lost_flow(parts["leak"], LUNG).low < 5.0
    parts["lung"] = measure(bench, "lung", lung=LUNG, now=DAY)
    hal: Any = device.service.hal
    hal.faults = (Fault(FaultKind.LEAK, device.clock.now(), strength=0.01),)
    leaking = calibrate.lost_flow(measure(bench, "leak", lung=LUNG, now=DAY), LUNG)
    hal.faults = ()
    assert leaking.low > 10.0
    path, own = tmp_path / "calibration.json", device_of(bench.client)
    saved = Calibration(own, parts).save(path)
    kept = load(path, own, now=DAY + datetime.timedelta(days=29))
    assert kept == saved
    known = kept.known_lung
    assert known is not None
    assert known.lung == LUNG
    assert np.exp(known.logarithms) == pytest.approx([5.0, 1000.0 / 20.0], rel=0.15)
    sheet = selftest(bench, LUNG, simulator=None, known=known, skip=("leak", "sweep"))
    (span,) = [x for x in sheet.findings if x.name == "sensor_span"]
    assert span.ok
    assert span.value == pytest.approx(1.0, abs=0.005)
    assert kept.valve == pytest.approx((slope.value,) * 3, rel=0.01)
    bent = replace(parts["valve"], reading=(228.0, 500.0, 228.0))  # not linear: 22.8 to 16.7
    mean, low, high = Calibration(own, {"valve": bent}).valve or (0.0,) * 3
    assert low < 16.7 < mean < 22.8 < high
    assert kept.about()["dates"]["peep"] == DAY.isoformat()
    with pytest.raises(InputError, match=r"31 days old.*calibrate valve"):
        load(path, own, now=DAY + datetime.timedelta(days=31))
    assert load(path, own, stale=True) == saved
    with pytest.raises(InputError, match="calibrate this one"):
        load(path, own | {"device_id": "00"}, now=DAY)
    content = json.loads(path.read_text())
    content["parts"]["valve"]["reading"][0] += 1.0
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match="was changed"):
        load(path, own, now=DAY)


def test_a_part_that_was_not_confirmed_is_not_measured(line: Line) -> None:
    class Refuses(Operator):
        def confirm(self, question: str) -> bool:
            return False

    bench = Bench(line.client, line.clock, DEFAULT, Refuses())
    for kind in calibrate.PARTS:
        with pytest.raises(InputError, match="not confirmed"):
            measure(bench, kind, lung=LUNG, reference=(0.0, 1.0))
