"""The adversary on a plant whose critical severity follows from a line of algebra."""

from __future__ import annotations

import json
import math

import jax
import numpy as np
import pytest
from typer.testing import CliRunner

from proofs.__main__ import app
from proofs.studies.adversary import EDGE, RIG, _Bench, adversary
from ventbench.base.errors import InputError
from ventbench.entries.cells import InProcessRunner, PlantError, ProtocolRun
from ventbench.entries.folder import as_submission
from ventbench.physics.mechanism import VALVE_GAIN
from ventbench.plants.hybrid import NAMES, to_vector
from ventbench.plants.rigs import load_rigs
from ventbench.sandbox.child.cell import Failure
from ventbench.task.stressors import STRESSORS, stressor

#: R, C, PIP and what is safe there, cmH2O.
R, C, PIP, LIMIT = 20.0, 50.0, 10.0, 25.0

#: Severity of `supply_high` that is to be critical.
SEVERITY = 0.3


def test_a_held_valve_is_unsafe_at_the_supply_that_algebra_says(make, monkeypatch) -> None:
    """A held flow Q gives PEEP + Q (R + t / C); the gate needs four samples, from t = 0.93 s on."""
    monkeypatch.setattr("proofs.studies.adversary.ROUNDS", 2)  # one coordinate has no combinations
    flow = (LIMIT - 5.0) / (R / 1e3 + 31 * 0.03 / C)
    u_in = flow / stressor("supply_high").strong ** SEVERITY / VALVE_GAIN
    entry = make(act=f"return {u_in!r}")
    arguments = [
        "study",
        "adversary",
        str(entry),
        "--lung",
        "R20C50",
        "--lung",
        "R5C50",
        "--simulator",
    ]
    arguments += ["physics", "--stressor", "supply_high", "--in-process", "--json", "-"]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 1, result.output
    values = json.loads(result.stdout)
    unsafe, safe = (
        next(x for x in values["lungs"] if x["lung"] == name) for name in ("R20C50", "R5C50")
    )
    assert unsafe["severity"] == pytest.approx(SEVERITY, abs=0.01)
    assert unsafe["pip"] == PIP
    now = VALVE_GAIN * 1.5 ** unsafe["severity"]
    assert unsafe["physics"] == {"gain": f"{now:.3g} instead of 22.8 mL/s per %"}
    # On the other lung the same flow, half as much again, ends below the limit.
    highest = 5.0 + 1.5 * u_in * VALVE_GAIN * (5.0 / 1e3 + 0.93 / C)
    assert safe["severity"] is None
    assert safe["excess"] == pytest.approx(highest - LIMIT, abs=0.1)
    assert "R5C50: nothing unsafe up to severity 1" in result.stderr
    assert "  gain: 25." in result.stderr


def test_rigs_are_as_far_from_the_middle_as_their_severity_says() -> None:
    rigs = load_rigs()
    assert rigs.population is not None
    entry = as_submission("pid_robust")
    bench = _Bench(entry, InProcessRunner(), rigs, [0, 5], STRESSORS, RIG)
    points = np.zeros((2, 2, len(STRESSORS) + len(RIG)))
    points[0, :, -len(RIG)] = 1.0  # resistance alone, to the end of the range
    points[1, :, -3:] = 0.5, -0.4, 0.2
    vectors = bench.vectors(points)
    for k, lung in enumerate((0, 5)):
        mean, factor = rigs.population.mean[lung], rigs.population.factor[lung]
        for vector, point in zip(vectors[:, k], points[:, k], strict=True):
            distance = np.linalg.norm(np.linalg.solve(factor, vector - mean))
            severity = np.linalg.norm(point)
            assert distance == pytest.approx(EDGE * severity, rel=1e-6)
        at = NAMES.index("resistance")
        deviation = np.linalg.norm(factor[at])
        assert abs(vectors[0, k, at] - mean[at]) == pytest.approx(EDGE * deviation)
        said = bench.physics(points[0], k)
        ratio = math.exp(vectors[0, k, at] - mean[at])
        assert said["resistance of the rig"] == f"x {ratio:.3g}"
    middle = jax.tree.map(lambda leaf: np.asarray(leaf)[0, 0], rigs.plants)
    assert np.abs(to_vector(middle)[at] - rigs.population.mean[0][at]) < 1.0


def test_physics_that_cannot_be_is_left_out(monkeypatch) -> None:
    """And pressures count once they are held for longer than 0.1 s."""
    rigs = load_rigs("physics")
    bench = _Bench(
        as_submission(lambda o: 1.0),
        InProcessRunner(),
        rigs,
        [0, 5],
        (stressor("supply_high"),),
        (),
    )
    points, pip = np.linspace(0.1, 1.0, 12).reshape(6, 2, 1), np.full((6, 2), PIP)
    pressure = np.full((12, 3, 34), 5.0)
    pressure[2, 1, 7:11] = LIMIT + 4.0  # four samples, and three
    pressure[4, 1, 7:10] = LIMIT + 4.0
    zero = np.zeros_like(pressure)

    def run(plants, *_, **__):
        gain = plants[0].physics.parameters()["gain"]
        broken = np.flatnonzero(gain[:, 0] / gain[:, 1] > 1.5**0.95)
        if broken.size:
            raise PlantError(int(broken[0]))
        failed, none = {(6,): Failure("act", "x")}, zero[..., :0]
        unknown = np.full_like(zero, np.nan)
        return ProtocolRun(pressure, zero, zero, none, unknown, failed, np.ones(1))

    monkeypatch.setattr("proofs.studies.adversary.step_through", run)
    excess = bench._batch(points, pip).ravel()
    expected = np.full(12, 5.0 - LIMIT)
    expected[[2, 6, 11]] = 4.0, np.inf, -np.inf
    np.testing.assert_allclose(excess, expected)
    monkeypatch.setattr(
        "proofs.studies.adversary.step_through", lambda *_, **__: _raise(PlantError(3))
    )
    with pytest.raises(PlantError):
        bench._batch(0.0 * points, pip)


def _raise(error: Exception) -> None:
    raise error


def test_what_is_not_there_is_refused() -> None:
    with pytest.raises(InputError, match="no lung 'R1C1' in these simulators; choose of R5C10"):
        adversary(lambda o: 1.0, simulator="physics", lungs=["R1C1"])
    with pytest.raises(InputError, match="no stressor 'wind'"):
        adversary(lambda o: 1.0, simulator="physics", stressors=["wind"])
