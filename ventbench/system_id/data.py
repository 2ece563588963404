"""Data of a fit: commands, sample times and measurements as plain arrays, and their noise."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import islice

import numpy as np
from numpy.typing import ArrayLike

from ventbench.base.arrays import Bools, Floats, Ints
from ventbench.base.errors import InputError
from ventbench.recordings.breaths import Breaths

#: Lags of the autocorrelations of noise, and correlations of neighbouring samples that are tried:
#: above the last, the model is taken to fit badly.
_LAGS, _CORRELATIONS = 5, np.arange(0.05, 0.96, 0.05)

#: Least standard deviation of the noise of pressure that is believed, cmH2O.
LEAST_SIGMA = 0.02


@dataclass(frozen=True, eq=False)
class Data:
    """n breaths of T samples, c = 1 (pressure) or 2 (pressure and flow) channels."""

    u_in: Floats  #: inspiratory valve, %, ``(n, T)``.
    u_out: Floats  #: expiratory valve, 0/1, ``(n, T)``.
    dt: Floats  #: time to the next sample, s, ``(n, T)``.
    #: pressure, cmH2O, and flow, mL/s; zero where nothing was measured, ``(n, c, T)``.
    measured: Floats
    #: 1 where measured, else 0, ``(n, c, T)``; also 0 of a first reading that only begins a breath.
    weight: Floats
    R: Floats  #: label of the lung's resistance, cmH2O/(L/s), ``(n,)``.
    C: Floats  #: label of the lung's compliance, mL/cmH2O, ``(n,)``.
    position: Floats  #: place of each breath in its recording, 0 first, 1 last, ``(n,)``.
    #: flow into the lung at each breath's first sample, mL/s, ``(n,)``; 0 where it is at rest.
    initial_flow: Floats

    def __len__(self) -> int:
        """Number of breaths n."""
        return len(self.u_in)

    @property
    def lung(self) -> Ints:
        """Index of each breath's lung label, from 0, ``(n,)``."""
        pairs = np.stack([self.R, self.C], axis=1)
        return np.unique(pairs, axis=0, return_inverse=True)[1].reshape(-1)

    def select(self, which: ArrayLike | slice) -> Data:
        """Select breaths by mask, index or slice; they keep their positions."""
        index = which if isinstance(which, slice) else np.asarray(which)
        return Data(**{name: array[index] for name, array in vars(self).items()})

    def shares_label(self, other: Data) -> Bools:
        """Which of m other breaths have the label of each, ``(n, m)``."""
        return (self.R[:, None] == other.R) & (self.C[:, None] == other.C)

    def with_pressure(self, pressure: ArrayLike) -> Data:
        """Replace the pressure, cmH2O, ``(n, T)``; blank samples keep their weight of zero.

        Raises:
            InputError: if the shape differs, or a pressure with weight is not finite.
        """
        pressure = np.asarray(pressure, float)
        if pressure.shape != self.u_in.shape:
            raise InputError(
                f"pressures of shape {pressure.shape} for commands of shape {self.u_in.shape}"
            )
        weight = self.weight[:, :1]
        if not np.all(np.isfinite(pressure[weight[:, 0] > 0])):
            raise InputError("a simulated pressure is not finite; use a stable simulator")
        measured = np.where(weight > 0, pressure[:, None], 0.0)
        measured[:, 0, 0] = np.nan_to_num(pressure[:, 0])
        return replace(self, measured=measured, weight=weight)


def make_data(breaths: Breaths, *, flow: bool = False) -> Data:
    """Make the data of a fit from a recording, with its flow if that is asked for.

    Positions, the place of each breath in its recording, are from 0 to 1: as the ids of the breaths
    are if these rise, so that breaths which were left out keep their places, else evenly. Breaths
    start at rest.

    Raises:
        InputError: if there is no breath, no pressure or, when asked for, no flow.
    """
    if len(breaths) == 0:
        raise InputError("no breaths to fit; choose a recording with at least one")
    if flow and breaths.flow is None:
        raise InputError("the recording has no flow; fit its pressure alone")
    channels = [breaths.pressure] + ([breaths.flow] if flow and breaths.flow is not None else [])
    measured = np.stack(channels, axis=1)
    weight = (np.isfinite(measured) & breaths.valid[:, None]).astype(float)
    if flow:
        weight[:, 1, 0] = 0.0  # a breath starts at rest
    if not weight[:, 0].any():
        raise InputError("no pressure is measured in these breaths")
    order = breaths.breath_id - breaths.breath_id[0]
    if np.any(np.diff(order) < 0):
        order = np.arange(len(breaths))
    position = order / max(int(order[-1]), 1)
    names = ("u_in", "u_out", "dt", "R", "C")
    plain = {name: getattr(breaths, name).astype(float) for name in names}
    masked = np.where(weight > 0, measured, 0.0)
    at_rest: Floats = np.zeros(len(breaths))
    return Data(measured=masked, weight=weight, position=position, initial_flow=at_rest, **plain)


@dataclass(frozen=True)
class Noise:
    """White noise plus a slow discrepancy of each channel, with exponential tails (Huber).

    The discrepancy, what a model misses from sample to sample, is first-order autoregressive. A
    Kalman filter predicts each sample from those before; its innovations are independent. White
    noise alone would count a slow error once for each sample. Autoregressive noise alone would
    count differences of neighbouring samples for all that is sure.
    """

    #: standard deviations of pressure, cmH2O, and of flow, mL/s, one for each channel.
    sigma: tuple[float, ...] = (0.25, 20.0)
    #: correlations of neighbouring samples of the discrepancy, one for each channel, within -1..1.
    ar: tuple[float, ...] = (0.0, 0.0)
    #: whitened size from which the tails are exponential; ``inf`` for a Gaussian.
    tail: float = 3.0
    #: shares of the variance that are the discrepancy's, one for each channel.
    slow: tuple[float, ...] = (1.0, 1.0)

    @property
    def white(self) -> Noise:
        """The same without correlation, so that no slow error is excused."""
        return replace(self, ar=(0.0,) * len(self.ar))

    def autocorrelation_time(self, weight: Floats) -> float:
        """Readings of the pressure that count as one (integrated autocorrelation time).

        ``weight`` ``(n, c, T)``: correlations are those of samples, of which some have no reading.
        """
        apart = float(np.median(np.diff(np.flatnonzero(weight[:, 0]))))
        correlation = self.ar[0] ** apart
        return 1.0 + 2.0 * self.slow[0] * correlation / (1.0 - correlation)

    def whiten(self, residual: Floats, weight: Floats) -> Floats:
        """Transform residuals to independent ones of unit variance; 0 where ``weight`` is 0.

        Args:
            residual: ``(n, ..., c, T)``.
            weight: ``(n, c, T)``.
        """
        ar, kalman_gain, scale = self._filter(weight)
        between = (slice(None),) + (None,) * (residual.ndim - weight.ndim)
        innovations = np.moveaxis(residual, -1, 0).copy()  # sample first, as the filter runs
        if np.any(ar):
            gain = np.moveaxis((ar * kalman_gain)[between], -1, 0)
            expected = np.zeros(innovations.shape[1:])
            for k, now in enumerate(innovations):
                now -= expected
                expected = ar[:, 0] * expected + gain[k] * now
        return weight[between] * np.moveaxis(innovations, 0, -1) / scale[between]

    def loss(self, white: Floats) -> Floats:
        """Negative log density of whitened residuals, without :meth:`log_norm`."""
        size = np.abs(white)
        core = np.minimum(size, self.tail)
        return 0.5 * core**2 + (self.tail * (size - core) if math.isfinite(self.tail) else 0.0)

    def influence(self, white: Floats) -> Floats:
        """Huber weight of each squared residual in the normal equations, 1 in the core."""
        return np.minimum(1.0, self.tail / np.maximum(np.abs(white), 1e-12))

    def log_norm(self) -> float:
        """Logarithm of the integral of ``exp(-loss)``."""
        c = self.tail
        tails = 2.0 / c * math.exp(-0.5 * c * c) if math.isfinite(c) else 0.0
        return math.log(math.sqrt(2.0 * math.pi) * math.erf(c / math.sqrt(2.0)) + tails)

    def log_likelihood(self, residual: Floats, weight: Floats) -> Floats:
        """Log-likelihood of the residuals ``(n, c, T)`` of each breath, ``(n,)``."""
        white = self.whiten(residual, weight)
        _, _, scale = self._filter(weight)
        terms = -self.loss(white) - weight * (np.log(scale) + self.log_norm())
        return terms.sum(axis=(1, 2))

    def log_scale(self, weight: Floats) -> Floats:
        """Logarithm of the product of all scales by which residuals are whitened, ``(n,)``."""
        return np.sum(weight * np.log(self._filter(weight)[2]), axis=(1, 2))

    def _filter(self, weight: Floats) -> tuple[Floats, Floats, Floats]:
        """Correlation, and gain and standard deviation of each innovation of the Kalman filter.

        Shapes ``(c, 1)`` and twice ``(n, c, T)``.
        """
        channels = weight.shape[1]
        per_channel = (x[:channels] for x in (self.sigma, self.ar, self.slow))
        return _kalman(*per_channel, weight.shape, weight.astype(float).tobytes())


#: Filters that are kept: fits ask for the same one at each of their steps.
_FILTERS = 32


@lru_cache(maxsize=_FILTERS)
def _kalman(
    sigma: tuple[float, ...],
    ar: tuple[float, ...],
    slow: tuple[float, ...],
    shape: tuple[int, int, int],
    weight: bytes,
) -> tuple[Floats, Floats, Floats]:
    """What :meth:`Noise._filter` returns, for the weights of a shape."""
    weights = np.frombuffer(weight).reshape(shape)
    scale, share, slow_share = (np.asarray(x, float)[:, None] for x in (sigma, ar, slow))
    gain, spread = np.empty(shape), np.empty(shape)
    variance = slow_share[:, 0] + np.zeros(shape[:-1])  # of the discrepancy, as expected
    for k in range(shape[-1]):
        spread[..., k] = variance + 1.0 - slow_share[:, 0]
        gain[..., k] = weights[..., k] * variance / spread[..., k]
        posterior = variance * (1.0 - gain[..., k])
        variance = slow_share[:, 0] + share[:, 0] ** 2 * (posterior - slow_share[:, 0])
    return share, gain, scale * np.sqrt(spread)


def robust_noise(residual: Floats, weight: Floats) -> Noise:
    """Estimate the noise from residuals ``(n, c, T)``, robust against outliers.

    A discrepancy of correlation ``a`` and share ``s`` has the autocorrelations ``s a^k`` at lags
    ``k``, to which both are fitted by least squares.

    ``weight`` is 1 where measured, else 0.
    """
    sigma, ar, slow = [], [], []
    for channel in range(residual.shape[1]):
        r, w = residual[:, channel], weight[:, channel] > 0
        size = 1.4826 * np.median(np.abs(r[w])) if w.any() else 0.0
        # Those of the median breath, as some breaths err as a whole.
        clipped, autocorrelations = np.clip(r, -3.0 * size, 3.0 * size) * w, []
        pairs = (k for k in range(1, r.shape[1]) if np.any(w[:, k:] & w[:, :-k]))
        lags = np.array(list(islice(pairs, _LAGS)) or [1])
        for lag in lags:
            both = w[:, lag:] & w[:, :-lag]
            ahead, behind = clipped[:, lag:] * both, clipped[:, :-lag] * both
            power = np.sum(ahead**2 + behind**2, axis=1)
            ratios = 2.0 * np.sum(ahead * behind, axis=1)[power > 0] / power[power > 0]
            autocorrelations.append(float(np.median(ratios)) if ratios.size else 0.0)
        powers = _CORRELATIONS[:, None] ** lags
        fitted = powers @ np.array(autocorrelations)
        share = np.clip(fitted / np.sum(powers**2, axis=1), 0.0, 1.0)
        best = int(np.argmin(np.sum((share[:, None] * powers - autocorrelations) ** 2, axis=1)))
        sigma.append(max(float(size), LEAST_SIGMA * (20.0 if channel else 1.0)))
        ar.append(float(_CORRELATIONS[best]) if share[best] > 0.0 else 0.0)
        slow.append(float(share[best]))
    return Noise(tuple(sigma), tuple(ar), slow=tuple(slow))
