"""Exchange of a pair of terms for one mechanism or for two others.

A search that adds one term at a time may take two that together imitate one, or two others, and no
exchange of a single term leads back.
"""

from __future__ import annotations

from functools import partial
from itertools import combinations, product
from typing import Any

from ventbench.base.executor import parallel_map
from ventbench.diagnosis.evaluator import Evaluator
from ventbench.diagnosis.hypothesis import FittedModel, Hypothesis, varies_by_breath
from ventbench.diagnosis.selection.acceptance import is_plausible, passes_heldout_test
from ventbench.diagnosis.selection.candidate_comparison import (
    cost_at,
    cost_of,
    fit_to_all,
    fit_with_noise,
    hopeless_above,
)
from ventbench.diagnosis.selection.shape_parameters import (
    fit_with_shape,
    shape_starts,
    shapes_at_default,
)
from ventbench.physics.catalogue import mechanism


def replace_pair(evaluator: Evaluator, current: FittedModel) -> FittedModel | None:
    """One mechanism, or two others, in the place of two, if the criterion prefers it; else None.

    Where the right mechanism loses a round narrowly, the one that is taken and a second one may
    imitate it together, and neither can be exchanged alone: a circuit's compliance with a late
    expiratory valve for gas that has inertia, or a slow sensor with such gas for both. Mechanisms
    that are confusable with either are fitted in their place, alone and by twos, from the values of
    the full fit, and held-out breaths must not object. So is each of the two by itself, with its
    shape free or from its grid: a valve with a second lag instead of a circuit behind a valve with
    one, or an inertance with more tubing before it.
    """
    small, first = evaluator.for_ranking, evaluator.restricted(current)
    names = [name for name in current.names if not varies_by_breath(name)]
    settings = evaluator.settings
    pairs = list(combinations(names, 2))
    work = [
        (current.hypothesis.without(*pair), name, start)
        for pair in pairs
        for name in _rivals(evaluator, current, pair)
        for start in _grid_starts(name)
    ]
    alone = [
        (current.hypothesis.without(*pair), dropped, form, start)
        for pair in pairs
        for dropped, kept in (pair, pair[::-1])
        for form, start in _other_forms(first, kept)
    ]
    if not work and not alone:
        return None

    reached, limits = cost_at(first, current.noise), {}
    for pair in pairs:
        rest = current.hypothesis.without(*pair)
        without = small.fit(rest, current.noise, first, tolerance=settings.fit.quick_tolerance)
        limits[rest] = hopeless_above(cost_of(without), reached, settings.forward)

    def begun(job: tuple[Hypothesis, str, dict[str, float]]) -> FittedModel:
        """A few steps of a rival's fit."""
        rest, name, start = job
        return _begun(small, rest.plus(Hypothesis((name,))), first, start)

    def begun_alone(job: tuple[Hypothesis, str, Hypothesis, dict[str, Any]]) -> FittedModel:
        _, dropped, form, start = job
        return _begun(small, current.hypothesis.without(dropped).plus(form), first, start)

    def freest(model: FittedModel) -> FittedModel:
        for path in (path for name in model.names for path in shapes_at_default(model, name)):
            freer = fit_with_shape(small, model, path, current.noise)
            if small.criterion(freer) < small.criterion(model):
                model = freer
        return model

    limit = small.criterion(first) + settings.forward.contender_criterion
    singles = list(zip(work, parallel_map(begun, work), strict=True))
    rivals = [model for (rest, *_), model in singles if cost_of(model) < limits[rest]]
    joined = [
        model for rest in limits for model in _joined_rivals(small, rest, singles, limits[rest])
    ]
    formed = [
        model
        for (rest, *_), model in zip(alone, parallel_map(begun_alone, alone), strict=True)
        if cost_of(model) < limits[rest]
    ]
    count = settings.forward.exchanged_pairs
    best_twos = sorted(joined, key=cost_of)[:count] + sorted(formed, key=cost_of)[:count]
    ended = parallel_map(
        lambda model: small.fit(model.hypothesis, current.noise, model), [*rivals, *best_twos]
    )
    close = [model for model in ended[: len(rivals)] if small.criterion(model) < limit]
    # Two rivals may need a shape before they come close: a valve that opens slowly, and a circuit.
    far = limit + settings.forward.large_gain
    shaped = [model for model in ended[len(rivals) :] if small.criterion(model) < far]
    freer = parallel_map(freest, close + shaped)
    close = [model for model in freer if small.criterion(model) < limit]
    models = parallel_map(partial(fit_to_all, evaluator, warm_start=current), close)
    criterion = evaluator.criterion(current)
    best = min(models, key=evaluator.criterion, default=None)
    if best is None or evaluator.criterion(best) >= criterion:
        return None
    already_small = {
        name for name in names if not is_plausible(current, name, settings.plausibility)
    }
    if not all(
        is_plausible(best, name, settings.plausibility)
        for name in best.names
        if name not in already_small
    ):
        return None
    held_out = evaluator.held_out_log_likelihood(current)
    lost = held_out - evaluator.held_out_log_likelihood(best)
    if passes_heldout_test(lost, settings.held_out_test):
        return None
    return fit_with_noise(evaluator, best.hypothesis, best)


def _begun(
    small: Evaluator, hypothesis: Hypothesis, first: FittedModel, start: dict[str, Any]
) -> FittedModel:
    """A few steps of a fit."""
    steps = small.settings.fit.start_iterations
    return small.fit(hypothesis, first.noise, first, start, iterations=steps, delay_rounds=0)


def _joined_rivals(
    small: Evaluator,
    rest: Hypothesis,
    singles: list[tuple[tuple[Hypothesis, str, dict[str, float]], FittedModel]],
    limit: float,
) -> list[FittedModel]:
    """The best two rivals together in the place of a pair, after a few steps.

    Args:
        small: evaluator of the breaths that rank candidates.
        rest: hypothesis without the pair.
        singles: single rivals after a few steps, with their starts.
        limit: cost above which no further step can make two rivals win.
    """
    best: dict[str, tuple[dict[str, float], FittedModel]] = {}
    for (other, name, start), model in singles:
        if other == rest and (name not in best or cost_of(model) < cost_of(best[name][1])):
            best[name] = start, model
    order = sorted(best, key=lambda name: cost_of(best[name][1]))
    count = small.settings.forward.exchanged_firsts
    work = [
        (best[first][1], added, best[second][0] | start)
        for k, first in enumerate(order[:count])
        for second in order[k + 1 :]
        for added, start in _forms(second)
    ]

    def begun(job: tuple[FittedModel, Hypothesis, dict[str, float]]) -> FittedModel:
        first, added, start = job
        return _begun(small, rest.plus(first.hypothesis).plus(added), first, start)

    models = parallel_map(begun, work)
    near = sorted((model for model in models if cost_of(model) < limit), key=cost_of)
    return near[: small.settings.forward.exchanged_twos]


def _forms(name: str) -> list[tuple[Hypothesis, dict[str, float]]]:
    """A mechanism in its usual form and in the others of its grids: a valve that opens slowly."""
    usual = Hypothesis((name,))
    shapes = [p for p in mechanism(name).description.parameters if p.shape and not p.discrete]
    return [(usual, {})] + [
        (Hypothesis((name,), (path,)), {path: value})
        for about in shapes
        for path in [f"{name}.{about.name}"]
        for value in about.grid
        if value != about.neutral
    ]


def _other_forms(current: FittedModel, name: str) -> list[tuple[Hypothesis, dict[str, Any]]]:
    """A selected mechanism with a shape free, or from other settings of its grids."""
    own = Hypothesis((name,))
    shaped = [
        (Hypothesis((name,), (path,)), start)
        for path in shapes_at_default(current, name)
        for start in shape_starts(current, path)
    ]
    return shaped + [(own, start) for start in _grid_starts(name) if start]


def _rivals(evaluator: Evaluator, current: FittedModel, pair: tuple[str, ...]) -> list[str]:
    """Mechanisms that are confusable with one of a pair, and are not selected."""
    listed = {name for own in pair for name in mechanism(own).description.confusable}
    return [
        name
        for name in evaluator.allowed_mechanisms
        if name not in current.names
        and not varies_by_breath(name)
        and (name in listed or set(mechanism(name).description.confusable) & set(pair))
    ]


def _grid_starts(name: str) -> list[dict[str, float]]:
    """Starts of a fit: the settings of the parameters that change a mechanism's effect much."""
    grids = {
        f"{name}.{about.name}": about.grid
        for about in mechanism(name).description.parameters
        if about.grid and not about.shape
    }
    return [dict(zip(grids, setting, strict=True)) for setting in product(*grids.values())]
