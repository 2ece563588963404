"""Breaths that could be recorded next: each family of commands stresses one part of the physics."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

#: Breaths in a family; they differ in size or in seed.
VARIANTS = 5

#: Ends of inspiration, s: of most families; of fast inflations; of slow ones.
_INSPIRED, _FAST, _SLOW = 1.0, 0.35, 1.5

#: Length of a hold with both valves shut, s, and of the shutters of an interrupted expiration.
_HOLD, _SHUTTER = 2.0, 0.16

#: Largest command of the inspiratory valve, %.
_LARGEST = 100.0


@dataclass(frozen=True)
class Rig:
    """Rough values of lung and valve; only the size of the commands depends on them.

    Attributes:
        R: resistance, cmH2O s/L.
        C: compliance, mL/cmH2O.
        gain: of the inspiratory valve, mL/s per %.
        peep: expiratory pressure, cmH2O.
    """

    R: float
    C: float
    gain: float
    peep: float


@dataclass(frozen=True, eq=False)
class Family:
    """k breaths of one kind.

    Attributes:
        name: short.
        title: what to do on the rig, in words.
        u_in: commands of the inspiratory valve, %, ``(k, T)``.
        u_out: commands of the expiratory valve, 0/1, ``(k, T)``.
    """

    name: str
    title: str
    u_in: Floats
    u_out: Floats

    def scaled(self, by: Floats) -> Family:
        """Return the family with each inspiration scaled by a factor, ``(k,)``."""
        return Family(self.name, self.title, self.u_in * by[:, None], self.u_out)

    def select(self, which: NDArray[np.bool_]) -> Family:
        """Return some of the breaths, by mask ``(k,)``."""
        return Family(self.name, self.title, self.u_in[which], self.u_out[which])


def families(rig: Rig, samples: int, dt: float) -> tuple[Family, ...]:
    """Make all families, sized so that an R-C lung stays at or below 35 cmH2O.

    Args:
        rig: lung and valve that the breaths are for.
        samples: number of samples of a breath.
        dt: time between samples, s.
    """
    t = np.arange(samples, dtype=np.float64) * dt
    return tuple(
        Family(name, title, *_sized(rig, dt, *shape(rig, t))) for name, title, shape in _KINDS
    )


def _sized(rig: Rig, dt: float, u: Floats, out: Floats, peaks: Floats) -> tuple[Floats, Floats]:
    """Scale inspirations to the peak pressures, cmH2O, that an R-C lung would reach."""
    flow = rig.gain * u
    rise = np.cumsum(flow, axis=1) * dt / rig.C + rig.R * flow / 1000.0
    wanted = np.maximum(peaks - rig.peep, 2.0)
    return np.clip(u * (wanted / rise.max(axis=1))[:, None], 0.0, _LARGEST), out


def _rows(t: Floats) -> Floats:
    return np.broadcast_to(t, (VARIANTS, len(t)))


def _opens(t: Floats, at: float) -> Floats:
    return (_rows(t) >= at - 1e-9).astype(float)


def _levels(low: float, high: float) -> Floats:
    return np.linspace(high, low, VARIANTS)


def _pressure_steps(rig: Rig, t: Floats) -> tuple[Floats, Floats, Floats]:
    """Flow of a controller that steps the pressure: it falls with the lung's time constant."""
    slow = max(rig.R * rig.C / 1000.0, 0.05)
    u = np.exp(-_rows(t) / slow) * (1.0 - np.exp(-(_rows(t) + 0.03) / 0.06)) + 0.02
    return u * (_rows(t) < _INSPIRED), _opens(t, _INSPIRED), _levels(12.0, 32.0)


def _pulses(peak: float, seed: int) -> Callable[[Rig, Floats], tuple[Floats, Floats, Floats]]:
    def shape(rig: Rig, t: Floats) -> tuple[Floats, Floats, Floats]:
        """Valve positions that last 2 to 5 samples, a third of them shut."""
        rng = np.random.default_rng(seed)
        u = np.zeros((VARIANTS, len(t)))
        for row in u:
            at = int(rng.integers(1, 3))
            while at < len(t):
                length = int(rng.integers(2, 6))
                shut = at > 3 and rng.uniform() < 0.35
                row[at : at + length] = 0.0 if shut else rng.uniform(0.15, 1.0)
                at += length
        return u * (_rows(t) < _INSPIRED), _opens(t, _INSPIRED), np.full(VARIANTS, peak)

    return shape


def _hold(rig: Rig, t: Floats) -> tuple[Floats, Floats, Floats]:
    u = (_rows(t) < _FAST).astype(float)
    return u, _opens(t, _FAST + _HOLD), _levels(12.0, 32.0)


def _ramp(rig: Rig, t: Floats) -> tuple[Floats, Floats, Floats]:
    u = np.clip(_rows(t) / _SLOW, 0.0, 1.0) * (_rows(t) < _SLOW)
    return u, _opens(t, _SLOW), _levels(12.0, 32.0)


def _staircase(rig: Rig, t: Floats) -> tuple[Floats, Floats, Floats]:
    """Small steps up, down and up again, so that the valve turns round."""
    heights = np.array([1.0, 2.0, 3.0, 4.0, 2.5, 1.0, 3.0, 0.5])
    step = np.minimum(_rows(t) / (_SLOW / len(heights)), len(heights) - 1).astype(int)
    return heights[step] * (_rows(t) < _SLOW), _opens(t, _SLOW), _levels(10.0, 25.0)


def _long_expiration(rig: Rig, t: Floats) -> tuple[Floats, Floats, Floats]:
    u = (_rows(t) < _FAST).astype(float)
    return u, _opens(t, _FAST), _levels(15.0, 35.0)


def _shutters(rig: Rig, t: Floats) -> tuple[Floats, Floats, Floats]:
    """Open and shut the expiratory valve in turn, at another pace in each breath."""
    u = (_rows(t) < _FAST).astype(float)
    pace = _SHUTTER * np.linspace(0.7, 1.6, VARIANTS)[:, None]
    late = _rows(t) - _FAST
    out = (late >= -1e-9) & ((late // pace).astype(int) % 2 == 0)
    return u, out.astype(float), _levels(20.0, 32.0)


_KINDS = (
    ("pressure_steps", "raise the pressure in one step and let it settle", _pressure_steps),
    ("strong_pulses", "pulse the inspiratory valve at random, strongly", _pulses(30.0, 1)),
    ("gentle_pulses", "pulse the inspiratory valve at random, gently", _pulses(16.0, 2)),
    ("hold", "inflate fast, then hold 2 s with both valves shut, then exhale", _hold),
    ("ramp", "open the inspiratory valve slowly and steadily", _ramp),
    ("staircase", "move the inspiratory valve in small steps, up and down", _staircase),
    ("long_expiration", "inflate fast, then exhale for a long time", _long_expiration),
    ("shutters", "inflate fast, then open and shut the expiratory valve in turn", _shutters),
)
