"""Simulation-based inference: networks that have seen simulated recordings of the generators.

Amortised inference in the sense of K. Cranmer, J. Brehmer, G. Louppe (PNAS 117 (2020) 30055): a
recording becomes a row of summaries of what a line through pressure, flow and volume leaves, by
phase and breath, and small networks give each term of the vocabulary a probability of its own.
``benchmarks/train_classifier.py`` trains them on draws that are no challenge's; terms that joined
the vocabulary later have none. It knows the generators, which no other diagnoser does; sizes of
effects, R and C it does not tell.
"""

from __future__ import annotations

import hashlib
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from proofs.diagnosers.common import see
from ventbench.base.errors import InputError
from ventbench.recordings.breaths import Breaths

Floats, Flags = NDArray[np.float64], NDArray[np.bool_]

#: The weights, with what they were trained on, and their SHA-256.
WEIGHTS = Path(__file__).with_suffix(".npz")
SHA256 = "8888f456e6de8acb39f663002bd0f71dc947be6765a1c250061fb0fc61af8f69"

#: Flow of the valve, L/s per %; largest standardised summary; least probability that is told.
_GAIN, _LARGEST, _TINY = 0.0228, 4.0, 1e-5

#: Likeliest terms of which sets are formed, by the size of the set.
_COMBINED = {2: 10, 3: 7, 4: 6}

#: Bands of a spectrum, Hz, and samples after the opening at which an expiration is looked at.
_BANDS, _AFTER = ((0.5, 2.0), (2.0, 4.0), (4.0, 8.0), (8.0, 15.0)), (1, 3, 8)


def diagnose(folder: Path) -> dict[str, Any]:
    """Answer a case."""
    case, weights = see(folder), load()
    seen, asked = case.breaths.select(~case.apart), case.breaths.select(case.apart)
    (chances,) = probabilities(weights, summaries(seen)[None])
    return {
        "hypotheses": hypotheses(weights["terms"].tolist(), chances),
        "pressures": case.pressures(predicted(seen, asked)),
    }


def predicted(seen: Breaths, asked: Breaths) -> Floats:
    """Pressures of breaths by the line, cmH2O, ``(k, T)``; an expiration falls as those seen do."""
    base, inside, out, p = _line(seen)
    line = np.linalg.lstsq(base[inside], p[inside], rcond=None)[0]
    rows, last = np.arange(len(p)), seen.valid.sum(axis=1) - 1
    rest, opened = float(np.median(p[rows, last])), np.argmax(seen.u_out == 1, axis=1)
    after = np.minimum(opened[:, None] + np.arange(p.shape[1]), last[:, None])
    above = np.where(out[rows[:, None], after], p[rows[:, None], after] - rest, 0.0).sum(axis=0)
    base = _line(asked)[0]
    told, opened = base @ line, np.argmax(asked.u_out == 1, axis=1)
    since = np.maximum(np.arange(told.shape[1]) - opened[:, None], 0)
    top = told[np.arange(len(told)), opened][:, None] - rest
    return np.where(asked.u_out == 0, told, rest + top * (above / max(above[0], 1e-9))[since])


def load() -> dict[str, NDArray[Any]]:
    """Read the weights.

    Raises:
        InputError: if they are not those that :data:`SHA256` tells.
    """
    if hashlib.sha256(WEIGHTS.read_bytes()).hexdigest() != SHA256:
        raise InputError(f"{WEIGHTS} is not the file of {SHA256[:12]}; check it out again")
    with np.load(WEIGHTS) as kept:
        return dict(kept)


def probabilities(weights: dict[str, NDArray[Any]], x: Floats) -> Floats:
    """Mean probability of each term by the networks, ``(n, k)``, from summaries, ``(n, m)``."""
    z = np.clip((x - weights["mean"]) / weights["sd"], -_LARGEST, _LARGEST)
    inner = np.tanh(z @ weights["w1"] + weights["b1"][:, None])
    logits = inner @ weights["w2"] + weights["b2"][:, None]
    return np.mean(1.0 / (1.0 + np.exp(-logits.astype(float))), axis=0)


def hypotheses(terms: list[str], chances: Floats) -> list[dict[str, Any]]:
    """Nothing, each term, and sets of the likeliest, as if terms were independent."""
    odds = np.log(np.clip(chances, 1e-9, None)) - np.log1p(-np.clip(chances, None, 1.0 - 1e-9))
    likely = np.argsort(-odds).tolist()
    sets: list[tuple[int, ...]] = [(), *((k,) for k in range(len(terms)))]
    for size, count in _COMBINED.items():
        sets += combinations(likely[:count], size)
    logs = np.array([odds[list(chosen)].sum() for chosen in sets])
    weights = np.exp(logs - logs.max())
    weights /= weights.sum()
    kept = [(chosen, p) for chosen, p in zip(sets, weights.tolist(), strict=True) if p > _TINY]
    total = sum(p for _, p in kept)
    return [
        {"terms": sorted(terms[k] for k in chosen), "probability": p / total} for chosen, p in kept
    ]


def summaries(breaths: Breaths) -> Floats:
    """Summaries of a recording whose breaths have pressures, ``(m,)``."""
    base, inside, out, p = _line(breaths)
    u, q, v = breaths.u_in, base[..., 1], base[..., 2]
    step = float(np.median(breaths.dt[breaths.valid]))
    rows, last = np.arange(len(u)), breaths.valid.sum(axis=1) - 1
    n = np.broadcast_to(np.linspace(-1.0, 1.0, len(u))[:, None], u.shape)
    time = np.cumsum(_late(np.where(breaths.valid, breaths.dt, 0.0), 1), axis=1)
    frame, upper = np.linalg.qr(base[inside])
    line = np.asarray(np.linalg.solve(upper + 1e-9 * np.eye(3), frame.T @ p[inside]), float)
    r = np.where(inside, p - base @ line, 0.0)
    above, change = p - line[0], np.diff(u, axis=1, prepend=0.0)
    high, rough = np.quantile(p[inside], 0.9), np.diff(r, 2, axis=1)
    noise = max(1.4826 * float(np.median(np.abs(rough[inside[:, 2:]]))) / 6**0.5, 1e-3)
    spread, late = max(float(r[inside].std()), 1e-3), _late(q, 1) - q
    found = [
        np.log(spread / noise),
        np.log(noise),
        line[0] - 5.0,
        np.log(max(line[1], 0.1) / breaths.R[0]),
        np.log(max(line[2], 0.1) * breaths.C[0] / 1e3),
        np.log(breaths.R[0]),
        np.log(breaths.C[0]),
        np.log(step),
        np.log(len(u)),
        np.log(np.mean(r[inside] ** 4) / spread**4),
        np.mean(np.isclose(p[inside], p.max(), atol=0.05)),
    ]
    signals = (
        q**2,
        v**2,
        q * v,
        np.gradient(q, axis=1),
        late,
        _late(q, 2) - q,
        _late(q, 4) - q,
        np.cumsum(np.where(inside, above, 0.0), axis=1),
        np.cumsum(v, axis=1),
        np.exp(-time / 0.05),
        np.exp(-time / 0.2),
        above**2,
        above * q,
        np.maximum(p - high, 0.0),
        n,
        n * q,
        n * v,
        n * late,
        time * late,
        np.sin(2.0 * np.pi * u),
        np.sin(np.pi * u),
        _late(np.sign(u), 1),
        _late(np.minimum(u, 4.0), 1),
        np.cumsum(q, axis=1) * q,
        time,
        _late(np.sign(change), 1),
    )
    x = np.stack([signal[inside] for signal in signals], axis=1)
    found += _correlations(x - frame @ (frame.T @ x), r[inside])
    loudness = (np.abs(_late(change, 1)), q, v, time, n)
    x = np.stack([signal[inside] for signal in loudness], axis=1)
    found += _correlations(x - x.mean(axis=0), np.abs(r[inside]) - np.abs(r[inside]).mean())
    power = max(float((r**2).sum()), 1e-9)
    found += [float((r[:, k:] * r[:, :-k]).sum()) / power for k in (1, 2, 4, 8)]
    expired = np.where(out, p - np.median(p[out]), 0.0)
    for signal in (r, np.diff(expired, axis=1)):
        spectrum = np.abs(np.fft.rfft(signal, axis=1)) ** 2
        hertz = np.fft.rfftfreq(signal.shape[1], step)
        bands = [np.mean(spectrum[:, (hertz >= a) & (hertz < b)]) for a, b in _BANDS]
        found += np.diff(np.log(np.array(bands) + 1e-6)).tolist()
        mean = spectrum[:, (hertz > 1.5) & (hertz < 9.0)].mean(axis=0)
        found.append(np.log(mean.max() / (np.median(mean) + 1e-9) + 1.0))
    opened = np.argmax(out, axis=1)
    fall = [p[rows, np.minimum(opened + k, last)] - p[rows, last] for k in (0, *_AFTER)]
    found += [float(np.median(f / np.maximum(fall[0], 0.5))) for f in fall[1:]]
    found += [np.median(p[:, 0] - p[rows, last]), np.median(p[rows, last]) - line[0]]
    each = np.stack([_breath(base[k], r[k], inside[k], line) for k in rows])
    silent = np.log(np.mean(r**2, axis=1) + 1e-6), np.log(np.mean(rough**2, axis=1) + 1e-6)
    breathed = np.log(np.mean(np.diff(expired, 2, axis=1) ** 2, axis=1) + 1e-6)
    for series in (*each.T, p[:, 0], *silent, breathed):
        found += _course(series)
    return np.nan_to_num(np.array(found, float), posinf=0.0, neginf=0.0)


def _line(breaths: Breaths) -> tuple[Floats, Flags, Flags, Floats]:
    """One, flow and volume, ``(n, T, 3)``; samples that count in either phase; pressures."""
    counted = breaths.valid & np.isfinite(breaths.pressure)
    inside, out = counted & (breaths.u_out == 0), counted & (breaths.u_out == 1)
    inside[:, 0] = False
    # A command acts from its sample on, a pressure is read before it.
    q = _late(np.where(breaths.u_out == 0, _GAIN * breaths.u_in, 0.0), 1)
    v = np.cumsum(q * _late(np.where(breaths.valid, breaths.dt, 0.0), 1), axis=1)
    return np.stack([np.ones_like(q), q, v], -1), inside, out, np.nan_to_num(breaths.pressure)


def _late(signal: Floats, samples: int) -> Floats:
    return np.pad(signal, ((0, 0), (samples, 0)))[:, : signal.shape[1]]


def _correlations(x: Floats, y: Floats) -> list[float]:
    """Correlation of each column of ``x``, ``(n, k)``, with ``y``; both are centred."""
    sizes = np.linalg.norm(x, axis=0) * np.linalg.norm(y)
    return (x.T @ y / np.maximum(sizes, 1e-9)).tolist()


def _breath(base: Floats, r: Floats, inside: NDArray[np.bool_], line: Floats) -> Floats:
    """Offset, relative resistance and elastance of a breath beside those of all, ridged."""
    x = base[inside] * np.array([1.0, max(line[1], 1.0), max(line[2], 1.0)])
    return np.asarray(np.linalg.solve(x.T @ x + 0.3 * np.eye(3), x.T @ r[inside]), float)


def _course(series: Floats) -> list[float]:
    """How a number of each breath changes: spread, drift, step beyond it, outliers."""
    n, sd = np.linspace(-1.0, 1.0, len(series)), max(float(series.std()), 1e-6)
    centred = series - series.mean()
    drift = float(centred @ n) / (sd * len(series) * max(float(n.std()), 1e-6))
    sums = np.abs(np.cumsum(centred)) / (sd * len(series) ** 0.5)
    z = series - np.median(series)
    z = z / max(1.4826 * float(np.median(np.abs(z))), 1e-3)
    return [
        np.log(sd),
        drift,
        float(sums.max()),
        float(np.log1p(z.max())),
        float(np.log1p(-z.min())),
        float(np.mean(np.abs(z) > 4.0)),
    ]
