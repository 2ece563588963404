"""Training of the residual controller: gradients through the simulators, Adam, one compiled scan.

The paper's objective, the mean of ``|pressure - PIP| + lambda |correction|`` over inspirations, is
differentiated through the controller, the valve and the simulator. Each update runs every lung at
every PIP. For protocol version 1 that is once on the official simulator without noise, and several
times with deviations drawn as those of the published draws are. For version 2 every run has
deviations and is on any rig and member, the airway pressure counts, and errors are divided by what
there is to gain in the cell, as in the normalised score.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array
from numpy.typing import ArrayLike

from ventbench import draws, protocol, rig_draws
from ventbench import environment as env
from ventbench.controllers.pid import PID
from ventbench.controllers.residual import Residual, untrained
from ventbench.environment import Scenario
from ventbench.interfaces import Plant
from ventbench.resume import Checkpoint, fingerprint


@dataclass(frozen=True)
class ResidualConfig:
    """Settings of the training of residual controllers; hashable, since they are static in ``jit``.

    Attributes:
        protocol: version of the protocol that is trained for: which pressure counts, and how far
            deviations reach.
        updates: number of updates of the network; the schedule stretches over them.
        copies: runs of each lung at each PIP in an update. In version 1 the first is on the
            official simulator without noise; all others have random deviations.
        learning_rate: peak of the cosine schedule of Adam.
        weight_decay: decay of the network's weights.
        lam: weight of the mean absolute correction, cmH2O for each %; the paper's lambda.
        agreement: weight of the disagreement of the ensemble along the controller's own commands;
            0 to train on the official simulator's response alone.
        first_breath: weight of the breath that is not scored; each scored breath has 1.
        widths: units of the network's hidden layers.
        pressures: number of earlier errors that it sees.
        commands: number of earlier commands that it sees.
        ahead: number of steps of the previous breath that it sees; 0 for none.
        limit: largest correction, %.
        members: members of the simulators' ensemble, 1 (the official ones) to 5; in version 2 the
            members of every rig are trained on.
        spread: reach of the deviations, as a multiple of the draws' ranges; 0 for none.
        round_robin: whether each update takes one lung at one PIP, in turn, as in the paper,
            instead of all of them.
    """

    protocol: int = 1
    updates: int = 3000
    copies: int = 4
    learning_rate: float = 4e-3
    weight_decay: float = 1e-5
    lam: float = 0.0
    agreement: float = 1.0
    first_breath: float = 0.25
    widths: tuple[int, ...] = (64, 64)
    pressures: int = 5
    commands: int = 6
    ahead: int = 6
    limit: float = 100.0
    members: int = 5
    spread: float = 1.0
    round_robin: bool = False

    def __post_init__(self) -> None:
        """Refuse numbers that cannot work.

        Raises:
            ValueError: naming the field and its value.
        """
        if self.protocol not in protocol.VERSIONS:
            raise ValueError(f"training: protocol = {self.protocol} is none of {protocol.VERSIONS}")
        for name in ("updates", "copies", "learning_rate", "limit", "members"):
            if not getattr(self, name) > 0:
                raise ValueError(f"training: {name} = {getattr(self, name)} must be positive")
        for name in (
            "weight_decay",
            "lam",
            "agreement",
            "first_breath",
            "pressures",
            "commands",
            "ahead",
        ):
            if not getattr(self, name) >= 0:
                raise ValueError(f"training: {name} = {getattr(self, name)} must not be negative")
        if not 0 <= self.spread <= 4:
            raise ValueError(f"training: spread = {self.spread} is outside 0..4")


#: Settings for version 2. There is no term for the ensemble's disagreement: its members are among
#: the plants that are trained on, and drawn when a controller is scored.
RIGS_CONFIG = ResidualConfig(protocol=2, copies=6, agreement=0.0, first_breath=0.1)


@jax.custom_vjp
def valve(u_in: Array) -> Array:
    """Clip a command to the valve's range, %, with a derivative where it leads back into it."""
    return jnp.clip(u_in, 0.0, protocol.U_MAX)


def _valve_forward(u_in: Array) -> tuple[Array, Array]:
    return valve(u_in), u_in


def _valve_backward(u_in: Array, gradient: Array) -> tuple[Array]:
    # Beyond an end of the range only a gradient that leads back into it passes.
    stuck = ((u_in > protocol.U_MAX) & (gradient < 0)) | ((u_in < 0) & (gradient > 0))
    return (jnp.where(stuck, 0.0, gradient),)


valve.defvjp(_valve_forward, _valve_backward)


@flax.struct.dataclass
class DifferentiableRun:
    """One run of three inspirations; every array ``(..., BREATHS, INSPIRATION_STEPS)``.

    Attributes:
        pressure: scored pressure, cmH2O.
        correction: correction of the PID's command, %.
        u_in: command as applied, %.
    """

    pressure: Array
    correction: Array
    u_in: Array


def run(
    controller: Residual, plant: Plant, cell: Scenario, airway: bool = False
) -> DifferentiableRun:
    """Run a controller through three inspirations.

    Args:
        controller: the controller.
        plant: plant of one lung.
        cell: one cell, batch shape ``()``.
        airway: return the airway pressure (protocol version 2), not the reading.
    """
    varied = env.vary(plant, cell)
    start = env.start_breath(varied, cell)

    def step(
        carry: tuple[Any, env.LoopState], at: tuple[Array, Array]
    ) -> tuple[Any, DifferentiableRun]:
        state, loop = carry
        breath, index = at
        # In one scan over all breaths: half the compilation of a scan of scans.
        loop = jax.tree.map(lambda new, old: jnp.where(index == 0, new, old), start, loop)
        seen = env.observe(cell, loop, breath, index)
        state, base, correction = controller.parts(state, seen)
        after, applied = env.inspire(varied, cell, loop, valve(base + correction))
        pressure = env.airway_pressure(varied, loop) if airway else loop.pressure
        return (state, after), DifferentiableRun(pressure, correction, applied)

    count = jnp.arange(protocol.BREATHS * protocol.INSPIRATION_STEPS)
    at = (count // protocol.INSPIRATION_STEPS, count % protocol.INSPIRATION_STEPS)
    _, steps = jax.lax.scan(step, (controller.init(()), start), at)
    shape = (protocol.BREATHS, protocol.INSPIRATION_STEPS)
    return jax.tree.map(lambda leaf: leaf.reshape(shape), steps)


def objective(
    controller: Residual,
    plants: Plant,
    cells: Scenario,
    first_breath: float,
    lam: float,
    *,
    airway: bool = False,
    weight: Array | float = 1.0,
) -> tuple[Array, Array]:
    """Mean of ``|pressure - PIP| + lam |correction|`` over inspirations and runs.

    Args:
        controller: the controller.
        plants: leaves ``(n, ...)``.
        cells: batch shape ``(n,)``.
        first_breath: weight of the first breath; the others have 1.
        lam: cmH2O for each %.
        airway: see :func:`run`.
        weight: of each run, shape ``(n,)`` or ``()``.

    Returns:
        The loss, cmH2O, and the applied commands, %, ``(n, BREATHS, INSPIRATION_STEPS)``.
    """
    runs = jax.vmap(partial(run, airway=airway), (None, 0, 0))(controller, plants, cells)
    scored = jnp.isin(jnp.arange(protocol.BREATHS), jnp.array(protocol.SCORED_BREATHS))
    breath = jnp.where(scored, 1.0, first_breath)[:, None]
    each = jnp.abs(runs.pressure - cells.pip[:, None, None]) + lam * jnp.abs(runs.correction)
    total = jnp.mean(each * breath * jnp.reshape(weight, (-1, 1, 1)))
    return total / jnp.mean(breath), runs.u_in


def disagreement(ensemble: Plant, cells: Scenario, u_in: Array) -> Array:
    """Disagreement of the members of an ensemble about the response to the same commands.

    Args:
        ensemble: leaves ``(members, n, ...)``, two members at least.
        cells: batch shape ``(n,)``.
        u_in: commands of one inspiration, %, shape ``(n, INSPIRATION_STEPS)``.

    Returns:
        Sample standard deviation over members of the pressure, mean over steps and cells, cmH2O:
        the exploitation index of one breath.
    """

    def pressures(plant: Plant, cell: Scenario, u_in: Array) -> Array:
        varied = env.vary(plant, cell)

        def step(loop: env.LoopState, u_in: Array) -> tuple[env.LoopState, Array]:
            after, _ = env.inspire(varied, cell, loop, u_in)
            return after, loop.pressure

        return jax.lax.scan(step, env.start_breath(varied, cell), u_in)[1]

    each = jax.vmap(jax.vmap(pressures), (0, None, None))(ensemble, cells, u_in)
    variance = jnp.var(each, axis=0, ddof=1)
    # 1e-6 keeps the derivative finite where all members agree, as in the first step.
    return jnp.mean(jnp.sqrt(variance + 1e-6))


#: Called with the number of updates done, the number of all updates, and the mean loss since the
#: last call, cmH2O.
Progress = Callable[[int, int, float], None]

#: Updates compiled into one scan; a checkpoint or a Ctrl-C falls between two of them.
CHUNK = 50


def _optimiser(config: ResidualConfig) -> optax.GradientTransformation:
    warm = max(config.updates // 50, 1)
    schedule = optax.warmup_cosine_decay_schedule(
        0.0, config.learning_rate, warm, max(config.updates, warm + 1)
    )
    return optax.chain(
        optax.clip_by_global_norm(1.0), optax.adamw(schedule, weight_decay=config.weight_decay)
    )


def _cells(number: Array, lungs: int, pips: int, config: ResidualConfig) -> tuple[Array, Array]:
    """Lung and PIP of each run of an update."""
    if config.round_robin:
        cell = jnp.full(config.copies, number % (lungs * pips))
    else:
        cell = jnp.repeat(jnp.arange(lungs * pips), config.copies)
    return cell // pips, cell % pips


@partial(jax.jit, static_argnames="config")
def _advance(
    carry: tuple[Any, Any],
    controller: Residual,
    plants: Plant,
    key: Array,
    first: Array,
    weights: Array,
    config: ResidualConfig,
) -> tuple[tuple[Any, Any], Array]:
    """``CHUNK`` updates, fewer at the end; returns layers, the optimiser's state and mean loss."""
    optimiser = _optimiser(config)
    members, lungs = jax.tree.leaves(plants)[0].shape[:2]
    pips = jnp.asarray(protocol.PIPS, jnp.float32)

    def update(carry: tuple[Any, Any], number: Array) -> tuple[tuple[Any, Any], Array]:
        layers, state = carry
        member_key, scenario_key = jax.random.split(jax.random.fold_in(key, number))
        lung, pip = _cells(number, lungs, len(protocol.PIPS), config)
        rigs = config.protocol == 2
        nominal = (jnp.arange(lung.size) % config.copies == 0) & (not rigs)
        member = jax.random.randint(member_key, lung.shape, 0, members) * ~nominal
        cells = draws.random_scenarios(
            scenario_key,
            pips[pip],
            spread=config.spread * ~nominal,
            smooth=True,
            ranges=rig_draws.RANGES if rigs else draws.RANGES,
        )
        those = jax.tree.map(lambda leaf: leaf[member, lung], plants)

        def value(layers: Any) -> Array:
            corrected = controller.replace(layers=layers)  # type: ignore[attr-defined]
            error, u_in = objective(
                corrected,
                those,
                cells,
                config.first_breath,
                config.lam,
                airway=rigs,
                weight=weights[lung, pip],
            )
            if config.agreement == 0 or members == 1:
                return error
            some = slice(None, None, config.copies)  # the official runs
            every = jax.tree.map(lambda leaf: leaf[:, lung[some]], plants)
            cell = jax.tree.map(lambda x: x[some], cells)
            apart = disagreement(every, cell, u_in[some, protocol.SCORED_BREATHS[0]])
            return error + config.agreement * apart

        mean, gradient = jax.value_and_grad(value)(layers)
        updates, state = optimiser.update(gradient, state, layers)
        new = (optax.apply_updates(layers, updates), state)
        last = number >= config.updates
        return jax.tree.map(lambda a, b: jnp.where(last, a, b), carry, new), mean

    carry, losses = jax.lax.scan(update, carry, first + jnp.arange(CHUNK))
    inside = first + jnp.arange(CHUNK) < config.updates
    return carry, jnp.sum(losses * inside) / jnp.maximum(jnp.sum(inside), 1)


def fit(
    plants: Plant,
    gains: tuple[float, float, float],
    *,
    config: ResidualConfig | None = None,
    seed: int = 0,
    checkpoint: Path | None = None,
    progress: Progress | None = None,
    keep: bool = False,
    weights: ArrayLike | None = None,
    start: Residual | None = None,
) -> Residual:
    """Train the correction of a PID on one lung, or on several at once.

    Bit-reproducible on one machine: every random number comes from ``seed`` and the number of
    the update, so that an interrupted training continues as if it had not been.

    Args:
        plants: simulators, leaves ``(members, lungs, ...)``; members beyond the settings' are left
            out.
        gains: P, I, D of the PID, %/cmH2O; they stay.
        config: settings of the training.
        seed: seed of the weights and the random deviations.
        checkpoint: file that the training is saved to every ``CHUNK`` updates and resumed from;
            deleted at the end.
        progress: called after every ``CHUNK`` updates.
        keep: leave the checkpoint, so that a finished training is read from it.
        weights: weight of each lung's error at each PIP, shape ``(lungs, P)``; 1 if not given.
        start: trained controller with the same gains and windows to go on from; a new network if
            not given.

    Returns:
        The controller, float32.

    Raises:
        InputError: if the checkpoint belongs to another training.
        FloatingPointError: if the loss is not finite; the checkpoint stays at the last good one.
    """
    config = config or ResidualConfig()
    most = config.members if config.protocol == 1 else None
    plants = jax.tree.map(lambda leaf: jnp.asarray(leaf[:most], jnp.float32), plants)
    lungs = jax.tree.leaves(plants)[0].shape[1]
    shape = (lungs, len(protocol.PIPS))
    weights = jnp.broadcast_to(jnp.asarray(1.0 if weights is None else weights, jnp.float32), shape)
    start_key, key = jax.random.split(jax.random.key(seed))
    like = Residual(
        PID(*(jnp.asarray(gain, jnp.float32) for gain in gains)),
        (),
        pressures=config.pressures,
        commands=config.commands,
        ahead=config.ahead,
        limit=config.limit,
    )
    controller = untrained(start_key, like, config.widths)
    if start is not None:
        layers = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), start.layers)
        controller = controller.replace(layers=layers)  # type: ignore[attr-defined]
    carry: Any = (controller.layers, _optimiser(config).init(controller.layers))
    settings = {
        "config": dataclasses.asdict(config), "gains": list(gains), "seed": seed,
        "simulators": fingerprint(plants), "weights": fingerprint(weights),
        "start": None if start is None else fingerprint(start.layers),
    }  # fmt: skip
    stored = Checkpoint(checkpoint, settings)
    carry, first = stored.restore(carry)
    while first < config.updates:
        new, loss = _advance(carry, like, plants, key, jnp.asarray(first), weights, config)
        loss = float(loss)
        if not np.isfinite(loss):
            raise FloatingPointError(
                f"training diverged between updates {first} and {first + CHUNK}"
            )
        carry, first = new, min(first + CHUNK, config.updates)
        stored.save(carry, first)
        if progress is not None:
            progress(first, config.updates, loss)
    if not keep:
        stored.delete()
    return controller.replace(layers=carry[0])  # type: ignore[attr-defined]
