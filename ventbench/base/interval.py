"""A value with its 95 % interval, wherever one is estimated."""

from __future__ import annotations

import math
from dataclasses import dataclass

#: Where ends are zero to this, replays on other machines round differently.
ROUNDING = 1e-9


@dataclass(frozen=True)
class Interval:
    """A value with the ends of its 95 % interval, all in one unit; NaN where there is none."""

    value: float
    low: float = math.nan
    high: float = math.nan

    @property
    def clear(self) -> bool:
        """Whether zero is outside, by more than rounding."""
        return self.low > ROUNDING or self.high < -ROUNDING

    def __str__(self) -> str:
        if math.isnan(self.value):
            return "–"
        if math.isnan(self.low):
            return f"{self.value:.4g}"
        return f"{self.value:.4g} ({self.low:.4g} to {self.high:.4g})"
