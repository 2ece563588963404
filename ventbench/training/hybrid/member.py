"""One member of the ensemble: both stages of the fit, on all recordings but one fold."""

from __future__ import annotations

from collections.abc import Callable

import flax.struct
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from ventbench.plants.hybrid import Hybrid
from ventbench.plants.sessions import Sessions
from ventbench.recordings import Breaths, join
from ventbench.training.hybrid.data import Inspirations, groups_of_sessions, inspirations
from ventbench.training.hybrid.expiration import WholeBreaths, fit_expiration, whole_breaths
from ventbench.training.hybrid.fit import Recipe, fit
from ventbench.training.hybrid.parameters import Pooled, plants


@flax.struct.dataclass
class TrainingSet:
    """Recordings arranged once for all members, so that all share one compilation.

    Attributes:
        inspirations: of the measured, then of the reconstructed breaths.
        whole: the measured breaths.
        weight: of each inspiration, ``(n,)``.
        fold: of each inspiration, -1 for a reconstructed one, ``(n,)``.
    """

    inspirations: Inspirations
    whole: WholeBreaths
    weight: Array
    fold: Array


def training_set(
    measured: Breaths,
    reconstructed: Breaths,
    fold: NDArray[np.int64],
    sessions: Sessions,
    recipe: Recipe,
) -> TrainingSet:
    """Arrange recordings; call it within :func:`ventbench.precision.float64`.

    Args:
        measured: m breaths.
        reconstructed: breaths that every member may see; their weight is the recipe's.
        fold: of each measured breath, shape ``(m,)``.
        sessions: by whose clocks breaths belong together.
        recipe: gives the weights.

    Raises:
        InputError: as :func:`~ventbench.training.hybrid.data.inspirations`.
    """
    breaths = join([measured, reconstructed])
    weight = np.append(np.ones(len(measured)), np.full(len(reconstructed), recipe.reconstructed))
    return TrainingSet(
        inspirations(breaths, sessions),
        whole_breaths(measured, sessions),
        jnp.asarray(weight * np.where(breaths.R == 50.0, recipe.R50, 1.0)),
        jnp.asarray(np.append(fold, np.full(len(reconstructed), -1))),
    )


def fit_member(
    data: TrainingSet,
    held_out: int,
    recipe: Recipe,
    progress: Callable[[float], None] | None = None,
) -> Pooled:
    """Fit one member; call it within :func:`ventbench.precision.float64`.

    Args:
        data: from :func:`training_set`.
        held_out: the fold whose breaths count for nothing.
        recipe: as of ``data``.
        progress: called with the share that is done, 0..1.
    """
    weight = jnp.where(data.fold == held_out, 0.0, data.weight)

    def report(done: int, _: float) -> None:
        if progress is not None:
            progress(done / recipe.iterations)

    pooled, _ = fit(data.inspirations, weight, recipe, report)
    return fit_expiration(pooled, data.whole, weight[: data.whole.u_in.shape[0]], recipe)


def session_plants(pooled: Pooled, sessions: Sessions, recipe: Recipe) -> Hybrid:
    """Plants of all sessions, leaves ``(sessions, ...)``."""
    return plants(pooled, groups_of_sessions(sessions), directed=recipe.directed)
