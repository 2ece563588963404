"""One recording on the bench: training and held-out breaths, and hypotheses fitted to them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ventbench.diagnosis.effort import EFFORT
from ventbench.diagnosis.hypothesis import Hypothesis
from ventbench.diagnosis.leaps import leapt
from ventbench.diagnosis.pulled import (
    AMPLITUDE,
    DURATION,
    ONSET,
    integrated,
    restarted,
    settled,
)
from ventbench.diagnosis.solved import Side, Solved, simulator
from ventbench.physics.catalogue import library
from ventbench.system_id.data import Data, Floats
from ventbench.system_id.derivatives import START
from ventbench.system_id.least_squares import minimise
from ventbench.system_id.noise import Noise
from ventbench.system_id.problem import Problem, settings
from ventbench.system_id.unknowns import described, unknowns

#: Expected fall of the cost, nats, at which a comparison's search ends, and its most steps.
_TOLERANCE, _ITERATIONS = 0.02, 14


@dataclass(frozen=True, eq=False)
class Bench:
    """A recording, split.

    Attributes:
        training: breaths that hypotheses are fitted to.
        judging: breaths that they are judged by.
        spread: prior standard deviation of each breath's own valve gain (of its logarithm), 0 if
            all breaths have the same.
        excluded: mechanisms that cannot act, as efforts in a passive test lung.
        folds: other splits of the same breaths, training and judging, so that with this one every
            breath judges once.
    """

    training: Side
    judging: Side
    spread: float = 0.0
    excluded: tuple[str, ...] = ()
    folds: tuple[tuple[Side, Side], ...] = ()
    _known: WeakKeyDictionary[Solved, Floats] = field(
        init=False, repr=False, default_factory=WeakKeyDictionary
    )

    @property
    def known(self) -> tuple[str, ...]:
        """Mechanisms of the library that may act."""
        return tuple(name for name in library() if name not in self.excluded)

    def solve(
        self,
        hypothesis: Hypothesis,
        noise: Noise,
        near: Solved | None = None,
        start: Mapping[str, ArrayLike] | None = None,
        *,
        side: Side | None = None,
        anew: bool = False,
        iterations: int = _ITERATIONS,
        tolerance: float = _TOLERANCE,
    ) -> Solved:
        """Fit a hypothesis from one start.

        Args:
            hypothesis: what acts.
            noise: of the measurement.
            near: another hypothesis, fitted to the same breaths, to start from.
            start: physical values to start from, by path; before those of ``near``.
            side: breaths; the training ones if not given.
            anew: look for dead times and each breath's effort beyond the next minimum.
            iterations: most steps.
            tolerance: expected fall of the cost, nats, at which the search ends.
        """
        side = side or self.training
        problem = self._problem(side, self._paths(hypothesis), noise, dict(hypothesis.fixed))
        layout = problem.unknowns
        order = (*side.simulator.names, START)
        first = {p: problem.fixed[:, order.index(p)] for p in layout.paths if "." not in p}
        first |= {p: described(p).mild for p in layout.paths if "." in p}
        if near is not None:
            known = set(near.problem.unknowns.paths)
            first |= {p: near.column(p) for p in layout.paths if p in known}
        first |= {p: value for p, value in (start or {}).items() if p in layout.paths}
        low, high = layout.bounds()
        x = layout.pack(first)
        if anew:
            x = leapt(problem, x)
        if EFFORT in hypothesis.names and (anew or near is None or EFFORT not in near.names):
            x = restarted(problem, x, refined=anew)
        found = minimise(
            problem.cost, problem.normal, x, low, high, tolerance=tolerance, iterations=iterations
        )
        return Solved(hypothesis, problem, found, float(problem.log_likelihood(found.x).sum()))

    def judged(self, solved: Solved) -> Floats:
        """Log-likelihood of each judging breath, ``(n,)``.

        Starts (and valve gains, where each breath has its own) are fitted to the breaths
        themselves; efforts are integrated out.
        """
        if solved not in self._known:
            problem, x = self.judge(solved)
            found = problem.log_likelihood(x)
            if EFFORT in solved.names:
                found = found + integrated(problem, x, float(solved.column(DURATION)[0]))
            self._known[solved] = found
        return self._known[solved]

    def judge(self, solved: Solved, side: Side | None = None) -> tuple[Problem, Floats]:
        """Put what some breaths gave to others; see :meth:`judged`."""
        side = side or self.judging
        own = (START, "gain") if self.spread else (START,)
        values = self.carried(solved, side)
        names = side.simulator.names
        taken = {name: values[:, k] for k, name in enumerate(names) if name != "position"}
        problem = self._problem(side, own, solved.noise, taken)
        columns = (*names, START)
        layout = problem.unknowns
        first = {p: problem.fixed[:, columns.index(p)] for p in own}
        low, high = layout.bounds()
        found = minimise(
            problem.cost, problem.normal, layout.pack(first), low, high, tolerance=0.1,
            iterations=4,
        )  # fmt: skip
        return problem, found.x

    def likelihood(self, solved: Solved, noise: Noise | None = None) -> float:
        """Log-likelihood of the training breaths, efforts of the patient integrated out.

        Args:
            solved: fitted to the training breaths.
            noise: at which it is judged, if not its own.
        """
        if EFFORT in solved.names:
            return float(settled(solved, noise or solved.noise).sum())
        return solved.log_likelihood if noise is None else solved.likelihood_at(noise)

    def criterion(self, solved: Solved, noise: Noise | None = None) -> float:
        """Bayesian information criterion on the training breaths; less is better.

        Without what each breath has of its own, which is fitted alike or integrated out.

        Args:
            solved: fitted to the training breaths.
            noise: at which it is judged, if not its own.
        """
        likelihood = self.likelihood(solved, noise)
        count = float(self.training.data.weight.sum())
        return -2.0 * likelihood + solved.shared * float(np.log(count))

    def predict(self, solved: Solved, side: Side, first: Floats | None = None) -> Floats:
        """Open-loop answers to breaths' commands, ``(n, c, T)``.

        Of a breath to come nobody knows the patient's effort: what is expected is the mean over the
        efforts of the breaths that were fitted.

        Args:
            solved: a hypothesis.
            side: the breaths.
            first: pressures that they start from, cmH2O, ``(n,)``; their first readings if None.
        """
        values = self.carried(solved, side)
        if first is not None:
            values[:, -1] = first
        if EFFORT not in solved.names:
            return side.simulator.predict(values)
        columns = [side.simulator.names.index(path) for path in (AMPLITUDE, ONSET)]
        total, efforts = 0.0, zip(solved.column(AMPLITUDE), solved.column(ONSET), strict=True)
        for effort in efforts:
            values[:, columns] = effort
            total = total + side.simulator.predict(values)
        return np.asarray(total) / len(solved.column(AMPLITUDE))

    def carried(self, solved: Solved, side: Side) -> Floats:
        """Physical values of breaths, ``(n, P + 1)``: what those of a label share.

        What is a breath's own, or unknown to the fit's simulator, is neutral, and its start the
        first reading.
        """
        data, known = side.data, solved.problem.data
        names = solved.problem.simulator.names
        values = settings(data, side.simulator.names, {})
        same = (data.R[:, None] == known.R) & (data.C[:, None] == known.C)
        same |= ~same.any(axis=1, keepdims=True)
        first = np.argmax(same, axis=1)
        for column, name in enumerate(side.simulator.names):
            if name != "position" and name in names and not self._own(name):
                item = described(name)  # rounding must not carry a value beyond its bound
                found = solved.values[first, names.index(name)]
                values[:, column] = np.clip(found, item.low, item.high)
        return values

    def _problem(
        self, side: Side, free: tuple[str, ...], noise: Noise, fixed: Mapping[str, ArrayLike]
    ) -> Problem:
        groups = {"gain": np.arange(len(side.data))} if self.spread else {}
        groups |= by_label(side.data, free)
        layout = unknowns(side.data, free, groups)
        base = settings(side.data, side.simulator.names, fixed)
        gain = float(np.log(described("gain").neutral))
        mean, precision = layout.prior({"gain": (gain, self.spread)} if self.spread else {})
        return Problem(side.data, side.simulator, layout, base, noise, mean, precision)

    def _own(self, path: str) -> bool:
        if path == "gain":
            return self.spread > 0
        return path == START or ("." in path and described(path).scope == "breath")

    def _paths(self, hypothesis: Hypothesis) -> tuple[str, ...]:
        extra = ("gain",) if self.spread else ()
        return tuple(dict.fromkeys((*hypothesis.paths, *extra)))


def bench(
    data: Data, held_out: NDArray[np.bool_], names: tuple[str, ...], excluded: tuple[str, ...] = ()
) -> Bench:
    """Split a recording.

    Args:
        data: all n breaths.
        held_out: those to judge by, bool, ``(n,)``.
        names: parameters that hypotheses may have.
        excluded: mechanisms that cannot act.
    """

    def split(judging: NDArray[np.bool_]) -> tuple[Side, Side]:
        parts = data.select(~judging), data.select(judging)
        return Side(parts[0], simulator(parts[0], names)), Side(
            parts[1], simulator(parts[1], names)
        )

    order = np.cumsum(~held_out)
    folds = [~held_out & (order % 2 == k) for k in range(2)]
    others = tuple(split(fold) for fold in folds if fold.any() and not fold.all())
    return Bench(*split(held_out), excluded=excluded, folds=others)


def by_label(data: Data, free: tuple[str, ...]) -> dict[str, NDArray[np.int64]]:
    """Groups of parameters that belong to the lung's R or C: one for each label."""
    groups = {}
    for path in free:
        follows = described(path).follows if "." in path else None
        if follows:
            label = data.R if follows == "R" else data.C
            groups[path] = np.unique(label, return_inverse=True)[1].reshape(-1)
    return groups
