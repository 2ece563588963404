"""The corrected simulator: its pressures for the recorded commands, and its plants."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ventbench.diagnosis import estimates
from ventbench.diagnosis.hypothesis import varies_by_breath
from ventbench.diagnosis.identification import IdentifiedModel
from ventbench.diagnosis.residual_analysis import open_loop_error
from ventbench.diagnosis.simulator_comparison import refit_base_parameters
from ventbench.interfaces import Plant
from ventbench.plants.catalog import Simulators
from ventbench.plants.corrected import Corrected
from ventbench.recordings.breaths import Breaths
from ventbench.system_id.data import Floats


@dataclass(frozen=True, eq=False)
class Correction:
    """A corrected simulator.

    Attributes:
        pressures: pressures of the simulator ``before``, ``refit`` and ``after``, cmH2O, ``(n, T)``
            each.
        training_errors: mean absolute error of ``before`` and ``after`` on the training breaths,
            inspirations and expirations, cmH2O.
        plants: the corrected simulator of each lung, by label; empty if the simulator has none.
        unchanged: True if the simulator is left as it is, because a correction would be worse.
        notes: notes for the reader.
    """

    pressures: dict[str, Floats]
    training_errors: tuple[float, float]
    plants: dict[str, Plant]
    unchanged: bool = False
    notes: tuple[str, ...] = ()


def correct(
    breaths: Breaths, held: NDArray[np.bool_], before: Floats, recording_model: IdentifiedModel,
    simulator_model: IdentifiedModel | None, simulators: Simulators,
) -> Correction:  # fmt: skip
    """Correct a simulator by the difference of the models of the recording and of itself.

    A simulator that is not the base model stays as it is if the correction raises its mean error on
    the training breaths. Likelihoods of coloured noise excuse slow errors, which a learned
    simulator may not make; the mean error does not.

    Args:
        breaths: n recorded ones.
        held: which of them are held out, ``(n,)``.
        before: pressures of the simulator, cmH2O, ``(n, T)``.
        recording_model: identified from the recording.
        simulator_model: identified from the simulator's response; None for the base model.
        simulators: what was diagnosed.
    """
    first = breaths.pressure[:, 0]  # where every simulation starts
    after = recording_model.pressures(recording_model.conclusion.full, held, first)
    training = breaths.valid & (breaths.time > 0) & ~held[:, None]
    if simulator_model is None:
        refit = recording_model.pressures(recording_model.conclusion.base, held, first)
        pressures = {"before": before, "refit": refit, "after": after}
        return _correct_base_model(breaths, recording_model, held, pressures, training)
    # The simulator's own model, and the same with the recording's R, C, R_ex and PEEP.
    identified = simulator_model.pressures(simulator_model.conclusion.full, held, first)
    data, noise = recording_model.evaluator.training.data, recording_model.conclusion.noise
    refitted = refit_base_parameters(simulator_model, data, noise)
    refit = simulator_model.pressures(refitted, held, first)
    pressures = {
        "before": before,
        "refit": before + refit - identified,
        "after": before + after - identified,
    }
    errors = _training_errors(breaths, pressures, training)
    recording_plants = recording_model.plants()
    if unchanged := bool(errors[1] >= errors[0]):
        pressures, recording_plants = dict.fromkeys(pressures, before), simulator_model.plants()
    if not simulators.has_plants:
        note = (
            f"{simulators.name} has no plant that could be corrected, so there is no "
            "corrected.json; the corrected pressures of the recorded breaths are in the diagnosis."
        )
        return Correction(pressures, errors, {}, unchanged, (_capital(note),))
    plants = _corrected_plants(breaths, simulators, recording_plants, simulator_model.plants())
    return Correction(pressures, errors, plants, unchanged)


def _correct_base_model(
    breaths: Breaths, recording_model: IdentifiedModel, held: NDArray[np.bool_],
    pressures: dict[str, Floats], training: NDArray[np.bool_],
) -> Correction:  # fmt: skip
    """The base model with everything that was identified, or with less if that errs less.

    Robust likelihoods excuse breaths that a term throws far off, but whoever uses the plant does
    not. Patient efforts belong to single breaths: their mean, which is the prediction for other
    breaths, may be off in all of them, so they are kept without this check.
    """
    least = open_loop_error(breaths.pressure, pressures["refit"], training)
    # A mild mechanism may raise the error a little, since the fit discounts coloured noise.
    ratio = recording_model.evaluator.settings.simulator.max_error_ratio

    def is_acceptable(pressure: Floats) -> bool:
        # The mean square sees a few breaths that are far off; the mean error hides them.
        error = open_loop_error(breaths.pressure, pressure, training)
        return error.mae <= ratio * least.mae and error.rmse <= ratio * least.rmse

    conclusion = recording_model.conclusion
    has_efforts = any(varies_by_breath(name) for name in conclusion.full.names)
    if has_efforts or is_acceptable(pressures["after"]):
        errors = _training_errors(breaths, pressures, training)
        return Correction(pressures, errors, estimates.plants(recording_model.fit))
    model, left_out = conclusion.base, "the identified mechanisms"
    if conclusion.unnamed is not None and conclusion.named.names:
        pressure = recording_model.pressures(conclusion.named, held, breaths.pressure[:, 0])
        if is_acceptable(pressure):
            model, left_out = conclusion.named, "the nonparametric term"
            pressures = pressures | {"after": pressure}
    if model is conclusion.base:
        pressures = pressures | {"after": pressures["refit"]}
    note = (
        f"With {left_out}, the simulator would err more on the training breaths than with R and C "
        "refitted alone, so the corrected simulator does without."
    )
    plants = estimates.plants_of(model, recording_model.evaluator)
    errors = _training_errors(breaths, pressures, training)
    return Correction(pressures, errors, plants, notes=(note,))


def _training_errors(
    breaths: Breaths, pressures: dict[str, Floats], training: NDArray[np.bool_]
) -> tuple[float, float]:
    before, after = (
        open_loop_error(breaths.pressure, pressures[key], training).mae
        for key in ("before", "after")
    )
    return before, after


def _corrected_plants(
    breaths: Breaths,
    simulators: Simulators,
    recording_plants: dict[str, Plant],
    simulator_plants: dict[str, Plant],
) -> dict[str, Plant]:
    """The given plant of each lung plus the difference of two physics."""
    return {
        name: Corrected(
            simulators.plant_of_breath(breaths, int(index[0])),
            recording_plants[name],
            simulator_plants[name],
        )
        for name, index in breaths.by_lung_index.items()
    }


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]
