"""The corrected simulator: what it answers to the recorded commands, and as a plant."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import numpy as np
from numpy.typing import NDArray

from ventbench.diagnosis import estimates, simulators
from ventbench.diagnosis.against import refitted
from ventbench.diagnosis.found import Found
from ventbench.diagnosis.hypothesis import varies_by_breath
from ventbench.diagnosis.residual_analysis import open_loop_error
from ventbench.diagnosis.simulators import Given
from ventbench.interfaces import Plant
from ventbench.plants.corrected import Corrected
from ventbench.precision import float64
from ventbench.recordings.breaths import Breaths
from ventbench.system_id.data import Floats

#: Times the refitted error beyond which a few breaths must be far off: what is mild may change less
#: than coloured noise excuses.
_FAR = 1.05


@dataclass(frozen=True, eq=False)
class Correction:
    """What is made of a simulator.

    Attributes:
        answers: pressures ``before``, ``refit`` and ``after``, cmH2O, ``(n, T)`` each.
        errs: mean absolute error of ``before`` and ``after`` on the training breaths, inspirations
            and expirations, cmH2O.
        plants: the corrected simulator of each lung, by label.
        left: whether the simulator was left as it is, as it errs more by what was found.
        notes: what the reader should know of it, a sentence each.
    """

    answers: dict[str, Floats]
    errs: tuple[float, float]
    plants: dict[str, Plant]
    left: bool = False
    notes: tuple[str, ...] = ()


def corrected(
    breaths: Breaths, held: NDArray[np.bool_], before: Floats, found: Found, had: Found | None,
    plant: Given,
) -> Correction:  # fmt: skip
    """Correct a simulator by the difference of what was found in the recording and in itself.

    One that has physics of its own and errs more by that on the breaths that were fitted is left
    as it is. Likelihoods of coloured noise excuse slow errors, which a learned simulator may not
    make; the mean error does not.

    Args:
        breaths: n recorded ones.
        held: which of them are held out, ``(n,)``.
        before: the simulator's answers, cmH2O, ``(n, T)``.
        found: in the recording.
        had: found in the simulator; None for the base model.
        plant: the simulator.
    """
    first = breaths.pressure[:, 0]  # where every simulation starts
    after = found.pressures(found.conclusion.full, held, first)
    seen = breaths.valid & (breaths.time > 0) & ~held[:, None]
    if had is None:
        refit = found.pressures(found.conclusion.base, held, first)
        answers = {"before": before, "refit": refit, "after": after}
        return _physics(breaths, found, held, answers, seen)
    # Its own physics, then the same with the recording's R, C, R_ex and PEEP.
    own = had.pressures(had.conclusion.full, held, first)
    refit = had.pressures(refitted(had, found.evaluator.training.data, found), held, first)
    answers = {"before": before, "refit": before + refit - own, "after": before + after - own}
    errs, wanted = _errs(breaths, answers, seen), found.plants()
    if left := bool(errs[1] >= errs[0]):
        answers, wanted = dict.fromkeys(answers, before), had.plants()
    return Correction(answers, errs, _beside(breaths, plant, wanted, had.plants()), left)


def _physics(
    breaths: Breaths, found: Found, held: NDArray[np.bool_], answers: dict[str, Floats],
    seen: NDArray[np.bool_],
) -> Correction:  # fmt: skip
    """The base model with all that was found, or with less if that makes it err more.

    Robust likelihoods excuse breaths that a shape throws far off; who uses the plant does not.
    Efforts of a patient are each breath's own: their mean, which is what others are expected to
    have, may be off in all of them.
    """
    least = open_loop_error(breaths.pressure, answers["refit"], seen)

    def serves(pressure: Floats) -> bool:
        errs = open_loop_error(
            breaths.pressure, pressure, seen
        )  # the square sees what few breaths hide
        return errs.mae <= _FAR * least.mae and errs.rmse <= _FAR * least.rmse

    own = any(varies_by_breath(name) for name in found.conclusion.full.names)
    if own or serves(answers["after"]):
        return Correction(answers, _errs(breaths, answers, seen), estimates.plants(found.fit))
    conclusion, kept, what = found.conclusion, found.conclusion.base, "what was found"
    if conclusion.unnamed is not None and conclusion.named.names:
        pressure = found.pressures(conclusion.named, held, breaths.pressure[:, 0])
        if serves(pressure):
            kept, what = conclusion.named, "what has no name"
            answers = answers | {"after": pressure}
    if kept is conclusion.base:
        answers = answers | {"after": answers["refit"]}
    note = (
        f"With {what} the simulator would err more on the breaths that were fitted than with R "
        "and C refitted, so the corrected simulator is without it."
    )
    plants = estimates.plants_of(kept, found.evaluator)
    return Correction(answers, _errs(breaths, answers, seen), plants, notes=(note,))


def _errs(
    breaths: Breaths, answers: dict[str, Floats], seen: NDArray[np.bool_]
) -> tuple[float, float]:
    before, after = (
        open_loop_error(breaths.pressure, answers[key], seen).mae for key in ("before", "after")
    )
    return before, after


def _beside(
    breaths: Breaths, plant: Given, wanted: dict[str, Plant], own: dict[str, Plant]
) -> dict[str, Plant]:
    """The given plant of each lung plus the difference of two physics."""
    make = simulators.plants_for(plant)
    result: dict[str, Plant] = {}
    for name, index in breaths.by_lung_index.items():
        with float64():
            stacked = make(breaths.select(index[:1]))
            one = jax.tree.map(lambda leaf: leaf[0], stacked)
        result[name] = Corrected(one, wanted[name], own[name])
    return result
