"""A recording beside a simulator that shares with it what no name says."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from ventbench import precision
from ventbench.diagnosis import simulators, split
from ventbench.diagnosis.against import against, refitted
from ventbench.diagnosis.found import found_in
from ventbench.diagnosis.steady import steadied
from ventbench.lungs import lung
from ventbench.physics import physics
from ventbench.recordings.breaths import Breaths
from ventbench.system_id import recorded

from . import small

NAME = "turbulent_resistance"
PASSIVE = ("patient_effort",)


def strange(breaths: Breaths) -> np.ndarray:
    """What each breath does in its own way, cmH2O, ``(n, T)``: nothing at its first sample."""
    phase = np.random.default_rng(4).uniform(0.0, 2.0 * np.pi, (len(breaths), 1))
    return 1.5 * (np.sin(6.0 * breaths.time + phase) - np.sin(phase))


@pytest.mark.slow  # three conclusions
def test_what_recording_and_simulator_share_is_no_mismatch():
    made = small.made(small.effect(NAME, quadratic=10.0))
    with precision.float64():
        plant = physics(lung(small.LABEL), {}).having(
            R=small.RIG.R, C=small.RIG.C, PEEP=small.RIG.peep
        )
    before = simulators.answers({small.LABEL: plant}, made) + strange(made)
    breaths = dataclasses.replace(made, pressure=made.pressure + strange(made))
    data, held = recorded(breaths), split.held_out(breaths)
    alone = found_in(data, held, PASSIVE, lambda what: None, small.SETTINGS)
    told: list[str] = []
    found, had = against(data, held, before, alone, PASSIVE, told.append)
    assert had.conclusion.names == ()
    assert found.conclusion.names == (NAME,)
    assert any(what.startswith("beside the simulator: ") for what in told)
    strength = found.fit.value(f"{NAME}.quadratic")
    assert float(strength[0]) == pytest.approx(10.0, rel=0.1)
    # The noise is the sensor's again.
    assert found.conclusion.noise.sigma[0] < 0.5 * alone.conclusion.noise.sigma[0]
    assert found.conclusion.noise.sigma[0] == pytest.approx(0.2, rel=0.2)
    steady = steadied(found, had, [NAME, "circuit_compliance"])
    assert steady is not None, "nothing but the effect asks for another lung"
    found, names = steady
    assert names == (NAME,), "what is idle beside the simulator's own lung is not missing"
    assert float(found.fit.value(f"{NAME}.quadratic")[0]) == pytest.approx(10.0, rel=0.1)
    np.testing.assert_allclose(found.fit.column("R"), had.conclusion.full.column("R")[0])
    first = breaths.pressure[:, 0]
    own = had.pressures(had.conclusion.full, held, first)
    after = before + found.pressures(found.conclusion.full, held, first) - own
    inside = breaths.inspiratory & (breaths.time > 0) & held[:, None]

    def error(answer: np.ndarray) -> float:
        return float(np.sqrt(np.mean((answer - breaths.pressure)[inside] ** 2)))

    refit = before + had.pressures(refitted(had, found.evaluator.training.data), held, first) - own
    assert error(after) < 0.6 * error(refit)
    assert error(after) < 0.4 * error(before)
