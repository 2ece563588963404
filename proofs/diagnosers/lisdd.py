"""LISDD (arXiv 2606.23215) made anew from a summary of its steps, not from its code.

A clean regime fixes what is common; the residual's energy is compared region by region, with exact
F tests and a false discovery rate over the regions; and the terms of a library are tried
exhaustively, alone and in pairs, by breaths that are held out. Here the regions are cells of phase,
command and volume; the library is that of the physics, to first order at a mild strength.
"""

from __future__ import annotations

from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.special import softmax

from proofs.diagnosers.common import (
    Seen,
    Templates,
    candidates,
    intervals,
    see,
    strength,
    templates,
)
from ventbench.base.arrays import runs
from ventbench.system_id import fit

Floats = NDArray[np.float64]

#: Cells of each axis, fewest samples of a region, and the false discovery rate over regions.
_CELLS, _FEWEST, _RATE = 4, 30, 0.01

#: Share of the regions, those of the least energy, that are the clean regime.
_CLEAN = 0.25

#: Samples behind one independent one, since neighbours are correlated.
_CORRELATED = 3.0

#: Level of the F test by which a set of terms must gain on held-out breaths, and its odds in a
#: comparison of sets: nats are divided by this.
_LEVEL, _COOLED = 1e-3, 10.0


def diagnose(folder: Path) -> dict[str, Any]:
    """Answer a case."""
    seen = see(folder)
    fitted = fit(seen.observed)
    model = templates(seen, fitted, candidates())
    regions = _regions(seen, model)
    guilty, noise = _energy(model, regions)
    names = list(model.effects)
    counted, held = model.weight > 0, (np.arange(len(model.weight)) % 3 == 2)[:, None]
    base = [*model.refit, np.ones_like(model.pressure)]

    def correction(chosen: tuple[str, ...], rows: NDArray[np.bool_]) -> tuple[Floats, Floats]:
        """Multiples of chosen terms, fitted to some samples, and the change of all pressures."""
        x = np.stack([*base, *(model.effects[name] for name in chosen)], axis=-1)
        weights = np.asarray(np.linalg.lstsq(x[rows], model.residual[rows], rcond=None)[0], float)
        return weights[len(base) :], x @ weights

    def left(chosen: tuple[str, ...]) -> float:
        change = correction(chosen, counted & ~held)[1]
        return float(np.sum((model.residual - change)[counted & held] ** 2))

    sets = [(), *((name,) for name in names), *combinations(names, 2)]
    energies = {chosen: left(chosen) for chosen in sets} if guilty else {(): left(())}
    freedom = float((counted & held).sum()) / _CORRELATED
    best, before = min(energies, key=energies.__getitem__), energies[()]
    single = min((c for c in energies if len(c) <= 1), key=energies.__getitem__)
    if len(best) == 2 and not _gains(energies[single], energies[best], freedom):
        best = single
    if best and not _gains(before, energies[best], freedom):
        best = ()
    told = [c for c in energies if c == best or len(c) <= 1]
    nats = [-0.5 * freedom * np.log(max(energies[c], 1e-9)) - 3.0 * len(c) for c in told]
    weights = 0.3 * softmax(np.array(nats) / _COOLED)
    hypotheses = [
        {"terms": sorted(c), "probability": w + 0.6 * (c == best)}
        for c, w in zip(told, weights.tolist(), strict=True)
        if w > 1e-4 or c == best
    ]
    rest = 1.0 - sum(h["probability"] for h in hypotheses)
    hypotheses.append({"terms": ["unknown:airway"], "probability": rest})
    multiples, change = correction(best, counted)
    parameters: dict[str, Any] = intervals(fitted, ("R", "C"))
    for name, multiple in zip(best, multiples, strict=True):
        parameters |= strength(name, float(multiple))
    vocabulary = seen.question["vocabulary"]["names"]
    known = {f"{n}.{key}" for n, about in vocabulary.items() for key in about["parameters"]}
    return {
        "hypotheses": hypotheses,
        "pressures": seen.pressures((model.pressure + change)[seen.apart]),
        "parameters": {k: v for k, v in parameters.items() if k in known | {"R", "C"}},
        "active": _active(seen, np.isin(regions, list(guilty))) if best or guilty else {},
        "notes": {"noise": noise},
    }


def _gains(before: float, after: float, freedom: float) -> bool:
    """Exact F test of the energies of held-out breaths, as if one more term were fitted."""
    ratio = (before - after) / max(after, 1e-12) * (freedom - 1.0)
    return bool(stats.f.sf(ratio, 1.0, freedom - 1.0) < _LEVEL)


def _regions(seen: Seen, model: Templates) -> NDArray[np.int64]:
    """Number of the cell of each sample: phase, and quantiles of command and volume, ``(n, T)``."""
    volume = np.cumsum(model.flow * seen.data.dt, axis=1)
    region = (seen.data.u_out > 0.5).astype(np.int64)
    for axis in (seen.data.u_in, volume):
        edges = np.unique(np.quantile(axis, np.arange(1, _CELLS) / _CELLS))
        region = region * _CELLS + np.searchsorted(edges, axis)
    return region


def _energy(model: Templates, regions: NDArray[np.int64]) -> tuple[set[int], float]:
    """Regions whose residual has more energy than the clean regime, and that regime's spread."""
    counted = model.weight > 0
    cells = {
        int(r): model.residual[counted & (regions == r)]
        for r in np.unique(regions)
        if (counted & (regions == r)).sum() >= _FEWEST
    }
    order = sorted(cells, key=lambda r: float(np.mean(cells[r] ** 2)))
    clean = np.concatenate([cells[r] for r in order[: max(1, round(_CLEAN * len(order)))]])
    variance, size = float(np.mean(clean**2)), len(clean) / _CORRELATED
    p = [
        stats.f.sf(np.mean(cells[r] ** 2) / max(variance, 1e-12), len(cells[r]) / _CORRELATED, size)
        for r in order
    ]
    adjusted = stats.false_discovery_control(p)  # Benjamini and Hochberg
    guilty = {r for r, value in zip(order, adjusted, strict=True) if value <= _RATE}
    return guilty, float(np.sqrt(variance))


def _active(seen: Seen, flags: NDArray[np.bool_]) -> dict[str, list[list[float]]]:
    """Intervals of time of each breath in which samples are guilty."""
    found = {}
    for breath, time, row in zip(seen.breaths.breath_id, seen.breaths.time, flags, strict=True):
        spans = [[float(time[a]), float(time[b - 1])] for a, b in runs(row)]
        if spans:
            found[str(breath)] = spans
    return found
