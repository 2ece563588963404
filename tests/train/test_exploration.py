"""Exploring: the paper's table and shapes, on plants and on benches that misbehave."""

from __future__ import annotations

import numpy as np
import pytest
from typer.testing import CliRunner

from ventbench.base import compilation
from ventbench.base.errors import InputError
from ventbench.cli import app
from ventbench.controllers.pid import PID
from ventbench.plants.single_compartment import single_compartment
from ventbench.recordings import load, write
from ventbench.task import protocol, waveform
from ventbench.task.interfaces import Observation
from ventbench.task.lungs import LUNG_IDS, lung
from ventbench.task.metrics.score import longest_run
from ventbench.train.exploration import (
    RANGES,
    Disturbance,
    ExplorationRanges,
    SimulatedVentilator,
    draw_disturbances,
    explore,
)

INSPIRATION = protocol.INSPIRATION_STEPS
HELD = ExplorationRanges((0.0, 0.0, 0.0), (50.0, 50.0), (0.5, 0.5), (50.0, 50.0))
STILL = ExplorationRanges((1.0, 0.5, 0.2), (0.0, 0.0), (0.3, 0.6), (0.0, 0.0))


def disturbance(boundary, u, begin, end) -> Disturbance:
    return Disturbance(*(np.array([x]) for x in (boundary, u, begin, end)))


def test_every_lung_has_ranges():
    assert tuple(RANGES) == LUNG_IDS
    for ranges in RANGES.values():
        pairs = (ranges.boundary_u, ranges.boundary_s, ranges.triangular_u, ranges.triangular_s)
        assert all(low < high for low, high in pairs)


def test_a_boundary_falls_linearly_from_the_start():
    one = disturbance(True, 60.0, 0.0, 0.4)
    found = [float(one.at(t)[0]) for t in (0.0, 0.1, 0.2, 0.4, 0.9)]
    np.testing.assert_allclose(found, [60.0, 45.0, 30.0, 0.0, 0.0], atol=1e-12)


def test_a_triangle_rises_to_its_middle_and_falls():
    one = disturbance(False, -20.0, 0.1, 0.5)
    found = [float(one.at(t)[0]) for t in (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.8)]
    np.testing.assert_allclose(found, [0.0, 0.0, -10.0, -20.0, -10.0, 0.0, 0.0], atol=1e-12)


def test_draws_stay_in_their_ranges_and_have_their_share():
    ranges = RANGES["R5C20"]
    found = draw_disturbances(np.random.default_rng(0), ranges, 4000)
    assert np.mean(found.boundary) == pytest.approx(0.25, abs=0.03)
    for boundary, low, high in ((True, *ranges.boundary_u), (False, *ranges.triangular_u)):
        u = found.u[found.boundary == boundary]
        assert low <= u.min() < low + 2 < high - 2 < u.max() <= high
    ends = np.stack([found.begin, found.end])
    assert np.all(ends[0] < ends[1])
    assert np.all(ends[0, found.boundary] == 0.0)
    assert np.all((ends[1, found.boundary] >= 0.4) & (ends[1, found.boundary] <= 0.8))
    inner = ends[:, ~found.boundary]
    assert inner.min() >= 0.1
    assert inner.max() <= 0.5 + 1e-3


def ventilator(lung_id="R20C50", width=6, **options) -> SimulatedVentilator:
    return SimulatedVentilator(single_compartment(lung(lung_id)), width, **options)


def test_without_disturbance_it_is_the_pid():
    found = explore(ventilator(), "R20C50", 6, ranges=STILL)
    pid, state = PID(*STILL.gains), None
    with compilation.float64():
        for step in range(INSPIRATION):
            pips = np.array(protocol.PIPS)
            seen = Observation(step * 0.03, 0.03, found.pressure[:, step], pips, None, None)
            state = pid.init((6,)) if state is None else state
            state, u_in = pid.step(state, seen)
            expected = np.clip(np.asarray(u_in), 0.0, 100.0)
            np.testing.assert_allclose(found.u_in[:, step], expected, atol=1e-9)


def test_expirations_are_the_hard_coded_ones():
    found = explore(ventilator(), "R20C50", 6)
    steps = np.arange(INSPIRATION, protocol.BREATH_STEPS)
    np.testing.assert_array_equal(
        found.u_in[:, INSPIRATION:], [waveform.expiratory_command(steps)] * 6
    )
    np.testing.assert_array_equal(found.u_out[:, INSPIRATION:], 1)
    np.testing.assert_array_equal(found.u_out[:, :INSPIRATION], 0)


@pytest.mark.parametrize("lung_id", LUNG_IDS)
def test_breaths_of_every_lung_are_varied_and_safe(lung_id):
    found = explore(ventilator(lung_id, width=48, noise=0.2), lung_id, 48, seed=3)
    assert found.notes == ()
    assert set(found.lung_ids) == {lung_id}
    assert np.ptp(found.u_in[:, 5]) > 20.0
    # One step of full flow into the stiffest lung is 7 cmH2O; then the valve has closed.
    assert found.pressure.max() < protocol.SAFETY_PRESSURE + 7.0
    assert longest_run(found.pressure > protocol.SAFETY_PRESSURE).max() <= 2
    assert len(np.unique(found.u_in, axis=0)) == 48


def test_the_same_seed_gives_the_same_breaths_and_another_others():
    first, again, other = (explore(ventilator(), "R5C20", 12, seed=seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.u_in, again.u_in)
    np.testing.assert_array_equal(first.pressure, again.pressure)
    assert np.abs(first.u_in - other.u_in).max() > 1.0


def test_breaths_can_be_written_and_read(tmp_path):
    told = []
    count = lambda *counts: told.append(counts)  # noqa: E731
    found = explore(ventilator(width=5), "R20C50", 7, progress=count)
    assert len(found) == 7
    assert told == [(5, 7), (7, 7)]
    write(found, tmp_path / "explored.csv")
    again = load(tmp_path / "explored.csv")
    np.testing.assert_array_equal(again.u_in, found.u_in)
    np.testing.assert_array_equal(again.pressure, found.pressure)


class Fake:
    """A ventilator whose sensor says what it is told to."""

    width, dt = 1, 0.03

    def __init__(self, pressures):
        self.pressures, self.commands = pressures, []

    def start(self, peep):
        self.step_of_breath = 0
        return np.array([self.pressures[0]])

    def step(self, u_in, u_out):
        self.commands.append((float(u_in[0]), float(u_out[0])))
        self.step_of_breath += 1
        return np.array([self.pressures[min(self.step_of_breath, len(self.pressures) - 1)]])


def test_the_valve_closes_while_the_pressure_is_above_the_gate():
    fake = Fake([5.0, 5.0, 26.0, 26.0, 5.0])  # the first PIP is 10, its gate 25 cmH2O
    found = explore(fake, "R5C10", 1, ranges=HELD)
    assert np.all(found.u_in[0, 2:4] == 0.0)
    assert np.all(found.u_out[0, :INSPIRATION] == 0)


@pytest.mark.parametrize("bad", [61.0, np.nan, np.inf])
def test_a_dangerous_pressure_is_vented_for_the_rest_of_the_inspiration(bad):
    fake = Fake([5.0, 8.0, bad, 8.0])
    explore(fake, "R5C10", 1)
    commands = np.array(fake.commands)
    assert np.all(commands[:2, 1] == 0.0)
    assert np.all(commands[2:INSPIRATION] == [0.0, 1.0])


def test_exploring_stops_after_three_vented_breaths():
    found = explore(Fake([5.0, 61.0, 5.0]), "R5C10", 10)
    assert len(found) == 3
    assert found.notes == ("exploring stopped: 3 breaths were vented, above 60 cmH2O",)
    found = explore(Fake([5.0, 61.0, 5.0]), "R5C10", 2)
    assert (len(found), found.notes) == (2, ())


def test_unknown_lungs_and_no_breaths_are_errors():
    with pytest.raises(InputError, match="no ranges to explore R50C10 in; they exist for R5C10"):
        explore(ventilator(), "R50C10", 1)
    with pytest.raises(InputError, match="ask for one at least"):
        explore(ventilator(), "R5C10", 0)


@pytest.mark.parametrize("plant", ["frozen", "physics"])
def test_the_command_line_explores_a_simulator(tmp_path, plant):
    out = tmp_path / "explored.csv"
    given = ["data", "explore", str(out), "--simulator", plant, "--lung", "R5C20", "--noise", "0.2"]
    said = CliRunner().invoke(app, [*given, "--breaths", "7"])
    assert said.exit_code == 0, said.output
    found = load(out)
    assert f"wrote 7 breaths of R5C20 to {out}" in said.stdout
    assert found.lung_ids.tolist() == ["R5C20"] * 7
    # The PIPs take turns, and exploring is no constant.
    assert np.ptp(found.pressure.max(axis=1)) > 5.0
    CliRunner().invoke(app, [*given, "--breaths", "7", "--seed", "1"])
    assert np.abs(load(out).u_in - found.u_in).max() > 1.0


def test_the_command_line_says_what_cannot_be_explored(tmp_path):
    none = CliRunner().invoke(app, ["data", "explore", str(tmp_path / "x.csv"), "--lung", "R9C9"])
    assert isinstance(none.exception, InputError)
    assert "--lung R9C9: the simulators frozen have R5C10" in str(none.exception)
    other = CliRunner().invoke(app, ["data", "explore", str(tmp_path / "x.txt")])
    assert isinstance(other.exception, InputError)
    assert not list(tmp_path.iterdir())
