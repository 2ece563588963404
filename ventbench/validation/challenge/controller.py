"""Commands of a breath: closed loop, exploration, and the ventilator's bias flow in expiration."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ventbench.validation.challenge.cases import NOMINAL_GAIN, Case
from ventbench.validation.challenge.instruments import Floats

#: The paper's grid of gains.
_GRID = np.concatenate([np.arange(1, 10) / 10.0, np.arange(1, 11)])

#: Largest loop gain, cmH2O at the next sample per cmH2O of error; a higher one rings.
_LARGEST_LOOP_GAIN = 1.3

#: The valve closes above this pressure, cmH2O.
_HIGHEST = 45.0

#: Typical PEEP of a rig, cmH2O.
_PEEP = 5.0

#: Share of the error that enters the integral at each sample: 32 ms of a memory of 0.5 s.
_INTEGRAL_SHARE = 0.06

#: End of inspiration, s.
INSPIRATION = 1.0


class RecordingController:
    """PI control to a target; some breaths add a disturbance, others follow a programme.

    Args:
        case: case whose breaths are recorded.
        time: times of the samples, s, ``(n, T)``.
        rng: source of gains, targets and programmes.
        share: scales pressures above PEEP and commands; 1 for the usual ones.
    """

    def __init__(
        self, case: Case, time: Floats, rng: np.random.Generator, share: float = 1.0
    ) -> None:
        n = len(time)
        self._time = time
        # cmH2O at the next sample per %: by resistance, and by the volume of 32 ms of flow.
        jump = 1e-3 * NOMINAL_GAIN * (case.lung_R + 32.0 / case.lung_C)
        highest = max(_LARGEST_LOOP_GAIN / jump, 0.5)
        gains = _GRID[np.less_equal(_GRID, highest)]
        self._kp = rng.choice(gains, n)
        self._ki = rng.choice(_GRID, n)
        self._target = share * rng.uniform(10.0, 35.0, n) + (1.0 - share) * _PEEP
        self._sum = np.zeros(n)
        explores = (rng.uniform(size=n) < 0.5) & (case.style == "mixed")
        programmed = explores & (rng.uniform(size=n) < 0.5)
        added = share * _disturbance(case, time, rng)
        self._added = np.where((explores & ~programmed)[:, None], added, 0.0)
        self._programme = np.where(programmed[:, None], share * _programme(case, time, rng), np.nan)
        kind = rng.integers(0, 3, n)
        self._bias = np.where(explores, np.where(kind == 0, 0.0, rng.uniform(0.0, 6.0, n)), 5.0)
        self._soft = ~explores

    def command(self, k: int, measured: Floats) -> Floats:
        """Command after sample ``k``, %, not yet clipped, ``(n,)``; ``measured`` in cmH2O."""
        t = self._time[:, k]
        error = self._target - measured
        self._sum = self._sum + _INTEGRAL_SHARE * (error - self._sum)
        closed = self._kp * error + self._ki * self._sum + self._added[:, k]
        inspired = np.where(np.isnan(self._programme[:, k]), closed, self._programme[:, k])
        inspired = np.where(measured > _HIGHEST, 0.0, inspired)
        risen = -np.expm1(-np.maximum(t - 1.5, 0.0) * 5.0)
        return np.where(t < INSPIRATION, inspired, self._bias * np.where(self._soft, risen, 1.0))


def expiratory(time: Floats) -> NDArray[np.int8]:
    """Command of the expiratory valve, ``(n, T)``: 0 in inspiration, 1 (open) after it."""
    return (time >= INSPIRATION).astype(np.int8)


def _steady_command(case: Case, pressure: float | Floats) -> float | Floats:
    """Constant command, %, that raises the airway by ``pressure``, cmH2O, within inspiration."""
    return pressure / (0.0228 * case.lung_R + 22.8 / case.lung_C)


def _disturbance(case: Case, time: Floats, rng: np.random.Generator) -> Floats:
    """Additions to the command, %, ``(n, T)``: a falling ramp from the start, or a triangle."""
    n = len(time)
    size = 2.0 * _steady_command(case, rng.uniform(5.0, 25.0, (n, 1)))
    length = rng.uniform(0.3, 0.8, n)[:, None]
    ramp = size * np.maximum(1.0 - time / length, 0.0)
    first, last = rng.uniform(0.1, 0.4, n)[:, None], rng.uniform(0.5, 0.9, n)[:, None]
    up = np.maximum(1.0 - np.abs(2.0 * (time - first) / (last - first) - 1.0), 0.0)
    sign = np.where(rng.uniform(size=n) < 0.3, -0.5, 1.0)[:, None]
    return np.where(rng.uniform(size=(n, 1)) < 0.4, ramp, sign * size * up)


def _programme(case: Case, time: Floats, rng: np.random.Generator) -> Floats:
    """Commands without a loop, %, ``(n, T)``: pieces of 2 to 8 samples, level or sloping."""
    rows = []
    for t in time:
        mean = _steady_command(case, rng.uniform(8.0, 28.0))
        at = np.cumsum(np.concatenate([[0], rng.integers(2, 9, 40)]))
        levels = mean * rng.uniform(0.0, 2.0, len(at)) * (rng.uniform(size=len(at)) < 0.85)
        k = np.arange(len(t))
        steps = levels[np.searchsorted(at, k, side="right") - 1]
        rows.append(np.interp(k, at, levels) if rng.uniform() < 0.4 else steps)
    return np.array(rows)
