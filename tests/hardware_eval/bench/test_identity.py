"""R and C of the mounted lung on lungs by analysis, which no simulator of the library has seen."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from hardware_eval.bench.drive import Driven
from hardware_eval.bench.identity import NOMINAL, Valve, identified
from hardware_eval.bench.selftest import programs
from ventbench.task import protocol
from ventbench.task.metrics.score import safety_limit

#: Settings of a QuickLung.
SETTINGS = [(R, C) for R in (5.0, 20.0, 50.0) for C in (10.0, 20.0, 50.0)]

#: Steps of integration in a control step; expiratory valve, cmH2O/(L/s).
FINE, OUTLET = 30, 4.0


def probed(
    R: float,
    C: float,
    parabolic: bool,
    noise: float,
    seed: int,
    valve: Valve = NOMINAL,
    slow: float = 0.0,
) -> list[Driven]:
    """The self-test's probes on a lung, by Euler's method; flow and pressure at each step.

    A parabolic resistor has its label's R at 1 L/s. Of the flow so much is still that of the
    command before, which also a slow valve gives.
    """
    draw, done = np.random.default_rng(seed), []
    for program in programs(f"R{R:g}C{C:g}")["lung"]:
        volume, rows, u_in, u_out, before = 0.0, [], 0.0, 1, 0.0
        for step in range(program.steps):
            for _ in range(FINE):
                elastic = volume / C
                if u_out:
                    flow = -1000.0 * elastic / (R + OUTLET)
                    pressure = 5.0 - 1e-3 * OUTLET * flow
                else:
                    flow = float(
                        np.array([1.0 - slow, slow]) @ valve.flow(np.array([u_in, before]))
                    )
                    through = 1e-3 * flow
                    drop = R * (through**2 if parabolic else through)
                    pressure = 5.0 + elastic + drop
                volume += flow * protocol.DT / FINE
            read = pressure + noise * draw.standard_normal()
            rows.append((0.03 * step, read, flow, u_in, u_out, 0.0, 0.0))
            before = u_in
            u_in, u_out = program.commands(step, read)
            u_in = min(u_in, 100.0)
        done.append(Driven(*np.array(rows, float).T, (), False, 0))  # type: ignore[arg-type]
    return done


@pytest.mark.parametrize(("R", "C"), SETTINGS)
def test_no_probe_comes_near_the_limit_of_pressure(R: float, C: float) -> None:
    pips = [program.pip for program in programs(f"R{R:g}C{C:g}")["lung"]]
    for pip, probe in zip(pips, probed(R, C, False, 0.3, seed=1), strict=True):
        assert probe.pressure.max() < safety_limit(pip) - 5.0


@pytest.mark.parametrize(
    ("trials", "settings"),
    [(1, SETTINGS[4:5]), pytest.param(3, SETTINGS, marks=pytest.mark.slow)],
    ids=["one", "all"],
)
def test_right_lungs_go_and_wrong_labels_do_not(
    trials: int, settings: list[tuple[float, float]]
) -> None:
    refused, passed, wrong = [], [], 0
    for R, C in settings:
        for k in range(trials):
            # A parabolic R of 50 would be told from flows far below 1 L/s; no scored lung has it.
            parabolic = k % 2 == 1 and R < 50.0
            probes = probed(R, C, parabolic, 0.1 + 0.1 * k, seed=k)
            holds, told = identified(probes, f"R{R:g}C{C:g}", None)
            if not holds or "cannot tell" in told:
                refused.append((R, C, k, holds, told))
            other = SETTINGS[(SETTINGS.index((R, C)) + 1 + 3 * k) % 9]
            wrong += 1
            holds, told = identified(probes, f"R{other[0]:g}C{other[1]:g}", None)
            if holds:
                passed.append((R, C, other, told))
    assert refused == []
    assert len(passed) <= 0.05 * wrong, passed


#: What the valve of a PVP gives: much at small openings, and ever less more.
CURVED = Valve((5.0, 10.0, 20.0, 30.0, 40.0), (171.0, 303.0, 477.0, 600.0, 707.0), 0.03)


def blind(probes: list[Driven]) -> list[Driven]:
    """The same without a flow sensor, each command in the row of its time."""
    return [
        replace(x, flow=np.full_like(x.flow, np.nan), u_in=np.append(x.u_in[1:], 0.0))
        for x in probes
    ]


@pytest.mark.parametrize(("R", "C"), SETTINGS)
def test_without_flow_the_curve_of_a_calibrated_valve_tells(R: float, C: float) -> None:
    label = f"R{R:g}C{C:g}"
    probes = blind(probed(R, C, R < 50.0, 0.2, seed=0, valve=CURVED))
    assert identified(probes, label, None)[0] is None
    holds, told = identified(probes, label, CURVED)
    assert holds, told
    for other in ("R5C20", "R20C10", "R50C50"):
        if other != label:
            assert identified(probes, other, CURVED)[0] is False


def test_without_flow_a_gain_that_is_not_known_leaves_R_C() -> None:
    """R 20 with C 50 and R 50 with C 20 are the same lung behind valves of different gain."""
    probes = blind(probed(20.0, 50.0, False, 0.1, seed=0))
    unsure = replace(NOMINAL, error=0.7)
    for label, other in (("R20C50", "R50C20"), ("R50C20", "R20C50")):
        holds, told = identified(probes, label, unsure)
        assert holds, told
        assert f"cannot tell {label} from" in told
        assert other in told
        assert told.endswith("without a flow sensor")
    assert identified(probes, "R5C10", unsure)[0] is False
    assert identified(probes, "R50C20", NOMINAL)[0] is False


def told_R(told: str) -> tuple[float, float]:
    """R and half of its interval, of what a person reads."""
    value, half = re.findall(r"R (.*?) \(\+-(.*?)\)", told)[0]
    return float(value), float(half)


@pytest.mark.parametrize("slow", [0.15, 0.25])
def test_the_delay_of_a_valve_is_none_of_R(slow: float) -> None:
    """The third probe rings on a lung of R 50, where a delay that is 2 ms off is much of R."""
    probes = blind(probed(50.0, 50.0, False, 0.1, seed=0, slow=slow))
    holds, told = identified(probes, "R50C50", NOMINAL)
    assert holds, told
    assert told_R(told)[0] == pytest.approx(50.0, rel=0.3)


@pytest.mark.parametrize("signs", [(1, 1, -1, -1, -1), (-1, -1, 1, 1, 1)])
def test_a_curve_may_be_bent_by_its_scatter(signs: tuple[int, ...]) -> None:
    bent = tuple(np.array(CURVED.flows) * (1.0 + 0.04 * np.array(signs)))
    probes = blind(probed(20.0, 20.0, True, 0.1, seed=0, valve=replace(CURVED, flows=bent)))
    holds, told = identified(probes, "R20C20", replace(CURVED, error=0.02, scatter=0.04))
    assert holds, told
    R, half = told_R(told)
    assert abs(R - 20.0) < half
