"""Score of controllers as the protocol has it, without a submission or a sandbox."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from ventbench import precision, protocol, rollouts
from ventbench.board.replay import spread
from ventbench.interfaces import Controller
from ventbench.metrics import safety
from ventbench.metrics.waveform import run_error
from ventbench.plants import frozen
from ventbench.plants.stacking import take
from ventbench.submissions.scoring import protocol_cells

#: Published draws.
DRAWS = 20


def measure(
    simulators: frozen.Frozen,
    controllers: Sequence[Controller],
    pips: Sequence[float] = protocol.PIPS,
    draws: int = DRAWS,
) -> tuple[NDArray[np.float64], float, bool]:
    """Score pure controllers.

    Args:
        simulators: six lungs.
        controllers: one a lung.
        pips: cmH2O, length P.
        draws: published draws to score on as well.

    Returns:
        Errors, cmH2O, ``(6, 1 + draws, P)``, the nominal ones first; the exploitation index,
        cmH2O; whether all runs were safe.
    """
    errors, requested, safe = [], [], True
    with precision.float64():
        cells = jax.tree.map(jnp.asarray, protocol_cells(tuple(pips), draws))
        pip, dt = np.asarray(cells.pip)[..., None], np.asarray(cells.dt)[..., None]
        for index, controller in enumerate(controllers):
            plant = jax.tree.map(jnp.asarray, take(simulators.plants, index))
            wide = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), controller)
            found, _ = rollouts.closed_loop(plant, wide, cells)
            errors.append(run_error(found.pressure, pip[..., None]))
            requested.append(np.asarray(found.requested))
            safe &= bool(np.all(safety.safe(found.pressure, pip, dt)))
    nominal = np.stack(requested)[None][:, :, 0]
    return np.stack(errors), float(spread(simulators, tuple(pips), nominal).mean()), safe
