"""Whether breaths that no fit has seen ask for a term."""

from __future__ import annotations

import numpy as np

from ventbench.diagnosis.bench import Bench
from ventbench.diagnosis.crossed import crossed
from ventbench.diagnosis.hypothesis import Hypothesis, has_own
from ventbench.diagnosis.solved import Solved
from ventbench.physics.catalogue import mechanism
from ventbench.system_id.data import Floats

#: Nats on held-out breaths from which a term is believed: log(1 / 0.01).
GATE = 4.6

#: How far the sum over breaths must exceed its own scatter.
_CONSISTENT = 1.3

#: Quantile of the gains' sizes that is usual, and times that beyond which they are cut off.
_USUAL, _FAR = 0.8, 1.5

#: Criterion from which the training breaths plainly ask for a term, and times the gate that it then
#: has to pass, as judgements of several splits hang together.
_PLAIN, _CROSSED = 20.0, 1.5

#: Share of a mild strength, and of all that is explained, below both of which a term is a trace.
WEAK, LITTLE = 0.2, 0.1


def believed(gained: Floats, gate: float = GATE) -> bool:
    """Whether held-out breaths ask for a term, by the log-likelihood that it gains in each.

    A split likelihood ratio: whatever the term, and however it was chosen, it exceeds the gate by
    chance in at most 1 % of the recordings. It must not hang on a few breaths either, nor may a few
    that fit nothing, as those of another rig, outvote the rest: with what is far from the others
    cut off, half of the gate must be left, and more than the sum's own scatter.
    """
    if float(gained.sum()) <= gate:
        return False
    far = _FAR * float(np.quantile(np.abs(gained), _USUAL))
    usual = np.clip(gained, -far, far)
    total, scatter = float(usual.sum()), float(np.sqrt(np.sum(usual**2)))
    return total > 0.5 * gate and total > _CONSISTENT * scatter


def needed(bench: Bench, current: Solved, without: Solved) -> bool:
    """Whether both the training breaths and the held-out ones ask for what the other one lacks.

    Where the training breaths plainly do and the held-out ones are too few to tell, every breath
    judges once, by fits to the others.

    Args:
        bench: of the recording.
        current: a hypothesis.
        without: with a term less, at the same noise.
    """
    gained = bench.criterion(without) - bench.criterion(current)
    if gained < 0:
        return False
    if believed(bench.judged(current) - bench.judged(without)):
        return True
    return gained > _PLAIN and believed(crossed(bench, current, without), _CROSSED * GATE)


def is_trace(bench: Bench, current: Solved, without: Solved, name: str) -> bool:
    """Whether a term is far weaker than a mild one and explains little beside the others.

    What another term's form or the integrator leaves, a tiny effect of almost any kind can trim,
    and enough breaths will believe it: a valve that is late by 1 ms beside four strong effects.

    Args:
        bench: of the recording.
        current: a hypothesis.
        without: with the term less, at the same noise.
        name: of the term.
    """
    item = mechanism(name).description.strength
    strength = float(np.max(np.abs(current.column(f"{name}.{item.name}") - item.neutral)))
    if has_own(name) or strength > WEAK * abs(item.mild - item.neutral):
        return False
    here = bench.criterion(current)
    nothing = bench.criterion(bench.solve(Hypothesis(), current.noise, current))
    return bench.criterion(without) - here < LITTLE * (nothing - here)
