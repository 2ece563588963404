"""What is missing: what the recording needs, less what the simulator has."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from ventbench.diagnosis import compare, estimates
from ventbench.diagnosis.compare import Lack, lacking
from ventbench.mechanics.lung_match import Estimate


def conclusion(**nats: float) -> Any:
    return SimpleNamespace(names=tuple(nats), held_out_gains=nats)


@pytest.fixture
def fits(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Function that makes a fit of strengths with half their intervals."""

    def parameters(found: Any, name: str) -> dict[str, Estimate]:
        value, half = found[name]
        strength = compare.mechanism(name).description.strength.name
        return {strength: Estimate(value, "", (value - half, value + half))}

    monkeypatch.setattr(estimates, "parameters", parameters)
    return lambda **strengths: strengths


def test_the_base_model_lacks_all_of_it_the_most_important_first(fits):
    wanted = conclusion(leak=8.0, valve_delay=90.0, inertance=20.0)
    missing, said = lacking(fits(), wanted, None, None)
    assert missing == [Lack(name, False) for name in ("valve_delay", "inertance", "leak")]
    assert said == []


def test_what_the_simulator_has_is_not_missing(fits):
    wanted, had = conclusion(leak=8.0, valve_delay=90.0), conclusion(valve_delay=50.0)
    recorded = fits(leak=(5.0, 1.0), valve_delay=(0.040, 0.003))
    simulated = fits(valve_delay=(0.043, 0.001))
    assert lacking(recorded, wanted, simulated, had) == ([Lack("leak", False)], [])


@pytest.mark.parametrize(("value", "missing"), [(0.046, False), (0.048, True), (0.032, True)])
def test_another_strength_is_missing_too(fits, value, missing):
    # Intervals of 4 and 3 ms each way: both together allow 5 ms, and 7 with a margin.
    one = conclusion(valve_delay=90.0)
    recorded, simulated = fits(valve_delay=(0.040, 0.004)), fits(valve_delay=(value, 0.003))
    found, said = lacking(recorded, one, simulated, one)
    assert found == ([Lack("valve_delay", True)] if missing else [])
    assert said == []


def test_efforts_are_each_breaths_own_and_not_compared(fits):
    one = conclusion(patient_effort=90.0)
    assert lacking(fits(), one, fits(), one) == ([], [])


def test_what_only_the_simulator_has_is_said(fits):
    missing, said = lacking(fits(), conclusion(), fits(leak=(5.0, 1.0)), conclusion(leak=9.0))
    assert missing == []
    assert len(said) == 1
    assert said[0].startswith("The simulator has ")
    assert "which the recording does not show" in said[0]
    assert compare.mechanism("leak").description.title in said[0]
