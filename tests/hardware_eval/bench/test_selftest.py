"""The go/no-go sheet on the virtual clock: a good bench, a wrong lung, and faults."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hardware_eval.bench import selftest as selftest_module
from hardware_eval.bench.drive import Driven, Program, collect
from hardware_eval.bench.identity import measured_lung
from hardware_eval.bench.loop import Bench, Operator
from hardware_eval.bench.raw_log import RECORDING
from hardware_eval.bench.selftest import LIMITS, programs, selftest, span_finding
from tests.hardware_eval.faults import Fault, FaultKind, FaultyDevice, LineFaultKind
from ventbench.base.errors import InputError

from .test_identity import probed

LUNG = "R5C20"


def test_a_good_bench_goes(bench: Bench) -> None:
    sheet = selftest(bench, LUNG, simulator="physics")
    assert sheet.go, str(sheet)
    assert min(sheet.errors, key=sheet.errors.__getitem__) == LUNG
    elsewhere = {"room", "reference", "clicked", "rise", "vented", "peep"}  # or when calibrated
    own = {name for name in LIMITS if " " not in name}  # else of calibration
    assert {finding.name for finding in sheet.findings} == own - elsewhere
    # The emulated lung reports its flow, so that R and C are those of the label.
    assert pytest.approx(5.0, rel=0.2) == sheet.R
    assert pytest.approx(20.0, rel=0.05) == sheet.C


def test_parts_are_left_out_one_by_one_and_the_sheet_says_so(
    bench: Bench, device: FaultyDevice
) -> None:
    begun = len(device.actuations)
    sheet = selftest(bench, LUNG, skip=("lung", "sweep", "sensor"))
    assert sheet.go, str(sheet)
    assert sheet.skipped == ("sensor", "sweep", "lung")
    assert {x.name for x in sheet.findings} == {
        "leak",
        "interruptions",
        "safety",
        "on_time",
        "latest_step",
        "round_trip",
    }
    assert sheet.as_dict()["skipped"] == ["sensor", "sweep", "lung"]
    assert "left out: lung" in str(sheet)
    moved = device.actuations[begun - 1 :]
    assert {x.u_out for x in moved if x.u_in > 0.0} == {0}  # the filling alone
    assert sum(a.u_out > b.u_out for a, b in pairwise(moved)) == 1
    with pytest.raises(InputError, match="no part 'valve'; choose of sensor, leak, sweep, lung"):
        selftest(bench, LUNG, skip=("valve",))


def test_what_a_slow_line_spoils_is_repeated(bench: Bench, device: FaultyDevice) -> None:
    now = device.clock.now() - device.start
    # Silent for 0.3 s within the first part, and for a step within the second.
    device.line.faults = tuple(
        Fault(LineFaultKind.SILENT, now + start, now + start + length)
        for start, length in ((4.0, 0.3), (16.0, 0.02))
    )
    sheet = selftest(bench, LUNG, simulator="physics")
    assert sheet.go, str(sheet)
    repeated = next(x for x in sheet.findings if x.name == "interruptions")
    assert repeated.value == 1.0
    assert "1 part repeated" in repeated.text


def test_a_line_that_stays_silent_is_a_no_go_that_says_so(
    bench: Bench, device: FaultyDevice
) -> None:
    now = device.clock.now() - device.start
    each = [Fault(LineFaultKind.SILENT, now + 2.3 + k, now + 2.8 + k) for k in range(200)]
    device.line.faults = tuple(each)
    sheet = selftest(replace(bench, rest=0.5), LUNG, simulator="physics")
    assert not sheet.go
    assert any("close other programs" in problem for problem in sheet.problems())
    assert "safety" not in {x.name for x in sheet.findings if not x.ok}


def test_a_wrongly_set_lung_is_a_no_go_that_names_it(bench: Bench) -> None:
    sheet = selftest(bench, "R20C50", simulator="physics")
    assert not sheet.go
    assert any(f"it is {LUNG}, not R20C50" in problem for problem in sheet.problems())


#: Settings of a QuickLung, by analysis: no simulator of the library has seen them.
SETTINGS = [(R, C) for R in (5.0, 20.0, 50.0) for C in (10.0, 20.0, 50.0)]


def analytic(program: Program, R: float, C: float, gain: float, draw: Any, noise: float) -> Driven:
    """A puff into a lung of R and C, seen by the converter of the PVP."""
    volume, pressures = 0.0, []
    for step in range(program.steps):
        command, u_out = program.commands(step, 0.0)
        flow = 0.0 if u_out else gain * 22.8 * command
        pressures.append(5.0 + volume / C + R * flow / 1000.0)
        volume += flow * 0.03
    pressure = np.array(pressures) + draw.normal(0.0, noise, len(pressures))
    pressure = np.round(pressure / 0.0703) * 0.0703
    time = 0.03 * np.arange(len(pressures), dtype=float)
    return Driven(time, pressure, time, time, time, time, time, (), False, 0)


@pytest.mark.parametrize("noise", [0.1, 0.2, 0.3])
def test_the_sweep_knows_its_error_rates(noise: float) -> None:
    draw, trials = np.random.default_rng(0), 100
    for R, C in SETTINGS:
        label, go = f"R{R:g}C{C:g}", {"right": 0, "stuck": 0}
        sweep = programs(label)["sweep"]
        for kind, gain in (("right", 0.87), ("stuck", 0.0)):
            for _ in range(trials):
                puffs = [analytic(each, R, C, gain, draw, noise) for each in sweep]
                assert max(puff.pressure.max() for puff in puffs) < 45.0  # the limit is 65
                measured = noise * (1.0 + draw.normal(0.0, 0.17))  # from 17 samples
                go[kind] += selftest_module._sweep(puffs, measured, label)[0].ok
        assert go["right"] >= trials - 4  # 1 % and its chance
        assert go["stuck"] <= 0.05 * trials


def held(C: float, flow: float, creep: float, noise: float) -> Driven:
    """A lung by Euler's method that is filled evenly, then closed, and leaks as an orifice does."""
    closed, steps = selftest_module.hold(f"R5C{C:g}", noise)
    filling, volume, stress, pressures = closed - 15, 0.0, 0.0, []
    for step in range(steps):
        pressures.append(5.0 + volume / C + stress)
        for _ in range(10):
            given = 15.0 * C / filling if step < filling else 0.0  # mL a step
            moved = 0.1 * (given - 0.03 * flow * np.sqrt((5.0 + volume / C) / 20.0))
            stress += creep * moved / C - 0.003 * stress / 0.7
            volume += moved
    u_in = (np.arange(steps) < filling).astype(float)
    time = 0.03 * np.arange(steps, dtype=float)
    return Driven(time, np.array(pressures), time, u_in, time, time, time, (), False, 0)


@pytest.mark.parametrize("C", [10.0, 50.0])
def test_a_leak_is_told_from_the_creep_of_a_tight_lung(C: float) -> None:
    draw, trials = np.random.default_rng(1), 20
    for creep in (0.0, 0.08):
        for flow in (0.0, 5.0, -5.0):
            lung, found = held(C, flow, creep, 0.3), []
            for _ in range(trials):
                pressure = lung.pressure + draw.normal(0.0, 0.3, len(lung.pressure))
                read = replace(lung, pressure=np.round(pressure / 0.0703) * 0.0703)
                found.append(selftest_module._closed(read, f"R5C{C:g}"))
            refused = sum(not finding.ok for finding in found)
            assert refused >= trials - 1 if flow else refused == 0, (creep, flow, refused)
            if flow and not creep:
                assert np.mean([x.value for x in found]) == pytest.approx(flow, abs=1.0)


@pytest.mark.parametrize("off", [0.95, 1.05])
def test_a_span_that_is_off_shows_on_a_calibrated_lung(off: float) -> None:
    """Lungs by analysis: the label holds, and only the lung's own calibration tells."""
    found = []
    for gain, seed in ((1.0, 0), (1.0, 1), (off, 2)):
        probes = [
            replace(probe, pressure=gain * probe.pressure)
            for probe in probed(20.0, 20.0, False, 0.2, seed)
        ]
        found.append(measured_lung(probes, "R20C20", 0.2)[0])
    then, again, changed = found
    assert span_finding(again, then).ok
    finding = span_finding(changed, then)
    assert not finding.ok
    assert finding.value == pytest.approx(off, abs=0.015)
    assert "calibrate sensor and flow" in finding.text
    assert span_finding(changed, replace(then, lung="R5C10")).ok  # another lung tells nothing
    assert span_finding(changed, None).ok
    silent = replace(changed, errors=(0.0, 0.0))  # a sensor without noise tells no error
    assert span_finding(silent, replace(then, errors=(0.0, 0.0))).text.startswith("neither")


FAULTS = {
    "sensor_zero": Fault(FaultKind.SENSOR_OFFSET, 0.0, strength=3.0),
    "leak": Fault(FaultKind.LEAK, 0.0, strength=0.05),
    "valve_gain": Fault(FaultKind.VALVE_WEAK, 0.0, strength=0.3),
    "safety": Fault(FaultKind.DISCONNECTED, 0.0),
}


@pytest.mark.parametrize("name", sorted(FAULTS))
def test_a_fault_is_a_no_go(name: str, bench: Bench, device: FaultyDevice) -> None:
    hal: Any = device.service.hal
    hal.faults = (replace(FAULTS[name], start=device.clock.now()),)
    sheet = selftest(bench, LUNG, simulator="physics")
    assert not sheet.go
    assert name in {finding.name for finding in sheet.findings if not finding.ok}


def test_exploring_continues_where_it_ended(bench: Bench, tmp_path: Path) -> None:
    first, _ = collect(bench, LUNG, 2, tmp_path, seed=3)
    assert len(first) == 2
    both, stopped = collect(bench, LUNG, 4, tmp_path, seed=3)
    assert len(both) == 4
    assert (both.u_in[:2] == first.u_in).all()
    assert (tmp_path / RECORDING).is_file()
    assert both.flow is not None
    assert stopped == ""
    with pytest.raises(InputError, match="choose another --out"):
        collect(bench, LUNG, 4, tmp_path, seed=4)


def test_exploring_stops_when_nothing_can_be_trusted(
    bench: Bench, device: FaultyDevice, tmp_path: Path
) -> None:
    collect(bench, LUNG, 1, tmp_path)
    hal: Any = device.service.hal
    hal.faults = (Fault(FaultKind.DISCONNECTED, device.clock.now()),)
    told: list[str] = []

    class Listens(Operator):
        def tell(self, text: str) -> None:
            told.append(text)

    explored, stopped = collect(replace(bench, operator=Listens()), LUNG, 10, tmp_path)
    assert stopped
    assert len(told) == 3
    assert len(explored) == 1
