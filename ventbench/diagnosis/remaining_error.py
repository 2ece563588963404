"""What the error that mechanisms leave may be: a nonparametric term, a latent input, or nuisance.

The best term of each kind and the best input are compared by what they gain on held-out breaths.
Coloured noise of the sensor and a valve gain that differs from breath to breath are nuisances that
an input must outdo. Beside mechanisms that explain much, a term that explains little of the error,
or a faint input, is negligible.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ventbench.diagnosis.evaluator import Evaluator
from ventbench.diagnosis.hypothesis import FittedModel, Hypothesis
from ventbench.diagnosis.latent_inputs import (
    GAIN_SCATTER,
    MEASUREMENT,
    PLACES,
    RELATIVE_SIZE,
    SUPPLY,
    LatentInput,
    fit_latent_inputs,
    log_likelihood_without_input,
    place_weights,
)
from ventbench.diagnosis.selection.acceptance import passes_heldout_test
from ventbench.diagnosis.selection.refinement import (
    NonparametricFit,
    compare_nonparametric_terms,
    places_of,
    without_breath_terms,
)
from ventbench.diagnosis.settings import SelectionConfig
from ventbench.system_id.data import Floats


@dataclass(frozen=True, eq=False)
class UnnamedEffect:
    """An effect for which the library has no mechanism."""

    name: str  #: public name of the nonparametric component, or of the latent input's place.
    term: str | None  #: the component's basis term, or None for a latent input.
    latent_input: LatentInput | None  #: the input, or None for a basis term.
    nats: float  #: held-out log-likelihood that it gains.
    #: weight of each place that was compared, the largest first.
    places: tuple[tuple[str, float], ...] = ()


@dataclass(frozen=True, eq=False)
class UnexplainedError:
    """Explanation of the error that the mechanisms leave."""

    term: NonparametricFit | None  #: best nonparametric term, or None.
    latent: UnnamedEffect | None  #: best latent input, or None.
    #: standard deviation of the logarithm of the breaths' gains; 0 if it does not matter.
    gain_sd: float
    slow_noise: UnnamedEffect | None  #: slow noise of the sensor; None if it gains nothing.

    @property
    def prefers_term(self) -> bool:
        """Whether the nonparametric term explains the most."""
        nats = 0.0 if self.latent is None else self.latent.nats
        return self.term is not None and self.term.nats >= nats


def explain_remaining_error(
    evaluator: Evaluator, wide: Evaluator, selected: FittedModel
) -> UnexplainedError:
    """Explain what mechanisms leave by a nonparametric term, a latent input or scatter of gains.

    Args:
        evaluator: evaluator with the library's parameters.
        wide: evaluator with the parameters of the nonparametric terms as well.
        selected: the mechanisms.
    """
    term = best_term(wide, selected)
    passive = without_breath_terms(evaluator, selected)
    inputs = fit_latent_inputs(evaluator, passive, (GAIN_SCATTER, *PLACES))
    reference = log_likelihood_without_input(evaluator, selected)[1]
    scatter, settings = inputs.pop(GAIN_SCATTER), evaluator.settings
    scattered = _gain_scatters(scatter, inputs, reference, term, settings)
    gain_sd = scatter.size if scattered else 0.0
    inputs[GAIN_SCATTER] = scatter
    slow_noise = _slow_noise(inputs, reference, settings)
    if term is not None and slow_noise is not None and term.nats < slow_noise.nats:
        # A curve that is the same in all breaths may gain by what slow errors have in common. One
        # that is there gains more than noise, which has to be found anew in each breath.
        term = None
    latent = _best_input(inputs, reference, settings)
    if latent is not None and _is_negligible_input(evaluator, selected, latent):
        latent = None
    return UnexplainedError(term, latent, gain_sd, slow_noise)


def gain_scatter(evaluator: Evaluator, selected: FittedModel) -> float:
    """Standard deviation of the logarithm of the breaths' gains; 0 if it does not matter.

    The same as in :func:`explain_remaining_error` but for a nonparametric term that explains more.

    Args:
        evaluator: evaluator with the same gain in all breaths.
        selected: the mechanisms.
    """
    passive = without_breath_terms(evaluator, selected)
    reference = log_likelihood_without_input(evaluator, selected)[1]
    scatter = fit_latent_inputs(evaluator, passive, (GAIN_SCATTER,))[GAIN_SCATTER]
    gained = scatter.held_out_log_likelihood - reference
    if not passes_heldout_test(gained, evaluator.settings.held_out_test):
        return 0.0
    inputs = fit_latent_inputs(evaluator, passive)
    scattered = _gain_scatters(scatter, inputs, reference, None, evaluator.settings)
    return scatter.size if scattered else 0.0


def _slow_noise(
    inputs: dict[str, LatentInput], reference: Floats, settings: SelectionConfig
) -> UnnamedEffect | None:
    """Slow noise of the sensor, if held-out breaths ask for it, with its rivals' weights."""
    sensor = inputs[MEASUREMENT]
    gained = sensor.held_out_log_likelihood - reference
    if not passes_heldout_test(gained, settings.held_out_test):
        return None
    places = tuple(place_weights(inputs.values()).items())
    return UnnamedEffect(MEASUREMENT, None, sensor, float(gained.sum()), places)


def best_term(wide: Evaluator, selected: FittedModel) -> NonparametricFit | None:
    """The nonparametric term that explains most, if held-out breaths and BIC ask for it."""
    iterations = wide.settings.fit.start_iterations
    start = wide.fit(selected.hypothesis, selected.noise, selected, iterations=iterations)
    comparison = compare_nonparametric_terms(wide, start)
    if comparison is None or not passes_heldout_test(
        comparison.held_out_gain, wide.settings.held_out_test
    ):
        return None
    best = comparison.ranked[0]
    if wide.criterion(best.fitted) > wide.criterion(comparison.base):
        return None
    gained = wide.held_out_log_likelihood(best.fitted) - wide.held_out_log_likelihood(start)
    nats = float(gained.sum())
    if _is_negligible_term(wide, start, best.fitted, nats):
        return None
    places = places_of(comparison, wide.settings.refinement)
    return NonparametricFit(best.name, best.fitted, nats, places)


def _is_negligible_term(
    wide: Evaluator, selected: FittedModel, with_term: FittedModel, nats: float
) -> bool:
    """Whether a nonparametric term beside names explains a small error, and little of it.

    A small error is little if it is less than half of the noise, or if the names explain far more.
    """
    if not selected.names:
        return False
    data, settings = wide.held_out.data, wide.settings.refinement
    seen = data.weight > 0.0

    def square(fitted: FittedModel) -> float:
        error = wide.predict(fitted, wide.held_out) - data.measured
        return float(np.mean(np.square(error[seen])))

    explained = square(selected) - square(with_term)
    if explained >= settings.least_change**2:
        return False
    noise = settings.least_noise_share * with_term.noise.sigma[0]
    return explained < noise**2 or nats < _least_beside_names(wide, selected)


def _least_beside_names(evaluator: Evaluator, selected: FittedModel) -> float:
    """Held-out log-likelihood, nats, below which an unnamed effect explains little beside names."""
    base = evaluator.fit(Hypothesis(), selected.noise, selected)
    held_out = evaluator.held_out_log_likelihood(selected)
    by_names = float((held_out - evaluator.held_out_log_likelihood(base)).sum())
    return evaluator.settings.held_out_test.negligible_share * by_names


def _gain_scatters(
    scatter: LatentInput,
    inputs: dict[str, LatentInput],
    reference: Floats,
    term: NonparametricFit | None,
    settings: SelectionConfig,
) -> bool:
    """Whether scatter of the valve's gain explains much of what any latent input does.

    A course within each breath imitates a gain that differs from breath to breath. The gain is the
    simpler of the two, and what it leaves is searched anew.
    """
    gained = scatter.held_out_log_likelihood - reference
    nats = float(gained.sum())
    if not passes_heldout_test(gained, settings.held_out_test):
        return False
    if term is not None and term.nats > nats:
        return False
    others = [
        float((latent.held_out_log_likelihood - reference).sum()) for latent in inputs.values()
    ]
    return nats > settings.latent_inputs.scatter_share * max(others)


def _best_input(
    inputs: dict[str, LatentInput], reference: Floats, settings: SelectionConfig
) -> UnnamedEffect | None:
    """The latent input that explains more than the mechanisms and than any nuisance, if any.

    Coloured noise and a gain that differs from breath to breath are nuisances.
    """
    test, limits = settings.held_out_test, settings.latent_inputs
    physical = dict(inputs)
    nuisances = physical.pop(MEASUREMENT), physical.pop(GAIN_SCATTER)
    sensor = nuisances[0]

    def unnamed(latent: LatentInput, gained: Floats) -> UnnamedEffect:
        places = tuple(place_weights(inputs.values()).items())
        return UnnamedEffect(latent.place, None, latent, float(gained.sum()), places)

    best = max(physical.values(), key=lambda latent: latent.training_log_likelihood)
    gained = best.held_out_log_likelihood - reference
    ahead = min(
        float((best.held_out_log_likelihood - other.held_out_log_likelihood).sum())
        for other in nuisances
    )
    if passes_heldout_test(gained, test, limits.threshold) and ahead > limits.threshold:
        return unnamed(best, gained)
    gained = sensor.held_out_log_likelihood - reference
    hum = sensor.periodic and sensor.size >= limits.sensor_amplitude
    if passes_heldout_test(gained, test) and hum:
        return unnamed(sensor, gained)
    return None


def _is_negligible_input(
    evaluator: Evaluator, selected: FittedModel, unnamed: UnnamedEffect
) -> bool:
    """Whether an input is far weaker than a mild effect and explains little beside the mechanisms.

    With many breaths, the least difference between the form of a mechanism and the library's passes
    the held-out test; :func:`~ventbench.diagnosis.selection.acceptance.is_negligible` asks the
    same of mechanisms.
    """
    latent, settings = unnamed.latent_input, evaluator.settings
    if latent is None or not selected.names:
        return False
    limits = settings.latent_inputs
    least = limits.least_size * (RELATIVE_SIZE if latent.place == SUPPLY else 1.0)
    if latent.size >= least:
        return False
    return unnamed.nats < _least_beside_names(evaluator, selected)
