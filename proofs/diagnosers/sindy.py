"""SINDy of the discrepancy: sparse regression of what a refitted lung leaves, with control.

S. L. Brunton, J. L. Proctor, J. N. Kutz, PNAS 113 (2016) 3932; for model discrepancies K. Kaheman,
E. Kaiser, B. Strom, J. N. Kutz, S. L. Brunton (2019, arXiv 1909.08574). The library is of pressure,
command and the reconstructed flow and volume. A term that survives is named by what it is.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from proofs.diagnosers.common import Refitted, Seen, intervals, see, simulated
from ventbench.system_id import fit

Floats = NDArray[np.float64]

#: Terms that a refit of R, C, R_ex and PEEP absorbs have no name.
_ABSORBED = ("1", "Q", "V", "out")

#: What each other term is called.
_TERMS = {
    "Q|Q|": "turbulent_resistance",
    "V^2": "nonlinear_compliance",
    "dQ/dt": "inertance",
    "dp/dt": "sensor_lag",
    "du/dt": "valve_lag",
    "u^2": "valve_curve",
    "sign u": "valve_dead_band",
    "integral p": "leak",
    "integral V": "viscoelasticity",
    "n": "sensor_drift",
    "n Q": "resistance_drift",
    "n V": "compliance_drift",
    "p^2": "sensor_curve",
    "integral u": "supply_droop",
    "V Q": "unknown:airway",
    "Q out": "exhalation_valve_delay",
}

#: Thresholds of coefficients of scaled terms, cmH2O, of which held-out breaths choose one.
_THRESHOLDS = (0.05, 0.1, 0.2, 0.4, 0.8)

#: Ridge of a regression, and most times that small coefficients are dropped.
_RIDGE, _ROUNDS = 1e-3, 20

#: Confidence in the terms; the rest is shared by nothing, and by each term alone.
_BELIEVED = 0.6


def diagnose(folder: Path) -> dict[str, Any]:
    """Answer a case."""
    seen = see(folder)
    fitted = fit(seen.observed)
    model = simulated(seen, fitted)
    terms = _library(seen, model)
    x = np.stack([term.ravel() for term in terms.values()], axis=1)
    scale = np.maximum(x.std(axis=0), 1e-9)
    x, y = x / scale, model.residual.ravel()
    counted = model.weight.ravel() > 0
    held = np.repeat(np.arange(len(model.weight)) % 3 == 2, model.weight.shape[1])
    train, test = counted & ~held, counted & held

    def sparse(threshold: float, rows: NDArray[np.bool_]) -> Floats:
        return thresholded_least_squares(x[rows], y[rows], threshold)

    def error(threshold: float) -> float:
        return float(np.mean((y - x @ sparse(threshold, train))[test] ** 2))

    best = min((np.inf, *_THRESHOLDS), key=error)
    coefficients = sparse(best, counted)
    predicted = model.pressure + (x @ coefficients).reshape(model.pressure.shape)
    sizes = dict(zip(terms, np.abs(coefficients), strict=True))
    named = {_TERMS[t]: size for t, size in sizes.items() if t not in _ABSORBED and size > 0.0}
    names = sorted(named, key=lambda name: -named[name])[:6]
    return {
        "hypotheses": _hypotheses(names),
        "pressures": seen.pressures(predicted[seen.apart]),
        "parameters": intervals(fitted, ("R", "C")),
    }


def thresholded_least_squares(x: Floats, y: Floats, threshold: float) -> Floats:
    """Sequentially thresholded ridge regression: small coefficients are dropped, others refitted.

    Args:
        x: terms, ``(n, k)``.
        y: what they explain, ``(n,)``.
        threshold: size below which a coefficient is dropped.
    """
    kept = np.full(x.shape[1], np.isfinite(threshold))
    found = np.zeros(x.shape[1])
    for _ in range(_ROUNDS):
        inner = x[:, kept].T @ x[:, kept] + _RIDGE * np.eye(int(kept.sum()))
        found = np.zeros(x.shape[1])
        found[kept] = np.linalg.solve(inner, x[:, kept].T @ y)
        still = kept & (np.abs(found) >= threshold)
        if (still == kept).all():
            break
        kept = still
    return np.where(kept, found, 0.0)


def _library(seen: Seen, model: Refitted) -> dict[str, Floats]:
    """Candidate terms at each sample, ``(n, T)`` each."""
    data, p, q = seen.data, model.pressure, model.flow
    u, dt, out = data.u_in, data.dt, data.u_out
    volume = np.cumsum(q * dt, axis=1)
    n = np.broadcast_to(data.position[:, None], p.shape)
    below = p - p[:, :1]

    def rate(signal: Floats) -> Floats:
        return np.diff(signal, axis=1, prepend=signal[:, :1]) / dt

    def integral(signal: Floats) -> Floats:
        return np.cumsum(signal * dt, axis=1)

    return {
        "1": np.ones_like(p),
        "Q": q,
        "V": volume,
        "out": out,
        "Q|Q|": q * np.abs(q),
        "V^2": volume**2,
        "dQ/dt": rate(q),
        "dp/dt": rate(p),
        "du/dt": rate(u),
        "u^2": u**2,
        "sign u": np.sign(u),
        "integral p": integral(below),
        "integral V": integral(volume),
        "n": n,
        "n Q": n * q,
        "n V": n * volume,
        "p^2": below**2,
        "integral u": integral(u),
        "V Q": volume * q,
        "Q out": q * out,
    }


def _hypotheses(names: list[str]) -> list[dict[str, Any]]:
    if not names:
        return [
            {"terms": [], "probability": 0.9},
            {"terms": ["unknown:airway"], "probability": 0.1},
        ]
    weights: dict[frozenset[str], float] = {frozenset(names): _BELIEVED}
    for terms in (frozenset(), *(frozenset({name}) for name in names)):
        weights[terms] = weights.get(terms, 0.0) + (1.0 - _BELIEVED) / (len(names) + 1)
    return [{"terms": sorted(terms), "probability": p} for terms, p in weights.items()]
