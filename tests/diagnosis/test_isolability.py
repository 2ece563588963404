"""Which mechanisms a plan can tell apart, against fits and against what is known."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from ventbench.base.errors import InputError
from ventbench.cli import app
from ventbench.diagnosis.isolability import isolability
from ventbench.recordings.breaths import make_breaths
from ventbench.simulation import Controls, read_controls
from ventbench.system_id import Noise, Predictor, fit, make_data, parameter_values

NAMES = ("valve_lag", "sensor_lag", "leak", "viscoelasticity")


def plan(*levels: float) -> list[Controls]:
    time = np.arange(60) * np.float64(0.03)
    falling = np.where(time < 1.0, np.exp(-time / 0.6), 0.0)
    return [Controls(time, level * falling, (time >= 1.0).astype(float)) for level in levels]


@pytest.fixture(scope="module")
def told():
    return isolability(plan(10.0, 20.0, 30.0), names=NAMES, noise={"pressure": 0.1})


def test_nats_are_those_that_a_fit_loses(told) -> None:
    controls = plan(10.0, 20.0, 30.0)
    columns = (np.stack([getattr(c, key) for c in controls]) for key in ("time", "u_in", "u_out"))
    ones = np.ones(3)
    time, u_in, u_out = columns
    blank = np.full(time.shape, 5.0)
    data = make_data(make_breaths(np.arange(3), 20 * ones, 50 * ones, time, u_in, u_out, blank))
    predictor = Predictor(data, ("R", "C", "R_ex", "PEEP", "gain", "position", "valve_lag.tau"))
    values = parameter_values(data, predictor.names, {"valve_lag.tau": 0.04})
    true = data.with_pressure(predictor.predict(values)[:, 0])
    noise = Noise((0.1, 20.0), (0.0, 0.0), np.inf)
    lost = [
        0.5 * float(np.sum((fit(true, names, noise=noise).residual / 0.1) ** 2))
        for names in ((), ("sensor_lag",))
    ]
    assert told.detectable["valve_lag"] == pytest.approx(lost[0], rel=0.25)
    assert told.nats["valve_lag", "sensor_lag"] <= 1.25 * lost[1]


@pytest.mark.parametrize("name", ["leak", "viscoelasticity"])
def test_what_hides_in_a_refit_is_shown_by_a_hold(name: str) -> None:
    told = isolability(plan(10.0, 20.0, 30.0), names=(name,))
    (hidden,) = told.unseen
    assert hidden.remedy is not None
    assert "hold" in hidden.remedy
    assert hidden.gained > 5.0 * told.threshold > 5.0 * hidden.nats


def test_more_breaths_and_sensors_tell_more(told) -> None:
    longer = isolability(plan(10.0, 20.0, 30.0, 15.0), names=NAMES, noise={"pressure": 0.1})
    both = isolability(
        plan(10.0, 20.0, 30.0), names=NAMES, sensors=("pressure", "flow"), noise={"pressure": 0.1}
    )
    for name in NAMES:
        for better in (longer, both):
            assert better.detectable[name] >= told.detectable[name] - 1e-6
    for name, quieter in isolability(
        plan(10.0, 20.0, 30.0), names=NAMES, noise={"pressure": 0.05}
    ).detectable.items():
        assert quieter == pytest.approx(4.0 * told.detectable[name], rel=1e-6)


def test_every_seen_mechanism_is_in_one_group(told) -> None:
    seen = [name for name, nats in told.detectable.items() if nats >= told.threshold]
    assert sorted(name for group in told.groups for name in group) == sorted(seen)
    assert {frozenset(pair) for pair in told.nats} == {
        frozenset((a, b)) for a in seen for b in seen if a != b
    }


def test_what_is_wrong_is_said() -> None:
    with pytest.raises(InputError, match="sensors volume: choose among pressure, flow"):
        isolability(plan(10.0), sensors=("volume",))
    with pytest.raises(InputError, match="no mechanism 'witchcraft'"):
        isolability(plan(10.0), names=("witchcraft",))


def write(path: Path, breaths: list[Controls]) -> Path:
    rows = ["breath_id,time_step,u_in,u_out"]
    for number, breath in enumerate(breaths, 1):
        columns = zip(breath.time, breath.u_in, breath.u_out, strict=True)
        rows += [f"{number},{t:.6f},{u:.6f},{o:g}" for t, u, o in columns]
    path.write_text("\n".join(rows) + "\n")
    return path


def test_a_plan_is_read_breath_by_breath(tmp_path: Path) -> None:
    given = plan(10.0, 20.0)
    read = read_controls(write(tmp_path / "plan.csv", given), by_breath=True)
    for a, b in zip(read, given, strict=True):
        np.testing.assert_allclose(a.u_in, b.u_in, atol=1e-6)
        np.testing.assert_allclose(a.time, b.time, atol=1e-6)
    (one,) = read_controls(write(tmp_path / "one.csv", given[:1]), by_breath=True)
    assert len(one.time) == 60
    back = [Controls(given[0].time[::-1], given[0].u_in, given[0].u_out), given[1]]
    with pytest.raises(InputError, match="line 3, column time_step"):
        read_controls(write(tmp_path / "back.csv", back), by_breath=True)
    with pytest.raises(InputError, match="line 62, column time_step"):
        read_controls(tmp_path / "plan.csv")
    assert all(np.all(np.diff(a.time) > 0) for a, _ in pairwise([*read, one]))


def test_the_command_tells_and_ends_with_1_where_something_is_open(tmp_path: Path) -> None:
    path = write(tmp_path / "plan.csv", plan(10.0, 20.0))
    words = ["diagnose", str(path), "--isolability", "--lung", "R20C50", "--names"]
    done = CliRunner().invoke(app, [*words, "valve_lag,valve_delay,leak", "--json", "-"])
    value = json.loads(done.stdout)
    assert value["lung"] == "R20C50"
    assert set(value["detectable"]) == {"valve_lag", "valve_delay", "leak"}
    assert done.exit_code == int(bool(value["confused"]))
