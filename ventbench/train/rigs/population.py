"""The prior of a population of rigs: what they share by their lungs, and how far they scatter.

``proofs.release.population`` fits the official one with it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ventbench.base.arrays import Floats
from ventbench.plants.hybrid import LUNG, NAMES

#: Standard deviations between rigs that the data start from, of logarithms unless said, by the
#: beginning of a name; and of everything else.
SCALES = {
    "resistance": 0.1,
    "elastance": 0.08,
    "offset": 0.3,
    "stiffening": 0.1,
    "valve_size": 0.08,
    "valve_bend": 0.1,
    "direction": 0.3,
}
DEFAULT_SCALE = 0.15

#: How many sessions these scales count for, and how many count for no correlation. With fewer of
#: either the renewals of the linearisation do not settle: some curves run away. The official roles
#: say how sessions that were left out lie in what results.
PRIOR_SESSIONS, UNCORRELATED_SESSIONS = 5.0, 30.0


def design_of(lungs: Sequence[str]) -> Floats:
    """Design of rigs: own means of a lung's numbers, common means of a ventilator's.

    Shape ``(J, p, q)`` for the lungs of J rigs, in the order in which they come.
    """
    names, mine = list(dict.fromkeys(lungs)), len(LUNG)
    shared = len(NAMES) - mine
    out = np.zeros((len(lungs), len(NAMES), mine * len(names) + shared))
    for j, lung in enumerate(lungs):
        first = mine * names.index(lung)
        out[j, :mine, first : first + mine] = np.eye(mine)
        out[j, mine:, mine * len(names) :] = np.eye(shared)
    return out


def scales() -> Floats:
    """:data:`SCALES` of all numbers of a rig, shape ``(len(NAMES),)``."""

    def scale(name: str) -> float:
        return next((s for start, s in SCALES.items() if name.startswith(start)), DEFAULT_SCALE)

    return np.array([scale(name) for name in NAMES])
