"""A plain forward search over the library: BIC, one held-out check, no places, shapes fixed.

What anyone would write first with the same library and the same fits. The weights of rivals are
those of BIC, flattened, since the forms of the library are not those of the rig.
"""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from proofs.diagnosers.common import candidates, intervals, see
from ventbench.physics.catalogue import library, parameter, paths
from ventbench.system_id import Data, Fit, Predictor, fit

#: Most terms; nats that held-out breaths must gain by a term; the odds 100 to one.
_MOST, _NATS = 4, 4.6

#: Steps of a fit that only has to be ranked, and candidates of a round that are fitted to the end.
_QUICK, _BEST = 4, 3

#: Weight of a difference of BIC, and share of what no candidate is.
_FLATTENED, _UNKNOWN = 0.05, 0.05

#: What breaths have of their own, of which several values may be likely.
_EFFORTS = ("patient_effort.amplitude", "patient_effort.onset")


def diagnose(folder: Path) -> dict[str, Any]:
    """Answer a case."""
    seen = see(folder)
    data = seen.observed
    testing = np.arange(len(data)) % 3 == 2
    train, test = data.select(~testing), data.select(testing)
    predictor = Predictor(train, paths(tuple(library())))

    def fitted(names: tuple[str, ...], iterations: int = 40) -> Fit:
        return fitted_to(train, names, predictor=predictor, iterations=iterations)

    best = fitted(())
    rivals: dict[tuple[str, ...], float] = {(): _bic(best)}
    held = _held_out(best, test)
    while len(best.names) < _MOST:
        left = [name for name in (*candidates(), "patient_effort") if name not in best.names]
        ranked = sorted((fitted((*best.names, name), _QUICK) for name in left), key=_bic)
        finished = sorted((fitted(each.names) for each in ranked[:_BEST]), key=_bic)
        gained = _held_out(finished[0], test) - held
        if _bic(finished[0]) >= _bic(best) or gained < _NATS:
            break
        best, held = finished[0], held + gained
        rivals |= {each.names: _bic(each) for each in finished}
    weights = {names: np.exp(-_FLATTENED * (bic - _bic(best))) for names, bic in rivals.items()}
    total = sum(weights.values())
    hypotheses = [
        {"terms": sorted(names), "probability": (1.0 - _UNKNOWN) * weight / total}
        for names, weight in weights.items()
    ]
    places = seen.question["vocabulary"]["places"]
    hypotheses += [
        {"terms": [f"unknown:{place}"], "probability": _UNKNOWN / len(places)} for place in places
    ]
    final = fitted_to(data, best.names)
    known = seen.question["vocabulary"]["names"]
    own = [f"{name}.{key}" for name in best.names for key in known[name]["parameters"]]
    free = [path for path in ("R", "C", *own) if path in final.problem.unknowns.paths]
    return {
        "hypotheses": hypotheses,
        "pressures": seen.pressures(seen.predict(final)),
        "parameters": intervals(final, free),
    }


def fitted_to(data: Data, names: tuple[str, ...], **given: Any) -> Fit:
    """Fit; the fit continues from where each breath is likeliest with another effort of its own."""
    found = fit(data, names, **given)
    layout, trials = found.problem.unknowns, [found.minimum.x]
    own = [path for path in _EFFORTS if path in layout.paths]
    if not own:
        return found
    for values in product(*(parameter(path).scan for path in own)):
        trials.append(found.minimum.x.copy())
        for path, value in zip(own, values, strict=True):
            trials[-1][layout.of(path)] = value
    likeliest = np.argmax([found.problem.log_likelihood(trial) for trial in trials], axis=0)
    start = {path: found.column(path) for path in layout.paths}
    for path in own:
        start[path] = np.choose(likeliest, [trial[layout.of(path)] for trial in trials])
    return fit(data, names, start=start, **given)


def _bic(fitted: Fit) -> float:
    """Bayesian information criterion; less is better."""
    count = float(fitted.problem.data.weight.sum())
    return -2.0 * float(fitted.log_likelihood.sum()) + len(fitted.minimum.x) * np.log(count)


def _held_out(fitted: Fit, data: Data) -> float:
    """Log-likelihood of other breaths, to which what is a breath's own is fitted."""
    shared = [p for p in fitted.problem.predictor.names if p not in ("position", *_EFFORTS)]
    bounds = {path: (parameter(path).low, parameter(path).high) for path in shared}
    fixed = {path: np.clip(fitted.column(path)[0], *bounds[path]) for path in shared}
    found = fitted_to(data, fitted.names, fixed=fixed, noise=fitted.noise)
    return float(found.log_likelihood.sum())
