"""A hypothesis against data: residuals, likelihood and normal equations at any parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from ventbench.errors import InputError
from ventbench.physics.catalogue import parameter, paths
from ventbench.system_id.data import Data, Floats
from ventbench.system_id.derivatives import START, Simulator
from ventbench.system_id.noise import Noise
from ventbench.system_id.unknowns import Unknowns


@dataclass(frozen=True, eq=False)
class Problem:
    """What a fit minimises; every method takes the unknowns ``x`` in coordinates, ``(U,)``.

    Attributes:
        data: measured.
        simulator: of the same breaths.
        unknowns: what may move.
        fixed: physical values of all columns of the simulator, ``(n, P + 1)``; those of free
            parameters are replaced.
        noise: of the measurement.
        mean: of the prior, in coordinates, ``(U,)``.
        precision: of the prior, 1 / variance, ``(U,)``.
    """

    data: Data
    simulator: Simulator
    unknowns: Unknowns
    fixed: Floats
    noise: Noise
    mean: Floats
    precision: Floats

    @cached_property
    def columns(self) -> tuple[int, ...]:
        """Where the free parameters stand among the simulator's."""
        order = (*self.simulator.names, START)
        return tuple(order.index(path) for path in self.unknowns.paths)

    def values(self, x: Floats) -> Floats:
        """Physical values of everything, ``(n, P + 1)``."""
        values = self.fixed.copy()
        values[:, list(self.columns)] = self.unknowns.unpack(x)
        return values

    def predict(self, x: Floats) -> Floats:
        """What would be measured, ``(n, c, T)``."""
        return self.simulator.predict(self.values(x))

    def residual(self, x: Floats) -> Floats:
        """Simulated minus measured, 0 where not measured, ``(n, c, T)``."""
        return self.residual_of(self.values(x))

    def residual_of(self, values: Floats) -> Floats:
        """The same at physical values of everything, ``(n, P + 1)``."""
        return self._residual(self.simulator.predict(values))

    def jacobian(self, x: Floats) -> tuple[Floats, Floats]:
        """Residual, and its derivative by the coordinates of each free path, ``(n, k, c, T)``.

        Column ``j`` of breath ``i`` belongs to the unknown ``unknowns.index[i, j]``.
        """
        values = self.values(x)
        seen, slopes = self.simulator.derivatives(values, self.columns)
        chain = self.unknowns.slopes(values[:, list(self.columns)])
        return self._residual(seen), slopes * (chain[:, :, None, None] * self.data.weight[:, None])

    def log_likelihood(self, x: Floats) -> Floats:
        """Of each breath, natural logarithm, ``(n,)``; without the prior."""
        return self.noise.log_likelihood(self.residual(x), self.data.weight)

    def cost(self, x: Floats) -> float:
        """Minus the logarithm of likelihood and prior, up to a constant; infinite if unstable."""
        return self._cost(self._white(self.residual(x)), x)

    def scores(self, x: Floats) -> tuple[float, Floats, Floats]:
        """Cost; its gradient by breath, ``(n, k)``; its Gauss-Newton Hessian, ``(n, k, k)``.

        Of the likelihood alone; the cost has the prior in it.
        """
        residual, slopes = self.jacobian(x)
        white = self._white(residual)
        rows = self.noise.whiten(slopes, self.data.weight)
        rows = rows.reshape(*rows.shape[:2], -1)
        flat = white.reshape(len(white), -1)
        weight = self.noise.influence(flat)
        weighted = rows * weight[:, None]
        gradient = np.matmul(weighted, flat[:, :, None])[:, :, 0]
        return self._cost(white, x), gradient, np.matmul(weighted, rows.swapaxes(1, 2))

    def normal(self, x: Floats) -> tuple[float, Floats, Floats]:
        """Cost, gradient ``(U,)`` and Gauss-Newton Hessian ``(U, U)``."""
        cost, by_breath, curvature = self.scores(x)
        index = self.unknowns.index
        gradient = self.precision * (x - self.mean)
        np.add.at(gradient, index, by_breath)
        hessian = np.diag(self.precision)
        np.add.at(hessian, (index[:, :, None], index[:, None, :]), curvature)
        return cost, gradient, hessian

    def _residual(self, seen: Floats) -> Floats:
        return np.where(self.data.weight > 0, seen - self.data.seen, 0.0)

    def _white(self, residual: Floats) -> Floats:
        return self.noise.whiten(residual, self.data.weight)

    def _cost(self, white: Floats, x: Floats) -> float:
        prior = 0.5 * np.sum(self.precision * (x - self.mean) ** 2)
        cost = float(np.sum(self.noise.loss(white)) + prior)
        return cost if np.isfinite(cost) else np.inf


def settings(data: Data, names: tuple[str, ...], given: Mapping[str, ArrayLike]) -> Floats:
    """Physical values of all parameters of a simulator and of the start, ``(n, P + 1)``.

    Args:
        data: gives R, C, positions and starting pressures.
        names: of the simulator.
        given: other values, a number or one for each breath; the rest is neutral.

    Raises:
        InputError: if a name is unknown or a value outside its bounds.
    """
    first = np.where(data.weight[:, 0, 0] > 0, data.seen[:, 0, 0], 5.0)
    known = {"R": data.R, "C": data.C, "position": data.position, START: first} | dict(given)
    columns = []
    for name in (*names, START):
        value = np.asarray(known.pop(name, None if name == START else parameter(name).neutral))
        if name != START:
            item = parameter(name)
            if not np.all((value >= item.low) & (value <= item.high)):
                raise InputError(f"{name} = {value} is outside {item.low}..{item.high} {item.unit}")
        columns.append(np.broadcast_to(value, (len(data),)).astype(float))
    if known:
        raise InputError(f"no parameter {sorted(known)} here; choose of {', '.join(paths())}")
    return np.stack(columns, axis=1)
