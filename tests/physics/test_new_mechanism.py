"""A mechanism that is added under its own name is modelled, fitted and screened like the others."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from ventbench.base.compilation import float64
from ventbench.base.errors import InputError
from ventbench.diagnosis.evaluator import make_evaluator
from ventbench.diagnosis.evidence import search
from ventbench.diagnosis.hypothesis import all_parameter_paths
from ventbench.diagnosis.settings import SearchSettings, SelectionConfig
from ventbench.physics import Description, Mechanism, Parameter, library, paths, physics
from ventbench.physics.catalogue import extended
from ventbench.system_id import Predictor, fit, interval, make_data
from ventbench.task.lungs import Lung
from ventbench.task.rollouts import open_loop

from . import cases

#: Pressure at which the valve of this mechanism opens, cmH2O.
OPENS = 15.0


class ReliefValve(Mechanism):
    """A valve at the airway that lets gas out above a pressure."""

    description = Description(
        name="pop_off_valve",
        title="relief valve at the airway",
        site="circuit",
        equation="q_relief = conductance max(p - 15 cmH2O, 0)",
        parameters=(
            Parameter("conductance", "mL/s per cmH2O", "above 15", 0.0, 60.0, 0.0, 10.0, 30.0),
        ),
        source="made up",
        signature="Pressure is cut off above 15 cmH2O.",
        confusable=("leak",),
    )

    def network(self, values, network, view):
        """Tangent of the outflow at the last pressure."""
        slope = 1e-3 * values["conductance"] * (view.pressure > OPENS)
        return network.plus(leak=slope, leak_flow=-slope * OPENS)


POP_OFF_VALVE = ReliefValve()

#: A small library, so that compiling takes seconds.
NAMES = ("pop_off_valve", "valve_delay", "turbulent_resistance")


@pytest.fixture(scope="module")
def relieved():
    """Twelve breaths of the model with the valve, 0.05 cmH2O of noise."""
    breaths = cases.recording(12, {})
    with extended(POP_OFF_VALVE), float64():
        plant = physics(Lung(10.0, 25.0), {"pop_off_valve": {"conductance": 20.0}}, PEEP=5.0)
        commands = (breaths.pressure[:, 0], breaths.u_in, breaths.u_out * 1.0, breaths.dt)
        pressure = np.array(open_loop(plant, *(jnp.asarray(x) for x in commands)))
    noise = np.random.default_rng(0).normal(0, 0.05, pressure.shape)
    return breaths, make_data(breaths).with_pressure(pressure + noise)


def test_it_is_known_by_name_within_the_block_only():
    before = paths()
    with extended(POP_OFF_VALVE):
        assert list(library()) == sorted(library())
        assert set(paths()) - set(before) == {"pop_off_valve.conductance"}
        with (
            pytest.raises(InputError, match="already has a mechanism 'pop_off_valve'"),
            extended(POP_OFF_VALVE),
        ):
            pass
    assert "pop_off_valve" not in library()
    assert paths() == before


def test_a_model_has_its_effect(relieved):
    breaths, data = relieved
    assert breaths.pressure.max() > OPENS + 3.0
    assert data.measured.max() < breaths.pressure.max() - 1.0


@pytest.mark.slow
def test_a_fit_estimates_its_strength(relieved):
    with extended(POP_OFF_VALVE):
        predictor = Predictor(relieved[1], paths(NAMES))
        fitted = fit(relieved[1], ["pop_off_valve"], predictor=predictor)
        conductance = interval(fitted, "pop_off_valve.conductance")
    assert conductance.low < 20.0 < conductance.high
    assert conductance.value == pytest.approx(20.0, rel=0.1)


def test_the_search_names_it(relieved):
    with extended(POP_OFF_VALVE):
        settings = SelectionConfig(search=SearchSettings(nonparametric_terms=()))
        names = all_parameter_paths(settings)
        evaluator = make_evaluator(relieved[1], np.arange(12) % 2 == 1, names, settings=settings)
        found = search(evaluator)
    assert found.fitted[0].terms[0].name == "pop_off_valve"
    assert found.weights[frozenset({"pop_off_valve"})] > 0.5
