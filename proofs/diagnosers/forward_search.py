"""A plain forward search over the library: BIC, one held-out check, no places, shapes fixed.

What anyone would write first with the same library and the same fits. The weights of rivals are
those of BIC, flattened, since the forms of the library are not those of the rig.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from proofs.diagnosers.common import candidates, intervals, see
from ventbench.physics.catalogue import library, paths
from ventbench.system_id import Fit, Predictor, fit, refit_breath_parameters

#: Most terms; nats that held-out breaths must gain by a term; the odds 100 to one.
_MOST, _NATS = 4, 4.6

#: Steps of a fit that only has to be ranked, and candidates of a round that are fitted to the end.
_QUICK, _BEST = 4, 3

#: Weight of a difference of BIC, and share of what no candidate is.
_FLATTENED, _UNKNOWN = 0.05, 0.05


def diagnose(folder: Path) -> dict[str, Any]:
    """Answer a case."""
    seen = see(folder)
    data = seen.observed
    testing = np.arange(len(data)) % 3 == 2
    train, test = data.select(~testing), data.select(testing)
    predictor = Predictor(train, paths(tuple(library())))

    def fitted(names: tuple[str, ...], iterations: int = 40) -> Fit:
        return fit(train, names, predictor=predictor, iterations=iterations)

    best = fitted(())
    rivals: dict[tuple[str, ...], float] = {(): best.bic}
    held = refit_breath_parameters(best, test).log_likelihood.sum()
    while len(best.names) < _MOST:
        left = [name for name in (*candidates(), "patient_effort") if name not in best.names]
        ranked = sorted((fitted((*best.names, name), _QUICK) for name in left), key=_bic)
        finished = sorted((fitted(each.names) for each in ranked[:_BEST]), key=_bic)
        gained = refit_breath_parameters(finished[0], test).log_likelihood.sum() - held
        if finished[0].bic >= best.bic or gained < _NATS:
            break
        best, held = finished[0], held + gained
        rivals |= {each.names: each.bic for each in finished}
    weights = {names: np.exp(-_FLATTENED * (bic - best.bic)) for names, bic in rivals.items()}
    total = sum(weights.values())
    hypotheses = [
        {"terms": sorted(names), "probability": (1.0 - _UNKNOWN) * weight / total}
        for names, weight in weights.items()
    ]
    hypotheses += [
        {"terms": [f"unknown:{place}"], "probability": _UNKNOWN / len(_places(seen))}
        for place in _places(seen)
    ]
    final = fit(data, best.names)
    known = seen.question["vocabulary"]["names"]
    own = [f"{name}.{key}" for name in best.names for key in known[name]["parameters"]]
    free = [path for path in ("R", "C", *own) if path in final.problem.unknowns.paths]
    return {
        "hypotheses": hypotheses,
        "pressures": seen.pressures(seen.predict(final)),
        "parameters": intervals(final, free),
    }


def _bic(fitted: Fit) -> float:
    return fitted.bic


def _places(seen: Any) -> list[str]:
    return seen.question["vocabulary"]["places"]
