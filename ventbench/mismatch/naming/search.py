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

#: Steps of a first fit; nats of criterion, and share of the gain, within which one may still win.
_FEW, _NEAR, _SHARE = 7, 60.0, 0.1

#: Nats from which a shape is freed; and how far the sum over breaths must exceed its own scatter.
_SHAPE, _CONSISTENT = 2.0, 1.3

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


def quieter(noise: Noise, than: Noise) -> bool:
    """Whether what is new in each sample is clearly less than with another noise."""
    size = [x.sigma[0] * np.sqrt(1.0 - x.ar[0] ** 2) for x in (noise, than)]
    return bool(size[0] < 0.98 * size[1])


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
    rivals = []
    for one in found:
        hypothesis = current.hypothesis.plus(one.hypothesis)
        rivals.append(
            bench.solve(hypothesis, white, current, one.start, iterations=_FEW, tolerance=0.1)
        )
    noise = current.noise
    own = [bench.criterion(one, noise_of(one)) for one in rivals]
    least = noise_of(rivals[int(np.argmin(own))])
    noise = least if quieter(least, noise) else noise
    order = _order(bench, rivals, noise)
    for _ in range(3):
        # At the noise of the best, all that may still win is fitted further.
        order[0][1] = bench.solve(order[0][1].hypothesis, noise, order[0][1])
        least = noise_of(order[0][1])
        noise = least if quieter(least, noise) else noise
        near = _order(bench, [one for _, one in order], noise)
        margin = max(_NEAR, _SHARE * (bench.criterion(current, noise) - near[0][0]))
        order = [
            [c, bench.solve(one.hypothesis, noise, one) if c < near[0][0] + margin else one]
            for c, one in near
        ]
        order = _order(bench, [one for _, one in order], noise)
        if not quieter(noise_of(order[0][1]), noise):
            break
    if noise is not current.noise:
        current = bench.solve(current.hypothesis, noise, current)
    best = tuple(Rival(one.hypothesis.names[-1], one, c) for c, one in order)
    return Step(current, best, bench.judged(best[0].solved) - bench.judged(current))


def _order(bench: Bench, rivals: list[Solved], noise: Noise) -> list[list]:
    """Criteria at one noise, with the rivals, best first."""
    pairs = [[bench.criterion(one, noise), one] for one in rivals]
    return sorted(pairs, key=lambda pair: pair[0])


def believed(gained: Floats) -> bool:
    """Whether held-out breaths ask for a term, by the log-likelihood that it gains in each.

    A split likelihood ratio: whatever the term, and however it was chosen, it exceeds the gate by
    chance in at most 1 % of the recordings. It must not hang on one or two breaths either.
    """
    total = float(gained.sum())
    return total > GATE and total > _CONSISTENT * float(np.sqrt(np.sum(gained**2)))


def forward(bench: Bench, start: Solved, tell: Progress) -> tuple[Solved, list[Step]]:
    """Add terms while held-out breaths ask for them, and drop those that a later one replaces."""
    current, steps = start, []
    while len(current.hypothesis.names) < _MOST:
        tell(f"comparing mechanisms ({len(current.hypothesis.names)} named)")
        found = step(bench, current, screen(current))
        if found is None:
            break
        steps.append(found)
        if not believed(found.gained):
            break
        current = shaped(bench, found.rivals[0].solved)
        current = dropped(bench, current)
    return current, steps


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
