"""A conclusion about breaths, with what it was drawn from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ventbench.diagnosis import estimates
from ventbench.diagnosis.conclusion import Conclusion, conclude
from ventbench.diagnosis.evaluator import Evaluator, make_evaluator
from ventbench.diagnosis.hypothesis import FittedModel, make_partition
from ventbench.diagnosis.screening import all_parameter_paths
from ventbench.diagnosis.settings import DEFAULT, SelectionConfig
from ventbench.interfaces import Plant
from ventbench.physics.catalogue import paths
from ventbench.system_id import Fit
from ventbench.system_id.data import Data, Floats


@dataclass(frozen=True, eq=False)
class Found:
    """A conclusion about breaths, with its final fit.

    Attributes:
        evaluator: of the breaths.
        conclusion: what they need.
        fit: of that to all of them.
    """

    evaluator: Evaluator
    conclusion: Conclusion
    fit: Fit

    def pressures(self, fitted: FittedModel, held: NDArray[np.bool_], first: Floats) -> Floats:
        """Open-loop answers of a hypothesis to the commands of all n breaths, cmH2O, ``(n, T)``.

        Args:
            fitted: on this bench.
            held: which breaths are held out, ``(n,)``.
            first: pressures that the answers start from, cmH2O, ``(n,)``.
        """
        pressure = np.empty((len(held), self.evaluator.training.data.u_in.shape[1]))
        for which, partition in ((~held, self.evaluator.training), (held, self.evaluator.held_out)):
            pressure[which] = self.evaluator.predict(fitted, partition, first[which])[:, 0]
        return pressure

    def plants(self) -> dict[str, Plant]:
        """What the conclusion says of each lung, by label: answers as :meth:`pressures` has."""
        return estimates.plants_of(self.conclusion.full, self.evaluator)


def found_in(
    data: Data,
    held: NDArray[np.bool_],
    excluded: tuple[str, ...],
    tell: Callable[[str], None],
    settings: SelectionConfig = DEFAULT,
) -> Found:
    """Draw a conclusion.

    Args:
        data: n breaths.
        held: which of them are held out, ``(n,)``.
        excluded: mechanisms that cannot act.
        tell: is told what is done.
        settings: every threshold.
    """
    narrow = make_evaluator(data, held, paths(), excluded, settings)
    wide: list[Evaluator] = []

    def wider() -> Evaluator:
        wide.append(make_evaluator(data, held, all_parameter_paths(settings), excluded, settings))
        return wide[0]

    found = conclude(narrow, wider, tell)
    # Gains that differ between breaths are each breath's own, and unknown of held-out ones.
    narrow, wide = (
        replace(narrow, gain_sd=found.gain_sd),
        [replace(one, gain_sd=found.gain_sd) for one in wide],
    )
    partition = make_partition(data, paths(), settings)
    if found.unnamed is not None and found.unnamed.term is not None:
        # With a slot, the training breaths alone: all of them would be one more compilation.
        return Found(wide[0], found, estimates.estimated(found.full, wide[0].training, wide[0]))
    return Found(narrow, found, estimates.estimated(found.named, partition, narrow))
