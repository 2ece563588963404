"""Which breaths are held out, and which can be used at all."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ventbench.errors import InputError
from ventbench.recordings.breaths import Breaths

#: Fewest breaths that can be split, and every how many-th is held out.
FEWEST, EVERY = 4, 3


def held_out(breaths: Breaths) -> NDArray[np.bool_]:
    """Every third breath of each lung, from its second on, bool, ``(n,)``."""
    found = np.zeros(len(breaths), bool)
    for index in breaths.by_lung_index.values():
        found[np.sort(index)[1::EVERY]] = True
    return found


def usable(breaths: Breaths) -> tuple[Breaths, list[str]]:
    """Breaths that can be diagnosed, and what to say of the others.

    Raises:
        InputError: if fewer than four are left, or no lung has two.
    """
    pressure = np.isfinite(breaths.pressure)
    good = pressure[:, 0] & (np.sum(pressure & breaths.inspiratory, axis=1) > 3)
    good &= np.any(breaths.u_in > 0, axis=1)
    notes = []
    if not good.all():
        ids = ", ".join(map(str, breaths.breath_id[~good][:5].tolist()))
        notes.append(
            f"{int((~good).sum())} breaths without a first pressure, inspiration or any command "
            f"were left out (breath_id {ids}...)."
        )
    if good.sum() < FEWEST:
        raise InputError(
            f"{int(good.sum())} usable breaths; a diagnosis needs at least {FEWEST} of a lung with "
            "pressures and commands"
        )
    breaths = breaths.select(good)
    if not held_out(breaths).any():
        raise InputError(
            "no lung has two usable breaths, so that none can be held out; record at least "
            f"{FEWEST} of a lung"
        )
    return breaths, notes
