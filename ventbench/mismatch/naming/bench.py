"""One recording on the bench: training and held-out breaths, and hypotheses fitted to them.

All hypotheses use one simulator of all breaths, so that nothing is compiled or placed twice;
training and held-out breaths differ by their weights alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ventbench.physics.catalogue import mechanism
from ventbench.physics.fits.data import Data, Floats
from ventbench.physics.fits.derivatives import START, Simulator
from ventbench.physics.fits.least_squares import Minimum, minimise
from ventbench.physics.fits.noise import Noise
from ventbench.physics.fits.problem import Problem, settings
from ventbench.physics.fits.unknowns import described, freed, unknowns

#: Expected fall of the cost, nats, at which a comparison's search ends, and its most steps.
_TOLERANCE, _ITERATIONS = 0.02, 14

#: Numbers of breaths that are compiled for: those of 60 breaths, split, and few.
_SIZES = (24, 40, 64)


@dataclass(frozen=True)
class Hypothesis:
    """What is taken to act.

    Attributes:
        names: mechanisms, and elements of slots.
        free: shape parameters that are fitted too, by path.
        fixed: parameters that stand at a value other than their neutral one, by path.
    """

    names: tuple[str, ...] = ()
    free: tuple[str, ...] = ()
    fixed: tuple[tuple[str, float], ...] = ()

    def plus(self, other: Hypothesis) -> Hypothesis:
        """Both together."""
        return Hypothesis(
            tuple(dict.fromkeys(self.names + other.names)),
            tuple(dict.fromkeys(self.free + other.free)),
            tuple(dict(self.fixed + other.fixed).items()),
        )

    def without(self, *names: str) -> Hypothesis:
        """The same without some mechanisms and what is theirs."""

        def kept(path: str) -> bool:
            return path.rpartition(".")[0] not in names

        return Hypothesis(
            tuple(name for name in self.names if name not in names),
            tuple(path for path in self.free if kept(path)),
            tuple((path, value) for path, value in self.fixed if kept(path)),
        )

    @cached_property
    def paths(self) -> tuple[str, ...]:
        """Of everything that is fitted."""
        fixed = dict(self.fixed)
        return tuple(p for p in dict.fromkeys((*freed(self.names), *self.free)) if p not in fixed)


@dataclass(frozen=True, eq=False)
class Side:
    """Some breaths and the simulator of their commands."""

    data: Data
    simulator: Simulator


@dataclass(frozen=True, eq=False)
class Solved:
    """A hypothesis fitted to some breaths.

    Attributes:
        hypothesis: what acts.
        problem: of the breaths.
        minimum: of the cost.
        log_likelihood: of the breaths, sum.
    """

    hypothesis: Hypothesis
    problem: Problem
    minimum: Minimum
    log_likelihood: float

    @cached_property
    def values(self) -> Floats:
        """Physical values of everything, ``(n, P + 1)``."""
        return self.problem.values(self.minimum.x)

    @cached_property
    def residual(self) -> Floats:
        """Simulated minus measured, ``(n, c, T)``."""
        return self.problem.residual(self.minimum.x)

    @property
    def noise(self) -> Noise:
        """Noise at which it was fitted."""
        return self.problem.noise

    @property
    def shared(self) -> int:
        """Unknowns that are not one breath's own."""
        return int(self.problem.unknowns.shared.sum())

    def column(self, path: str) -> Floats:
        """Physical value of a parameter in each breath, ``(n,)``."""
        return self.values[:, (*self.problem.simulator.names, START).index(path)]

    def likelihood_at(self, noise: Noise) -> float:
        """Log-likelihood of its residuals if the noise is another."""
        return float(noise.log_likelihood(self.residual, self.problem.data.weight).sum())


@dataclass(frozen=True, eq=False)
class Bench:
    """A recording, split.

    Attributes:
        training: breaths that hypotheses are fitted to.
        judging: breaths that they are judged by.
        spread: prior standard deviation of each breath's own valve gain (of its logarithm), 0 if
            all breaths have the same.
    """

    training: Side
    judging: Side
    spread: float = 0.0

    def solve(
        self,
        hypothesis: Hypothesis,
        noise: Noise,
        near: Solved | None = None,
        start: Mapping[str, ArrayLike] | None = None,
        *,
        side: Side | None = None,
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
        found = minimise(
            problem.cost, problem.normal, layout.pack(first), low, high, tolerance=tolerance,
            iterations=iterations,
        )  # fmt: skip
        return Solved(hypothesis, problem, found, float(problem.log_likelihood(found.x).sum()))

    def judged(self, solved: Solved, side: Side | None = None) -> Floats:
        """Log-likelihood of each judging breath, or of those of another side, ``(n,)``.

        Starts (and valve gains, where each breath has its own) are fitted to the breaths
        themselves; efforts are integrated out.
        """
        from ventbench.mismatch.naming.effort import EFFORT, evidence
        from ventbench.mismatch.naming.linear import local

        problem, x = self.judge(solved, side)
        found = problem.log_likelihood(x)
        if EFFORT in solved.hypothesis.names:
            duration = float(solved.column(f"{EFFORT}.duration")[0])
            found = found + evidence(local(problem, x), duration).nats
        return found

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

    def criterion(self, solved: Solved, noise: Noise | None = None) -> float:
        """Bayesian information criterion on the training breaths; less is better.

        Without what each breath has of its own, which is fitted alike or integrated out.

        Args:
            solved: fitted to the training breaths.
            noise: at which it is judged, if not its own.
        """
        if any(map(has_own, solved.hypothesis.names)):
            at = (
                solved
                if noise is None
                else replace(solved, problem=replace(solved.problem, noise=noise))
            )
            likelihood = float(self.judged(at, self.training).sum())
        else:
            likelihood = solved.log_likelihood if noise is None else solved.likelihood_at(noise)
        count = float(self.training.data.weight.sum())
        return -2.0 * likelihood + solved.shared * float(np.log(count))

    def predict(self, solved: Solved, side: Side, first: Floats | None = None) -> Floats:
        """Open-loop answers to breaths' commands, ``(n, c, T)``.

        Args:
            solved: a hypothesis.
            side: the breaths.
            first: pressures that they start from, cmH2O, ``(n,)``; their first readings if None.
        """
        values = self.carried(solved, side)
        if first is not None:
            values[:, -1] = first
        return side.simulator.predict(values)

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
                values[:, column] = solved.values[first, names.index(name)]
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


def bench(data: Data, held_out: NDArray[np.bool_], names: tuple[str, ...]) -> Bench:
    """Split a recording.

    Args:
        data: all n breaths.
        held_out: those to judge by, bool, ``(n,)``.
        names: parameters that hypotheses may have.
    """
    training, judging = data.select(~held_out), data.select(held_out)
    return Bench(
        Side(training, simulator(training, names)), Side(judging, simulator(judging, names))
    )


def simulator(data: Data, names: tuple[str, ...]) -> Simulator:
    """Place some breaths in one of few sizes, so that little is compiled."""
    return Simulator(data, names, sizes=_SIZES)


def by_label(data: Data, free: tuple[str, ...]) -> dict[str, NDArray[np.int64]]:
    """Groups of parameters that belong to the lung's R or C: one for each label."""
    groups = {}
    for path in free:
        follows = described(path).follows if "." in path else None
        if follows:
            label = data.R if follows == "R" else data.C
            groups[path] = np.unique(label, return_inverse=True)[1].reshape(-1)
    return groups


def has_own(name: str) -> bool:
    """Whether a mechanism has parameters that are each breath's own."""
    return any(item.scope == "breath" for item in mechanism(name).description.parameters)
