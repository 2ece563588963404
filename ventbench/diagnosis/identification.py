"""Identification of a model from breaths: the data split, and a conclusion with its final fit."""

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
from ventbench.diagnosis.settings import DEFAULT, DataSettings, SelectionConfig
from ventbench.errors import InputError
from ventbench.interfaces import Plant
from ventbench.physics.catalogue import paths
from ventbench.recordings.breaths import Breaths
from ventbench.system_id import Fit
from ventbench.system_id.data import Data, Floats

#: A breath needs more inspiratory samples with a pressure than these.
_INSPIRATORY = 3

#: Breath ids that a note lists at most.
_LISTED = 5


def held_out(breaths: Breaths, settings: DataSettings = DEFAULT.data) -> NDArray[np.bool_]:
    """Every third breath (by default) of each lung, from its second on, bool, ``(n,)``."""
    chosen = np.zeros(len(breaths), bool)
    for index in breaths.by_lung_index.values():
        chosen[np.sort(index)[1 :: settings.held_out_every]] = True
    return chosen


def usable(breaths: Breaths, settings: DataSettings = DEFAULT.data) -> tuple[Breaths, list[str]]:
    """Breaths that can be diagnosed, and notes on the others.

    Raises:
        InputError: if too few are left, or no lung has two.
    """
    fewest, pressure = settings.min_breaths, np.isfinite(breaths.pressure)
    good = pressure[:, 0] & (np.sum(pressure & breaths.inspiratory, axis=1) > _INSPIRATORY)
    good &= np.any(breaths.u_in > 0, axis=1)
    notes = []
    if not good.all():
        ids = ", ".join(map(str, breaths.breath_id[~good][:_LISTED].tolist()))
        notes.append(
            f"{int((~good).sum())} breaths without a first pressure, inspiration or any command "
            f"were left out (breath_id {ids}...)."
        )
    if good.sum() < fewest:
        raise InputError(
            f"{int(good.sum())} usable breaths; a diagnosis needs at least {fewest} of a lung with "
            "pressures and commands"
        )
    breaths = breaths.select(good)
    if not held_out(breaths, settings).any():
        raise InputError(
            "no lung has two usable breaths, so that none can be held out; record at least "
            f"{fewest} of a lung"
        )
    return breaths, notes


@dataclass(frozen=True, eq=False)
class IdentifiedModel:
    """A model identified from breaths, with the final fit.

    Attributes:
        evaluator: evaluator of the breaths.
        conclusion: base model, mechanisms and nonparametric term that the breaths need.
        fit: final fit of the conclusion, with intervals.
    """

    evaluator: Evaluator
    conclusion: Conclusion
    fit: Fit

    def pressures(self, fitted: FittedModel, held: NDArray[np.bool_], first: Floats) -> Floats:
        """Open-loop pressures of a model for the commands of all n breaths, cmH2O, ``(n, T)``.

        Args:
            fitted: a model that was fitted with this evaluator.
            held: which breaths are held out, ``(n,)``.
            first: pressures that the breaths start from, cmH2O, ``(n,)``.
        """
        pressure = np.empty((len(held), self.evaluator.training.data.u_in.shape[1]))
        for which, partition in ((~held, self.evaluator.training), (held, self.evaluator.held_out)):
            pressure[which] = self.evaluator.predict(fitted, partition, first[which])[:, 0]
        return pressure

    def plants(self) -> dict[str, Plant]:
        """The identified plant of each lung, by label; it answers as :meth:`pressures` does."""
        return estimates.plants_of(self.conclusion.full, self.evaluator)


def identify(
    data: Data,
    held: NDArray[np.bool_],
    excluded: tuple[str, ...],
    tell: Callable[[str], None],
    settings: SelectionConfig = DEFAULT,
) -> IdentifiedModel:
    """Find the mechanisms that breaths need, and fit them.

    Args:
        data: n breaths.
        held: which of them are held out, ``(n,)``.
        excluded: mechanisms that cannot act.
        tell: receives the current step, in words.
        settings: every threshold.
    """
    narrow = make_evaluator(data, held, paths(), excluded, settings)
    wide: list[Evaluator] = []

    def widened() -> Evaluator:
        wide.append(make_evaluator(data, held, all_parameter_paths(settings), excluded, settings))
        return wide[0]

    conclusion = conclude(narrow, widened, tell)
    # Gains that differ between breaths are parameters of each breath, unknown of held-out ones.
    gain_sd = conclusion.gain_sd
    if conclusion.unnamed is not None and conclusion.unnamed.term is not None:
        # With a nonparametric term, the training breaths alone: all would be one more compilation.
        evaluator = replace(wide[0], gain_sd=gain_sd)
        fit = estimates.final_fit(conclusion.full, evaluator.training, evaluator)
        return IdentifiedModel(evaluator, conclusion, fit)
    evaluator = replace(narrow, gain_sd=gain_sd)
    everything = make_partition(data, paths(), settings)
    fit = estimates.final_fit(conclusion.named, everything, evaluator)
    return IdentifiedModel(evaluator, conclusion, fit)
