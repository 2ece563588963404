"""Fits of hypotheses to a recording, and what held-out breaths say of them.

An :class:`Evaluator` holds a recording that is split into training and held-out breaths; it finds
the maximum-likelihood parameters of hypotheses on the training breaths, computes their information
criterion there, and evaluates them by the log-likelihood of the held-out breaths.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ventbench.base.arrays import Bools, Floats
from ventbench.base.executor import parallel_map
from ventbench.diagnosis.hypothesis import (
    FittedModel,
    Hypothesis,
    Linearisation,
    Partition,
    linearise,
    make_partition,
)
from ventbench.diagnosis.patient_effort import BreathTerm, breath_term
from ventbench.diagnosis.settings import DEFAULT, SelectionConfig
from ventbench.physics.catalogue import library
from ventbench.system_id.data import Data, Noise, robust_noise
from ventbench.system_id.levenberg_marquardt import Minimum, minimise
from ventbench.system_id.predictor import START
from ventbench.system_id.problem import (
    GIVEN,
    Problem,
    make_problem,
    parameter_of,
    parameter_values,
)


def delay_restarts(problem: Problem, x: Floats, settings: SelectionConfig = DEFAULT) -> Floats:
    """Move each dead time to the value of its grid that is the likeliest, if it clearly is.

    The likelihood of a dead time is nearly flat between two samples and falls steeply where an edge
    passes one, so that a local search stays between the samples where it began. Other values are
    compared with all other parameters refitted to first order.

    Args:
        problem: problem of any hypothesis.
        x: point in the coordinates of its unknowns, ``(U,)``.
        settings: every threshold.
    """
    predictor, noise = problem.predictor, problem.noise
    for path in _dead_times(problem):
        linear = linearise(problem, x, clip=np.inf)
        least = float(np.sum(noise.loss(linear.residual))) - settings.fit.delay_gain
        for value in parameter_of(path).scan:
            trial = linear.values.copy()
            trial[:, predictor.names.index(path)] = value
            residual = linear.residual + linear.template(predictor.predict(trial))
            loss = float(np.sum(noise.loss(residual)))
            if loss < least:
                x, least = x.copy(), loss
                x[problem.unknowns.of(path)] = parameter_of(path).coordinate(value)
    return x


def _dead_times(problem: Problem) -> tuple[str, ...]:
    """Free dead times, of which other values may be likelier."""
    parameters = {path: parameter_of(path) for path in problem.unknowns.paths}
    return tuple(
        path for path, parameter in parameters.items() if parameter.kinked and parameter.scan
    )


def _reusable_minimum(problem: Problem, x: Floats, earlier: FittedModel | None) -> Minimum | None:
    """The minimum of an earlier fit to the same problem that ended at ``x``; None if there is none.

    A model whose parameters were taken over and not fitted has no normal equations.
    """
    if earlier is None or earlier.minimum.iterations == 0:
        return None
    earlier_problem, layout = earlier.problem, earlier.problem.unknowns
    same = earlier_problem.predictor is problem.predictor and earlier_problem.noise == problem.noise
    same &= earlier_problem.data is problem.data  # the same breaths, less what acts in time
    same &= layout.paths == problem.unknowns.paths
    same &= np.array_equal(layout.index, problem.unknowns.index)
    for name in ("fixed", "mean", "precision"):
        same &= np.array_equal(getattr(earlier_problem, name), getattr(problem, name))
    # A value and its logarithm differ in the last digit.
    same = same and np.allclose(earlier.minimum.x, x, rtol=1e-12, atol=1e-12)
    return earlier.minimum if same else None


@dataclass(frozen=True, eq=False)
class Evaluator:
    """A recording that is split into training and held-out breaths."""

    training: Partition  #: breaths that hypotheses are fitted to.
    held_out: Partition  #: breaths that evaluate them.
    #: prior standard deviation of the logarithm of each breath's valve gain; 0 if all breaths have
    #: the same gain.
    gain_sd: float = 0.0
    #: mechanisms that cannot act, as efforts in a passive test lung.
    excluded: tuple[str, ...] = ()
    #: further splits of the same breaths, training and held-out, such that every breath is held out
    #: exactly once in all splits together.
    folds: tuple[tuple[Partition, Partition], ...] = ()
    #: whether noise is white: a slow discrepancy takes what physics would explain.
    white: bool = False
    settings: SelectionConfig = DEFAULT  #: every threshold.
    _held_out: WeakKeyDictionary[FittedModel, Floats] = field(
        init=False, repr=False, default_factory=WeakKeyDictionary
    )

    @property
    def allowed_mechanisms(self) -> tuple[str, ...]:
        """Mechanisms of the library that may act."""
        return tuple(name for name in library() if name not in self.excluded)

    def estimate_noise(self, fitted: FittedModel) -> Noise:
        """Noise that a model leaves in the breaths that it was fitted to."""
        return self.colour(robust_noise(fitted.residual, fitted.problem.data.weight))

    def colour(self, noise: Noise) -> Noise:
        """The noise as this evaluator has it."""
        return noise.white if self.white else noise

    def partition(self, data: Data) -> Partition:
        """Combine breaths with a predictor that has the parameters of this evaluator."""
        return Partition(data, self.training.predictor.of(data))

    def fit(
        self,
        hypothesis: Hypothesis,
        noise: Noise,
        warm_start: FittedModel | None = None,
        start: Mapping[str, ArrayLike] | None = None,
        *,
        partition: Partition | None = None,
        restart: bool = False,
        iterations: int | None = None,
    ) -> FittedModel:
        """Find the maximum-likelihood parameters of a hypothesis.

        Args:
            hypothesis: the terms.
            noise: model of the measurement noise.
            warm_start: a model of the same breaths whose parameters the search starts from.
            start: physical values to start from, by path; they precede those of ``warm_start``.
            partition: the breaths; the training breaths if None.
            restart: True to look also for dead times and each breath's effort beyond the nearest
                optimum.
            iterations: most steps; as in the settings if None.
        """
        settings, partition = self.settings.fit, partition or self.training
        iterations = settings.iterations if iterations is None else iterations
        fixed = dict(hypothesis.fixed)
        problem = make_problem(partition, hypothesis.paths, noise, fixed, self.gain_sd)
        earlier: dict[str, ArrayLike] = {}
        if warm_start is not None:
            earlier = {path: warm_start.column(path) for path in warm_start.problem.unknowns.paths}
        x = problem.start(earlier | dict(start or {}))
        if restart:
            x = delay_restarts(problem, x, self.settings)
        before = () if warm_start is None else warm_start.names
        x = breath_term(hypothesis.names).start(problem, x, before, refit=restart)
        smoothed = warm_start is not None and warm_start.hypothesis == hypothesis
        if start or not smoothed:
            x = problem.smoothed_start(x, tolerance=settings.tolerance, iterations=iterations)
        low, high = problem.unknowns.bounds()

        def search(x: Floats, previous: Minimum | None = None) -> Minimum:
            return minimise(
                problem.cost,
                problem.normal,
                x,
                low,
                high,
                tolerance=settings.tolerance,
                iterations=iterations,
                warm_start=previous,
            )

        minimum = search(x, _reusable_minimum(problem, x, warm_start))
        for _ in range(settings.delay_rounds):
            beyond = problem.at_likeliest_changes(minimum.x, settings.delay_gain)
            if beyond is None:  # a step may carry a dead time over a sample, and none leads back
                beyond = problem.best_of_scan(minimum, _dead_times(problem), settings.delay_gain)
            if beyond is None:
                break
            trial = search(beyond)
            if trial.cost >= minimum.cost:
                break
            minimum = trial
        return FittedModel(hypothesis.names, problem, minimum, hypothesis)

    @cached_property
    def for_ranking(self) -> Evaluator:
        """Evaluator with as many training breaths as rank candidates: one batch of simulations.

        This one, if the recording has no more of them.
        """
        index = self._ranking_breaths
        if len(index) == len(self.training.data):
            return self
        return replace(self, training=self.partition(self.training.data.select(index)))

    @cached_property
    def _ranking_breaths(self) -> NDArray[np.intp]:
        """Evenly spaced training breaths: one batch, but at least two of each lung."""
        lungs, size = self.training.data.lung, len(self.training.data)
        share = min(1.0, self.settings.data.batch_size / size)
        chosen = []
        for lung in np.unique(lungs):
            index = np.flatnonzero(lungs == lung)
            count = min(len(index), max(2, int(share * len(index))))
            chosen.append(index[np.linspace(0, len(index) - 1, count).round().astype(int)])
        return np.sort(np.concatenate(chosen))

    def held_out_log_likelihood(self, fitted: FittedModel) -> Floats:
        """Log-likelihood of each held-out breath, nats, ``(n,)``.

        Starting pressures (and valve gains, where each breath has its own) are fitted to the
        held-out breaths themselves; patient effort is integrated out.
        """
        if fitted not in self._held_out:
            self._held_out[fitted] = self.log_likelihood(fitted, self.held_out)
        return self._held_out[fitted]

    def held_out_gain(self, full: FittedModel, reduced: FittedModel) -> Floats:
        """Log-likelihood that each held-out breath gains by one model over another, ``(n,)``."""
        return self.held_out_log_likelihood(full) - self.held_out_log_likelihood(reduced)

    def sensitivities(self, fitted: FittedModel, partition: Partition) -> tuple[Floats, Floats]:
        """Change of the pressures of n breaths by what is a breath's own, cmH2O, ``(n, T)`` each.

        Returns:
            By the logarithm of the valve's gain, and by the pressure that the breath starts from.
        """
        values, names = self.transferred_values(fitted, partition), partition.predictor.names
        gain = names.index("gain")
        slopes = partition.predictor.derivatives(values, (gain, len(names)))[1][:, :, 0]
        return slopes[:, 0] * values[:, gain, None], slopes[:, 1]

    def log_likelihood(self, fitted: FittedModel, partition: Partition) -> Floats:
        """Log-likelihood of each of other breaths; see :meth:`held_out_log_likelihood`."""
        problem, x = self.refit_breath_parameters(fitted, partition)
        plain = problem.log_likelihood(x)
        return plain + self.breath_term(fitted).log_likelihood_gain(problem, x, fitted)

    def criterion(self, fitted: FittedModel) -> float:
        """Bayesian information criterion (BIC) on the training breaths; less is better.

        Only shared unknowns count: each breath's own are integrated out, or the same in all
        hypotheses. What the labels say of R and C counts too (see :meth:`label_log_density`).

        Args:
            fitted: a model of the training breaths.
        """
        count = float(self.training.data.weight.sum())
        penalty = int(fitted.problem.unknowns.shared.sum()) * float(np.log(count))
        breaths = float(self.breath_term(fitted).marginal_log_likelihood(fitted).sum())
        return penalty - 2.0 * (breaths + self.label_log_density(fitted))

    def label_log_density(self, fitted: FittedModel) -> float:
        """Logarithm of the prior density of each lung's R and C, less its largest value, nats.

        The labels are right within a tolerance, and sometimes wrong altogether: a Cauchy density of
        the logarithm. Mechanisms that make up for each other, such as a circuit and a slow valve
        behind a low resistance, may describe the breaths equally well with different lungs.
        """
        data, tolerance = self.training.data, self.settings.data.label_tolerance
        lungs = np.unique(data.lung, return_index=True)[1]
        ratios = (fitted.column("R") / data.R, fitted.column("C") / data.C)
        off = np.log(np.stack(ratios)[:, lungs]) / tolerance
        return -float(np.log1p(off**2).sum())

    def predict(
        self, fitted: FittedModel, partition: Partition, first: Floats | None = None
    ) -> Floats:
        """Open-loop response to the breaths' commands, ``(n, c, T)``.

        Args:
            fitted: a model.
            partition: the breaths.
            first: pressures that they start from, cmH2O, ``(n,)``; their first readings if None.
        """
        values = self.transferred_values(fitted, partition)
        if first is not None:
            values[:, -1] = first
        return self.breath_term(fitted).predict(fitted, partition.predictor, values)

    def refit_breath_parameters(
        self, fitted: FittedModel, partition: Partition | None = None
    ) -> tuple[Problem, Floats]:
        """Fit only the breaths' own starting pressures and gains; all else stays as fitted.

        Args:
            fitted: a model.
            partition: the breaths; the held-out ones if None.

        Returns:
            The problem without patient effort, and its unknowns.
        """
        partition, settings = partition or self.held_out, self.settings.fit
        fixed = self.transferred(fitted, partition)
        problem = make_problem(partition, (START,), fitted.noise, fixed, self.gain_sd)
        minimum = minimise(
            problem.cost,
            problem.normal,
            problem.start({}),
            *problem.unknowns.bounds(),
            tolerance=settings.breath_tolerance,
            iterations=settings.breath_iterations,
        )
        return problem, minimum.x

    def transferred_values(self, fitted: FittedModel, partition: Partition) -> Floats:
        """Values of shared parameters for other breaths of the same lungs, ``(n, P + 1)``.

        Parameters that differ from breath to breath, or that the model's predictor does not have,
        are neutral; gains are the median of the lung's. Breaths start at their first reading.

        Args:
            fitted: a model.
            partition: the other breaths. Those of a label that the model has not seen take the
                values of its first breath.
        """
        data, reference = partition.data, fitted.problem.data
        names = fitted.problem.predictor.names
        values = parameter_values(data, partition.predictor.names, {})
        same = data.shares_label(reference)
        same |= ~same.any(axis=1, keepdims=True)
        first = np.argmax(same, axis=1)
        for column, name in enumerate(partition.predictor.names):
            if name not in GIVEN and name in names and not self.differs_by_breath(name):
                parameter = parameter_of(name)  # rounding must not carry a value beyond its bound
                value = fitted.values[first, names.index(name)]
                values[:, column] = np.clip(value, parameter.low, parameter.high)
        if self.gain_sd and "gain" in fitted.problem.unknowns.paths:
            # R and C of a lung are those beside its own gains: a breath to come has their median.
            gains = np.where(same, fitted.column("gain"), np.nan)
            values[:, partition.predictor.names.index("gain")] = np.nanmedian(gains, axis=1)
        return values

    def transferred(self, fitted: FittedModel, partition: Partition) -> dict[str, Floats]:
        """The same by path, ``(n,)`` each, without what the data of a breath give."""
        values = self.transferred_values(fitted, partition)
        names = partition.predictor.names
        return {name: values[:, k] for k, name in enumerate(names) if name not in GIVEN}

    def linearised(self, fitted: FittedModel, partition: Partition) -> Linearisation:
        """A model around other breaths with starts, and perhaps gains, of their own."""
        return linearise(*self.refit_breath_parameters(fitted, partition), clip=np.inf)

    def mean_square(self, fitted: FittedModel, partition: Partition | None = None) -> float:
        """Mean square of the open-loop error of breaths, cmH2O^2.

        They start from their first readings, or, where these have no weight, as all tell.

        Args:
            fitted: a model.
            partition: the breaths; the held-out ones if None.
        """
        partition, first = partition or self.held_out, None
        if not partition.data.weight[:, 0, 0].any():
            problem, x = self.refit_breath_parameters(fitted, partition)
            first = problem.values(x)[:, -1]
        error = self.predict(fitted, partition, first) - partition.data.measured
        return float(np.mean(np.square(error[partition.data.weight > 0.0])))

    def breath_term(self, fitted: FittedModel) -> BreathTerm:
        """Term of a model whose parameters differ from breath to breath."""
        return breath_term(fitted.names)

    def differs_by_breath(self, path: str) -> bool:
        """Whether a parameter has a value of its own in each breath."""
        if path == "gain":
            return self.gain_sd > 0
        return path == START or ("." in path and parameter_of(path).scope == "breath")


def make_evaluator(
    data: Data,
    held_out: Bools,
    names: tuple[str, ...],
    excluded: tuple[str, ...] = (),
    settings: SelectionConfig = DEFAULT,
) -> Evaluator:
    """Split a recording.

    Args:
        data: all n breaths.
        held_out: which breaths evaluate hypotheses, bool, ``(n,)``.
        names: paths of the parameters that hypotheses may have.
        excluded: mechanisms that cannot act.
        settings: every threshold.
    """
    predictor = make_partition(data.select(~held_out), names, settings).predictor

    def of(mask: Bools) -> Partition:
        chosen = data.select(mask)
        return Partition(chosen, predictor.of(chosen))

    order = np.cumsum(~held_out)
    folds = [~held_out & (order % 2 == k) for k in range(2)]
    splits = tuple((of(~fold), of(fold)) for fold in folds if fold.any() and not fold.all())
    return Evaluator(
        of(~held_out), of(held_out), excluded=excluded, folds=splits, settings=settings
    )


def cross_validated_gain(evaluator: Evaluator, full: FittedModel, reduced: FittedModel) -> Floats:
    """Log-likelihood that a term gains in each breath, by fits to other breaths, ``(n,)``.

    Args:
        evaluator: evaluator of the recording; the gains are in the order of its folds.
        full: fitted to the training breaths.
        reduced: the hypothesis without the term, at the same noise.
    """

    def evaluate(work: tuple[tuple[Partition, Partition], FittedModel]) -> Floats:
        (training, held_out), fitted = work
        fold = replace(evaluator, training=training, held_out=held_out, folds=())
        start = fold.transferred(fitted, training)
        return fold.held_out_log_likelihood(fold.fit(fitted.hypothesis, fitted.noise, start=start))

    likelihoods = parallel_map(evaluate, product(evaluator.folds, (full, reduced)))
    pairs = zip(likelihoods[::2], likelihoods[1::2], strict=True)
    first = evaluator.held_out_gain(full, reduced)
    return np.concatenate([first, *(nats_full - nats_reduced for nats_full, nats_reduced in pairs)])


def fit_with_noise(
    evaluator: Evaluator, hypothesis: Hypothesis, warm_start: FittedModel | None = None
) -> FittedModel:
    """Fit a hypothesis to the training breaths, and its noise, in turn."""
    settings = evaluator.settings.fit
    noise = warm_start.problem.noise if warm_start else Noise()
    fitted = evaluator.fit(hypothesis, noise, warm_start)
    for _ in range(settings.noise_rounds):
        noise = evaluator.estimate_noise(fitted)
        again = evaluator.fit(hypothesis, noise, fitted, restart=True)
        before = noise.log_likelihood(fitted.residual, fitted.problem.data.weight)
        gained = again.log_likelihood.sum() - before.sum()
        fitted = again if gained > 0 else evaluator.fit(hypothesis, noise, fitted)
        if gained < settings.noise_gain:
            break
    return fitted
