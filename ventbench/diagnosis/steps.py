"""One comparison: what could be added to a hypothesis, each fitted, at one noise."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ventbench.diagnosis.bench import Bench
from ventbench.diagnosis.candidates import Candidate
from ventbench.diagnosis.hypothesis import Hypothesis
from ventbench.diagnosis.solved import Solved
from ventbench.system_id.data import Floats
from ventbench.system_id.noise import Noise, estimate
from ventbench.system_id.together import each

#: Nats from which a hypothesis explains much.
MUCH = 100.0

#: Candidates that are refitted, unless much is missing; nats below which one is not looked at.
_REFITTED, _FAINT = 6, 3.0

#: Steps of a first fit; nats of criterion, and share of the gain, within which one may still win.
_FEW, _NEAR, _SHARE = 12, 60.0, 0.1

#: Criterion that another noise must gain; most times that a fit and its noise take turns.
_LIKELIER, _SETTLED = 2.0, 5


@dataclass(frozen=True, eq=False)
class Rival:
    """A hypothesis that was compared with the one that was chosen, at the same noise."""

    name: str
    solved: Solved
    criterion: float


@dataclass(frozen=True, eq=False)
class Step:
    """One comparison: what could be added to a hypothesis.

    Attributes:
        before: without, at the same noise.
        rivals: the candidates, best first.
        gained: held-out log-likelihood of the best, less that without, by breath.
    """

    before: Solved
    rivals: tuple[Rival, ...]
    gained: Floats

    @property
    def nats(self) -> float:
        """Held-out log-likelihood that the best gains."""
        return float(self.gained.sum())


def noise_of(solved: Solved) -> Noise:
    """Noise that a hypothesis leaves on the training breaths."""
    return estimate(solved.residual, solved.problem.data.weight)


def settle(bench: Bench, hypothesis: Hypothesis, near: Solved | None = None) -> Solved:
    """Fit a hypothesis and its noise in turn."""
    solved = bench.solve(hypothesis, near.problem.noise if near else Noise(), near)
    for _ in range(_SETTLED):
        noise = noise_of(solved)
        again = bench.solve(hypothesis, noise, solved, anew=True)
        gained = again.log_likelihood - solved.likelihood_at(noise)
        solved = again if gained > 0 else bench.solve(hypothesis, noise, solved)
        if gained < _LIKELIER:
            break
    return solved


def whitened(bench: Bench, current: Solved) -> Solved:
    """The same hypothesis at white noise.

    Coloured noise excuses an error that is slow, and R, C and PEEP may go anywhere for it.
    """
    white = replace(current.noise, ar=(0.0, 0.0))
    near = current if current.names else None
    return bench.solve(current.hypothesis, white, near)


def step(
    bench: Bench, current: Solved, candidates: list[Candidate], near: Solved | None = None
) -> Step | None:
    """Compare what could be added; None if nothing is worth a look.

    Args:
        bench: of the recording.
        current: the hypothesis that is added to.
        candidates: what could be.
        near: where fits start; ``current`` if not given.
    """
    found = [one for one in candidates if max(one.nats, one.white) > _FAINT]
    if not found:
        return None
    # Templates are linear: where much is missing they rank badly, and all are refitted.
    if max(one.nats for one in found) < MUCH:
        found = found[:_REFITTED]
    # Whitened by what an effect leaves in the residual, its own fit would hardly see it.
    white = replace(current.noise, ar=(0.0, 0.0))
    rivals = each(
        lambda one: bench.solve(
            current.hypothesis.plus(one.hypothesis), white, near or current, one.start,
            iterations=_FEW, tolerance=0.1,
        ),
        found,
    )  # fmt: skip
    criterion = _Criteria(bench)
    own = each(lambda one: criterion(one, noise_of(one)), rivals)
    noise = criterion.likelier(rivals[int(np.argmin(own))], current.noise)
    order = criterion.order(rivals, noise)
    for _ in range(3):
        # At the noise of the best, all that may still win is fitted further.
        order[0] = bench.solve(order[0].hypothesis, noise, order[0])
        noise = criterion.likelier(order[0], noise)
        order = criterion.order(order, noise)
        best = criterion(order[0], noise)
        limit = best + max(_NEAR, _SHARE * (criterion(current, noise) - best))
        order = criterion.order(_further(bench, order, noise, criterion, limit), noise)
        if criterion.likelier(order[0], noise) is noise:
            break
    if noise is not current.noise:
        current = bench.solve(current.hypothesis, noise, current)
    listed = tuple(Rival(x.hypothesis.names[-1], x, criterion(x, noise)) for x in order)
    return Step(current, listed, bench.judged(order[0]) - bench.judged(current))


def _further(
    bench: Bench, order: list[Solved], noise: Noise, criterion: _Criteria, limit: float
) -> list[Solved]:
    """The same, those below a limit fitted on at a noise."""

    def further(one: Solved) -> Solved:
        return bench.solve(one.hypothesis, noise, one) if criterion(one, noise) < limit else one

    return each(further, order)


class _Criteria:
    """Criteria of fits at several noises, each computed once."""

    def __init__(self, bench: Bench) -> None:
        self._bench = bench
        self._known: dict[tuple[int, Noise], tuple[Solved, float]] = {}

    def __call__(self, solved: Solved, noise: Noise) -> float:
        key = (id(solved), noise)
        if key not in self._known:  # which keeps the fit, and thereby its identity
            self._known[key] = (solved, self._bench.criterion(solved, noise))
        return self._known[key][1]

    def likelier(self, solved: Solved, noise: Noise) -> Noise:
        """The noise that a fit leaves, if it makes the fit clearly likelier than another one."""
        own = noise_of(solved)
        return own if self(solved, own) < self(solved, noise) - _LIKELIER else noise

    def order(self, rivals: list[Solved], noise: Noise) -> list[Solved]:
        """The best first."""
        return sorted(rivals, key=lambda one: self(one, noise))
