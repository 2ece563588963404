"""Commands of breaths, and the strengths at which mechanisms are tested."""

from __future__ import annotations

import numpy as np

from ventbench.physics import library
from ventbench.recordings import Breaths

from . import oracle

T = 64

#: Together with the mechanism, so that the oracle's equations have a solution.
WITH = {"inertance": {"circuit_compliance": {"compliance": 1.0}}}


def strengths(name, level="strong"):
    """Parameters of a mechanism and what it needs, by mechanism."""
    own = {p.name: getattr(p, level) for p in library()[name].description.parameters}
    return {name: own} | WITH.get(name, {})


def commands(n, seed=0):
    """Steps and drifts during inspiration, then an open expiratory valve; ``(n, T)`` each."""
    rng = np.random.default_rng(seed)
    dt = 0.032 + rng.uniform(-0.001, 0.001, (n, T))
    inspired = np.arange(T) < 31
    steps = np.repeat(rng.uniform(0, 26, (n, 8)), 4, axis=1)[:, :31]
    u_in = np.full((n, T), 3.0)
    u_in[:, :31] = np.clip(steps * rng.uniform(0.4, 1, (n, 1)) + rng.normal(0, 1.5, (n, 31)), 0, 60)
    return u_in, np.broadcast_to(~inspired * 1.0, (n, T)), dt


def recording(n, m, *, R=10.0, C=25.0, noise=0.0, seed=0, positions=None, each=None, **base):
    """Breaths by the oracle; ``each`` gives further parameters of a breath by its index."""
    u_in, u_out, dt = commands(n, seed)
    rng = np.random.default_rng(seed + 1000)
    start = 5.0 + rng.normal(0, 0.3, n)
    positions = np.linspace(0, 1, n) if positions is None else positions
    rows = np.stack(
        [
            oracle.breath(
                R,
                C,
                u_in[i],
                u_out[i],
                dt[i],
                start[i],
                m | (each(i) if each else {}),
                position=positions[i],
                **base,
            )
            for i in range(n)
        ]
    )
    pressure = rows[:, 0] + rng.normal(0, noise, (n, T))
    time = np.cumsum(np.pad(dt[:, :-1], ((0, 0), (1, 0))), axis=1)
    return Breaths(
        breath_id=np.arange(n),
        R=np.full(n, R),
        C=np.full(n, C),
        time=time,
        dt=dt.copy(),
        u_in=u_in,
        u_out=u_out.astype(np.int8),
        pressure=pressure,
        valid=np.ones((n, T), bool),
        time_inferred=np.zeros(n, bool),
        flow=rows[:, 1],
        volume=rows[:, 2],
    )
