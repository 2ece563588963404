"""Validation of a model: whether breaths ask for its terms, and whether its residuals are noise.

**Terms.** A likelihood asks only whether a term helps. A term may help by imitating another one
with a strength that no rig has, such as muscles that push where an effort pulls, or with one that
is too small to be told from a clock, an integrator or the form of another term. Bounds of
parameters rule out impossible values; what remains is ruled out here, by figures that each
mechanism's file gives.

**Residuals** veto "nothing missing". Each breath's error is a sum of what may differ from breath to
breath, and of the rest,

    e_b(t) = a_b g_b(t) + z_b + s_b h_b(t) + r_b(t),

with the sensitivities ``g`` to the logarithm of the valve's gain and ``h`` to the state that the
breath starts from, and a shift ``z`` of the zero, by least squares. If nothing is missing, breaths
are exchangeable: the order of ``a_b``, of ``z_b`` and of the size of ``r_b`` says nothing. A test
by ranks asks that (after Pettitt, Applied Statistics 28, 1979), and permutations of the breaths of
each lung give its p-value whatever the noise. Scatter of gains that has an order is thus no noise.
The rest is tested along all axes (:func:`~ventbench.diagnosis.residual_analysis.locate`), and
against the noise itself.

Noise is what neighbouring readings do not share (:func:`~.residual_analysis.excess_over_noise`),
whatever its tails and however it grows with flow.

"Nothing is missing" is worth as much as the recording could tell. The effect of a mechanism on the
prediction, less what a refit absorbs, is a template (see :func:`~.hypothesis.linearise`). Its power
is twice the log-likelihood that the mechanism would gain. The limit is the strength at which the
testing breaths are expected to gain twice what they must.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ventbench.base.arrays import Bools, Floats, Ints
from ventbench.base.executor import parallel_map
from ventbench.diagnosis.evaluator import Evaluator, cross_validated_gain
from ventbench.diagnosis.findings import Change, ErrorRegion, Quantity
from ventbench.diagnosis.hypothesis import (
    FittedModel,
    Linearisation,
    linearise,
    varies_by_breath,
)
from ventbench.diagnosis.residual_analysis import (
    Excess,
    amplitudes,
    errors,
    excess_over_noise,
    locate,
    of_breaths,
    quiet_samples,
)
from ventbench.diagnosis.settings import (
    DEFAULT,
    HeldOutTestSettings,
    PlausibilitySettings,
    ResidualSettings,
)
from ventbench.mechanics.labels import Estimate
from ventbench.physics.catalogue import mechanism, strength_path
from ventbench.recordings.breaths import Breaths
from ventbench.task.metrics.bootstrap import limits, resampled_means

#: Gain on the testing breaths that is expected at a detection limit, nats: twice the bound of the
#: held-out test, since the gain itself scatters; and strengths at which the effect is simulated.
_NATS, _ROUNDS = 2.0 * DEFAULT.held_out_test.threshold, 2


def is_plausible(fitted: FittedModel, name: str, settings: PlausibilitySettings) -> bool:
    """Whether a mechanism's strength is at least the smallest that is named.

    An effort must reach that strength in some breaths, and nearly all of what does must pull.

    Args:
        fitted: a model with the mechanism.
        name: name of the mechanism, or of a basis term, which has no least strength.
        settings: every threshold.
    """
    description = mechanism(name).description
    beyond = fitted.column(strength_path(name)) - description.strength.neutral
    felt = np.abs(beyond) >= description.least
    if not varies_by_breath(name):
        return bool(felt.any())
    frequent = felt.sum() >= max(settings.effort_breaths, settings.effort_share * len(felt))
    # By their squares: a breath without an effort may be given a small one of either sign.
    square = np.where(felt, beyond**2, 0.0)
    return bool(frequent and square[beyond > 0].sum() >= settings.effort_pulls * square.sum())


def excludes_neutral(estimate: Estimate, name: str) -> bool:
    """Whether the 95 % interval of a mechanism's strength excludes that it is off.

    Args:
        estimate: estimate of the strength.
        name: name of the mechanism.
    """
    low, high = estimate.ci95
    neutral = mechanism(name).description.strength.neutral
    return not (np.isfinite(low) and np.isfinite(high)) or not low <= neutral <= high


def is_weak(name: str, beyond: Floats, share: float) -> bool:
    """Whether a mechanism's strengths are at most a share of what a mild one is beyond none.

    Args:
        name: name of the mechanism.
        beyond: by how much strengths differ from none, or from others, in their unit.
        share: the share.
    """
    strength = mechanism(name).description.strength
    return bool(np.max(np.abs(beyond)) <= share * abs(strength.mild - strength.neutral))


def explained_share(worth: float, error: float, rest: float) -> float:
    """Share of the squared error which is no noise that a name explains, 0..1.

    A name may be no more than the shadow of an effect that the library lacks: if one effect causes
    both, the name's part is the squared correlation of its template with that effect.

    Args:
        worth: root-mean-square error that the name takes away, cmH2O; NaN if unknown.
        error: error with the name, cmH2O.
        rest: part of it that tests of the residuals show to be no noise, cmH2O.

    Returns:
        The share; 1 where nothing is known to be left.
    """
    explained = max(worth, 0.0) * (2.0 * error + max(worth, 0.0))
    return explained / (explained + rest**2) if rest > 0.0 and np.isfinite(worth) else 1.0


def passes_heldout_test(
    gains: Floats,
    settings: HeldOutTestSettings = DEFAULT.held_out_test,
    threshold: float | None = None,
) -> bool:
    """Whether held-out breaths ask for a term, and agree in that.

    The sum of the gains is a split likelihood ratio: whatever the term and however it was chosen,
    chance exceeds the threshold in at most 1 % of recordings. A few breaths that no model fits, as
    those of another rig, must not decide: odds of 10 to 1 are left in 97.5 % of the sums over
    resampled breaths.

    Args:
        gains: log-likelihood that the term gains in each held-out breath, nats, ``(n,)``.
        settings: settings of the test.
        threshold: nats that the sum must exceed; as in ``settings`` if None.
    """
    threshold = settings.threshold if threshold is None else threshold
    least = len(gains) * limits(resampled_means(gains))[0]
    return float(gains.sum()) > threshold and least > settings.resampled


def is_needed(evaluator: Evaluator, full: FittedModel, reduced: FittedModel) -> bool:
    """Whether both training and held-out breaths ask for a term.

    Where the training breaths ask for it clearly and the held-out breaths are too few to tell, the
    test is repeated by cross-validation.

    Args:
        evaluator: evaluator of the recording.
        full: a hypothesis with the term.
        reduced: the hypothesis without the term, at the same noise.
    """
    settings = evaluator.settings.held_out_test
    gained = evaluator.criterion(reduced) - evaluator.criterion(full)
    if gained < 0:
        return False
    if passes_heldout_test(evaluator.held_out_gain(full, reduced), settings):
        return True
    return gained > settings.clear_criterion and passes_heldout_test(
        cross_validated_gain(evaluator, full, reduced),
        settings,
        settings.cross_validation_factor * settings.threshold,
    )


def detection_limits(evaluator: Evaluator, fitted: FittedModel) -> dict[str, float]:
    """Smallest strength of each mechanism that would have been seen.

    Args:
        evaluator: evaluator of the recording.
        fitted: the model in which nothing more is missing, fitted to the training breaths.

    Returns:
        Distance from the neutral strength, in its unit, by name; infinite if not even the largest
        possible strength would have been seen. Mechanisms that differ from breath to breath are
        left out, and none is below the least strength that is named.
    """
    linear = linearise(fitted.problem, fitted.minimum.x)
    count = [float(part.data.weight.sum()) for part in (evaluator.held_out, evaluator.training)]
    share = count[0] / max(count[1], 1.0)
    names = [
        name
        for name in evaluator.allowed_mechanisms
        if name not in fitted.names and not varies_by_breath(name)
    ]
    limits = parallel_map(lambda name: _limit(linear, name, share), names)
    return dict(zip(names, limits, strict=True))


def _limit(linear: Linearisation, name: str, share: float) -> float:
    """Strength at which the testing breaths gain enough, by the secant from two strengths."""
    description = mechanism(name).description
    strength, predictor = description.strength, linear.problem.predictor
    column = predictor.names.index(strength_path(name))
    largest = abs(strength.high - strength.neutral)
    distance = abs(strength.mild - strength.neutral)
    secondary = [p for p in description.parameters[1:] if not p.shape]
    limit = np.inf
    for _ in range(_ROUNDS):
        trial = linear.values.copy()
        trial[:, column] = strength.neutral + distance
        for parameter in secondary:
            trial[:, predictor.names.index(f"{name}.{parameter.name}")] = parameter.mild
        template = linear.template(predictor.predict(trial))
        nats = 0.5 * share * float(np.sum(template**2))
        if not nats > 0.0:
            return np.inf
        limit = distance * float(np.sqrt(_NATS / nats))
        if limit > largest and distance >= largest:
            return np.inf
        distance = float(np.clip(limit, 0.2 * distance, largest))
    return max(limit, description.least) if limit <= largest else np.inf


@dataclass(frozen=True, eq=False)
class Adequacy:
    """What the residuals of the final model say."""

    #: ranges in which they are not noise, as :func:`locate` orders them.
    regions: tuple[ErrorRegion, ...]
    #: significant and material orders in time, the largest effect first.
    changes: tuple[Change, ...]
    vetoed: bool  #: whether "nothing is missing" would be wrong.
    #: root-mean-square of the noise by neighbouring readings, cmH2O; NaN if unknown.
    noise: float
    at_rest: float  #: the same where nothing moves.
    #: root-mean-square beyond the noise where something moves, cmH2O; 0 if chance may do it.
    excess: float


def check_residuals(
    breaths: Breaths,
    simulated: Floats,
    gain: Floats,
    start: Floats,
    noise_sd: float,
    flow: Floats,
    volume: Floats,
    *,
    sorted_by: Ints | None = None,
    judged: Excess | None = None,
    gains_scatter: bool,
    settings: ResidualSettings,
) -> Adequacy:
    """Test what a model leaves of a recording.

    Args:
        breaths: n breaths of T samples, in the order of their recording.
        simulated: pressures of the final model from the first readings, cmH2O, ``(n, T)``.
        gain: change of the pressures by the logarithm of the valve's gain, cmH2O, ``(n, T)``.
        start: change of the pressures by the pressure that a breath starts from, ``(n, T)``.
        noise_sd: standard deviation of the measurement, cmH2O.
        flow: flow of the refitted simulator, mL/s, ``(n, T)``.
        volume: volume of the refitted simulator, mL, ``(n, T)``.
        sorted_by: see :func:`locate`.
        judged: what breaths that are not here show beyond noise.
        gains_scatter: whether gains that differ from breath to breath are no error.
        settings: levels and ranges.
    """
    error, usable = errors(breaths, simulated)
    signals, sizes, of_start = of_breaths(breaths, simulated, gain, start)
    rest = error - np.einsum("ntk,nk->nt", signals, sizes)
    size = np.sqrt(_mean_square(rest, usable))
    of_gain = signals[..., 0] * sizes[:, :1] if gains_scatter else 0.0
    regions = locate(
        breaths,
        simulated + of_start + of_gain,
        noise_sd,
        flow,
        volume,
        sorted_by=sorted_by,
        settings=settings,
        least=settings.negligible,
    )
    lungs = np.unique(breaths.lung_ids, return_inverse=True)[1]
    series: dict[Quantity, Floats] = {
        "gain": sizes[:, 0],
        "zero": sizes[:, 1],
        "error": size,
    }
    breath_signals = signals[..., [2, 0]] if gains_scatter else signals[..., [2]]
    of_breath = np.einsum("ntk,nk->nt", breath_signals, amplitudes(error, usable, breath_signals))
    shared = excess_over_noise(error - of_breath, usable, quiet_samples(breaths))
    p = [order_p_value(values, lungs, settings) for values in series.values()]
    p.append(min((region.p_value for region in regions), default=1.0))
    p += [shared.p_value, 1.0 if judged is None else judged.p_value]
    significant = passes_fdr(np.array(p), settings.veto_level)
    total = _mean_square(error - of_start, usable)
    # The simulator's own gain in units of the sensitivity, which may be that of another lung.
    simulator_gain = np.median(amplitudes(np.where(usable, simulated, 0.0), usable, signals)[:, 0])
    offsets = {"gain": max(float(simulator_gain), 0.1), "error": 0.0}
    changes = []
    for k, (name, values) in enumerate(series.items()):
        if not significant[k]:
            continue
        first, fitted, drifts = _step_or_line(values, lungs)
        low, high = fitted[0], fitted[-1]
        if name == "error":
            worth = abs(high - low)
        else:
            mended = error - of_start - signals[..., k] * (fitted - fitted.mean())[:, None]
            worth = _root(total) - _root(_mean_square(mended, usable))
        how_much = high - low
        if name != "zero":
            how_much = (offsets[name] + high) / max(offsets[name] + low, 1e-6)
        if worth >= settings.negligible:
            number = int(breaths.breath_id[first])
            changes.append(Change(name, number, float(how_much), drifts, p[k], float(worth)))
    changes.sort(key=lambda change: -change.worth)
    vetoed = bool(changes) or bool(significant[len(series) :].any())
    vetoed |= judged is not None and judged.outweighs_noise
    excess = shared.size if significant[len(series) + 1] else 0.0
    return Adequacy(regions, tuple(changes), vetoed, shared.noise, shared.at_rest, excess)


def order_p_value(
    values: Floats, groups: Ints, settings: ResidualSettings = DEFAULT.residuals
) -> float:
    """Probability that values in random order show as large a change at any breath.

    Args:
        values: a value of each breath, in the order of time, ``(n,)``.
        groups: lung of each breath, ``(n,)``; only breaths of one lung are exchanged.
        settings: number of permutations, and fewest breaths.
    """
    n = len(values)
    if n < settings.min_breaths:
        return 1.0
    rng = np.random.default_rng(0)
    permuted = np.zeros((settings.flips + 1, n), np.float32)  # as recorded, then permuted
    for group in np.unique(groups):
        members = np.flatnonzero(groups == group)
        of_lung = np.sort(values[members])  # equal values have the mean of their ranks
        sides = [np.searchsorted(of_lung, values[members], side) for side in ("left", "right")]
        ranks = 0.5 * (sides[0] + sides[1] - len(members))
        ranks = ranks / max(float(np.std(ranks)), 1e-12)
        permuted[0, members] = ranks
        permuted[1:, members] = rng.permuted(np.tile(ranks, (settings.flips, 1)), axis=1)
    k = np.arange(1, n)
    largest = np.abs(np.cumsum(permuted, axis=1)[:, :-1] / np.sqrt(k * (n - k))).max(axis=1)
    return float(np.mean(largest >= largest[0] * (1.0 - 1e-5)))


def passes_fdr(p_values: Floats, level: float) -> Bools:
    """Which of m tests are significant at a false discovery rate (Benjamini and Hochberg, 1995)."""
    # Here, not above: scipy's statistics take half a second to import.
    from scipy.stats import false_discovery_control

    return np.asarray(false_discovery_control(p_values) <= level)


def _step_or_line(values: Floats, groups: Ints) -> tuple[int, Floats, bool]:
    """First breath after the best step, the values of the step or line, and whether it is a line.

    Both are fitted by least squares to the values less each lung's mean; the better one counts.
    """
    centred = values.copy()
    for group in np.unique(groups):
        centred[groups == group] -= values[groups == group].mean()
    n, k = len(values), np.arange(1, len(values))
    before = np.cumsum(centred)[:-1]
    gained = before**2 / k + (centred.sum() - before) ** 2 / (n - k)
    first = int(np.argmax(gained)) + 1
    step = np.where(np.arange(n) < first, centred[:first].mean(), centred[first:].mean())
    line = np.polyval(np.polyfit(np.arange(n), centred, 1), np.arange(n))
    drifts = bool(np.sum((centred - line) ** 2) < np.sum((centred - step) ** 2))
    return first, values.mean() + (line if drifts else step), drifts


def _mean_square(values: Floats, usable: Bools) -> Floats:
    """Mean square over the usable samples of each breath, ``(n,)``."""
    return np.sum(np.where(usable, values**2, 0.0), axis=1) / np.maximum(usable.sum(axis=1), 1)


def _root(mean_squares: Floats) -> float:
    return float(np.sqrt(np.mean(mean_squares)))
