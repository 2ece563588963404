"""Forward selection with a gate on held-out breaths."""

from __future__ import annotations

from collections.abc import Callable

from ventbench.diagnosis import moving
from ventbench.diagnosis.bench import Bench
from ventbench.diagnosis.candidates import HELD, screen
from ventbench.diagnosis.effort import EFFORT
from ventbench.diagnosis.gate import believed, is_trace, needed
from ventbench.diagnosis.hypothesis import Hypothesis, has_own
from ventbench.diagnosis.solved import Solved
from ventbench.diagnosis.steps import MUCH, Rival, Step, noise_of, settle, step, whitened
from ventbench.physics.catalogue import mechanism

#: Most terms, and comparisons: a term that was dropped may come back, but not for ever.
_MOST, _ROUNDS = 6, 14

#: Names from which it is asked whether something else does better; of fewer, the next may be what
#: is missing.
_SEVERAL = 4

#: Share of what efforts explain from which an effect that all breaths share goes first.
_MOSTLY = 0.5

#: Candidates that are tried where the best one is not believed.
_OTHERS = 3

#: Nats from which a shape is freed.
_SHAPE = 2.0

Progress = Callable[[str], None]
Simpler = Callable[[Solved], Solved | None]


def forward(
    bench: Bench, start: Solved, tell: Progress, simpler: Simpler = lambda _: None
) -> tuple[Solved, list[Step]]:
    """Add terms while held-out breaths ask for them, and drop those that a later one replaces.

    Args:
        bench: of the recording.
        start: what terms are added to.
        tell: is told what is done.
        simpler: gives what ends the search if something else does better than all terms.
    """
    current, steps = start, []
    for _ in range(_ROUNDS):
        if len(current.hypothesis.names) == _MOST:
            break
        tell(f"comparing mechanisms ({len(current.hypothesis.names)} named)")
        white = whitened(bench, current)
        found = step(bench, current, screen(current, white, bench.known), white)
        if found is None:
            break
        steps.append(found)
        best = _best(bench, found)
        if best is None:
            break
        current = dropped(bench, shaped(bench, best))
        if len(current.names) < _SEVERAL:
            continue
        instead = simpler(current)
        if instead is not None:
            return instead, []
    instead = simpler(current)
    return (current, steps) if instead is None else (instead, [])


def _best(bench: Bench, found: Step) -> Solved | None:
    """The candidate to go on with, or None if none is believed.

    What is free in each breath looks like any sum of effects, so that efforts wait for what is the
    same in all breaths.
    """
    first = found.rivals[0]
    if has_own(first.name):
        nothing = bench.criterion(found.before)
        enough = nothing - _MOSTLY * (nothing - first.criterion)
        shared = (x for x in found.rivals if x.criterion < enough and not has_own(x.name))
        with_it = _beyond(bench, found, next(shared, None))
        if with_it is not None:
            return with_it
    if not believed(found.gained) and not needed(bench, first.solved, found.before):
        return _other(bench, found)
    best = _settled(bench, first)
    if is_trace(bench, best, _without(bench, found, best), first.name):
        return _other(bench, found)
    if first.name != EFFORT or moving.beats_noise(bench, best):
        return best
    return _beyond(bench, found, next((x for x in found.rivals if not has_own(x.name)), None))


def _beyond(bench: Bench, found: Step, rival: Rival | None) -> Solved | None:
    """With a rival, settled, if it is needed there."""
    if rival is None:
        return None
    with_it = _settled(bench, rival)
    without = _without(bench, found, with_it)
    if not needed(bench, with_it, without) or is_trace(bench, with_it, without, rival.name):
        return None
    return with_it


def _without(bench: Bench, found: Step, with_it: Solved) -> Solved:
    """What a step added to, at the noise of what it gives."""
    return bench.solve(found.before.hypothesis, with_it.noise, found.before)


def _settled(bench: Bench, rival: Rival) -> Solved:
    """Fitted at its own noise: that of a step still holds much of the effect."""
    return settle(bench, rival.solved.hypothesis, rival.solved)


def _other(bench: Bench, found: Step) -> Solved | None:
    """Another candidate that explains much and is believed, where the best one is not.

    So does a sum of several effects look to what is free in each breath: large, and never twice
    alike.
    """
    least = bench.criterion(found.before) - MUCH
    own = [(bench.criterion(x.solved, noise_of(x.solved)), x) for x in found.rivals[1:]]
    promising = sorted((pair for pair in own if pair[0] < least), key=lambda pair: pair[0])
    for _, rival in promising[:_OTHERS]:
        with_it = _beyond(bench, found, rival)
        if with_it is not None:
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
        if not needed(bench, current, without) or is_trace(bench, current, without, name):
            current = without
    return current
