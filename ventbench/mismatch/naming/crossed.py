"""Every breath as a judge: the gain of a term in each, by fits to the other breaths."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ventbench.mismatch.naming.bench import Bench
from ventbench.mismatch.naming.solved import Side, Solved
from ventbench.physics.fits.data import Floats
from ventbench.physics.fits.derivatives import START


def crossed(bench: Bench, current: Solved, without: Solved) -> Floats:
    """Log-likelihood that a term gains in each breath, in the order of the folds, ``(n,)``.

    Args:
        bench: of the recording.
        current: with the term, fitted to the training breaths.
        without: the same hypothesis without it, at the same noise.
    """
    gains = [bench.judged(current) - bench.judged(without)]
    for training, judging in bench.folds:
        fold = replace(bench, training=training, judging=judging, folds=())
        new, old = (_again(fold, one, training) for one in (current, without))
        gains.append(fold.judged(new) - fold.judged(old))
    return np.concatenate(gains)


def _again(fold: Bench, solved: Solved, training: Side) -> Solved:
    """The same hypothesis fitted to other breaths, from where it was."""
    values, names = fold.carried(solved, training), training.simulator.names
    start = {path: values[:, k] for k, path in enumerate(names) if path != START}
    return fold.solve(solved.hypothesis, solved.noise, start=start)
