"""Identification of a model from breaths: use of the breaths, and a conclusion with its final fit.

Each breath has one use, so that no question is answered by breaths that an earlier one has used up:
*training* breaths fit hypotheses, *testing* breaths decide which terms are needed, and *judging*
breaths, which no fit and no test has seen, choose the corrected simulator and measure its error.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace

import numpy as np

from ventbench.base.arrays import Bools, Floats
from ventbench.base.errors import InputError
from ventbench.diagnosis import estimates
from ventbench.diagnosis.conclusion import Conclusion, conclude, without_name, without_term
from ventbench.diagnosis.evaluator import Evaluator, make_evaluator
from ventbench.diagnosis.hypothesis import (
    FittedModel,
    Partition,
    all_parameter_paths,
    varies_by_breath,
)
from ventbench.diagnosis.settings import DEFAULT, DataSettings, SelectionConfig
from ventbench.diagnosis.validation import excludes_neutral, is_weak
from ventbench.physics.catalogue import mechanism, special_cases
from ventbench.plants.simulators import Simulators
from ventbench.recordings.breaths import Breaths
from ventbench.system_id import START, ConfidenceInterval, Fit, likely_places
from ventbench.system_id.data import Data
from ventbench.system_id.levenberg_marquardt import minimise
from ventbench.system_id.problem import make_problem, parameter_of
from ventbench.task.interfaces import Plant

#: A breath needs more inspiratory samples with a pressure than these.
_INSPIRATORY = 3

#: Breath ids that a note lists at most.
_LISTED = 5


@dataclass(frozen=True, eq=False)
class Split:
    """Use of n breaths; masks ``(n,)``."""

    testing: Bools  #: breaths that decide which terms a model needs.
    #: breaths that choose the corrected simulator and measure its error. A lung with few breaths
    #: has none to spare: its testing breaths judge as well.
    judging: Bools

    @property
    def identifying(self) -> Bools:
        """Breaths that the identification may see: training and testing breaths."""
        return ~self.judging | self.testing

    @property
    def fitted(self) -> Bools:
        """Breaths of the final fits: all but the judging ones."""
        return ~self.judging


def held_out(breaths: Breaths, settings: DataSettings = DEFAULT.data) -> Bools:
    """Every third breath (by default) of each lung, from its second on, bool, ``(n,)``."""
    chosen = np.zeros(len(breaths), bool)
    for index in breaths.by_lung_index.values():
        chosen[np.sort(index)[1 :: settings.held_out_every]] = True
    return chosen


def split(
    breaths: Breaths, settings: DataSettings = DEFAULT.data, never_fitted: Collection[int] = ()
) -> Split:
    """Assign the breaths to their uses.

    Args:
        breaths: n breaths.
        settings: how many are held out, and for what.
        never_fitted: ids of breaths that were held out when the simulator was made; they judge it.
    """
    testing, judging = held_out(breaths, settings), np.zeros(len(breaths), bool)
    earlier = np.isin(breaths.breath_id, list(never_fitted))
    for index in map(np.sort, breaths.by_lung_index.values()):
        tests, judges = testing[index], np.zeros(len(index), bool)
        if earlier[index].any() and not np.all(earlier[index] | tests):
            judges = earlier[index]
        elif len(index) >= settings.judging_from:
            judges[settings.judging_every - 1 :: settings.judging_every] = True
        else:
            judges = tests
        judging[index] = judges
        if np.any(tests & ~judges):
            testing[index] = tests & ~judges
    return Split(testing, judging)


def never_fitted(breaths: Breaths, simulators: Simulators) -> tuple[int, ...]:
    """Ids of the breaths that were held out when a simulator was made of the same recording."""
    origin = simulators.origin
    if breaths.sha256 is None or origin.get("recording_sha256") != breaths.sha256:
        return ()
    return tuple(int(breath) for breath in origin.get("held_out_breaths", ()))


def without_saturated(
    breaths: Breaths, settings: DataSettings = DEFAULT.data
) -> tuple[Breaths, tuple[float, float] | None]:
    """Breaths without the readings at which the pressure sensor saturates, and what these are.

    A saturated reading is censored: it says only that the pressure was at least that. Readings that
    merely come near a largest one thin out towards it; those that saturate pile up there. A sensor
    that saturates on one lung of a session does so on all.

    Returns:
        The breaths, and the reading, cmH2O, with its share of all readings; None if none saturates.
    """
    pressure = np.where(breaths.valid, breaths.pressure, np.nan)
    known = np.isfinite(pressure)
    top = float(np.max(pressure, initial=-np.inf, where=known))

    def piles_up(own: Floats) -> bool:
        values, counts = np.unique(own[np.isfinite(own)], return_counts=True)
        if len(values) < 2 or values[-1] < top:
            return False
        return bool(counts[-1] >= max(settings.saturated_share * counts.sum(), 10 * counts[-2]))

    if not any(piles_up(pressure[index]) for index in breaths.by_lung_index.values()):
        return breaths, None
    masked = np.where(pressure == top, np.nan, breaths.pressure)
    return replace(breaths, pressure=masked), (top, float(np.mean(pressure[known] == top)))


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
        """Change of the pressures of n breaths by what is a breath's own, cmH2O, ``(n, T)`` each.

        Args:
            data: breaths of the model's lungs.

        Returns:
            By the logarithm of the valve's gain, and by the pressure that the breath starts from.
        """
        evaluator, model = self.evaluator, self.conclusion.full
        partition = evaluator.partition(data)
        values, names = evaluator.transferred_values(model, partition), partition.predictor.names
        gain = names.index("gain")
        slopes = partition.predictor.derivatives(values, (gain, len(names)))[1][:, :, 0]
        return slopes[:, 0] * values[:, gain, None], slopes[:, 1]

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
    earlier: FittedModel | None = None,
) -> IdentifiedModel:
    """Find the mechanisms that breaths need, and fit them.

    Args:
        data: n breaths.
        held: which of them test the terms, ``(n,)``.
        excluded: mechanisms that cannot act.
        tell: receives the current step, in words.
        settings: every threshold.
        fitted: which breaths the final fit may use, ``(n,)``; all but the testing ones if None.
        earlier: mechanisms to start from too, fitted to the same lungs.
    """
    names = all_parameter_paths(settings, excluded)
    evaluator = make_evaluator(data, held, names, excluded, settings)
    # Breaths that judge are in no search, though they test: few breaths have both uses.
    chosen = ~held if fitted is None else fitted
    searched = evaluator.partition(data.select(chosen))
    conclusion = conclude(evaluator, searched, tell, earlier)
    # Gains that differ between breaths are parameters of each breath, unknown of held-out ones.
    evaluator = replace(evaluator, gain_sd=conclusion.gain_sd)
    while True:
        has_term = conclusion.unnamed is not None and conclusion.unnamed.term is not None
        # A nonparametric term is fitted to the training breaths alone, to save time.
        final = evaluator.training if has_term else evaluator.partition(data.select(chosen))
        fit = estimates.final_fit(conclusion.full, final, evaluator)
        vague = [
            name
            for name in conclusion.names
            if not _is_definite(fit, name) or _is_negligible(fit, conclusion, name, settings)
        ]
        if not vague:
            return IdentifiedModel(evaluator, _with_changes_of(conclusion, fit), fit, final)
        # The least needed one first: the intervals of others may shrink once it has gone.
        name = min(vague, key=lambda name: conclusion.held_out_gains.get(name, 0.0))
        if _is_idle_form(conclusion, name, settings):
            conclusion = without_term(conclusion)
        else:
            conclusion = without_name(conclusion, name, evaluator)


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
    moved = replace(full, minimum=replace(full.minimum, x=x))
    return replace(conclusion, full=moved, named=moved if named is full else named)


def place_of_change(
    evaluator: Evaluator, fitted: FittedModel, data: Data, path: str
) -> ConfidenceInterval:
    """Where a change is by all breaths of a recording, 0..1, with the rest as fitted.

    A fit leaves some breaths out, and the first affected one may be among them: a judging breath
    or, beside a nonparametric term, a testing one. Starts are fitted on either side of the change;
    gains of single breaths are as usual, since they would make up for a wrong place.
    """
    partition = evaluator.partition(data)
    fixed = evaluator.transferred(fitted, partition)
    starts, about = [], parameter_of(path)
    for place in (about.high, about.low):  # all breaths before, and after
        fixed[path] = np.full(len(data), place)
        side = make_problem(partition, (START,), fitted.noise, fixed)
        bounds = side.unknowns.bounds()
        starts.append(minimise(side.cost, side.normal, side.start({}), *bounds).x)
    places, costs = side.change_costs(starts[0], path, after=starts[1])
    return likely_places(places, costs, float(places[np.argmin(costs)]))


def _is_idle_form(conclusion: Conclusion, name: str, settings: SelectionConfig) -> bool:
    """Whether a nonparametric term contains a mechanism and adds little to it.

    Beside such a term, the mechanism's strength may be anything: the term can do all that it does.
    """
    unnamed = conclusion.unnamed
    if unnamed is None or unnamed.term is None or name not in special_cases(unnamed.term):
        return False
    share = settings.held_out_test.negligible_share
    return unnamed.nats < share * conclusion.held_out_gains.get(name, 0.0)


def _is_negligible(fit: Fit, conclusion: Conclusion, name: str, settings: SelectionConfig) -> bool:
    """Whether the final fit leaves a mechanism far weaker than a mild one, that explains little.

    Gas that rings has several minima; a fit to more breaths may end in that of a much smaller
    inertance than the selection weighed.
    """
    strength, limits = mechanism(name).description.strength, settings.held_out_test
    path = f"{name}.{strength.name}"
    if varies_by_breath(name) or path not in fit.problem.unknowns.paths:
        return False
    beyond, gains = fit.value(path) - strength.neutral, conclusion.held_out_gains
    little = gains.get(name, 0.0) < limits.negligible_share * sum(gains.values())
    return little and is_weak(name, beyond, limits.negligible_strength)


def _is_definite(fit: Fit, name: str) -> bool:
    """Whether the interval of a mechanism's strength excludes that it is off."""
    strength = mechanism(name).description.strength
    if varies_by_breath(name) or f"{name}.{strength.name}" not in fit.problem.unknowns.paths:
        return True
    return excludes_neutral(estimates.parameter_estimates(fit, name)[strength.name], name)
