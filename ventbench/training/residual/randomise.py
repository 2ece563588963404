"""Benches that deviate as those of the published draws do, drawn anew for every update."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from ventbench import draws, protocol
from ventbench.scenario import Scenario


def scenarios(key: Array, pip: Array, nominal: Array, spread: float) -> Scenario:
    """Deviations from the distributions of :mod:`ventbench.draws`; never its published draws.

    The converter's step is there as noise of its width, as rounding has no derivative.

    Args:
        key: of all random numbers.
        pip: nominal, cmH2O, shape ``(n,)``.
        nominal: cells without any deviation, boolean, shape ``(n,)``.
        spread: how far the deviations reach, as a multiple of the draws' ranges. The delay stays
            below one step, and noise grows likewise.

    Returns:
        Cells of batch shape ``(n,)``.
    """
    n = pip.shape[0]
    keys = iter(jax.random.split(key, len(draws.RANGES) + 3))
    on = spread * ~nominal
    drawn = {}
    for name, (low, high) in draws.RANGES.items():
        middle = {"dt_scale": 1.0, "r_scale": 1.0, "c_scale": 1.0}.get(name, 0.0)
        value = jax.random.uniform(next(keys), (n,), minval=low - middle, maxval=high - middle)
        drawn[name] = middle + on * value
    sd = jax.random.uniform(next(keys), (n,), minval=draws.NOISE_SD[0], maxval=draws.NOISE_SD[1])
    shape = (n, protocol.BREATHS, protocol.INSPIRATION_STEPS)
    noise = sd[:, None, None] * jax.random.normal(next(keys), shape)
    noise += draws.QUANTUM * jax.random.uniform(next(keys), shape, minval=-0.5, maxval=0.5)
    peep = protocol.PEEP + drawn["peep_shift"]
    return Scenario(
        pip=pip + drawn["pip_shift"],
        peep=peep,
        start=peep + drawn["start_shift"],
        dt=protocol.DT * drawn["dt_scale"],
        r_scale=drawn["r_scale"],
        c_scale=drawn["c_scale"],
        delay=jnp.minimum(drawn["delay"], 0.99),
        quantum=jnp.zeros(n),
        noise=on[:, None, None] * noise,
    )
