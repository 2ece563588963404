"""Types of arrays that stand everywhere, and runs of a mask.

Each field and argument says its shape and unit.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]


def runs(mask: Bools) -> list[tuple[int, int]]:
    """Starts and ends of the runs of True in a mask ``(n,)``; a run ends before its end."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(int)))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))
