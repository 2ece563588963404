"""Questions of a challenge: their kinds, a case of one, and the noise that all sensors have."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hardware_eval.emulation.cases import Case

Kind = Literal["single", "null", "pair", "four", "outside", "form", "masked"]


@dataclass(frozen=True)
class DrawnCase:
    """A case and the kind of question that it belongs to."""

    kind: Kind
    case: Case


def coloured_noise(
    case: Case, correlation: float, rng: np.random.Generator, shape: tuple[int, ...]
) -> NDArray[np.float64]:
    """Noise of a sensor, cmH2O: white, and a share that is correlated from sample to sample."""
    white, slow = rng.standard_normal(shape), rng.standard_normal(shape)
    for k in range(1, shape[1]):
        slow[:, k] *= np.sqrt(1.0 - correlation**2)
        slow[:, k] += correlation * slow[:, k - 1]
    return case.noise * (np.sqrt(1.0 - case.coloured) * white + np.sqrt(case.coloured) * slow)
