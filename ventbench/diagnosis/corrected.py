"""The corrected simulator: its pressures, its plants, and open-loop errors before and after.

A correction may not make a simulator worse, whatever an identification has concluded. Three
simulators compete for each lung: as given; with R, C, R_ex and PEEP refitted; and corrected. The
*judging* breaths, which no fit and no test of a term has seen, decide: the refit replaces the given
simulator, and the correction the refit, only where neither the root-mean-square nor the mean
absolute error rises. Errors in reports are measured on the same breaths, so that on every lung
``after <= refit <= before`` holds by construction.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any

import numpy as np

from ventbench.base import compilation
from ventbench.base.arrays import Bools, Floats
from ventbench.diagnosis import estimates
from ventbench.diagnosis.evaluator import Evaluator
from ventbench.diagnosis.experiment import Experiment, Judge, Split, open_loop_error
from ventbench.diagnosis.findings import FULL_BREATH, OpenLoopComparison, OpenLoopError, Stage
from ventbench.diagnosis.hypothesis import FittedModel, Partition
from ventbench.diagnosis.identification import IdentifiedModel
from ventbench.diagnosis.settings import CorrectionSettings
from ventbench.diagnosis.simulator_comparison import less_unmodelled, refit_base_parameters
from ventbench.physics.catalogue import parameter
from ventbench.plants.corrected import Corrected
from ventbench.plants.plant_files import parse_rig_id, rig_id
from ventbench.plants.sensed import Sensed, Sensor
from ventbench.recordings.breaths import Breaths
from ventbench.recordings.clocks import rigs_by_clock, sampling_intervals
from ventbench.recordings.decimation import is_fast
from ventbench.system_id.data import Data
from ventbench.system_id.problem import parameter_of, parameter_values
from ventbench.task.interfaces import Plant

#: Length of what is reported as the beginning of inspiration, s.
_BEGINNING = 0.2

#: Logarithms of the factors on the valve's gain that are tried: those of public rigs are within
#: 0.5, and a step of 0.025 is a third of what breaths of one rig scatter by.
_GAINS = np.linspace(-0.6, 0.6, 49)

#: Plants of the lungs, by label, and by label and clock where several ventilators recorded one.
Plants = dict[str, Plant]


@dataclass(frozen=True, eq=False)
class Correction:
    """A corrected simulator."""

    #: pressures of the simulator ``before``, ``refit`` and ``after``, cmH2O, ``(n, T)`` each.
    pressures: dict[str, Floats]
    #: those whose residuals tell what is missing: where the judge leaves the base model as it is
    #: given, it is refitted, since a label that is a little off is no missing physics.
    tested: Floats
    #: mean absolute error of the simulator as given and of the correction, before any choice, on
    #: the breaths of the final fits, inspirations and expirations, cmH2O.
    training_errors: tuple[float, float]
    #: the corrected simulator of each lung, by label; empty if the simulator has none.
    plants: Plants
    #: what each lung's corrected simulator is, by label: as given, refitted or corrected.
    chosen: dict[str, Stage] = field(default_factory=dict)
    #: True if the simulator is left as it is, because a correction would be worse.
    unchanged: bool = False
    notes: tuple[str, ...] = ()  #: notes for the reader.

    @property
    def helps(self) -> bool:
        """Whether the correction is chosen for any lung."""
        return "after" in self.chosen.values()


def correct(
    experiment: Experiment,
    recording_model: IdentifiedModel,
    simulator_model: IdentifiedModel | None,
) -> Correction:
    """Correct a simulator by the difference of the models of the recording and of itself.

    A simulator that is not the base model stays as it is if the correction raises its mean error on
    the breaths of the fits. Likelihoods of coloured noise excuse slow errors, which a learned
    simulator may not make; the mean error does not. The judge chooses among the rest.

    Args:
        experiment: n breaths, and what is diagnosed.
        recording_model: identified from the recording.
        simulator_model: identified from the simulator's response; None for the base model.
    """
    breaths, data, split = experiment.breaths, experiment.data, experiment.uses
    before, simulators = experiment.before, experiment.simulators
    if simulator_model is None:
        pressures, plants, notes = _base_model(experiment, recording_model)
    else:
        pressures, plants, notes = _any_model(
            breaths, data, split, before, recording_model, simulator_model
        )
    fitted = _compared(breaths, split.fitted)
    errors = (
        open_loop_error(breaths.pressure, before, fitted).mae,
        open_loop_error(breaths.pressure, pressures["after"], fitted).mae,
    )
    unchanged = simulator_model is not None and bool(errors[1] >= errors[0])
    if unchanged:
        pressures, notes = dict.fromkeys(pressures, before), []  # notes on the correction
    refitted, chosen = choose(breaths, experiment.judge, pressures)
    if unchanged:
        unchanged_stages: dict[str, Stage] = dict.fromkeys(chosen, "before")
        refitted = chosen = unchanged_stages
    final = {
        "before": before,
        "refit": by_lung(breaths, pressures, refitted),
        "after": by_lung(breaths, pressures, chosen),
    }
    given = "refit" if simulator_model is None else "before"
    tested = by_lung(breaths, pressures | {"before": pressures[given]}, chosen)
    if not simulators.has_plants:
        note = (
            f"There is no corrected.json, since no plant stands behind {simulators.name} that "
            "could be corrected; the corrected pressures of the recorded breaths are in the "
            "diagnosis."
        )
        return Correction(final, tested, errors, {}, chosen, unchanged, (*notes, note))
    # Plants of one kind can be run together: the base model is the library's physics here.
    uncorrected = {
        name: simulators.plant(name)
        if simulators.is_base_physics
        else simulators.plant_of_breath(breaths, int(index[0]))
        for name, index in breaths.by_lung_index.items()
    }
    result: Plants = {}
    for name, stage in chosen.items():
        if simulator_model is not None:
            identified = plants["before"][name]
            result[name] = Corrected(uncorrected[name], plants[stage][name], identified)
        elif stage == "before":
            result[name] = uncorrected[name]
        else:
            of_stage = plants[stage].items()
            result |= {key: plant for key, plant in of_stage if parse_rig_id(key)[0] == name}
    return Correction(final, tested, errors, result, chosen, unchanged, tuple(notes))


_NOTE_ON_DRIFT = (
    "The corrected simulator is fitted for the least open-loop error: with the reported "
    "parameters, which allow for slow noise and for valve gains that scatter, it would err more."
)


_NOTE_ON_GAINS = (
    "The corrected simulator has a gain of the valve for each lung at each ventilator, which the "
    "clock tells: breaths left out of their group one at a time err {:.2f} cmH2O, with one gain "
    "for all {:.2f}."
)


def choose(
    breaths: Breaths, judge: Judge, pressures: dict[str, Floats]
) -> tuple[dict[str, Stage], dict[str, Stage]]:
    """Choose the refitted and the corrected simulator of each lung, by its judging breaths.

    Args:
        breaths: n recorded breaths.
        judge: has the readings; a lung without judging breaths follows those of all lungs together.
        pressures: pressures of the candidates ``before``, ``refit`` and ``after``, cmH2O, ``(n,
            T)`` each.

    Returns:
        The candidate that stands for the refitted simulator, which is ``before`` where a refit is
        worse, and the one that stands for the corrected simulator, both by label.
    """
    # What reports measure: inspirations, from the second sample on.
    judged = breaths.inspiratory & (breaths.time > 0)
    refitted: dict[str, Stage] = {}
    corrected: dict[str, Stage] = {}
    for name, index in breaths.by_lung_index.items():
        mask = judged
        if judge.judging[index].any():
            mask = judged & (breaths.lung_ids == name)[:, None]
        best: Stage = "before"
        if _is_no_worse(judge, pressures["refit"], pressures[best], mask):
            best = "refit"
        refitted[name] = corrected[name] = best
        if _is_no_worse(judge, pressures["after"], pressures[best], mask):
            corrected[name] = "after"
    return refitted, corrected


def behind_sensor(plant: Any, sensor: Sensor, stage: Stage, lungs: tuple[Any, ...]) -> Corrected:
    """A corrected plant whose simulator is read through a sensor.

    Plants of all stages have one structure, so that they can be run together.

    Args:
        plant: what was corrected beside the sensor, a :class:`Corrected`.
        sensor: the sensor.
        stage: what is chosen: the simulator as given, refitted, or with the sensor.
        lungs: base models of the simulator's response and of the recording.
    """
    if stage == "after":
        return plant.replace(simulator=Sensed(plant.simulator, sensor))
    physics = plant.without_mechanisms
    neutral = {path: parameter(path).neutral for path in physics.names if "." in path}
    had, wanted = (physics.having(**neutral, **lung.parameters()) for lung in lungs)
    off = tuple(np.asarray(parameter(path).neutral) for path in sensor.names)
    through = Sensed(plant.simulator, sensor.replace(values=off))  # type: ignore[attr-defined]
    return Corrected(through, wanted if stage == "refit" else had, had)


def _compared(breaths: Breaths, mask: Bools) -> Bools:
    """Readings of some breaths but for the first, where every simulation starts, ``(n, T)``."""
    return breaths.valid & (breaths.time > 0) & mask[:, None]


def _is_no_worse(judge: Judge, trial: Floats, current: Floats, mask: Bools) -> bool:
    """Whether neither error rises; a simulator whose pressures are unknown never wins."""
    new, old = (judge.error(pressure, mask) for pressure in (trial, current))
    if not np.isfinite(old.rmse):
        return bool(np.isfinite(new.rmse))
    return bool(new.rmse <= old.rmse and new.mae <= old.mae)


def by_lung(breaths: Breaths, pressures: dict[str, Floats], stages: dict[str, Stage]) -> Floats:
    """Pressures of the stage that is chosen for each lung, cmH2O, ``(n, T)``."""
    result = pressures["before"].copy()
    for name, index in breaths.by_lung_index.items():
        result[index] = pressures[stages[name]][index]
    return result


def _base_model(
    experiment: Experiment, recording_model: IdentifiedModel
) -> tuple[dict[str, Floats], dict[str, Plants], list[str]]:
    """Candidates for the base model: refitted, and with everything that was identified.

    The refit errs least in open loop on its breaths. The correction has the reported parameters,
    unless coloured noise let them drift: then it is fitted anew for the least error. The
    nonparametric term is left out if it throws breaths far off, as robust likelihoods allow. Last,
    each lung at each ventilator takes a gain of its own.
    """
    breaths, data, split = experiment.breaths, experiment.data, experiment.uses
    first = breaths.pressure[:, 0]
    evaluator, conclusion = recording_model.evaluator, recording_model.conclusion
    settings = evaluator.settings.correction
    of_fits = _compared(breaths, split.fitted)

    def error(pressure: Floats) -> float:
        return open_loop_error(breaths.pressure, pressure, of_fits).rmse

    base = fit_open_loop(evaluator, conclusion.base, recording_model.final, settings, label=True)
    refit = recording_model.pressures(base, data, first)
    final = recording_model.fit
    after, notes = recording_model.pressures(final, data, first), []
    model = final
    if not final.hypothesis.breath_terms:
        if not conclusion.white:
            again = fit_open_loop(evaluator, final, recording_model.final, settings)
            pressure = recording_model.pressures(again, data, first)
            if error(pressure) < settings.drift_ratio * error(after):
                model, after = again, pressure
                notes.append(_NOTE_ON_DRIFT)
        named = conclusion.named
        if conclusion.unnamed is not None and named.names and error(after) > error(refit):
            pressure = recording_model.pressures(named, data, first)
            if error(pressure) < error(after):
                model, after = named, pressure
                notes.append(
                    "With the nonparametric term, the simulator would err more than with R and C "
                    "refitted alone, so the corrected simulator does without."
                )
    of_model = estimates.plants_of(model, evaluator)
    unsuited = not model.names or model.hypothesis.breath_terms or experiment.by_flow
    gains = None if unsuited else _gains_of_rigs(experiment, model, evaluator)
    if gains is not None:
        after = gains.pressures
        of_model = {
            key: _with_gain(of_model[parse_rig_id(key)[0]], factor)
            for key, factor in gains.factors.items()
        }
        notes.append(_NOTE_ON_GAINS.format(*gains.errors))
    plants = {"refit": estimates.plants_of(base, evaluator), "after": of_model}
    return {"before": experiment.before, "refit": refit, "after": after}, plants, notes


@dataclass(frozen=True, eq=False)
class _Gains:
    """Gains of the valve of each lung at each ventilator."""

    factors: dict[str, float]  #: on the gain of the model, by lung id or rig id.
    pressures: Floats  #: with them, cmH2O, ``(n, T)``.
    #: mean absolute error of breaths that are left out of their group, and with one gain, cmH2O.
    errors: tuple[float, float]


def _gains_of_rigs(
    experiment: Experiment, model: FittedModel, evaluator: Evaluator
) -> _Gains | None:
    """Gains with the least mean absolute error on the breaths of the fits, of each lung and rig.

    Breaths of one ventilator share what setting it up changed; the likelihood lets a few breaths of
    far-off gains pull those of all. None if gains of groups do not help breaths that are left out
    of their group one at a time.
    """
    breaths, fitted = experiment.breaths, experiment.uses.fitted
    partition = evaluator.partition(experiment.data)
    values = evaluator.transferred_values(model, partition)
    values[:, -1] = breaths.pressure[:, 0]
    gain, bounds = partition.predictor.names.index("gain"), parameter_of("gain")
    points = np.repeat(values[None], len(_GAINS), axis=0)
    points[:, :, gain] *= np.exp(_GAINS)[:, None]
    points[:, :, gain] = np.clip(points[:, :, gain], bounds.low, bounds.high)
    predicted = partition.predictor.predict_all(points)[:, :, 0]  # (k, n, T)
    judged = _compared(breaths, fitted) & np.isfinite(breaths.pressure)
    off = np.where(judged, np.abs(predicted - breaths.pressure), 0.0)
    errors = off.sum(axis=2) / np.maximum(judged.sum(axis=1), 1)  # (k, n)
    unchanged = len(_GAINS) // 2
    chosen = np.full(len(breaths), unchanged)
    left_out = chosen.copy()
    recorded, clocks = experiment.recorded, sampling_intervals(experiment.recorded)
    rigs = np.zeros(len(breaths), int) if is_fast(recorded) else rigs_by_clock(recorded)
    factors: dict[str, float] = {}
    for label, index in breaths.by_lung_index.items():
        groups = [index[rigs[index] == rig] for rig in np.unique(rigs[index])]
        for members in sorted(groups, key=len):
            of_fits = members[fitted[members]]
            if len(of_fits) > 1:
                total = errors[:, of_fits].sum(axis=1)
                chosen[members] = total.argmin()
                left_out[of_fits] = np.argmin(total[:, None] - errors[:, of_fits], axis=0)
            factor = float(np.exp(_GAINS[chosen[members[0]]]))
            if len(groups) > 1:
                factors[rig_id(label, float(np.median(clocks[members])))] = factor
            factors[label] = factor  # the last has most breaths
    at = np.flatnonzero(fitted)
    own = float(errors[left_out[at], at].mean())
    common = float(errors[unchanged, at].mean())
    if own >= evaluator.settings.correction.drift_ratio * common:
        return None
    pressures = np.take_along_axis(predicted, chosen[None, :, None], axis=0)[0]
    return _Gains(factors, pressures, (own, common))


def _with_gain(plant: Any, factor: float) -> Plant:
    """The plant with another gain of its valve."""
    bounds = parameter_of("gain")
    with compilation.float64():
        gain = np.clip(factor * np.asarray(plant.get("gain")), bounds.low, bounds.high)
        return plant.having(gain=gain)


def _any_model(
    breaths: Breaths,
    data: Data,
    split: Split,
    before: Floats,
    recording_model: IdentifiedModel,
    simulator_model: IdentifiedModel,
) -> tuple[dict[str, Floats], dict[str, Plants], list[str]]:
    """Candidates for any simulator: itself plus differences of the physics of both models.

    The correction has the reported parameters, unless it errs less with those that are fitted for
    the least error of the corrected simulator.
    """
    first = breaths.pressure[:, 0]
    conclusion, evaluator = recording_model.conclusion, recording_model.evaluator
    # The simulator's own model, and the same with the recording's R, C, R_ex and PEEP.
    simulator_fit = simulator_model.conclusion.full
    noise = conclusion.noise.white
    refitted = refit_base_parameters(simulator_model, evaluator.training.data, noise)
    identified = simulator_model.pressures(simulator_fit, data, first)
    after = before + recording_model.pressures(conclusion.full, data, first) - identified
    plants_after, notes = recording_model.plants(), []
    again = _least_error_model(data, split, before, recording_model, simulator_model)
    if again is not None:
        of_fits = _compared(breaths, split.fitted)
        pressure = before + recording_model.pressures(again, data, first) - identified
        errors = [open_loop_error(breaths.pressure, p, of_fits).rmse for p in (pressure, after)]
        if errors[0] < evaluator.settings.correction.drift_ratio * errors[1]:
            after, plants_after = pressure, estimates.plants_of(again, evaluator)
            notes.append(_NOTE_ON_DRIFT)
    pressures = {
        "before": before,
        "refit": before + simulator_model.pressures(refitted, data, first) - identified,
        "after": after,
    }
    plants = {
        "before": simulator_model.plants(),
        "refit": estimates.plants_of(refitted, simulator_model.evaluator),
        "after": plants_after,
    }
    return pressures, plants, notes


def _least_error_model(
    data: Data,
    split: Split,
    before: Floats,
    recording_model: IdentifiedModel,
    simulator_model: IdentifiedModel,
) -> FittedModel | None:
    """The recording's model, fitted for the least error of the simulator that it corrects.

    None if it has parameters of each breath, which nobody knows of breaths to come.
    """
    evaluator, full = recording_model.evaluator, recording_model.conclusion.full
    if full.hypothesis.breath_terms:
        return None
    reduced = less_unmodelled(data, before, simulator_model).select(split.fitted)
    partition = evaluator.partition(reduced)
    return fit_open_loop(evaluator, full, partition, evaluator.settings.correction)


def fit_open_loop(
    evaluator: Evaluator,
    fitted: FittedModel,
    partition: Partition,
    settings: CorrectionSettings,
    *,
    label: bool = False,
) -> FittedModel:
    """Fit a hypothesis for the least open-loop error: at white noise, from several starts.

    Coloured noise excuses slow errors, and a fit from one start may end in a local minimum far off.
    The result never errs more on its breaths than its starts do.

    Args:
        evaluator: evaluator of the recording.
        fitted: the hypothesis, fitted to some breaths.
        partition: breaths to fit.
        settings: which starts to try.
        label: also start from the labels' R and C, and from other lungs around them.
    """
    evaluator = replace(evaluator, gain_sd=0.0)  # a breath to come has the usual gain
    noise = replace(fitted.noise.white, tail=settings.tail)
    values, names = evaluator.transferred_values(fitted, partition), partition.predictor.names
    estimates_of_fit = {p: values[:, names.index(p)] for p in fitted.hypothesis.paths if p in names}
    starts = [estimates_of_fit]
    if label:
        data = partition.data
        starts.append({"R": data.R, "C": data.C})
        starts.append(_best_lung(partition, settings))
    models = [evaluator.fit(fitted.hypothesis, noise, start=s, partition=partition) for s in starts]
    return min(models, key=lambda model: evaluator.mean_square(model, partition))


def _best_lung(partition: Partition, settings: CorrectionSettings) -> dict[str, Floats]:
    """R and C of each lung, of a grid around its label, with which the base model errs least."""
    data, names = partition.data, partition.predictor.names
    label = parameter_values(data, names, {})
    factors = list(product(settings.lung_factors, repeat=2))
    points = np.repeat(label[None], len(factors), axis=0)
    for point, (of_R, of_C) in zip(points, factors, strict=True):
        for path, factor in (("R", of_R), ("C", of_C)):
            parameter, column = parameter_of(path), names.index(path)
            point[:, column] = np.clip(point[:, column] * factor, parameter.low, parameter.high)
    predicted = partition.predictor.predict_all(points)
    square = np.sum(((predicted - data.measured) * data.weight) ** 2, axis=(2, 3))  # (m, n)
    start = {"R": data.R.copy(), "C": data.C.copy()}
    for lung in np.unique(data.lung):
        members = data.lung == lung
        best = int(np.argmin(square[:, members].sum(axis=1)))
        for path in start:
            start[path][members] = points[best][members, names.index(path)]
    return start


def compare_open_loop(
    breaths: Breaths,
    judge: Judge,
    pressures: dict[str, Floats],
    noise_sd: float,
    scatter_error: Floats | None = None,
    start: Floats | None = None,
) -> OpenLoopComparison:
    """Open-loop errors of a simulator before and after its correction.

    Args:
        breaths: n recorded breaths of T samples.
        judge: has the readings of the breaths that no fit has seen.
        pressures: pressures of the simulator ``before``, ``refit`` and ``after``, cmH2O, ``(n,
            T)``.
        noise_sd: standard deviation of the readings, cmH2O.
        scatter_error: standard deviation of the pressure because gains or efforts differ from
            breath to breath, cmH2O, ``(n, T)``; None if nothing does.
        start: change of the pressure by the reading that a breath starts from, ``(n, T)``; None if
            that is exact.
    """
    judged = _compared(breaths, judge.judging)
    inspiration = breaths.inspiratory & judged

    def by_stage(mask: Bools) -> dict[str, OpenLoopError]:
        return {stage: judge.error(simulated, mask) for stage, simulated in pressures.items()}

    def root(values: Floats | None) -> float:
        return 0.0 if values is None else float(np.sqrt(np.mean(values[judged] ** 2)))

    parts = {
        FULL_BREATH: judged,
        f"first {_BEGINNING:g} s of inspiration": inspiration & (breaths.time <= _BEGINNING),
        "rest of inspiration": inspiration & (breaths.time > _BEGINNING),
        "expiration": (breaths.u_out == 1) & breaths.valid & judge.judging[:, None],
    }
    lungs = breaths.by_lung_index
    for name in lungs if len(lungs) > 1 else ():
        parts[f"lung {name}"] = inspiration & (breaths.lung_ids == name)[:, None]
    errors = by_stage(inspiration)
    return OpenLoopComparison(
        judge.ids,
        errors["before"],
        errors["refit"],
        errors["after"],
        noise_sd * float(np.hypot(1.0, root(start))),
        {name: by_stage(mask) for name, mask in parts.items() if mask.any()},
        root(scatter_error),
    )
