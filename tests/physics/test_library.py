"""What every mechanism promises, whatever it is."""

from __future__ import annotations

import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from ci.generated_tables import mechanisms
from ventbench.base.compilation import float64
from ventbench.base.errors import InputError
from ventbench.physics import library, mechanism, parameter, paths, physics, strength_path
from ventbench.physics.catalogue import basis_terms, intermittent, special_cases
from ventbench.physics.nonparametric import NONPARAMETRIC_COMPONENTS
from ventbench.task.lungs import Lung
from ventbench.task.rollouts import open_loop

from . import cases

DOCS = Path(__file__).parents[2] / "docs/physics.md"

NAMES = """
valve_delay valve_lag valve_dead_band valve_curve valve_hysteresis command_rounding supply_droop
leak circuit_compliance inertance turbulent_resistance nonlinear_compliance viscoelasticity
sensor_lag sensor_drift exhalation_valve_delay patient_effort supply_pressure compliance_drift
resistance_drift sensor_curve gain_step gain_drift resistance_step compliance_step zero_step
clock_offset clock_skew trapped_gas relief_leak
"""


@pytest.fixture(scope="module")
def breaths():
    return cases.recording(3, {})


def test_the_public_names_are_there():
    assert set(NAMES.split()) <= set(library())


@pytest.mark.parametrize("name", library())
def test_description_is_complete(name):
    described = mechanism(name).description
    for text in (described.title, described.equation, described.source, described.signature):
        assert len(text) > 8
    assert described.confusable
    # What is written as a name of the library must be one.
    assert {x for x in described.confusable if "_" in x} <= set(library()) - {name}
    assert json.loads(json.dumps(described.as_dict()))["name"] == name
    assert not described.strength.shape
    assert set(described.special_case_of) <= set(basis_terms())
    short = [item.name for item in described.parameters]
    assert {name for pair in described.interchangeable for name in pair} <= set(short)
    assert not set(described.equivalents) & set(library())
    for item in described.parameters:
        assert item.unit
        assert item.meaning
    assert described.strength.mild != described.strength.neutral


@pytest.mark.parametrize("name", [*library(), *basis_terms(), *NONPARAMETRIC_COMPONENTS])
def test_the_docs_name_it(name):
    assert f"`{name}`" in DOCS.read_text("utf-8")


def test_the_sites_table_has_equation_and_parameters():
    for line, (name, own) in zip(mechanisms().splitlines()[2:], library().items(), strict=True):
        equation = own.description.equation.replace("|", r"\|")
        assert line.startswith(f"| `{name}` | `{equation}` |")
        assert all(f"`{item.name}`" in line for item in own.description.parameters)


@pytest.mark.parametrize("name", intermittent())
def test_strengths_that_are_tried_of_an_event_are_possible(name):
    strength = mechanism(name).description.strength
    assert strength.scan
    assert strength.neutral not in strength.scan
    assert all(strength.low <= value <= strength.high for value in strength.scan)


def play_of(width, smooth):
    given = {"width": width, "give": 0.0, "smooth": smooth}
    return {name: jnp.array(value) for name, value in given.items()}


@pytest.mark.parametrize("smooth", [0.0, 0.5, 1.0])
def test_play_knows_the_travel_and_no_time(smooth):
    """Two samples with one command, or a sample halfway, leave the valve where it is without."""
    play, own = mechanism("valve_hysteresis"), play_of(6.0, smooth)

    def position(commands):
        memory = jnp.array(0.0)
        for u in commands:
            now, memory = play.command(own, jnp.array(u), memory)
        return float(now)

    once = position([0.0, 2.0, 30.0, 27.0])
    assert position([0.0, 2.0, 2.0, 30.0, 30.0, 30.0, 27.0, 27.0]) == pytest.approx(once, abs=1e-4)
    halves = position([0.0, 1.0, 2.0, 16.0, 30.0, 28.5, 27.0])
    assert halves == pytest.approx(once, abs=0.25 * smooth * (1.0 - smooth) * 6.0 + 1e-4)


def test_smooth_play_is_that_of_bouc_and_wen():
    """After a reversal, it goes from one side to the other exponentially with the travel."""
    play, own = mechanism("valve_hysteresis"), play_of(6.0, 1.0)
    memory, behind = jnp.array(0.0), []
    for u in [*np.linspace(0.0, 60.0, 61), *np.linspace(60.0, 50.0, 11)[1:]]:
        now, memory = play.command(own, jnp.array(u), memory)
        behind.append(u - float(now))
    travel = np.arange(11.0)
    expected = -3.0 + 6.0 * np.exp(-travel / 3.0)
    np.testing.assert_allclose(behind[60:], expected, atol=1e-4)


def test_special_cases_differ_between_the_terms_of_a_component():
    assert special_cases("sensor_memory") == (
        "pressure_line",
        "sensor_hysteresis",
        "sensor_lag",
    )
    assert special_cases("drift_shape") == ("sensor_drift",)
    assert special_cases("sensor_shape") == ("sensor_curve",)
    assert special_cases("volume_resistance") == ("airway_opening",)
    assert special_cases("flow_shape") == ("turbulent_resistance",)
    assert set(special_cases("command_memory")) == {
        "valve_delay",
        "valve_lag",
        "supply_droop",
        "valve_hysteresis",
        "valve_rate",
    }


@pytest.mark.parametrize("name", library())
def test_neutral_is_off_exactly_and_strong_is_not(name, breaths, predicted):
    shapes = {p.name: p.strong for p in mechanism(name).description.parameters[1:]}
    strength = mechanism(name).description.strength
    # Beside others, of which none may be moved by it.
    others = {
        "valve_lag": {"tau": 0.03},
        "viscoelasticity": {"ratio": 0.3},
        "circuit_compliance": {"compliance": 1.0},
        "turbulent_resistance": {"quadratic": 3.0},
    }
    others.pop(name, None)
    without = predicted(breaths, others)
    off = predicted(breaths, others | {name: shapes | {strength.name: strength.neutral}})
    np.testing.assert_allclose(off, without, atol=1e-9, rtol=0)
    on = predicted(breaths, others | {name: shapes | {strength.name: strength.strong}})
    assert np.abs(on - without).max() > 0.05


def test_absent_is_neutral(breaths, predicted):
    """A plant that does not name a mechanism equals one that has it at neutral."""
    with float64():
        plant = physics(Lung(10.0, 25.0), PEEP=5.0)
        arrays = (breaths.pressure[:, 0], breaths.u_in, breaths.u_out * 1.0, breaths.dt)
        lean = open_loop(plant, *(jnp.asarray(x) for x in arrays))
    np.testing.assert_allclose(predicted(breaths, {}), lean, atol=1e-9, rtol=0)


def test_names_are_checked():
    with pytest.raises(InputError, match="choose of airway_opening"):
        mechanism("gremlins")
    with pytest.raises(InputError, match=r"no parameter 'leak\.size'; leak has conductance"):
        parameter("leak.size")
    with pytest.raises(InputError, match="the base has R, C"):
        parameter("Q")
    assert strength_path("leak") == "leak.conductance"
    assert "valve_lag.tau" in paths()
    assert "valve_lag.tau" not in paths(("leak",))
