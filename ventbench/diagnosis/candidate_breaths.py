"""Breaths that could be recorded next: each family of commands stresses one part of the physics."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ventbench.base.arrays import Bools, Floats

#: Breaths of each kind, and largest command of the inspiratory valve, %.
_VARIANTS, _MOST = 5, 100.0

#: Length of most inspirations, of fast and of slow inflations, of a hold with both valves shut, and
#: of the interruptions of an expiration, s.
_INSPIRATION, _FAST, _SLOW, _HOLD, _SHUTTER = 1.0, 0.35, 1.5, 2.0, 0.16


@dataclass(frozen=True)
class Rig:
    """Rough values of lung and valve; only the size of the commands depends on them."""

    R: float  #: resistance, cmH2O/(L/s).
    C: float  #: compliance, mL/cmH2O.
    gain: float  #: gain of the inspiratory valve, mL/s per %.
    peep: float  #: expiratory pressure, cmH2O.


@dataclass(frozen=True, eq=False)
class Family:
    """k breaths of one kind."""

    name: str  #: short.
    title: str  #: what to do on the rig, in words.
    u_in: Floats  #: commands of the inspiratory valve, %, ``(k, T)``.
    u_out: Floats  #: commands of the expiratory valve, 0/1, ``(k, T)``.

    def scaled(self, by: Floats) -> Family:
        """Return the family with each inspiration scaled by a factor, ``(k,)``."""
        return Family(self.name, self.title, self.u_in * by[:, None], self.u_out)

    def select(self, which: Bools) -> Family:
        """Return some of the breaths, by mask ``(k,)``."""
        return Family(self.name, self.title, self.u_in[which], self.u_out[which])


#: Makes commands ``u_in`` (of any size) and ``u_out``, ``(k, T)``, and peak pressures, cmH2O,
#: ``(k,)``, from times, s, ``(k, T)``.
_Shape = Callable[[Rig, Floats], tuple[Floats, Floats, Floats]]


def families(rig: Rig, samples: int, dt: float) -> tuple[Family, ...]:
    """Make all families, sized so that an R-C lung stays at or below 35 cmH2O.

    Args:
        rig: lung and valve that the breaths are for.
        samples: number of samples of a breath.
        dt: time between samples, s.
    """
    times = np.arange(samples, dtype=np.float64) * dt
    t = np.broadcast_to(times, (_VARIANTS, samples))
    made = []
    for name, title, shape in _KINDS:
        u_in, u_out, peaks = shape(rig, t)
        made.append(Family(name, title, _sized(rig, dt, u_in, peaks), u_out))
    return tuple(made)


def _sized(rig: Rig, dt: float, u: Floats, peaks: Floats) -> Floats:
    """Scale inspirations to the peak pressures, cmH2O, that an R-C lung would reach."""
    flow = rig.gain * u
    rise = np.cumsum(flow, axis=1) * dt / rig.C + rig.R * flow / 1000.0
    rise_limit = np.maximum(peaks - rig.peep, 2.0)
    return np.clip(u * (rise_limit / rise.max(axis=1))[:, None], 0.0, _MOST)


def _opens(t: Floats, at: float) -> Floats:
    return (t >= at - 1e-9).astype(float)


def _levels(t: Floats, low: float, high: float) -> Floats:
    return np.linspace(high, low, len(t))


def _pressure_steps(rig: Rig, t: Floats) -> tuple[Floats, Floats, Floats]:
    """Flow of a controller that steps the pressure: it falls with the lung's time constant."""
    slow = max(rig.R * rig.C / 1000.0, 0.05)
    u = np.exp(-t / slow) * (1.0 - np.exp(-(t + 0.03) / 0.06)) + 0.02
    return u * (t < _INSPIRATION), _opens(t, _INSPIRATION), _levels(t, 12.0, 32.0)


def _pulses(peak: float, seed: int) -> _Shape:
    def shape(rig: Rig, t: Floats) -> tuple[Floats, Floats, Floats]:
        """Valve positions that last 2 to 5 samples, a third of them shut."""
        rng, samples = np.random.default_rng(seed), t.shape[1]
        u = np.zeros(t.shape)
        for row in u:
            at = int(rng.integers(1, 3))
            while at < samples:
                length = int(rng.integers(2, 6))
                shut = at > 3 and rng.uniform() < 0.35
                row[at : at + length] = 0.0 if shut else rng.uniform(0.15, 1.0)
                at += length
        return u * (t < _INSPIRATION), _opens(t, _INSPIRATION), np.full(len(t), peak)

    return shape


def _hold(rig: Rig, t: Floats) -> tuple[Floats, Floats, Floats]:
    u = (t < _FAST).astype(float)
    return u, _opens(t, _FAST + _HOLD), _levels(t, 12.0, 32.0)


def _ramp(rig: Rig, t: Floats) -> tuple[Floats, Floats, Floats]:
    u = np.clip(t / _SLOW, 0.0, 1.0) * (t < _SLOW)
    return u, _opens(t, _SLOW), _levels(t, 12.0, 32.0)


def _staircase(rig: Rig, t: Floats) -> tuple[Floats, Floats, Floats]:
    """Small steps up, down and up again, so that the valve turns round."""
    heights = np.array([1.0, 2.0, 3.0, 4.0, 2.5, 1.0, 3.0, 0.5])
    step = np.minimum(t / (_SLOW / len(heights)), len(heights) - 1).astype(int)
    return heights[step] * (t < _SLOW), _opens(t, _SLOW), _levels(t, 10.0, 25.0)


def _long_expiration(rig: Rig, t: Floats) -> tuple[Floats, Floats, Floats]:
    u = (t < _FAST).astype(float)
    return u, _opens(t, _FAST), _levels(t, 15.0, 35.0)


def _shutters(rig: Rig, t: Floats) -> tuple[Floats, Floats, Floats]:
    """Open and shut the expiratory valve in turn, at another pace in each breath."""
    u = (t < _FAST).astype(float)
    pace = _SHUTTER * np.linspace(0.7, 1.6, len(t))[:, None]
    since_end = t - _FAST
    out = (since_end >= -1e-9) & ((since_end // pace).astype(int) % 2 == 0)
    return u, out.astype(float), _levels(t, 20.0, 32.0)


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
