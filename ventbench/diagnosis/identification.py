"""Identification of a model from breaths: a conclusion with its final fit."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ventbench.base.arrays import Bools, Floats, Ints
from ventbench.base.interval import Interval
from ventbench.diagnosis import estimates
from ventbench.diagnosis.conclusion import Conclusion, conclude, drop_mechanism
from ventbench.diagnosis.evaluator import Evaluator, make_evaluator
from ventbench.diagnosis.hypothesis import (
    FittedModel,
    Partition,
    all_parameter_paths,
    varies_by_breath,
)
from ventbench.diagnosis.settings import DEFAULT, SelectionConfig
from ventbench.diagnosis.validation import excludes_neutral
from ventbench.physics.catalogue import mechanism
from ventbench.system_id import START, Fit, likely_places
from ventbench.system_id.data import Data
from ventbench.system_id.levenberg_marquardt import minimise
from ventbench.system_id.problem import make_problem, parameter_of
from ventbench.task.interfaces import Plant


@dataclass(frozen=True, eq=False)
class IdentifiedModel:
    """A model identified from breaths, with the final fit."""

    evaluator: Evaluator  #: evaluator of the breaths.
    conclusion: Conclusion  #: base model, mechanisms and nonparametric term that the breaths need.
    fit: FittedModel  #: final fit of the conclusion, which reports show.
    final: Partition  #: breaths of the final fit, with a predictor of the conclusion's parameters.

    def pressures(self, fitted: FittedModel, data: Data, first: Floats | None = None) -> Floats:
        """Open-loop pressures of a model for the commands of n breaths, cmH2O, ``(n, T)``.

        Args:
            fitted: a model that was fitted with this evaluator.
            data: any breaths of its lungs.
            first: pressures that the breaths start from, cmH2O, ``(n,)``; their first readings if
                None.
        """
        return self.evaluator.predict(fitted, self.evaluator.partition(data), first)[:, 0]

    def sensitivities(self, data: Data) -> tuple[Floats, Floats]:
        """Of breaths of the model's lungs; see :meth:`Evaluator.sensitivities`."""
        partition = self.evaluator.partition(data)
        return self.evaluator.sensitivities(self.conclusion.full, partition)

    def effort_spread(self, data: Data) -> Floats:
        """Standard deviation of the pressures of breaths to come, as efforts differ, cmH2O.

        ``(n, T)``, or a zero that stands for all where there is no effort.
        """
        evaluator, model = self.evaluator, self.conclusion.full
        partition = evaluator.partition(data)
        values = evaluator.transferred_values(model, partition)
        return evaluator.breath_term(model).spread(model, partition.predictor, values)[:, 0]

    def plants(self) -> dict[str, Plant]:
        """The identified plant of each lung, by label; it answers as :meth:`pressures` does."""
        return estimates.plants_of(self.conclusion.full, self.evaluator)


def identify(
    data: Data,
    held: Bools,
    excluded: tuple[str, ...],
    tell: Callable[[str], None],
    settings: SelectionConfig = DEFAULT,
    fitted: Bools | None = None,
    also: Sequence[str] = (),
) -> IdentifiedModel:
    """Find the mechanisms that breaths need, and fit them.

    Args:
        data: n breaths.
        held: which of them test the terms, ``(n,)``.
        excluded: mechanisms that cannot act.
        tell: receives the current step, in words.
        settings: every threshold.
        fitted: which breaths the final fit may use, ``(n,)``; all but the testing ones if None.
        also: names of mechanisms that are tried in any case.
    """
    names = all_parameter_paths(settings, excluded)
    evaluator = make_evaluator(data, held, names, excluded, settings)
    # Breaths that judge are in no search, though they test: few breaths have both uses.
    chosen = ~held if fitted is None else fitted
    searched = evaluator.partition(data.select(chosen))
    conclusion = conclude(evaluator, searched, tell, also)
    # Gains that differ between breaths are parameters of each breath, unknown of held-out ones.
    evaluator = replace(evaluator, gain_sd=conclusion.gain_sd, white=conclusion.white)
    while True:
        has_term = conclusion.unnamed is not None and conclusion.unnamed.term is not None
        # A nonparametric term is fitted to the training breaths alone, to save time.
        final = evaluator.training if has_term else evaluator.partition(data.select(chosen))
        fit = estimates.final_fit(conclusion.full, final, evaluator)
        vague = [name for name in conclusion.names if not _is_definite(fit, name)]
        if not vague:
            return IdentifiedModel(evaluator, _with_changes_of(conclusion, fit), fit, final)
        # The least needed one first: the intervals of others may shrink once it has gone.
        name = min(vague, key=lambda name: conclusion.held_out_gains.get(name, 0.0))
        conclusion = drop_mechanism(conclusion, name, evaluator)


def _with_changes_of(conclusion: Conclusion, fit: Fit) -> Conclusion:
    """The conclusion with each change between the breaths where the final fit has it.

    Between two training breaths there may be several others, of which some come before a change.
    """
    full, named = conclusion.full, conclusion.named
    layout, x = full.problem.unknowns, full.minimum.x.copy()
    for path in layout.paths:
        if parameter_of(path).change_point and path in fit.problem.unknowns.paths:
            x[layout.of(path)] = fit.value(path)
    if np.array_equal(x, full.minimum.x):
        return conclusion
    changed = replace(full, minimum=replace(full.minimum, x=x))
    return replace(conclusion, full=changed, named=changed if named is full else named)


def place_of_change(evaluator: Evaluator, fitted: FittedModel, data: Data, path: str) -> Interval:
    """Where a change is by all breaths of a recording, 0..1, with the rest as fitted.

    A fit leaves some breaths out, and the first affected one may be among them: a judging breath
    or, beside a nonparametric term, a testing one. Starts are fitted on either side of the change;
    gains of single breaths are as usual, since they would make up for a wrong place.
    """
    partition = evaluator.partition(data)
    fixed = evaluator.transferred(fitted, partition)
    starts, parameter = [], parameter_of(path)
    for place in (parameter.high, parameter.low):  # all breaths before, and after
        fixed[path] = np.full(len(data), place)
        side = make_problem(partition, (START,), fitted.noise, fixed)
        bounds = side.unknowns.bounds()
        starts.append(minimise(side.cost, side.normal, side.start({}), *bounds).x)
    places, costs = side.change_costs(starts[0], path, after=starts[1])
    return likely_places(places, costs, float(places[np.argmin(costs)]))


def first_after(place: Interval, position: Floats, ids: Ints) -> tuple[int, int, int]:
    """First breath after a change, with the first and the last that it may be.

    Breaths that judge, or that were left out, are not seen: a change beside one may have come
    before or after it.

    Args:
        place: of the change, 0..1.
        position: of the n breaths that are seen, in rising order, ``(n,)``.
        ids: their ids, ``(n,)``.
    """
    low, now, high = np.searchsorted(position, (place.low, place.value, place.high))
    last = len(ids) - 1
    earliest = int(ids[low - 1]) + 1 if low else int(ids[0])
    return int(ids[min(now, last)]), earliest, int(ids[min(high, last)])


def _is_definite(fit: Fit, name: str) -> bool:
    """Whether the interval of a mechanism's strength excludes that it is off."""
    strength = mechanism(name).description.strength
    if varies_by_breath(name) or f"{name}.{strength.name}" not in fit.problem.unknowns.paths:
        return True
    return excludes_neutral(estimates.parameter_estimates(fit, name)[strength.name], name)
