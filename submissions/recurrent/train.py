"""Train the network by gradients through the simulators, and write ``weights.npz``.

    python submissions/recurrent/train.py                  # the shipped weights, within the spread
    python submissions/recurrent/train.py --seed 1 --out submissions/recurrent/seeds/1

An interrupted training continues where its checkpoint is. One processor core is enough.

Every update draws runs of three breaths of three kinds: on rigs around the training rigs, as a
mixed model of them says; on the training rigs themselves with the deviations of the draws; and far
beyond both, with lungs between and beyond the six, dead time, leaks, soft tubing, dead bands,
sensors that show too little, efforts of a patient and lungs that change after the first breath.
These are the tuning half of the stressors as terms of the simulators; the other half is in none.
"""

from __future__ import annotations

import argparse
import os
import time
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

os.environ.setdefault(
    "XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
)

import flax.struct
import jax
import jax.numpy as jnp
import network
import numpy as np
import optax
from jax import Array
from jax.ad_checkpoint import checkpoint_name
from optax.contrib import MuonDimensionNumbers, muon

from ventbench.base import compilation, files
from ventbench.controllers.pid import PID
from ventbench.entries.reference import PID_GAINS
from ventbench.plants import frozen
from ventbench.plants.hybrid import NAMES, from_vector, to_vector
from ventbench.task import draws, protocol, rollouts
from ventbench.task import environment as env
from ventbench.task.metrics.score import LEAST_HEADROOM
from ventbench.train.rigs.population import PRIOR_SESSIONS, UNCORRELATED_SESSIONS, design_of, scales

#: Runs of one update: each lung at each PIP so many times, of which these shares are of a kind.
TIMES, DRAWN, RECORDED = 10, 3, 4

#: Penalty of a pressure above the target by more than the room, or above the cap, 1/cmH2O.
ROOM, CAP, DANGER = 7.0, 45.0, 0.3

#: Weight of the runs far beyond, and what their error is compressed around, cmH2O.
BEYOND, COMPRESSED = 0.5, 2.0

#: Weights of the expected readings and of the rig's numbers, which the hidden layer has to tell.
EXPECTED, PROBE, PROBED = 0.02, 0.05, 6


#: In the backward pass what has these functions is kept: the compiler would repeat them in each
#: product that they are part of, which takes three times as long.
_KEPT = "kept"
_XP = SimpleNamespace(**vars(jnp))
_XP.tanh = lambda x: checkpoint_name(jnp.tanh(x), _KEPT)
_XP.arcsinh = lambda x: checkpoint_name(jnp.arcsinh(x), _KEPT)

_each = partial(jax.vmap, in_axes=-1, out_axes=-1)


@flax.struct.dataclass
class Altered:
    """Rigs with what they do not have of their own; every array has the batch shape ``(n,)``."""

    rig: Any  #: leaves ``(..., n)``, so that every operation runs over contiguous numbers.
    leak: Array  #: share of the expiratory valve that stays open.
    dead: Array  #: dead band of the inspiratory valve, %.
    wear: Array  #: share of the flow that is lost at 100 %.
    effort: Array  #: largest pressure of the muscles, cmH2O.
    onset: Array  #: of the effort, s.

    def init(self, pressure: Array, peep: Array | None = None) -> Any:
        state, signals = _each(lambda rig, *given: rig.init(*given))(self.rig, pressure, peep)
        return (state, jnp.zeros_like(pressure)), signals

    def step(self, carry: Any, u_in: Array, u_out: Array, dt: Array) -> Any:
        state, time = carry

        def muscles(at: Array) -> Array:
            phase = jnp.clip((at - self.onset) / 0.8, 0.0, 1.0)
            return self.effort * jnp.sin(jnp.pi * phase) ** 2

        more = muscles(time + dt) - muscles(time)
        state = state.replace(elastic=state.elastic - more, drop=state.drop + more)
        u_in = jnp.maximum(u_in - self.dead, 0.0) * (1.0 - self.wear * u_in / protocol.U_MAX)
        step = _each(lambda rig, *given: rig.step(*given))
        state, signals = step(self.rig, state, u_in, u_out + self.leak, dt)
        return (state, time + dt), signals


@flax.struct.dataclass
class Runs:
    """Runs of three breaths, n of them."""

    rigs: Any  #: leaves ``(n, ...)``.
    cells: env.Scenario
    altered: dict[str, Array]  #: fields of :class:`Altered`, ``(n, BREATHS)``.
    scales: Array  #: of R and C in each breath, ``(2, n, BREATHS)``.
    weight: Array  #: of the error, ``(n,)``.
    beyond: Array  #: whether it is of the third kind, ``(n,)``.


@flax.struct.dataclass
class Rigs:
    """What runs are drawn from."""

    mean: Array  #: of the rigs of each lung, ``(L, p)``.
    factor: Array  #: of the covariance between rigs, ``(p, p)``.
    recorded: Any  #: all members of the training rigs, leaves ``(K, L, ...)``.
    weight: Array  #: of each lung and PIP, ``(L, P)``.


def rigs_to_train_on() -> Rigs:
    """A population of the training rigs alone; the held-out rigs have no part.

    Its prior is that of :mod:`ventbench.train.rigs.population`. Fits shrink rigs towards their
    lung: what members of one rig differ by counts as well.
    """
    official = frozen.load()
    pairs = [(k, r) for k, rigs in enumerate(official.training_rigs) for r in rigs]
    members = len(jax.tree.leaves(official.members)[0])
    vectors = to_vector(official.members)[:, [rig for _, rig in pairs]]
    design = design_of([official.lung_ids[k] for k, _ in pairs])
    beta = np.linalg.lstsq(
        design.reshape(-1, design.shape[2]), vectors.mean(axis=0).ravel(), rcond=None
    )[0]
    off = (vectors - design @ beta).reshape(-1, len(NAMES))
    prior = np.diag(scales() ** 2)
    count = len(pairs)
    scatter = off.T @ off / members
    covariance = (PRIOR_SESSIONS * prior + scatter) / (PRIOR_SESSIONS + count)
    shrunk = count / (count + UNCORRELATED_SESSIONS)
    covariance = shrunk * covariance + (1.0 - shrunk) * np.diag(covariance.diagonal())
    first = [[k for k, _ in pairs].index(lung) for lung in range(len(official.lung_ids))]
    mean = design[first] @ beta
    chosen = [
        [(k // len(own) % members, own[k % len(own)]) for k in range(12)]
        for own in official.training_rigs
    ]
    at = np.array(chosen).transpose(1, 0, 2)
    recorded = jax.tree.map(
        lambda leaf: jnp.asarray(np.asarray(leaf)[at[..., 0], at[..., 1]], jnp.float32),
        official.members,
    )
    factor = np.linalg.cholesky(covariance)
    mean, factor = (jnp.asarray(x, jnp.float32) for x in (mean, factor))
    rigs: Any = Rigs(mean, factor, recorded, jnp.ones((len(mean), len(protocol.PIPS))))
    return rigs.replace(weight=_weights(rigs))


def _weights(rigs: Rigs) -> Array:
    """Mean of 1 / headroom of runs as of :func:`draw`, by lung and PIP."""
    lungs = rigs.weight.shape[0]
    runs = draw(rigs, jax.random.key(123), times=20)
    gains = jnp.asarray(PID_GAINS, jnp.float32)[jnp.arange(len(runs.weight)) % lungs]
    full = rollouts.Script(jnp.full(102, protocol.U_MAX))

    @jax.jit
    def pressures(controller: Any) -> Array:
        return rollouts.closed_loop(runs.rigs, controller, runs.cells)[0].pressure

    target = runs.cells.pip[:, None, None]
    pid = jnp.abs(pressures(PID(*gains.T)) - target)[:, 1:, 1:].mean((1, 2))
    rise = jnp.maximum(target - pressures(full), 0.0)[:, 1:, 1:].mean((1, 2))
    inverse = 1.0 / jnp.maximum(pid - rise, LEAST_HEADROOM)
    used = jnp.where(runs.beyond, 0.0, 1.0).reshape(-1, len(protocol.PIPS), lungs)
    inverse = inverse.reshape(used.shape)
    return ((inverse * used).sum(0) / used.sum(0)).T


def draw(rigs: Rigs, key: Array, times: int = TIMES) -> Runs:
    """Runs of all lungs at all PIPs, ``times`` each, of the three kinds in turn."""
    lungs, pips = rigs.weight.shape
    n = lungs * pips * times
    at = jnp.arange(n)
    lung, pip, kind = at % lungs, at // lungs % pips, at // (lungs * pips) % TIMES
    beyond = kind >= DRAWN + RECORDED
    recorded = (kind >= DRAWN) & ~beyond
    keys = iter(jax.random.split(key, 40))

    def uniform(low: float, high: float, shape: tuple[int, ...] = (n,)) -> Array:
        return jax.random.uniform(next(keys), shape, minval=low, maxval=high)

    def sometimes(share: float, low: float, high: float) -> Array:
        return beyond * (uniform(0.0, 1.0) < share) * uniform(low, high)

    vector = rigs.mean[lung]
    wide = jnp.where(beyond, uniform(0.7, 2.0), 1.0)
    vector = vector + wide[:, None] * (jax.random.normal(next(keys), vector.shape) @ rigs.factor.T)
    for name, room in (("resistance", 0.9), ("elastance", 0.2)):
        column = NAMES.index(name)
        means = rigs.mean[:, column]
        anywhere = uniform(0.0, 1.0) * (jnp.ptp(means) + 2 * room) + means.min() - room
        often = beyond & (uniform(0.0, 1.0) < 0.6)
        vector = vector.at[:, column].set(jnp.where(often, anywhere, vector[:, column]))
    member = jax.random.randint(next(keys), (n,), 0, jax.tree.leaves(rigs.recorded)[0].shape[0])
    plants = jax.tree.map(
        lambda new, old: jnp.where(
            recorded.reshape(-1, *[1] * (new.ndim - 1)), old[member, lung], new
        ),
        from_vector(vector),
        rigs.recorded,
    )
    plants = plants.replace(
        valve_delay=plants.valve_delay + sometimes(0.3, 0.0, 0.08),
        valve_lag=plants.valve_lag + sometimes(0.15, 0.0, 0.08),
        circuit_compliance=plants.circuit_compliance + 1e-3 * sometimes(0.2, 0.0, 3.0),
        K2=plants.K2 + sometimes(0.2, 0.0, 10.0),
    )
    wanted = jnp.asarray(protocol.PIPS)[pip]
    cells: Any = draws.random_scenarios(next(keys), wanted, smooth=True)
    # Rigs that are drawn anew do not deviate further; half of the others have no gain of a breath.
    steady = recorded & (uniform(0.0, 1.0) < 0.5)
    low = sometimes(0.15, -3.0, 0.0)
    cells = cells.replace(
        r_scale=jnp.where(recorded, cells.r_scale, 1.0),
        c_scale=jnp.where(recorded, cells.c_scale, 1.0),
        delay=jnp.where(recorded | beyond, cells.delay, 0.0),
        gain=jnp.where(steady[:, None], 1.0, cells.gain),
        noise=cells.noise + low[:, None, None],
    )
    shapes = jnp.asarray([[0.0, 1.0, 0.5], [0.0, 1.0, 1.0], [0.0, 0.5, 1.0]])
    which = jax.random.randint(next(keys), (2, n), 0, 3)
    change = jnp.stack([sometimes(0.2, -1.1, 1.1), sometimes(0.15, -0.9, 0.3)])
    effort = sometimes(0.15, 3.0, 12.0) * jnp.sign(uniform(-1.0, 1.0))
    constant = {
        "leak": sometimes(0.15, 0.0, 0.06) / plants.conductance,
        "dead": sometimes(0.15, 0.0, 3.5),
        "wear": sometimes(0.15, 0.0, 0.5),
        "onset": uniform(0.0, 0.4),
    }
    altered = {name: jnp.repeat(x[:, None], 3, axis=1) for name, x in constant.items()}
    altered["effort"] = effort[:, None] * shapes[0]
    weight = rigs.weight[lung, pip] * jnp.where(beyond, BEYOND, 1.0)
    return Runs(plants, cells, altered, jnp.exp(change[..., None] * shapes[which]), weight, beyond)


@jax.custom_vjp
def bounded(u_in: Array) -> Array:
    """A command in the valve's range; outside, the gradient passes where it leads back."""
    return jnp.clip(u_in, 0.0, protocol.U_MAX)


def _bounded(u_in: Array) -> tuple[Array, Array]:
    return jnp.clip(u_in, 0.0, protocol.U_MAX), u_in


def _back(u_in: Array, slope: Array) -> tuple[Array]:
    stuck = ((u_in < 0.0) & (slope > 0.0)) | ((u_in > protocol.U_MAX) & (slope < 0.0))
    return (jnp.where(stuck, 0.0, slope),)


bounded.defvjp(_bounded, _back)


def initial(key: Array) -> dict[str, Array]:
    """Weights before the training: a proportional controller around 15 %."""
    width, memory = network.WIDTH, network.MEMORY
    sizes = {name: int(np.prod(shape)) for name, shape in network.OUTPUTS.items()}
    total = sum(sizes.values())
    keys = iter(jax.random.split(key, 8))

    def dense(rows: int, columns: int, scale: float = 1.0) -> Array:
        return scale * jax.random.normal(next(keys), (rows, columns)) / np.sqrt(rows)

    out = jnp.zeros(total).at[: sizes["plan"]].set(0.3)
    gains = jnp.repeat(jnp.array([-0.15, 0.0, 0.0]), network.COMMANDS)
    first = sizes["plan"] + sizes["expected"]
    out = out.at[first : first + sizes["gains"]].set(gains)
    weights = {
        "in": dense(network.INPUTS, width),
        "in_bias": jnp.zeros(width),
        "out": dense(width, total, 0.1),
        "out_bias": out,
        "gates": dense(network.SEEN + memory, 2 * memory).T,
        "steps": jnp.zeros((network.COMMANDS, 2 * memory)).at[:, :memory].set(-1.0),
        "correct": jnp.zeros(memory),
        "probe": dense(width, PROBED, 0.1),
    }
    for k in range(2):
        weights[f"deep{k}"] = dense(width, width)
        weights[f"deep{k}_bias"] = jnp.zeros(width)
    return weights


def roll(weights: dict[str, Array], runs: Runs) -> tuple[Array, Array, Array]:
    """Run the network.

    Returns:
        Airway pressures at steps 2 to 34, ``(BREATHS, COMMANDS, n)``; errors of the expected
        readings in each breath, ``(BREATHS, n)``; and the hidden layer before each breath,
        ``(BREATHS, n, WIDTH)``.
    """
    cells, n = runs.cells, runs.weight.shape[0]
    target = cells.pip

    def breathe(before: tuple[Array, Array], breath: Array) -> Any:
        r_scale, c_scale = runs.scales[:, :, breath]
        own = (cells.r_scale * r_scale, cells.c_scale * c_scale, cells.gain[:, breath])
        plant: Any = Altered(
            jax.tree.map(lambda x: jnp.moveaxis(x, 0, -1), runs.rigs.vary(*own)),
            **{name: x[:, breath] for name, x in runs.altered.items()},
        )
        begun = env.start_breath(plant, cells)
        first = env.observe(cells, begun, breath, 0).pressure
        done = jnp.broadcast_to(jnp.arange(network.BEFORE) < breath, (n, network.BEFORE))
        x = network.features(jnp, *before, done.astype(target.dtype), target, cells.dt, first)
        hidden, parts = network.encode(jnp, weights, x, target)
        plan, expected, context = (parts[name].T for name in ("plan", "expected", "context"))

        def policy(state: Any, seen: Any, given: Any) -> Any:
            now, following, expected, gains, step = given
            whole = (now, following, expected, gains, context)
            asked, state = network.feedback(
                _XP, weights, state[0], seen.pressure, seen.target, whole, step
            )
            shut = seen.pressure > jnp.minimum(network.CAP, seen.target + network.ROOM)
            applied = jnp.where(shut, 0.0, bounded(asked))
            return (network.remember(state, applied, now), applied, seen.pressure), applied

        @partial(jax.checkpoint, policy=jax.checkpoint_policies.save_only_these_names(_KEPT))
        def step(carry: Any, at: Any) -> Any:
            loop, state = carry
            (loop, (state, applied, reading)), pressure = rollouts.control_step(
                plant,
                cells,
                policy,
                lambda _, after, *__: after.signals.scored,
                (loop, (state,)),
                (breath, *at),
            )
            return (loop, state), (pressure, applied, reading)

        following = jnp.concatenate([plan[1:], plan[-1:]])
        gains = jnp.moveaxis(parts["gains"], (2, 1), (0, 1))
        given = (plan, following, expected[:-1], gains, weights["steps"])
        (loop, _), (pressure, applied, reading) = jax.lax.scan(
            step, (begun, network.begin(jnp, (n,))), (jnp.arange(network.COMMANDS), given)
        )
        last = env.observe(cells, loop, breath, network.COMMANDS).pressure
        readings = jnp.concatenate([reading, last[None]])
        missed = jnp.abs(expected - jax.lax.stop_gradient(readings)).mean(0)
        # The third breath is written nowhere.
        made = zip(before, (applied, readings), strict=True)
        after = tuple(old.at[:, breath].set(new.T, mode="drop") for old, new in made)
        return after, (pressure, missed, hidden)

    sizes = (network.COMMANDS, network.READINGS)
    nothing: Any = tuple(jnp.zeros((n, network.BEFORE, size)) for size in sizes)
    return jax.lax.scan(breathe, nothing, jnp.arange(protocol.BREATHS))[1]


def _numbers(runs: Runs) -> Array:
    """Numbers of the rigs that the hidden layer has to tell, of the order of 1, ``(n, 6)``."""
    rig = runs.rigs.vary(runs.cells.r_scale, runs.cells.c_scale)
    columns = {
        "resistance": (jnp.log(rig.R + 0.5 * rig.K2) - 2.5) / 0.7,
        "elastance": (jnp.log(rig.E) - 3.9) / 0.7,
        "turbulence": (jnp.log(0.5 * rig.K2 / rig.R) + 0.5) / 0.7,
        "valve": (jnp.log(rig.valve(jnp.full_like(rig.R, 20.0))) + 0.8) / 0.2,
        "late": (rig.valve_delay - 0.015) / 0.01,
        "small": (jnp.log(rig.valve(jnp.full_like(rig.R, 5.0))) + 2.2) / 0.3,
    }
    return jnp.clip(jnp.stack(list(columns.values()), -1), -4.0, 4.0)


def loss(weights: dict[str, Array], runs: Runs) -> tuple[Array, Array]:
    pressure, missed, told = roll(weights, runs)
    target = runs.cells.pip
    error = jnp.abs(pressure - target)[1:].mean((0, 1))
    counted = jnp.where(runs.beyond, COMPRESSED * jnp.log1p(error / COMPRESSED), error)
    high = jnp.maximum(pressure - jnp.minimum(target + ROOM, CAP), 0.0)
    danger = (high + 0.1 * high**2).mean((0, 1)) * protocol.BREATHS
    wanted = _numbers(runs)
    probe = jnp.abs(told[1:] @ weights["probe"] - wanted).mean((0, 2))
    total = runs.weight * (counted + DANGER * danger) + EXPECTED * missed[1:].sum(0) + PROBE * probe
    kinds = [jnp.where(runs.beyond, 0.0, runs.weight * error), runs.beyond * error]
    shares = jnp.stack([1.0 - runs.beyond.mean(), runs.beyond.mean()])
    shown = jnp.stack([kind.mean() for kind in kinds]) / shares
    return total.mean(), jnp.concatenate([shown, jnp.stack([high.max(), probe.mean()])])


@flax.struct.dataclass
class State:
    weights: Any
    average: Any  #: of the weights over the last updates, which are written.
    optimiser: Any
    key: Array
    count: Array


#: Updates over which the rate rises.
_WARM = 100


def _matrices(weights: dict[str, Array]) -> dict[str, Any]:
    """Weights whose change Muon makes orthogonal; Adam has the rest."""
    names = ("in", "deep0", "deep1", "out", "gates")
    return {name: MuonDimensionNumbers() if name in names else None for name in weights}


_MATRICES: Any = _matrices

#: The optimiser without its rate. From the same weights and draws, 500 updates by Muon ended at
#: 18.0 on the development draws, by Adam at 18.5.
_OPTIMISER = optax.chain(
    optax.clip_by_global_norm(1.0),
    muon(-1.0, beta=0.9, adam_b2=0.99, consistent_rms=0.2, muon_weight_dimension_numbers=_MATRICES),
)


@partial(jax.jit, donate_argnums=0)
def update(state: State, rigs: Rigs, updates: Array, rate: Array) -> tuple[State, Array]:
    """One of so many updates, with a rate that rises, then falls as a cosine."""
    key, now = jax.random.split(jax.random.wrap_key_data(state.key))
    (_, shown), slope = jax.value_and_grad(loss, has_aux=True)(state.weights, draw(rigs, now))
    change, kept = _OPTIMISER.update(slope, state.optimiser, state.weights)
    falls = 0.01 + 0.99 * 0.5 * (1.0 + jnp.cos(jnp.pi * state.count / updates))
    rate = -rate * jnp.minimum((state.count + 1.0) / _WARM, falls)
    weights = jax.tree.map(lambda w, c: w + rate * c, state.weights, change)
    share = 1.0 / jnp.minimum(state.count + 1.0, 200.0)
    average = jax.tree.map(lambda a, w: a + share * (w - a), state.average, weights)
    return State(weights, average, kept, jax.random.key_data(key), state.count + 1), shown


def save(weights: dict[str, Array], path: Path) -> None:
    """Write the weights."""
    path.parent.mkdir(parents=True, exist_ok=True)
    arrays: Any = {k: np.asarray(v, np.float32) for k, v in weights.items() if k != "probe"}
    files.write_atomically(path, lambda file: np.savez(file, **arrays))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    here = Path(__file__).parent
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--updates", type=int, default=20000)
    parser.add_argument("--rate", type=float, default=2e-3)
    parser.add_argument("--out", type=Path, default=here)
    parser.add_argument("--checkpoint", type=Path)
    parser.add_argument("--start", type=Path, help="weights to begin with")
    args = parser.parse_args()
    compilation.keep()
    checkpoint = args.checkpoint or Path("runs") / f"recurrent-{args.seed}.npz"
    rigs = rigs_to_train_on()
    start, key = jax.random.split(jax.random.key(args.seed))
    weights = initial(start)
    if args.start is not None:
        with np.load(args.start) as arrays:
            weights |= {name: jnp.asarray(arrays[name]) for name in arrays.files}
    state = State(
        weights,
        jax.tree.map(jnp.copy, weights),
        _OPTIMISER.init(weights),
        jax.random.key_data(key),
        jnp.zeros(()),
    )
    if checkpoint.exists():
        leaves, tree = jax.tree.flatten(state)
        with np.load(checkpoint) as arrays:
            kept = [jnp.asarray(arrays[str(k)]) for k in range(len(leaves))]
        state = jax.tree.unflatten(tree, kept)
    begun, done = time.process_time(), int(state.count)
    for count in range(done, args.updates):
        state, shown = update(state, rigs, float(args.updates), args.rate)
        if (count + 1) % 50 == 0 or count + 1 == args.updates:
            figures = ", ".join(f"{x:.4f}" for x in np.asarray(shown))
            print(f"{count + 1} of {args.updates}: {figures}; {time.process_time() - begun:.0f} s")
        if (count + 1) % 200 == 0 or count + 1 == args.updates:
            checkpoint.parent.mkdir(parents=True, exist_ok=True)
            parts: Any = {str(k): np.asarray(x) for k, x in enumerate(jax.tree.leaves(state))}
            files.write_atomically(checkpoint, lambda file, a=parts: np.savez(file, **a))
            save(state.average, args.out / "weights.npz")


if __name__ == "__main__":
    main()
