"""One recording on the bench: training and held-out breaths, and hypotheses fitted to them.

Dead times on the far side of a sample.

The likelihood of a dead time is nearly flat between two samples and falls off steeply where an edge
passes one, so that a search stays on the side where it began. The other sides are looked at with
all else refitted to first order.

Every breath as a judge: the gain of a term in each, by fits to the other breaths.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import product
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ventbench.diagnosis.hypothesis import FittedModel, Hypothesis, Partition, make_partition
from ventbench.diagnosis.linearisation import linearise
from ventbench.diagnosis.patient_effort import (
    AMPLITUDE,
    DURATION,
    EFFORT,
    ONSET,
    effort_log_likelihood_gain,
    marginal_log_likelihood,
    restart_efforts,
)
from ventbench.diagnosis.settings import DEFAULT, SelectionConfig
from ventbench.physics.catalogue import library
from ventbench.system_id.data import Data, Floats
from ventbench.system_id.derivatives import START
from ventbench.system_id.least_squares import minimise
from ventbench.system_id.noise import Noise
from ventbench.system_id.problem import Problem
from ventbench.system_id.problem import settings as parameter_values
from ventbench.system_id.together import each
from ventbench.system_id.unknowns import described, unknowns

#: Expected fall of the cost, nats, at which a comparison's search ends, and its most steps.
_TOLERANCE, _ITERATIONS = 0.02, 14


@dataclass(frozen=True, eq=False)
class Evaluator:
    """A recording, split.

    Attributes:
        training: breaths that hypotheses are fitted to.
        held_out: breaths that they are judged by.
        gain_sd: prior standard deviation of each breath's own valve gain (of its logarithm), 0 if
            all breaths have the same.
        excluded: mechanisms that cannot act, as efforts in a passive test lung.
        folds: other splits of the same breaths, training and judging, so that with this one every
            breath judges once.
        settings: every threshold.
    """

    training: Partition
    held_out: Partition
    gain_sd: float = 0.0
    excluded: tuple[str, ...] = ()
    folds: tuple[tuple[Partition, Partition], ...] = ()
    settings: SelectionConfig = DEFAULT
    _known: WeakKeyDictionary[FittedModel, Floats] = field(
        init=False, repr=False, default_factory=WeakKeyDictionary
    )

    @property
    def allowed_mechanisms(self) -> tuple[str, ...]:
        """Mechanisms of the library that may act."""
        return tuple(name for name in library() if name not in self.excluded)

    def fit(
        self,
        hypothesis: Hypothesis,
        noise: Noise,
        near: FittedModel | None = None,
        start: Mapping[str, ArrayLike] | None = None,
        *,
        partition: Partition | None = None,
        restart: bool = False,
        iterations: int = _ITERATIONS,
        tolerance: float = _TOLERANCE,
    ) -> FittedModel:
        """Fit a hypothesis from one start.

        Args:
            hypothesis: what acts.
            noise: of the measurement.
            near: another hypothesis, fitted to the same breaths, to start from.
            start: physical values to start from, by path; before those of ``near``.
            partition: breaths; the training ones if not given.
            restart: look for dead times and each breath's effort beyond the next minimum.
            iterations: most steps.
            tolerance: expected fall of the cost, nats, at which the search ends.
        """
        partition = partition or self.training
        problem = self._problem(partition, self._paths(hypothesis), noise, dict(hypothesis.fixed))
        layout = problem.unknowns
        order = (*partition.simulator.names, START)
        first = {p: problem.fixed[:, order.index(p)] for p in layout.paths if "." not in p}
        first |= {p: described(p).mild for p in layout.paths if "." in p}
        if near is not None:
            known = set(near.problem.unknowns.paths)
            first |= {p: near.column(p) for p in layout.paths if p in known}
        first |= {p: value for p, value in (start or {}).items() if p in layout.paths}
        low, high = layout.bounds()
        x = layout.pack(first)
        if restart:
            x = delay_restarts(problem, x)
        if EFFORT in hypothesis.names and (restart or near is None or EFFORT not in near.names):
            x = restart_efforts(problem, x, refined=restart)
        found = minimise(
            problem.cost, problem.normal, x, low, high, tolerance=tolerance, iterations=iterations
        )
        return FittedModel(hypothesis, problem, found, float(problem.log_likelihood(found.x).sum()))

    def held_out_log_likelihood(self, fitted: FittedModel) -> Floats:
        """Log-likelihood of each judging breath, ``(n,)``.

        Starts (and valve gains, where each breath has its own) are fitted to the breaths
        themselves; efforts are integrated out.
        """
        if fitted not in self._known:
            problem, x = self.refit_breath_parameters(fitted)
            found = problem.log_likelihood(x)
            if EFFORT in fitted.names:
                found = found + effort_log_likelihood_gain(
                    problem, x, float(fitted.column(DURATION)[0])
                )
            self._known[fitted] = found
        return self._known[fitted]

    def refit_breath_parameters(
        self, fitted: FittedModel, partition: Partition | None = None
    ) -> tuple[Problem, Floats]:
        """Put what some breaths gave to others; see :meth:`held_out_log_likelihood`."""
        partition = partition or self.held_out
        own = (START, "gain") if self.gain_sd else (START,)
        values = self.transferred_values(fitted, partition)
        names = partition.simulator.names
        taken = {name: values[:, k] for k, name in enumerate(names) if name != "position"}
        problem = self._problem(partition, own, fitted.noise, taken)
        columns = (*names, START)
        layout = problem.unknowns
        first = {p: problem.fixed[:, columns.index(p)] for p in own}
        low, high = layout.bounds()
        found = minimise(
            problem.cost, problem.normal, layout.pack(first), low, high, tolerance=0.1,
            iterations=4,
        )  # fmt: skip
        return problem, found.x

    def training_log_likelihood(self, fitted: FittedModel, noise: Noise | None = None) -> float:
        """Log-likelihood of the training breaths, efforts of the patient integrated out.

        Args:
            fitted: fitted to the training breaths.
            noise: at which it is judged, if not its own.
        """
        if EFFORT in fitted.names:
            return float(marginal_log_likelihood(fitted, noise or fitted.noise).sum())
        return fitted.log_likelihood if noise is None else fitted.log_likelihood_at(noise)

    def criterion(self, fitted: FittedModel, noise: Noise | None = None) -> float:
        """Bayesian information criterion on the training breaths; less is better.

        Without what each breath has of its own, which is fitted alike or integrated out.

        Args:
            fitted: fitted to the training breaths.
            noise: at which it is judged, if not its own.
        """
        likelihood = self.training_log_likelihood(fitted, noise)
        count = float(self.training.data.weight.sum())
        return -2.0 * likelihood + fitted.shared * float(np.log(count))

    def predict(
        self, fitted: FittedModel, partition: Partition, first: Floats | None = None
    ) -> Floats:
        """Open-loop answers to breaths' commands, ``(n, c, T)``.

        Of a breath to come nobody knows the patient's effort: what is expected is the mean over the
        efforts of the breaths that were fitted.

        Args:
            fitted: a hypothesis.
            partition: the breaths.
            first: pressures that they start from, cmH2O, ``(n,)``; their first readings if None.
        """
        values = self.transferred_values(fitted, partition)
        if first is not None:
            values[:, -1] = first
        if EFFORT not in fitted.names:
            return partition.simulator.predict(values)
        columns = [partition.simulator.names.index(path) for path in (AMPLITUDE, ONSET)]
        total, efforts = 0.0, zip(fitted.column(AMPLITUDE), fitted.column(ONSET), strict=True)
        for effort in efforts:
            values[:, columns] = effort
            total = total + partition.simulator.predict(values)
        return np.asarray(total) / len(fitted.column(AMPLITUDE))

    def transferred_values(self, fitted: FittedModel, partition: Partition) -> Floats:
        """Physical values of breaths, ``(n, P + 1)``: what those of a label share.

        What is a breath's own, or unknown to the fit's simulator, is neutral, and its start the
        first reading.
        """
        data, known = partition.data, fitted.problem.data
        names = fitted.problem.simulator.names
        values = parameter_values(data, partition.simulator.names, {})
        same = (data.R[:, None] == known.R) & (data.C[:, None] == known.C)
        same |= ~same.any(axis=1, keepdims=True)
        first = np.argmax(same, axis=1)
        for column, name in enumerate(partition.simulator.names):
            if name != "position" and name in names and not self._own(name):
                item = described(name)  # rounding must not carry a value beyond its bound
                found = fitted.values[first, names.index(name)]
                values[:, column] = np.clip(found, item.low, item.high)
        return values

    def _problem(
        self,
        partition: Partition,
        free: tuple[str, ...],
        noise: Noise,
        fixed: Mapping[str, ArrayLike],
    ) -> Problem:
        groups = {"gain": np.arange(len(partition.data))} if self.gain_sd else {}
        groups |= by_label(partition.data, free)
        layout = unknowns(partition.data, free, groups)
        base = parameter_values(partition.data, partition.simulator.names, fixed)
        gain = float(np.log(described("gain").neutral))
        mean, precision = layout.prior({"gain": (gain, self.gain_sd)} if self.gain_sd else {})
        return Problem(partition.data, partition.simulator, layout, base, noise, mean, precision)

    def _own(self, path: str) -> bool:
        if path == "gain":
            return self.gain_sd > 0
        return path == START or ("." in path and described(path).scope == "breath")

    def _paths(self, hypothesis: Hypothesis) -> tuple[str, ...]:
        extra = ("gain",) if self.gain_sd else ()
        return tuple(dict.fromkeys((*hypothesis.paths, *extra)))


def make_evaluator(
    data: Data,
    held_out: NDArray[np.bool_],
    names: tuple[str, ...],
    excluded: tuple[str, ...] = (),
    settings: SelectionConfig = DEFAULT,
) -> Evaluator:
    """Split a recording.

    Args:
        data: all n breaths.
        held_out: those that evaluate hypotheses, bool, ``(n,)``.
        names: parameters that hypotheses may have.
        excluded: mechanisms that cannot act.
        settings: every threshold.
    """

    def split(mask: NDArray[np.bool_]) -> tuple[Partition, Partition]:
        training, other = data.select(~mask), data.select(mask)
        return make_partition(training, names, settings), make_partition(other, names, settings)

    order = np.cumsum(~held_out)
    folds = [~held_out & (order % 2 == k) for k in range(2)]
    others = tuple(split(fold) for fold in folds if fold.any() and not fold.all())
    return Evaluator(*split(held_out), excluded=excluded, folds=others, settings=settings)


def by_label(data: Data, free: tuple[str, ...]) -> dict[str, NDArray[np.int64]]:
    """Groups of parameters that belong to the lung's R or C: one for each label."""
    groups = {}
    for path in free:
        follows = described(path).follows if "." in path else None
        if follows:
            label = data.R if follows == "R" else data.C
            groups[path] = np.unique(label, return_inverse=True)[1].reshape(-1)
    return groups


#: Nats by which another side must be likelier.
_JUMP = 2.0


def delay_restarts(problem: Problem, x: Floats) -> Floats:
    """Move each dead time to the value of its scan that is the likeliest, if it clearly is.

    Args:
        problem: of any hypothesis.
        x: its unknowns, ``(U,)``.
    """
    for path in problem.unknowns.paths:
        item = described(path)
        if item.kinked and item.scan:
            x = _elsewhere(problem, x, path)
    return x


def _elsewhere(problem: Problem, x: Floats, path: str) -> Floats:
    place = linearise(problem, x, np.inf)
    column = problem.simulator.names.index(path)
    best, reached = x, float(np.sum(problem.noise.loss(place.residual))) - _JUMP
    for value in described(path).scan:
        trial = place.values.copy()
        trial[:, column] = value
        left = place.residual + place.template(problem.simulator.predict(trial))
        loss = float(np.sum(problem.noise.loss(left)))
        if loss < reached:
            best, reached = x.copy(), loss
            best[problem.unknowns.of(path)] = described(path).coordinate(value)
    return best


def cross_validated_gain(
    evaluator: Evaluator, current: FittedModel, without: FittedModel
) -> Floats:
    """Log-likelihood that a term gains in each breath, in the order of the folds, ``(n,)``.

    Args:
        evaluator: of the recording.
        current: with the term, fitted to the training breaths.
        without: the same hypothesis without it, at the same noise.
    """

    def judged(work: tuple[tuple[Partition, Partition], FittedModel]) -> Floats:
        (training, judging), fitted = work
        fold = replace(evaluator, training=training, held_out=judging, folds=())
        return fold.held_out_log_likelihood(_again(fold, fitted, training))

    found = each(judged, product(evaluator.folds, (current, without)))
    gains = [new - old for new, old in zip(found[::2], found[1::2], strict=True)]
    return np.concatenate(
        [
            evaluator.held_out_log_likelihood(current) - evaluator.held_out_log_likelihood(without),
            *gains,
        ]
    )


def _again(fold: Evaluator, fitted: FittedModel, training: Partition) -> FittedModel:
    """The same hypothesis fitted to other breaths, from where it was."""
    values, names = fold.transferred_values(fitted, training), training.simulator.names
    start = {path: values[:, k] for k, path in enumerate(names) if path != START}
    return fold.fit(fitted.hypothesis, fitted.noise, start=start)
