"""Breaths to learn from: cells drawn anew, and many of them in one scan."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from ventbench import draws, protocol
from ventbench import environment as env
from ventbench.interfaces import Plant
from ventbench.scenario import Scenario
from ventbench.training.rl import features

#: Commands of a breath that matter: the last one moves no pressure that is scored.
STEPS = protocol.INSPIRATION_STEPS - 1

#: Error that costs a reward of 1, cmH2O.
REWARD_SCALE = 10.0

#: Given a key, features ``(E, COUNT)`` and the PID's command, %, ``(E,)``: returns ``u_in``, %, and
#: what else is to be kept of the step.
Act = Callable[[Array, Array, Array], tuple[Array, Any]]


def sample(
    key: Array, count: int, lungs: int = 1, first: Array | int = 0, vary: bool = True
) -> Scenario:
    """Draw cells of one breath each, deviating from nominal as the published draws do.

    The distributions are those of :mod:`ventbench.draws`; its draws themselves are never used.

    Args:
        key: of the random numbers.
        count: number of cells E.
        lungs: cells of that many lungs in turn get the same nominal PIP.
        first: which of the six PIPs comes first.
        vary: false for nominal cells, without any deviation.
    """
    *keys, noise_key, sd_key = jax.random.split(key, len(draws.RANGES) + 2)
    drawn = {
        name: jax.random.uniform(k, (count,), minval=low, maxval=high)
        for k, (name, (low, high)) in zip(keys, draws.RANGES.items(), strict=True)
    }
    low, high = draws.NOISE_SD
    sd = jax.random.uniform(sd_key, (count, 1, 1), minval=low, maxval=high)
    noise = sd * jax.random.normal(noise_key, (count, 1, protocol.INSPIRATION_STEPS))
    which = (first + jnp.arange(count) // lungs) % len(protocol.PIPS)
    if not vary:
        kept = {name: 1.0 if name.endswith("scale") else 0.0 for name in drawn}
        drawn = {name: jnp.full((count,), value) for name, value in kept.items()}
        noise = jnp.zeros_like(noise)
    peep = protocol.PEEP + drawn["peep_shift"]
    return Scenario(
        pip=jnp.asarray(protocol.PIPS, noise.dtype)[which] + drawn["pip_shift"],
        peep=peep,
        start=peep + drawn["start_shift"],
        dt=protocol.DT * drawn["dt_scale"],
        r_scale=drawn["r_scale"],
        c_scale=drawn["c_scale"],
        delay=drawn["delay"],
        quantum=jnp.full((count,), draws.QUANTUM if vary else 0.0),
        noise=noise,
    )


def of_cells(plants: Plant, count: int) -> Plant:
    """One plant for each of ``count`` cells, the lungs in turn: leaves ``(L, ...)`` repeated."""
    lungs = jax.tree.leaves(plants)[0].shape[0]
    return jax.tree.map(lambda leaf: jnp.asarray(leaf)[jnp.arange(count) % lungs], plants)


def roll(plants: Plant, cells: Scenario, act: Act, key: Array) -> tuple[Array, Any, Array]:
    """Run one breath in every cell.

    Args:
        plants: leaves ``(E, ...)``, as of :func:`of_cells`.
        cells: E of them.
        act: see :data:`Act`; asked :data:`STEPS` times.
        key: split for the steps.

    Returns:
        Features before each command, shape ``(STEPS, E, COUNT)``; what ``act`` kept; rewards,
        ``-|error| / REWARD_SCALE`` after each command, shape ``(STEPS, E)``.
    """
    varied = env.vary(plants, cells)

    def step(carry: Any, now: tuple[Array, Array]) -> tuple[Any, tuple[Array, Any, Array]]:
        bench, memory = carry
        index, key = now
        memory, x, base = features.see(memory, env.observe(cells, bench, 0, index))
        asked, kept = act(key, x, base)
        bench, _ = env.inspire(varied, cells, bench, asked)
        return (bench, memory), (x, kept, -jnp.abs(bench.pressure - cells.pip) / REWARD_SCALE)

    start = (env.start_breath(varied, cells), features.init(cells.pip.shape))
    _, out = jax.lax.scan(step, start, (jnp.arange(STEPS), jax.random.split(key, STEPS)))
    return out


@partial(jax.jit, static_argnames="count")
def errors(plants: Plant, controller: Any, cells: Scenario, count: int) -> Array:
    """Mean ``|pressure - PIP|`` of one inspiration in each cell, cmH2O, shape ``(count,)``.

    Args:
        plants: leaves ``(L, ...)``, the lungs of the cells in turn.
        controller: a pure one that starts anew at each breath.
        cells: ``count`` of them.
        count: number of cells.
    """
    varied = env.vary(of_cells(plants, count), cells)

    def step(carry: Any, index: Array) -> tuple[Any, Array]:
        bench, state = carry
        state, asked = controller.step(state, env.observe(cells, bench, 0, index))
        after, _ = env.inspire(varied, cells, bench, asked)
        return (after, state), jnp.abs(bench.pressure - cells.pip)

    start = (env.start_breath(varied, cells), controller.init(cells.pip.shape))
    _, out = jax.lax.scan(step, start, jnp.arange(protocol.INSPIRATION_STEPS))
    return jnp.mean(out, axis=0)
