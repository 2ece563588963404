"""Design ``parameters.npz``, and measure whether the learning converges on rigs it has not seen.

    python submissions/repetitive/make.py          # design, on training rigs
    python submissions/repetitive/make.py check    # norm of Q - L T; exit code 1 if it reaches 1

The gains are those of the scheduled PID. The feed-forward to begin with is that of the least mean
error over rigs of a kind, by Gauss and Newton with reweighted least squares; so is ``L``, from what
the errors of breath 2 tell of those of breath 3, whose valve has a gain of its own. ``L`` is
then made smaller until the norm of ``Q - L T`` is below a limit on all rigs of the design.
"""

import argparse
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from controller import ABOVE, LUNGS, STEPS, TIME_CONSTANT, counted, effort, features, kinds

from ventbench.base import compilation
from ventbench.plants import frozen
from ventbench.task import draws, protocol, rollouts
from ventbench.task import environment as env
from ventbench.train.plants import plants_to_train_on

FILE = Path(__file__).parent / "parameters.npz"
PIDS = Path(__file__).parents[1] / "pid_scheduled" / "lungs.npz"
PIPS = np.asarray(protocol.PIPS)

#: Cells of each lung and PIP, and renewals of the linearisation.
COPIES, RENEWALS = 12, 9

#: Standard deviation of the logarithm of a valve's gain between rigs, which the few rigs of the
#: training hardly show.
VALVES = 0.1

#: Largest norm on rigs of the design.
MOST = 0.9

#: Prior standard deviations of the feed-forward's changes, %, and of the elements of ``L`` over P.
BEGIN_SCALE, LEARNING_SCALE = 20.0, 0.5

#: An error below this has the weight of one of this size, cmH2O.
SOFT = 0.2

#: Steps of the pressure that an element of ``L`` looks back and ahead.
BACK, AHEAD = 1, 8

#: Change of the feed-forward that a response is measured by, %.
CHANGE = 1.0

#: Rigs of each lung that the check draws from the population, and the seed that they follow from.
DRAWN, SEED = 10, b"ventbench, repetitive, the check".ljust(32)


@jax.jit
def breath(plants, cells, number, gains, forward):
    """A breath of each cell: pressures, readings and commands, shape ``(n, STEPS)``.

    Args:
        plants: leaves ``(n, ...)``.
        cells: batch shape ``(n,)``.
        number: of the breath.
        gains: P, I, D, shape ``(n, 3)``.
        forward: feed-forward, %, shape ``(n, STEPS)``.
    """
    P, I, D = gains.T  # noqa: E741
    a = cells.dt / (cells.dt + TIME_CONSTANT)

    def policy(state, seen, feed):
        before, integral, derivative, _ = state
        error = seen.target - seen.pressure
        integral = integral + a * (error - integral)
        derivative = derivative + a * (error - before - derivative)
        u = P * error + I * integral + D * derivative + feed
        return (error, integral, derivative, seen.pressure), jnp.where(error > -ABOVE, u, 0.0)

    varied = env.vary(plants, cells, number)
    zero = jnp.zeros_like(cells.pip)

    def step(carry, at):
        carry, (pressure, u) = rollouts.control_step(
            varied,
            cells,
            policy,
            lambda before, _, __, u: (before.signals.scored, u),
            carry,
            (number, *at),
        )
        return carry, (pressure, carry[1][3], u)

    begin = (env.start_breath(varied, cells), (zero,) * 4)
    _, out = jax.lax.scan(step, begin, (jnp.arange(STEPS), forward.T))
    return jax.tree.map(lambda x: x.T, out)


class Bench:
    """Cells of lungs to try feed-forwards on.

    Args:
        plants: leaves ``(n, ...)``.
        cells: batch shape ``(n,)``.
    """

    def __init__(self, plants, cells):
        both = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), (plants, cells))
        self.plants, self.cells = both
        self.pip = np.asarray(cells.pip, float)[:, None]

    def run(self, number, gains, forward):
        """Pressures, errors as read, and commands of a breath, shape ``(n, STEPS)``."""
        arrays = (jnp.asarray(x, jnp.float32) for x in (gains, forward))
        found = breath(self.plants, self.cells, jnp.asarray(number), *arrays)
        pressure, reading, u = (np.asarray(x, float) for x in found)
        return pressure, self.pip - reading, u

    def responses(self, number, gains, forward):
        """Derivatives of pressures and of readings by the feed-forward, ``(n, STEPS, STEPS)``."""
        pressure, read, u = self.run(number, gains, forward)
        inwards = np.where(u > 0.5 * protocol.U_MAX, -CHANGE, CHANGE)
        by = []
        for step in range(STEPS - 1):
            moved = inwards * (np.arange(STEPS) == step)
            after = self.run(number, gains, forward + moved)
            by.append(np.stack([after[0] - pressure, read - after[1]]) / inwards[:, step, None])
        by.append(np.zeros_like(by[0]))
        return np.moveaxis(np.array(by), 0, -1)


def norms(p, weight, T, u):
    """Norm of ``Q - L T`` of each cell, with the errors that count.

    Args:
        p: parameters.
        weight: of kinds of lungs, shape ``(n, 6)``.
        T: derivatives of readings by the feed-forward, shape ``(n, STEPS, STEPS)``.
        u: commands, %, shape ``(n, STEPS)``.
    """
    free = np.array([counted(own, np.ones(STEPS)) for own in u])
    L = np.tensordot(weight, p["learning"], 1)
    return np.linalg.norm(p["keep"] - L @ (free[:, :, None] * T), 2, axis=(1, 2))


def weighted(rows, right, error, scale):
    """Ridge regression with each row's weight the inverse of its error: nearly least absolutes."""
    weight = 1.0 / np.maximum(np.abs(error), SOFT)
    normal = rows.T @ (weight[:, None] * rows) + len(rows) / STEPS * np.diag(scale**-2.0)
    return np.linalg.solve(normal, rows.T @ (weight * right))


def told(p, bench, wanted):
    """What the first breath of each cell tells.

    Args:
        p: parameters; what efforts are measured by is added if it is not there.
        bench: cells; of each lung as many, in turn, if so.
        wanted: rise of breath 2, cmH2O, shape ``(n,)``.

    Returns:
        Weights of kinds, shape ``(n, 6)``; features, shape ``(n, 6, 5)``.
    """
    n = len(bench.pip)
    _, error, u = bench.run(0, np.tile(p["first"], (n, 1)), np.zeros((n, STEPS)))
    took = effort(u, bench.pip - error, error[:, 0])
    if "centre" not in p:
        own = took.reshape(6, -1, took.shape[-1])
        away = (own - own.mean(1, keepdims=True)).reshape(len(took), -1)
        covariance = away.T @ away / len(away)
        p |= {
            "centre": own.mean(1),
            "precision": np.linalg.inv(covariance),
            "deviation": np.sqrt(covariance.diagonal()),
        }
    pairs = zip(took, wanted, strict=True)
    return np.array([kinds(p, x) for x in took]), np.array([features(p, *x) for x in pairs])


def gains_of(p, weight):
    """P, I, D of cells, % per cmH2O, shape ``(n, 3)``."""
    return np.exp(weight @ np.log(p["gains"]))


def forward_of(p, weight, each):
    """Feed-forward to begin with of cells, %, shape ``(n, STEPS)``."""
    return np.einsum("nk,nkm,kms->ns", weight, each, p["begin"])


def by_lung(bench, pressure):
    """Mean error without the first step on each of six lungs, cmH2O."""
    return np.abs((bench.pip - pressure)[:, 1:]).reshape(6, -1).mean(1)


def first_forward(p, bench, weight, each):
    """Choose ``begin``: what the feed-forward to begin with is for features of a kind."""
    gains, terms = gains_of(p, weight), p["begin"][0].size
    lung = np.arange(len(weight)) * 6 // len(weight)
    for turn in range(RENEWALS):
        forward = forward_of(p, weight, each)
        pressure, _, _ = bench.run(1, gains, forward)
        errors = by_lung(bench, pressure)
        print(f"{turn}: error of breath 2", errors.round(3), errors.mean().round(4), flush=True)
        if turn == RENEWALS - 1:
            return
        T = bench.responses(1, gains, forward)[0][:, 1:]
        for kind in range(6):
            own = lung == kind
            shares = each[own, kind] * weight[own, kind][:, None]
            rows = np.einsum("nts,nm->ntms", T[own], shares).reshape(-1, terms)
            right = (bench.pip - pressure)[own, 1:].ravel()
            change = weighted(rows, right, right, np.full(terms, BEGIN_SCALE))
            p["begin"][kind] += change.reshape(p["begin"][kind].shape)


def learning(p, bench, weight, each):
    """Choose ``L``: what the errors of breath 2 tell of the feed-forward of breath 3."""
    gains, forward = gains_of(p, weight), forward_of(p, weight, each)
    lung = np.arange(len(weight)) * 6 // len(weight)
    _, read, u = bench.run(1, gains, forward)
    pressure, _, commands = bench.run(2, gains, forward)
    d = np.array([counted(*own) for own in zip(u, read, strict=True)])
    T, by_reading = bench.responses(2, gains, forward)
    lag = np.subtract.outer(np.arange(STEPS), np.arange(STEPS)).T
    at = np.nonzero((lag >= -BACK) & (lag <= AHEAD))
    for kind in range(6):
        own = np.flatnonzero(lung == kind)
        rows = (T[own][:, 1:, at[0]] * d[own][:, None, at[1]]).reshape(-1, len(at[0]))
        right = (bench.pip - pressure)[own, 1:].ravel()
        scale = np.full(len(at[0]), LEARNING_SCALE * p["gains"][kind][0])
        p["learning"][kind][at] = weighted(rows, right, right, scale)
        share, whole = 1.0, p["learning"][kind].copy()
        only = np.tile(np.arange(6) == kind, (len(own), 1))
        while norms(p, only, by_reading[own], commands[own]).max() > MOST:
            share *= 0.9
            p["learning"][kind] = share * whole
        print(f"{LUNGS[kind]}: {share:.2f} of L", flush=True)
    taught = np.einsum("nk,kst,nt->ns", weight, p["learning"], d)
    after, *_ = bench.run(2, gains, forward + taught)
    both = by_lung(bench, pressure), by_lung(bench, after)
    print("error of breath 3 without and with learning", *(x.round(3) for x in both))


def design():
    """Choose all parameters, and write them."""
    given = plants_to_train_on("frozen")
    members, lungs = jax.tree.leaves(given.plants)[0].shape[:2]
    lung, pip, _ = (x.ravel() for x in np.indices((lungs, len(PIPS), COPIES)))
    cell_key, key, valve_key = jax.random.split(jax.random.key(0), 3)
    member = np.asarray(jax.random.randint(key, lung.shape, 0, members))
    plants = jax.tree.map(lambda leaf: np.asarray(leaf)[member, lung], given.plants)
    cells: Any = draws.random_scenarios(cell_key, jnp.asarray(PIPS[pip], jnp.float32), smooth=True)
    scatter = jnp.exp(VALVES * jax.random.normal(valve_key, lung.shape))
    bench = Bench(plants, cells.replace(gain=cells.gain * scatter[:, None]))
    away = abs(np.subtract.outer(np.arange(STEPS), np.arange(STEPS)))
    with np.load(PIDS) as pids:
        p = {"first": pids["single"], "gains": pids["gains"]}
    p |= {
        "begin": np.zeros((6, 5, STEPS)),
        "learning": np.zeros((6, STEPS, STEPS)),
        "keep": 0.6 * (away == 0) + 0.1 * (away == 1),
    }
    weight, each = told(p, bench, bench.pip[:, 0] - np.asarray(cells.start))
    right = np.mean(weight.argmax(1) == lung)
    print(f"kind of lung told in {100 * right:.0f} % of the cells", flush=True)
    first_forward(p, bench, weight, each)
    learning(p, bench, weight, each)
    np.savez(FILE, **p)


def check():
    """Print the largest norm by lung on rigs held out and drawn; say whether all are below 1."""
    p, official, most = dict(np.load(FILE)), frozen.load(), []
    assert official.population is not None, "the official simulators have a population"
    for at, name in enumerate(official.lung_ids):
        apart = list(official.held_out_rigs[at])
        known = jax.tree.map(lambda leaf, apart=apart: leaf[0, apart], official.sessions_plants)
        drawn = official.population.rigs(SEED, at, 12 - len(apart))
        rigs = jax.tree.map(lambda *x: np.concatenate(x), known, drawn)
        rig, pip = (x.ravel() for x in np.indices((12, len(PIPS))))
        plants = jax.tree.map(lambda leaf, rig=rig: leaf[rig], rigs)
        bench = Bench(plants, env.nominal_scenario(PIPS[pip]))
        weight, each = told(p, bench, bench.pip[:, 0] - protocol.PEEP)
        gains, forward = gains_of(p, weight), forward_of(p, weight, each)
        _, _, u = bench.run(1, gains, forward)
        found = norms(p, weight, bench.responses(1, gains, forward)[1], u)
        most.append(found.max())
        print(f"{name}: 12 rigs, norm {most[-1]:.3f} at most, {found.mean():.3f} mean", flush=True)
    print(f"largest norm of Q - L T: {max(most):.3f}")
    return max(most) < 1.0


def main():
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("what", choices=["design", "check"], default="design", nargs="?")
    given = parser.parse_args()
    compilation.keep()
    if given.what == "check":
        sys.exit(0 if check() else 1)
    design()


if __name__ == "__main__":
    main()
