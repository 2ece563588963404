"""Parameters with intervals, lungs and plants of a conclusion."""

from __future__ import annotations

import numpy as np

from ventbench.mismatch.naming.bench import Side, Solved, has_own
from ventbench.mismatch.result import Estimate, LungMatch
from ventbench.physics.catalogue import library, mechanism
from ventbench.physics.fits import Fit, fit, interval
from ventbench.physics.fits.derivatives import START
from ventbench.plants.base import Plant

#: Shapes whose default is a guess: the interval of a strength must allow for it.
_UNCERTAIN = ("supply_droop.recovery",)

#: How far a label's R and C may be off: tolerances of test lungs and of the valve's gain.
_TOLERANCE_R, _TOLERANCE_C = 0.30, 0.20


def estimated(solved: Solved, side: Side) -> Fit:
    """Fit a conclusion's hypothesis to a side's breaths, with covariance.

    Args:
        solved: the conclusion, on some of the breaths.
        side: breaths to fit.
    """
    hypothesis = solved.hypothesis
    free = [p for p in _UNCERTAIN if p.rpartition(".")[0] in hypothesis.names]
    start = {}
    for path in solved.problem.unknowns.paths:
        if path != START and not ("." in path and has_own(path.rpartition(".")[0])):
            start[path] = float(np.median(solved.column(path)))
    if len(np.unique(side.data.lung)) > 1:
        start = {path: value for path, value in start.items() if path not in ("R", "C")}
    return fit(
        side.data, hypothesis.names, free=dict.fromkeys((*hypothesis.free, *free)),
        fixed=dict(hypothesis.fixed), start=start, noise=solved.noise, simulator=side.simulator,
    )  # fmt: skip


def parameters(found: Fit, name: str) -> dict[str, Estimate]:
    """Values and intervals of a mechanism; of what is each breath's own, over the breaths."""
    values = {}
    for item in mechanism(name).description.parameters:
        path = f"{name}.{item.name}"
        if path not in found.problem.unknowns.paths:
            continue
        if item.scope == "breath":
            column = found.column(path)
            low, middle, high = np.quantile(column, [0.025, 0.5, 0.975])
            values[item.name] = Estimate(float(middle), item.unit, (float(low), float(high)))
        else:
            one = interval(found, path)
            values[item.name] = Estimate(one.value, item.unit, (one.low, one.high))
    return values


def lungs(found: Fit) -> tuple[LungMatch, ...]:
    """Fitted R and C of each label, and whether the label can be right."""
    data, matches = found.problem.data, []
    labels = np.unique(np.stack([data.R, data.C], axis=1), axis=0)
    for group, (R, C) in enumerate(labels):
        fitted_R, fitted_C = (float(found.value(path)[group]) for path in ("R", "C"))
        ci = {path: _ends(found, path, group) for path in ("R", "C")}
        near = _near(ci["R"], R, _TOLERANCE_R) and _near(ci["C"], C, _TOLERANCE_C)
        matches.append(
            LungMatch(f"R{R:g}C{C:g}", fitted_R, fitted_C, ci["R"], ci["C"], near, "pressure")
        )
    return tuple(matches)


def _ends(found: Fit, path: str, group: int) -> tuple[float, float]:
    low, high = found.ci95(path)[group]
    return float(low), float(high)


def _near(ci95: tuple[float, float], label: float, tolerance: float) -> bool:
    return ci95[0] <= label * (1.0 + tolerance) and ci95[1] >= label * (1.0 - tolerance)


def plants(found: Fit) -> dict[str, Plant]:
    """The fitted plant of each lung, by label, without what each breath has of its own."""
    data, result = found.problem.data, {}
    for R, C in np.unique(np.stack([data.R, data.C], axis=1), axis=0):
        breath = int(np.flatnonzero((data.R == R) & (data.C == C))[0])
        plant = found.plant(breath)
        own = [name for name in library() if has_own(name)]
        kept = {
            name: value
            for name, value in zip(plant.names, plant.values, strict=True)
            if name.rpartition(".")[0] not in own and name != "position"
        }
        result[f"R{R:g}C{C:g}"] = plant.replace(  # type: ignore[attr-defined]
            names=tuple(kept), values=tuple(kept.values())
        )
    return result
