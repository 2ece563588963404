"""A conclusion about breaths, with what it was drawn from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ventbench.diagnosis import estimates
from ventbench.diagnosis.bench import Bench, bench
from ventbench.diagnosis.conclude import Conclusion, conclude
from ventbench.diagnosis.places import all_paths
from ventbench.diagnosis.solved import Side, Solved, simulator
from ventbench.interfaces import Plant
from ventbench.physics.catalogue import paths
from ventbench.system_id import Fit
from ventbench.system_id.data import Data, Floats


@dataclass(frozen=True, eq=False)
class Found:
    """A conclusion about breaths, with its final fit.

    Attributes:
        bench: of the breaths.
        conclusion: what they need.
        fit: of that to all of them.
    """

    bench: Bench
    conclusion: Conclusion
    fit: Fit

    def pressures(self, solved: Solved, held: NDArray[np.bool_], first: Floats) -> Floats:
        """Open-loop answers of a hypothesis to the commands of all n breaths, cmH2O, ``(n, T)``.

        Args:
            solved: on this bench.
            held: which breaths are held out, ``(n,)``.
            first: pressures that the answers start from, cmH2O, ``(n,)``.
        """
        pressure = np.empty((len(held), self.bench.training.data.u_in.shape[1]))
        for which, side in ((~held, self.bench.training), (held, self.bench.judging)):
            pressure[which] = self.bench.predict(solved, side, first[which])[:, 0]
        return pressure

    def plants(self) -> dict[str, Plant]:
        """What the conclusion says of each lung, by label: answers as :meth:`pressures` has."""
        return estimates.plants_of(self.conclusion.full, self.bench)


def found_in(
    data: Data, held: NDArray[np.bool_], excluded: tuple[str, ...], tell: Callable[[str], None]
) -> Found:
    """Draw a conclusion.

    Args:
        data: n breaths.
        held: which of them are held out, ``(n,)``.
        excluded: mechanisms that cannot act.
        tell: is told what is done.
    """
    narrow = bench(data, held, paths(), excluded)
    wide: list[Bench] = []

    def wider() -> Bench:
        wide.append(bench(data, held, all_paths(), excluded))
        return wide[0]

    found = conclude(narrow, wider, tell)
    # Gains that differ between breaths are each breath's own, and unknown of held-out ones.
    narrow, wide = (
        replace(narrow, spread=found.spread),
        [replace(one, spread=found.spread) for one in wide],
    )
    side = Side(data, simulator(data, paths()))
    if found.place is not None and found.place.element is not None:
        # With a slot, the training breaths alone: all of them would be one more compilation.
        return Found(wide[0], found, estimates.estimated(found.full, wide[0].training, wide[0]))
    return Found(narrow, found, estimates.estimated(found.named, side, narrow))
