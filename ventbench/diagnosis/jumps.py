"""Smoothing of a signal that jumps, by windows that end before the jumps (LPA-ICI).

Noise of what drives a model is no noise of what the model predicts. A filter in the model takes it
off the prediction, so that a recording with a noisy flow asks for filters that no rig has. The
model is therefore driven by the flow that is expected behind the readings (regression calibration).

On either side of each sample, lines are fitted to growing windows that end there. The largest
window is taken whose confidence interval meets those of all smaller ones (intersection of
confidence intervals: Goldenshluger and Nemirovski, Mathematical Methods of Statistics, 1997;
Katkovnik, IEEE Transactions on Signal Processing, 1999): a jump parts them, and so does any form
that the noise does not hide. Without noise every window is one sample. Of what the smoothing takes
off, the moving mean is given back (twicing: Tukey, Exploratory Data Analysis, 1977): the volume
that has passed stays as it was measured.
"""

from __future__ import annotations

import numpy as np

from ventbench.base.arrays import Floats
from ventbench.recordings.bad_samples import noise_of

#: Numbers of samples of the windows; half-width of the confidence intervals in standard deviations;
#: and samples over whose mean no volume may be lost.
_WINDOWS, _WIDTH, _MEAN = (1, 3, 4, 6, 8, 11, 15, 20), 1.5, np.ones(11)


def without_noise(signal: Floats) -> Floats:
    """The signal that is expected behind evenly spaced readings with white noise.

    Args:
        signal: T readings, ``(T,)``.

    Returns:
        The same without most of the noise, whose size the second differences tell, ``(T,)``.
    """
    if len(signal) < max(_WINDOWS):
        return signal
    sd = noise_of(signal)
    weighted, precision = np.zeros(len(signal)), np.zeros(len(signal))
    for direction in (1, -1):
        readings = signal[::direction]
        low, high = np.full(len(signal), -np.inf), np.full(len(signal), np.inf)
        best, variance = readings, np.ones(len(signal))
        meet = np.ones(len(signal), bool)
        for size in _WINDOWS:
            # A line through the window has this value at its last sample.
            weights = (4 * size - 2 - 6 * np.arange(size)) / (size * (size + 1))
            value, relative = np.convolve(readings, weights)[: len(signal)], weights @ weights
            half = _WIDTH * sd * np.sqrt(relative)
            low, high = np.maximum(low, value - half), np.minimum(high, value + half)
            meet &= (low <= high) & (np.arange(len(signal)) >= size - 1)
            best, variance = np.where(meet, value, best), np.where(meet, relative, variance)
        weighted += (best / variance)[::direction]
        precision += 1.0 / variance[::direction]
    smooth = weighted / precision
    left = np.convolve(signal - smooth, _MEAN, "same")
    return smooth + left / np.convolve(np.ones(len(signal)), _MEAN, "same")
