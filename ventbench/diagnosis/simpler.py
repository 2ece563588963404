"""One shape instead of many names.

What the library has no name for can be imitated by a sum of names, each of which the breaths
believe. If one element of a slot does better alone, the sum is an imitation.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

from ventbench.diagnosis import places
from ventbench.diagnosis.bench import Bench
from ventbench.diagnosis.beside import PROMISING
from ventbench.diagnosis.hypothesis import Hypothesis
from ventbench.diagnosis.solved import Solved
from ventbench.diagnosis.steps import Rival, settle, step

#: Names from which a sum may be an imitation.
_MANY = 3


class OneShape:
    """The best shape alone, found when it is first asked for."""

    def __init__(self, bench: Bench, wider: Callable[[], Bench], null: Solved) -> None:
        """Remember what to look at.

        Args:
            bench: with the library's parameters.
            wider: gives the same bench with those of all slots too.
            null: nothing but R, C, R_ex and PEEP, settled.
        """
        self._bench, self._wider, self._null = bench, wider, null

    def __call__(self, named: Solved) -> Solved | None:
        """What is left of many names if one shape does better alone; else None."""
        if len(named.names) < _MANY or self._best is None:
            return None
        wide, shape = self._wider(), self._best.solved
        if wide.criterion(shape) > self._bench.criterion(named):
            return None
        if wide.judged(shape).sum() < self._bench.judged(named).sum():
            return None
        kin = places.holds(self._best.name)
        kept = tuple(name for name in named.names if name in kin)
        if not kept:
            return self._null
        return settle(self._bench, named.hypothesis.without(*set(named.names) - set(kept)), named)

    @cached_property
    def _best(self) -> Rival | None:
        wide = self._wider()
        here = wide.solve(Hypothesis(), self._null.noise, self._null, iterations=3)
        found = step(wide, here, places.scan(here)[:PROMISING])
        if found is None:
            return None
        best = found.rivals[0]
        return Rival(best.name, settle(wide, best.solved.hypothesis, best.solved), best.criterion)
