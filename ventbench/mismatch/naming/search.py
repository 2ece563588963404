"""Forward selection with a gate on held-out breaths."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ventbench.mismatch.naming.bench import Bench
from ventbench.mismatch.naming.candidates import HELD, Candidate, screen
from ventbench.mismatch.naming.hypothesis import Hypothesis
from ventbench.mismatch.naming.solved import Solved
from ventbench.physics.catalogue import mechanism
from ventbench.physics.fits.data import Floats
from ventbench.physics.fits.noise import Noise, estimate

#: Nats on held-out breaths from which a term is believed: log(1 / 0.01).
GATE = 4.6

#: Most terms; candidates that are refitted; nats below which a candidate is not looked at.
_MOST, _REFITTED, _FAINT, _MUCH = 6, 6, 3.0, 100.0

#: Candidates that are tried where the best one is not believed.
_OTHERS = 3

#: Steps of a first fit; nats of criterion, and share of the gain, within which one may still win.
_FEW, _NEAR, _SHARE = 12, 60.0, 0.1

#: Criterion that another noise must gain.
_LIKELIER = 2.0

#: Nats from which a shape is freed; and how far the sum over breaths must exceed its own scatter.
_SHAPE, _CONSISTENT = 2.0, 1.3

#: Quantile of the gains' sizes that is usual, and times that beyond which they are cut off.
_USUAL, _FAR = 0.8, 1.5

Progress = Callable[[str], None]


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
    for _ in range(2):
        solved = bench.solve(hypothesis, noise_of(solved), solved)
    return solved


def step(bench: Bench, current: Solved, candidates: list[Candidate]) -> Step | None:
    """Compare what could be added; None if nothing is worth a look."""
    found = [one for one in candidates if max(one.nats, one.white) > _FAINT]
    if not found:
        return None
    # Templates are linear: where much is missing they rank badly, and all are refitted.
    if max(one.nats for one in found) < _MUCH:
        found = found[:_REFITTED]
    # Whitened by what an effect leaves in the residual, its own fit would hardly see it.
    white = replace(current.noise, ar=(0.0, 0.0))
    rivals = [
        bench.solve(
            current.hypothesis.plus(one.hypothesis), white, current, one.start,
            iterations=_FEW, tolerance=0.1,
        )
        for one in found
    ]  # fmt: skip
    criterion = _Criteria(bench)
    own = [criterion(one, noise_of(one)) for one in rivals]
    noise = criterion.likelier(rivals[int(np.argmin(own))], current.noise)
    order = criterion.order(rivals, noise)
    for _ in range(3):
        # At the noise of the best, all that may still win is fitted further.
        order[0] = bench.solve(order[0].hypothesis, noise, order[0])
        noise = criterion.likelier(order[0], noise)
        order = criterion.order(order, noise)
        best = criterion(order[0], noise)
        limit = best + max(_NEAR, _SHARE * (criterion(current, noise) - best))
        order = [
            bench.solve(one.hypothesis, noise, one) if criterion(one, noise) < limit else one
            for one in order
        ]
        order = criterion.order(order, noise)
        if criterion.likelier(order[0], noise) is noise:
            break
    if noise is not current.noise:
        current = bench.solve(current.hypothesis, noise, current)
    listed = tuple(Rival(x.hypothesis.names[-1], x, criterion(x, noise)) for x in order)
    return Step(current, listed, bench.judged(order[0]) - bench.judged(current))


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


def believed(gained: Floats) -> bool:
    """Whether held-out breaths ask for a term, by the log-likelihood that it gains in each.

    A split likelihood ratio: whatever the term, and however it was chosen, it exceeds the gate by
    chance in at most 1 % of the recordings. It must not hang on a few breaths either, nor may a few
    that fit nothing, as those of another rig, outvote the rest: with what is far from the others
    cut off, half of the gate must be left, and more than the sum's own scatter.
    """
    if float(gained.sum()) <= GATE:
        return False
    far = _FAR * float(np.quantile(np.abs(gained), _USUAL))
    usual = np.clip(gained, -far, far)
    total, scatter = float(usual.sum()), float(np.sqrt(np.sum(usual**2)))
    return total > 0.5 * GATE and total > _CONSISTENT * scatter


def forward(bench: Bench, start: Solved, tell: Progress) -> tuple[Solved, list[Step]]:
    """Add terms while held-out breaths ask for them, and drop those that a later one replaces."""
    current, steps = start, []
    while len(current.hypothesis.names) < _MOST:
        tell(f"comparing mechanisms ({len(current.hypothesis.names)} named)")
        found = step(bench, current, screen(current, bench.known))
        if found is None:
            break
        steps.append(found)
        best = _settled(bench, found.rivals[0]) if believed(found.gained) else _other(bench, found)
        if best is None:
            break
        current = dropped(bench, shaped(bench, best))
    return current, steps


def _settled(bench: Bench, rival: Rival) -> Solved:
    """Fitted at its own noise: that of a step still holds much of the effect."""
    return settle(bench, rival.solved.hypothesis, rival.solved)


def _other(bench: Bench, found: Step) -> Solved | None:
    """Another candidate that explains much and is believed, where the best one is not.

    So does a sum of several effects look to what is free in each breath: large, and never twice
    alike.
    """
    least = bench.criterion(found.before) - _MUCH
    own = [(bench.criterion(x.solved, noise_of(x.solved)), x) for x in found.rivals[1:]]
    promising = sorted((pair for pair in own if pair[0] < least), key=lambda pair: pair[0])
    for _, rival in promising[:_OTHERS]:
        with_it = _settled(bench, rival)
        without = bench.solve(found.before.hypothesis, with_it.noise, found.before)
        much = bench.criterion(without) - bench.criterion(with_it) > _MUCH
        if much and believed(bench.judged(with_it) - bench.judged(without)):
            return with_it
    return None


def shaped(bench: Bench, current: Solved) -> Solved:
    """Free what shapes the newest term's effect, if the recording asks for it."""
    name = current.hypothesis.names[-1]
    for item in mechanism(name).description.parameters:
        path = f"{name}.{item.name}"
        if not item.shape or path in HELD:
            continue
        freer = bench.solve(
            current.hypothesis.plus(Hypothesis((name,), (path,))), current.noise, current
        )
        if bench.criterion(freer) > bench.criterion(current):
            continue
        if float((bench.judged(freer) - bench.judged(current)).sum()) > _SHAPE:
            current = freer
    return current


def dropped(bench: Bench, current: Solved) -> Solved:
    """Leave out terms that are not needed any more."""
    for name in current.hypothesis.names[:-1]:
        without = bench.solve(current.hypothesis.without(name), current.noise, current)
        if not believed(bench.judged(current) - bench.judged(without)):
            current = without
    return current
