"""Recorded inspirations as the arrays that the training of the learned plant takes."""

from __future__ import annotations

from typing import Any

import flax.struct
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from ventbench.plants.learned import REFERENCE_DT, Normalisation

Floats = NDArray[np.floating]

#: Breaths and steps are padded to multiples of these, so that all lungs share one compilation.
_PAD_BREATHS, _PAD_STEPS = 128, 32


@flax.struct.dataclass
class WindowedInspirations:
    """Training data: inspirations, step by step, padded; every array float32.

    Attributes:
        start: first pressure, cmH2O, shape ``(n,)``.
        u_in: command of each step, %, shape ``(n, T)``.
        dt: time for which it was held, s, shape ``(n, T)``.
        after: pressure at its end, cmH2O, 0 where unknown, shape ``(n, T)``.
        weight: weight of the pressure in the loss, 0 where unknown, shape ``(n, T)``.
        window: measured pressures up to each step, the newest last, cmH2O, ``(n, T, H_p)``.
        known: whether each pressure of the window was measured, shape ``(n, T, H_p)``.
        count: breaths before the padding, shape ``()``.
    """

    start: Array
    u_in: Array
    dt: Array
    after: Array
    weight: Array
    window: Array
    known: Array
    count: Array


def inspirations(
    u_in: Floats,
    u_out: Floats,
    dt: Floats,
    pressure: Floats,
    window: int,
    weight: Floats | None = None,
) -> WindowedInspirations:
    """Arrange recorded breaths for training.

    Args:
        u_in: inspiratory valve, %, shape ``(n, T)``.
        u_out: expiratory valve, 0/1, shape ``(n, T)``.
        dt: time from each sample to the next, s, shape ``(n, T)``; the last one is not used.
        pressure: cmH2O, shape ``(n, T)``, NaN where blank. A blank first pressure takes the next
            one known, for the start alone.
        window: length of the pressure window.
        weight: weight of each breath in the loss, shape ``(n,)``; 1 if not given.

    Raises:
        ValueError: if shapes differ, there is no breath, a breath has no inspiration or no pressure
            to learn from, or a command or interval of an inspiration is not finite or possible.
    """
    u_in, u_out, dt, pressure = (np.asarray(x, float) for x in (u_in, u_out, dt, pressure))
    if not (u_in.ndim == 2 and u_in.shape == u_out.shape == dt.shape == pressure.shape):
        raise ValueError(
            f"training arrays must share one shape (n, T); got u_in {u_in.shape}, u_out "
            f"{u_out.shape}, dt {dt.shape}, pressure {pressure.shape}"
        )
    n, samples = u_in.shape
    if n == 0 or samples < 2:
        raise ValueError(f"training needs breaths of two samples or more; got shape {u_in.shape}")
    breath_weight = np.ones(n) if weight is None else np.asarray(weight, float)
    if breath_weight.shape != (n,) or not np.all(breath_weight >= 0):
        raise ValueError("weight must hold one number >= 0 for each breath")
    # Steps until the expiratory valve first opens.
    active = np.cumprod(u_out < 0.5, axis=1)[:, :-1] > 0
    for name, array, low, high in (("u_in", u_in, 0.0, 100.0), ("dt", dt, 1e-4, 1.0)):
        bad = active & ~((array[:, :-1] >= low) & (array[:, :-1] <= high))
        if bad.any():
            i, j = np.argwhere(bad)[0]
            raise ValueError(
                f"breath {i}, step {j}: {name} = {array[i, j]} is outside {low:g}..{high:g}"
            )
    known = np.isfinite(pressure)
    learnable = active & known[:, 1:]
    if not learnable.any(axis=1).all():
        i = int(np.flatnonzero(~learnable.any(axis=1))[0])
        raise ValueError(f"breath {i} has no inspiratory step with a known pressure after it")
    start = pressure[np.arange(n), np.argmax(known, axis=1)]

    steps = int(active.sum(axis=1).max())
    steps = -(-steps // _PAD_STEPS) * _PAD_STEPS
    rows = -(-n // _PAD_BREATHS) * _PAD_BREATHS

    def pad(values: NDArray[Any]) -> NDArray[Any]:
        values = values[:, :steps]
        return np.pad(values, ((0, rows - n), (0, steps - values.shape[1])))

    # Before the first sample the windows hold the start, as a lung at rest does.
    past = np.concatenate([np.repeat(start[:, None], window, axis=1), pressure[:, 1:-1]], axis=1)
    windows = np.lib.stride_tricks.sliding_window_view(past, window, axis=1)
    fields = {
        "start": np.pad(start, (0, rows - n)),
        "u_in": pad(np.where(active, u_in[:, :-1], 0.0)),
        "dt": np.where(pad(active), pad(dt[:, :-1]), REFERENCE_DT),
        "after": pad(np.where(learnable, pressure[:, 1:], 0.0)),
        "weight": pad(learnable * breath_weight[:, None]),
        "window": np.stack([pad(np.nan_to_num(windows[..., k])) for k in range(window)], axis=-1),
        "known": np.stack([pad(np.isfinite(windows[..., k])) for k in range(window)], axis=-1),
    }
    arrays = {
        name: jnp.asarray(x, bool if x.dtype == bool else jnp.float32) for name, x in fields.items()
    }
    return WindowedInspirations(**arrays, count=jnp.asarray(n, jnp.int32))


def normalisation(data: WindowedInspirations, tau: float) -> Normalisation:
    """Constants for the inputs and outputs of a network from what it will be trained on.

    Args:
        data: the training set.
        tau: time constant of expiration, s.
    """
    used = np.asarray(data.weight) > 0
    pressure, u_in = np.asarray(data.after)[used], np.asarray(data.u_in)[used]
    now = np.asarray(data.window)[..., -1][used]
    both = np.asarray(data.known)[..., -1][used]
    change = float(np.std((pressure - now)[both])) if both.any() else 1.0
    return Normalisation(
        pressure_mean=float(pressure.mean()),
        pressure_scale=max(float(pressure.std()), 1.0),
        control_mean=float(u_in.mean()),
        control_scale=max(float(u_in.std()), 1.0),
        jump_scale=max(change, 0.1),
        rate_scale=max(change, 0.1),
        tau=tau,
    )


def expiratory_time_constant(u_out: Floats, dt: Floats, pressure: Floats) -> float:
    """Fit the time constant of expiration, s, by least absolute error.

    Each expiration relaxes from its first pressure to a rest pressure of its own.

    Args:
        u_out: expiratory valve, 0/1, shape ``(n, T)``.
        dt: time from each sample to the next, s, shape ``(n, T)``.
        pressure: cmH2O, shape ``(n, T)``, NaN where blank; breaths with blanks are left out.

    Returns:
        A value in 0.02..2 s; 0.2 s if no expiration was measured.
    """
    taus = np.geomspace(0.02, 2.0, 100)
    error = np.zeros_like(taus)
    measured = False
    for valve, interval, p in zip(u_out, dt, pressure, strict=True):
        opened = np.flatnonzero(np.asarray(valve) > 0.5)
        if opened.size < 20 or not np.all(np.isfinite(p[opened[0] :])):
            continue
        first = opened[0]
        time = np.concatenate([[0.0], np.cumsum(interval[first:-1])])
        decay = np.exp(-time[:, None] / taus)
        p = np.asarray(p, float)[first:, None]
        excess = p - p[0] * decay  # = rest (1 - decay): its least squares is the rest pressure
        rest = (excess * (1 - decay)).sum(axis=0) / ((1 - decay) ** 2).sum(axis=0)
        error += np.abs(rest + (p[0] - rest) * decay - p).sum(axis=0)
        measured = True
    return float(taus[np.argmin(error)]) if measured else 0.2
