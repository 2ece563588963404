"""What a replay needs, and what it gives."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


class Simulators(Protocol):
    """What :func:`ventbench.plants.frozen.load` returns.

    Attributes:
        plants: stacked over the lungs.
        ensemble: the plants of every seed, stacked over members, then lungs.
    """

    @property
    def plants(self) -> Any:
        """See the class."""
        ...

    @property
    def ensemble(self) -> Any:
        """See the class."""
        ...

    def about(self) -> Mapping[str, Any]:
        """Version and hashes, as they go into a record."""
        ...


@dataclass(frozen=True)
class Replayed:
    """What the commands of one record give; L lungs, P PIPs, K draws.

    Attributes:
        nominal: error of the nominal runs, cmH2O, shape ``(L, P)``.
        drawn: error of the drawn runs, cmH2O, shape ``(K, L, P)``.
        safe: whether all runs of a lung pass the safety gate, shape ``(L,)``.
        peak: highest pressure of each run, nominal ones first, cmH2O, shape ``(1 + K, L, P)``.
        steps_above: longest time above the safety limit of each run, steps, likewise.
        below: commands below 0 %, nominal and drawn, shape ``(L,)``.
        above: commands above 100 %, likewise.
        spread: see :func:`spread`, cmH2O, shape ``(L, P)``.
        pressure: nominal inspiration of :data:`TRACE_BREATH`, cmH2O, shape ``(L, P, S)``.
        u_in: likewise, as applied, %.
    """

    nominal: Floats
    drawn: Floats
    safe: NDArray[np.bool_]
    peak: Floats
    steps_above: NDArray[np.int64]
    below: NDArray[np.int64]
    above: NDArray[np.int64]
    spread: Floats
    pressure: Floats
    u_in: Floats
