"""Kennedy and O'Hagan's discrepancy: a Gaussian process over what a refitted lung leaves.

M. C. Kennedy, A. O'Hagan, J. R. Stat. Soc. B 63 (2001) 425, modular: R and C are refitted first,
and the discrepancy is a process over what the simulator says of each sample. It names nothing; the
inputs that it needs, by automatic relevance (R. M. Neal, 1996), tell where something is missing.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve
from scipy.optimize import minimize
from scipy.spatial.distance import cdist
from scipy.stats import Covariance, multivariate_normal

from proofs.diagnosers.common import Refitted, Seen, intervals, see, simulated
from ventbench.system_id import fit

Floats = NDArray[np.float64]

#: Samples that the process is fitted to.
_POINTS = 500

#: Places that an input speaks for: flow, volume, command, its change, the clock, the breath.
_PLACES = ("airway", "lung", "inspiratory_valve", "clock", "muscles", "pressure_sensor")

#: Prior of the logarithms of scales, and nats of evidence at which something is surely missing.
_PRIOR, _EVIDENCE = 1.5, 20.0


def diagnose(folder: Path) -> dict[str, Any]:
    """Answer a case."""
    seen = see(folder)
    fitted = fit(seen.observed)
    model = simulated(seen, fitted)
    x = _inputs(seen, model)
    rng = np.random.default_rng(0)
    where = np.flatnonzero(model.weight.ravel() > 0)
    chosen = rng.choice(where, min(_POINTS, len(where)), replace=False)
    process = _Process(x[chosen], model.residual.ravel()[chosen])
    predicted = model.pressure + process.mean(x).reshape(model.pressure.shape)
    missing = float(np.clip(process.evidence / _EVIDENCE, 0.02, 0.98))
    relevance = np.exp(-process.scales[: len(_PLACES)])
    shares = missing * relevance / relevance.sum()
    return {
        "hypotheses": [
            {"terms": [], "probability": 1.0 - missing},
            *(
                {"terms": [f"unknown:{place}"], "probability": share}
                for place, share in zip(_PLACES, shares, strict=True)
            ),
        ],
        "pressures": seen.pressures(predicted[seen.apart]),
        "parameters": intervals(fitted, ("R", "C")),
    }


def _inputs(seen: Seen, model: Refitted) -> Floats:
    """Flow, volume, command, its change, time in the breath and the breath's number, scaled."""
    data = seen.data
    volume = np.cumsum(model.flow * data.dt, axis=1)
    change = np.diff(data.u_in, axis=1, prepend=0.0)
    time = np.cumsum(data.dt, axis=1)
    number = np.broadcast_to(data.position[:, None], time.shape)
    columns = (model.flow, volume, data.u_in, change, time, number)
    x = np.stack([column.ravel() for column in columns], axis=1)
    return (x - x.mean(axis=0)) / np.maximum(x.std(axis=0), 1e-9)


class _Process:
    """A squared exponential process with a length scale for each input.

    Attributes:
        scales: logarithms of the length scales, then of the size and of the noise.
        evidence: log marginal likelihood over that of noise alone, nats.
    """

    def __init__(self, x: Floats, y: Floats) -> None:
        self._x, self._y = x, y
        spread = np.log(max(y.std(), 1e-3))
        centre = np.array([1.0] * x.shape[1] + [spread, spread - 0.7])

        def cost(z: Floats) -> float:
            return -self._likelihood(z) + 0.5 * float(np.sum(((z - centre) / _PRIOR) ** 2))

        bounds = [(-2.0, 5.0)] * x.shape[1] + [(-5.0, 4.0), (-4.0, 4.0)]
        self.scales = minimize(cost, centre, bounds=bounds, options={"maxiter": 25}).x
        alone = -0.5 * len(y) * (np.log(2.0 * np.pi * max(y.var(), 1e-6)) + 1.0)
        self.evidence = self._likelihood(self.scales) - alone
        self._weights = solve(self._covariance(self.scales), y, assume_a="pos")

    def mean(self, x: Floats) -> Floats:
        """Predictive mean, ``(k,)``."""
        return self._kernel(self.scales, x) @ self._weights

    def _kernel(self, z: Floats, x: Floats) -> Floats:
        scale = np.exp(z[:-2])
        return np.exp(2.0 * z[-2] - 0.5 * cdist(x / scale, self._x / scale, "sqeuclidean"))

    def _covariance(self, z: Floats) -> Floats:
        return self._kernel(z, self._x) + np.exp(2.0 * z[-1]) * np.eye(len(self._y))

    def _likelihood(self, z: Floats) -> float:
        root = Covariance.from_cholesky(cholesky(self._covariance(z), lower=True))
        return float(multivariate_normal.logpdf(self._y, cov=root))  # type: ignore[arg-type]
