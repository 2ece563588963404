"""Every breath as a judge: the gain of a term in each, by fits to the other breaths."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np

from ventbench.diagnosis.bench import Bench
from ventbench.diagnosis.solved import Side, Solved
from ventbench.system_id.data import Floats
from ventbench.system_id.derivatives import START
from ventbench.system_id.together import each


def crossed(bench: Bench, current: Solved, without: Solved) -> Floats:
    """Log-likelihood that a term gains in each breath, in the order of the folds, ``(n,)``.

    Args:
        bench: of the recording.
        current: with the term, fitted to the training breaths.
        without: the same hypothesis without it, at the same noise.
    """

    def judged(work: tuple[tuple[Side, Side], Solved]) -> Floats:
        (training, judging), solved = work
        fold = replace(bench, training=training, judging=judging, folds=())
        return fold.judged(_again(fold, solved, training))

    found = each(judged, product(bench.folds, (current, without)))
    gains = [new - old for new, old in zip(found[::2], found[1::2], strict=True)]
    return np.concatenate([bench.judged(current) - bench.judged(without), *gains])


def _again(fold: Bench, solved: Solved, training: Side) -> Solved:
    """The same hypothesis fitted to other breaths, from where it was."""
    values, names = fold.carried(solved, training), training.simulator.names
    start = {path: values[:, k] for k, path in enumerate(names) if path != START}
    return fold.solve(solved.hypothesis, solved.noise, start=start)
