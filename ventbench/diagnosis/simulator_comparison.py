"""A simulator compared with a recording: which mechanisms are missing in it.

The same candidate mechanisms are fitted to the recording and to the simulator's response to the
recorded commands. What only the recording needs is missing in the simulator.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from ventbench.base.arrays import Bools, Floats
from ventbench.diagnosis import estimates
from ventbench.diagnosis.conclusion import eliminate
from ventbench.diagnosis.evaluator import Evaluator, fit_with_noise
from ventbench.diagnosis.hypothesis import FittedModel, Hypothesis, Partition, varies_by_breath
from ventbench.diagnosis.identification import IdentifiedModel, identify
from ventbench.diagnosis.settings import DEFAULT
from ventbench.diagnosis.validation import is_needed, is_weak, passes_heldout_test
from ventbench.physics.catalogue import mechanism, strength_path
from ventbench.system_id import fit
from ventbench.system_id.data import Data, Noise
from ventbench.system_id.problem import free_paths


def identify_both(
    data: Data,
    held: Bools,
    response: Floats,
    recording_only_model: IdentifiedModel,
    excluded: tuple[str, ...],
    tell: Callable[[str], None],
    fitted: Bools | None = None,
) -> tuple[IdentifiedModel, IdentifiedModel]:
    """Identify the models of a simulator and of its recording.

    What no model can describe may be common to both: valves that differ from breath to breath, or
    learned shapes. If the simulator errs less with that part than the model of the recording does,
    the part is subtracted from the recording, and the recording is identified anew: what is then
    found is what the simulator lacks.

    The simulator's response is described by the recording's mechanisms where held-out breaths do
    not object: the difference of two models that describe one rig by other names corrects nothing.

    Args:
        data: n recorded breaths.
        held: which of them are held out, ``(n,)``.
        response: pressures of the simulator for the recorded commands, cmH2O, ``(n, T)``.
        recording_only_model: identified from the recording alone.
        excluded: mechanisms that cannot act.
        tell: receives the current step, in words.
        fitted: which breaths final fits may use, ``(n,)``; all but the testing ones if None.

    Returns:
        The models of the recording and of the simulator.
    """
    settings, noise = recording_only_model.evaluator.settings, recording_only_model.conclusion.noise
    measured = with_sensor_noise(data, response, noise, settings.simulator.noise_seed)
    simulator_model = identify(
        measured, held, excluded, lambda step: tell(f"simulator: {step}"), settings, fitted
    )
    simulator_model = with_mechanisms_of(simulator_model, recording_only_model)
    first = response[:, 0]
    modelled = simulator_model.pressures(simulator_model.conclusion.full, data, first)
    unmodelled = np.nan_to_num(response - modelled)
    reduced = data.with_pressure(data.measured[:, 0] - unmodelled)
    refitted = refit_base_parameters(simulator_model, reduced.select(~held))
    refit = simulator_model.pressures(refitted, data, first) + unmodelled
    # Predicted as breaths to come: parameters of each breath are not known of them.
    predicted = recording_only_model.pressures(recording_only_model.conclusion.full, data, first)
    training = data.select(~held)
    error = min(mean_error(training, response[~held]), mean_error(training, refit[~held]))
    share = settings.simulator.residual_model_share
    if error >= share * mean_error(training, predicted[~held]):
        return recording_only_model, simulator_model
    recording_model = identify(
        reduced,
        held,
        excluded,
        lambda step: tell(f"recording less the simulator's part: {step}"),
        settings,
        fitted,
    )
    fit = _noiseless_fit(simulator_model, data.with_pressure(modelled), held, recording_model)
    return recording_model, replace(simulator_model, fit=fit)


def refit_lungs(
    evaluator: Evaluator, data: Data, held: Bools, response: Floats
) -> tuple[FittedModel, FittedModel]:
    """Base models of a simulator's response and of the recording less what the first one misses.

    Their difference is what other lungs would change of the simulator.

    Args:
        evaluator: evaluator of the recording.
        data: n recorded breaths.
        held: which of them are held out, ``(n,)``.
        response: pressures of the simulator for the recorded commands, cmH2O, ``(n, T)``.
    """
    evaluator, white = replace(evaluator, gain_sd=0.0), Noise((1.0,), (0.0,))
    training, predictor = data.select(~held), evaluator.training.predictor
    answered = Partition(training.with_pressure(np.nan_to_num(response[~held])), predictor)
    base = evaluator.fit(Hypothesis(), white, partition=answered)
    missed = base.residual[:, 0]  # less what was measured: the response
    reduced = Partition(training.with_pressure(training.measured[:, 0] + missed), predictor)
    return base, evaluator.fit(Hypothesis(), white, base, partition=reduced)


def with_mechanisms_of(
    simulator_model: IdentifiedModel, recording_model: IdentifiedModel
) -> IdentifiedModel:
    """Describe a simulator's response by the mechanisms of its recording too, if that is better.

    A selection takes one mechanism at a time and may stop short of several that act together, such
    as a bent valve behind tubing; what the recording showed would then seem to be missing.

    Args:
        simulator_model: identified from the simulator's response.
        recording_model: identified from the recording.

    Returns:
        The simulator's model with those mechanisms of the recording that it needs, or as it was if
        BIC or held-out breaths do not prefer that.
    """
    evaluator, conclusion = simulator_model.evaluator, simulator_model.conclusion
    recording_fit, simulator_fit = recording_model.conclusion.named, conclusion.full
    added = tuple(name for name in recording_fit.names if name not in simulator_fit.names)
    if not added:
        return simulator_model
    joint = simulator_fit.hypothesis.plus(recording_fit.hypothesis.minus(*simulator_fit.names))
    # From the values of the base model: those of a poor description lie in a minimum of their own.
    full = eliminate(evaluator, fit_with_noise(evaluator, joint), added)[0]
    against = evaluator.fit(simulator_fit.hypothesis, full.noise, simulator_fit)
    if not is_needed(evaluator, full, against):
        return simulator_model
    named, unnamed = full, conclusion.unnamed
    if unnamed is not None and unnamed.term is not None:
        named = evaluator.fit(full.hypothesis.minus(unnamed.term), full.noise, full)
    else:
        unnamed = None  # an input that varied in time beside the mechanisms of before
    conclusion = replace(conclusion, named=named, full=full, unnamed=unnamed, noise=full.noise)
    fit = estimates.final_fit(full, simulator_model.final, evaluator)
    return replace(simulator_model, conclusion=conclusion, fit=fit)


def describe_otherwise(recording_model: IdentifiedModel, simulator_model: IdentifiedModel) -> bool:
    """Whether each of two models has mechanisms that the other one has not.

    A learned simulator and its recording may then be described by different names for one rig, and
    all of those names seem to be missing. The recording should be described by the simulator's
    names too; held-out breaths tell which description corrects the simulator.
    """
    models = (recording_model, simulator_model)
    recorded, simulated = (set(model.conclusion.names) for model in models)
    return not recorded <= simulated and not simulated <= recorded


def mean_error(data: Data, pressure: Floats) -> float:
    """Mean absolute error where pressure was measured, cmH2O.

    Args:
        data: n recorded breaths.
        pressure: simulated pressures, cmH2O, ``(n, T)``.
    """
    weight = data.weight[:, 0]
    return float(np.sum(np.abs(pressure - data.measured[:, 0]) * weight) / np.sum(weight))


def less_unmodelled(data: Data, response: Floats, simulator_model: IdentifiedModel) -> Data:
    """Recorded breaths less what the simulator's model does not describe of the simulator.

    Physics that is fitted to these makes the least error when the simulator is corrected by it.

    Args:
        data: n recorded breaths.
        response: pressures of the simulator for the recorded commands, cmH2O, ``(n, T)``.
        simulator_model: identified from the simulator's response.
    """
    modelled = simulator_model.pressures(simulator_model.conclusion.full, data, response[:, 0])
    return data.with_pressure(data.measured[:, 0] - np.nan_to_num(response - modelled))


def with_sensor_noise(
    data: Data, response: Floats, noise: Noise, seed: int = DEFAULT.simulator.noise_seed
) -> Data:
    """A simulator's response as the sensor of the recording would have shown it.

    With the noise of the recording, the same mechanisms are detectable in both.

    Args:
        data: n recorded breaths.
        response: pressures of the simulator, cmH2O, ``(n, T)``.
        noise: model of the recording's noise.
        seed: seed of the noise.
    """
    from scipy import signal  # here, as it takes long to import

    rng = np.random.default_rng(seed)
    sigma, ar, slow = noise.sigma[0], noise.ar[0], noise.slow[0]
    fresh = rng.normal(0.0, sigma * np.sqrt(slow * (1.0 - ar**2)), response.shape)
    fresh[:, 0] = rng.normal(0.0, sigma * np.sqrt(slow), len(fresh))
    coloured = signal.lfilter([1.0], [1.0, -ar], fresh)
    white = rng.normal(0.0, sigma * np.sqrt(1.0 - slow), response.shape)
    return data.with_pressure(np.nan_to_num(response) + coloured + white)


def refit_base_parameters(
    simulator_model: IdentifiedModel, data: Data, noise: Noise | None = None
) -> FittedModel:
    """Refit R, C, R_ex and PEEP of the simulator's model to other breaths.

    Args:
        simulator_model: identified from the simulator's response.
        data: the breaths.
        noise: model of the measurement noise; that of the model if not given.
    """
    simulator_fit, evaluator = simulator_model.conclusion.full, simulator_model.evaluator
    noise = noise or simulator_model.conclusion.noise
    partition = Partition(data, evaluator.training.predictor)
    return evaluator.fit(simulator_fit.hypothesis, noise, simulator_fit, partition=partition)


def missing_mechanisms(
    recording_model: IdentifiedModel, simulator_model: IdentifiedModel | None
) -> tuple[dict[str, bool], list[str]]:
    """Compare the mechanisms of a recording with those of a simulator.

    Args:
        recording_model: identified from the recording.
        simulator_model: identified from the simulator's response; None for the base model, which
            has no mechanisms.

    Returns:
        The missing mechanisms, the most important first, and whether the simulator has each with
        other parameters; and notes on what the simulator has and the recording does not show.
    """
    conclusion = recording_model.conclusion
    order = sorted(conclusion.names, key=lambda name: -conclusion.held_out_gains.get(name, 0.0))
    if simulator_model is None:
        return dict.fromkeys(order, False), []
    present = simulator_model.conclusion.names
    missing = {
        name: name in present
        for name in order
        if name not in present or _differs(recording_model, simulator_model, name)
    }
    notes = [
        f"The simulator has {mechanism(name).description.title}, which the recording does not show."
        for name in present
        if name not in conclusion.names
    ]
    return missing, notes


def refit_at_simulator_parameters(
    data: Data,
    held: Bools,
    response: Floats,
    recording_model: IdentifiedModel,
    simulator_model: IdentifiedModel,
    missing: Sequence[str],
) -> tuple[IdentifiedModel, tuple[str, ...]] | None:
    """Fit what a simulator lacks with the rest of its physics held at the simulator's own values.

    The base parameters are refitted in every hypothesis so that mechanisms can be trusted, but they
    need not be wrong in the simulator: from a few breaths each R and C is uncertain, and a
    correction by them costs accuracy on held-out breaths.

    Args:
        data: n recorded breaths.
        held: which of them are held out, ``(n,)``.
        response: pressures of the simulator for the recorded commands, cmH2O, ``(n, T)``.
        recording_model: identified from the recording.
        simulator_model: identified from the simulator's response.
        missing: mechanisms that the simulator lacks, or has with other parameters.

    Returns:
        The model of the recording with the simulator's own R, C, R_ex, PEEP and other mechanisms,
        and the mechanisms that are still missing; None if held-out breaths ask for other values.
    """
    full, simulator_fit = recording_model.conclusion.full, simulator_model.conclusion.full
    if any(varies_by_breath(name) for name in (*full.names, *simulator_fit.names)):
        return None
    place = recording_model.conclusion.unnamed
    term = (place.term,) if place is not None and place.term else ()
    # What the simulator's model does not describe is in the corrected simulator: here as well.
    reduced = less_unmodelled(data, response, simulator_model)
    evaluator = recording_model.evaluator
    evaluator = replace(
        evaluator,
        training=evaluator.partition(reduced.select(~held)),
        held_out=evaluator.partition(reduced.select(held)),
    )
    test = evaluator.settings.held_out_test

    def fit_with(names: Sequence[str]) -> FittedModel:
        requested = (*names, *term)
        hypothesis = _combined(full.hypothesis, simulator_fit.hypothesis, requested)
        return _fit_beside(evaluator, hypothesis, requested, full, simulator_fit)

    score = evaluator.held_out_log_likelihood
    names, fitted = tuple(missing), fit_with(missing)
    refitted = evaluator.fit(full.hypothesis, full.noise, full)
    if passes_heldout_test(score(refitted) - score(fitted), test):
        return None
    nothing = score(fit_with(()))
    while names:
        # A mechanism that only compensated another R or C is idle beside the simulator's own.
        fewer = [
            fit_with([candidate for candidate in names if candidate != name]) for name in names
        ]
        lost = [score(fitted) - score(less) for less in fewer]
        least = int(np.argmin([nats.sum() for nats in lost]))
        name = names[least]
        total = float((score(fitted) - nothing).sum())
        path = strength_path(name)
        beyond = fitted.column(path) - simulator_fit.column(path)[0]
        negligible = is_weak(name, beyond, test.negligible_strength)
        negligible &= bool(lost[least].sum() < test.negligible_share * total)
        if passes_heldout_test(lost[least], test) and not negligible:
            break
        fitted = fewer[least]
        names = tuple(candidate for candidate in names if candidate != name)
    conclusion = replace(recording_model.conclusion, full=fitted)
    return IdentifiedModel(evaluator, conclusion, fitted, evaluator.training), names


def _noiseless_fit(
    simulator_model: IdentifiedModel,
    modelled: Data,
    held: Bools,
    recording_model: IdentifiedModel,
) -> FittedModel:
    """Fit of the simulator's model to its own pressures, without noise or unmodelled part.

    The values are those of the model; their intervals are what such breaths tell of them.
    """
    fitted, evaluator = simulator_model.conclusion.full, simulator_model.evaluator
    partition = Partition(modelled.select(~held), evaluator.training.predictor)
    problem = replace(fitted.problem, noise=recording_model.conclusion.noise)
    return estimates.final_fit(replace(fitted, problem=problem), partition, evaluator)


def _differs(recording_model: IdentifiedModel, simulator_model: IdentifiedModel, name: str) -> bool:
    """Whether the intervals of a mechanism's strengths lie apart."""
    strength = mechanism(name).description.strength
    if strength.scope == "breath":
        return False
    values = [
        estimates.parameter_estimates(model.fit, name)[strength.name]
        for model in (recording_model, simulator_model)
    ]
    gap = abs(values[0].value - values[1].value)
    half = [0.5 * (value.ci95[1] - value.ci95[0]) for value in values]
    separation = recording_model.evaluator.settings.simulator.separation
    return bool(gap > separation * np.hypot(half[0], half[1]))


def _combined(full: Hypothesis, simulated: Hypothesis, requested: tuple[str, ...]) -> Hypothesis:
    """The mechanisms asked for as the recording has them, all others as the simulator has them."""
    rest = [name for name in full.names if name not in requested]
    return simulated.minus(*requested).plus(full.minus(*rest))


def _fit_beside(
    evaluator: Evaluator,
    hypothesis: Hypothesis,
    requested: tuple[str, ...],
    full: FittedModel,
    simulator_fit: FittedModel,
) -> FittedModel:
    """Fit the parameters of the mechanisms asked for; all others stay at the simulator's values."""
    partition = evaluator.training
    free = [
        p for p in (*free_paths(requested), *hypothesis.free) if p.rpartition(".")[0] in requested
    ]
    values = evaluator.transferred(simulator_fit, partition)
    fixed: dict[str, ArrayLike] = {p: x for p, x in values.items() if p not in free}
    constants = {p: x for p, x in hypothesis.fixed if p.rpartition(".")[0] in requested}
    solution = fit(
        partition.data,
        hypothesis.names,
        free=free,
        fixed=fixed | constants,
        start={p: float(np.median(full.column(p))) for p in free},
        gain_sd=evaluator.gain_sd,
        noise=full.noise,
        predictor=partition.predictor,
    )
    return FittedModel(hypothesis.names, solution.problem, solution.minimum, hypothesis)
