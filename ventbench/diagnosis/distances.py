"""Open-loop distances on held-out breaths, whole and in parts."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ventbench.diagnosis.result import Distance, Distances
from ventbench.recordings.breaths import Breaths
from ventbench.system_id.data import Floats

#: Length of what is told as the beginning of a breath, s.
_BEGINNING = 0.2


def distance(recorded: Floats, simulated: Floats, mask: NDArray[np.bool_]) -> Distance:
    """Distance over the samples of a mask, all ``(n, T)``; NaN if there is none."""
    error = (simulated - recorded)[mask & np.isfinite(recorded) & np.isfinite(simulated)]
    if error.size == 0:
        return Distance(float("nan"), float("nan"))
    return Distance(float(np.mean(np.abs(error))), float(np.sqrt(np.mean(error**2))))


def distances(
    breaths: Breaths, held: NDArray[np.bool_], answers: dict[str, Floats], floor: float
) -> Distances:
    """All distances of a diagnosis.

    Args:
        breaths: n recorded breaths of T samples.
        held: which of them no fit has seen, ``(n,)``.
        answers: pressures ``before``, ``refit`` and ``after``, ``(n, T)``.
        floor: standard deviation of the noise, cmH2O.
    """
    # The first sample is where every simulation starts.
    inspiration = breaths.inspiratory & (breaths.time > 0) & held[:, None]

    def all_of(mask: NDArray[np.bool_]) -> dict[str, Distance]:
        return {key: distance(breaths.pressure, x, mask) for key, x in answers.items()}

    whole = all_of(inspiration)
    parts = {
        f"first {_BEGINNING:g} s of inspiration": inspiration & (breaths.time <= _BEGINNING),
        "rest of inspiration": inspiration & (breaths.time > _BEGINNING),
        "expiration": (breaths.u_out == 1) & breaths.valid & held[:, None],
    }
    lungs = breaths.by_lung_index
    if len(lungs) > 1:
        for name, index in lungs.items():
            here = np.zeros(len(breaths), bool)
            here[index] = True
            parts[f"lung {name}"] = inspiration & here[:, None]
    ids = tuple(int(i) for i in breaths.breath_id[held])
    groups = {name: all_of(mask) for name, mask in parts.items() if mask.any()}
    return Distances(ids, whole["before"], whole["refit"], whole["after"], floor, groups)
