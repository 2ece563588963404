"""Least error that any commands attain in a cell, by sequential linear programming.

The error of an inspiration is ``f(u) = mean over steps 2 to 34 of |p_t(u) - PIP|`` for commands
``u`` in 0 to 100 %, with plant, deviations and target known and no noise: more than any controller
knows. Every breath begins at the same rest, and its gain is the only thing of its own: a cell is
one inspiration, whose gain is the first of its :attr:`Scenario.gain`.

**Upper bound.** At ``u`` the pressures are linearised by automatic differentiation, and a linear
program finds the best change of the commands within the valve's range and a trust region (Fletcher
and Sainz de la Maza's method for piecewise smooth functions); it is taken if the true error falls.
Several starts keep the best. The commands are kept as a witness: anybody can apply them.

**Certificate.** At the result, the last linear program within :data:`CERTIFICATE_RADIUS` says by
how much ``f`` could fall at first order: zero at a stationary point. And no commands can be better
than a valve that is fully open throughout as long as the pressure is below PIP, if more command
never means less pressure: ``mean max(PIP - p_t(100 %), 0)`` is a lower bound on the error of every
controller.

**Second optimiser.** :func:`second_optimum` checks the upper bound on some cells. It shares the
pressures with the first and nothing else: Adam on commands behind a sigmoid, from starts of its
own, half of them random.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import highspy
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array
from numpy.typing import NDArray

from ventbench.base import compilation
from ventbench.base.arrays import Floats
from ventbench.task import environment as env
from ventbench.task import protocol, rollouts
from ventbench.task.draws import DEVELOPMENT_SEED, uniforms
from ventbench.task.environment import Scenario
from ventbench.task.interfaces import Plant

#: Commands that act before the last scored pressure, and pressures that they can change.
COMMANDS = protocol.INSPIRATION_STEPS - 1

#: Steps that each start opens the valve fully for, before a command that holds the pressure.
STARTS = (1, 2, 4, 8, 16, 33)

#: Command after the opening of a start, %.
HOLD = 8.0

#: Iterations of each start; most cells end earlier, by the trust region.
ITERATIONS = 60

#: Trust region, %: first, smallest (the search ends there), and that of the certificate.
FIRST_RADIUS, SMALLEST_RADIUS, CERTIFICATE_RADIUS = 50.0, 1e-4, 0.1

#: Share of the predicted decrease that must happen for a step to be taken, and for a larger region.
ACCEPTED, GOOD = 0.1, 0.7

#: Cells whose derivatives are computed together: bounds memory.
BATCH = 64


@dataclass(frozen=True, eq=False)
class Attainable:
    """Bounds of n cells."""

    #: error that :attr:`commands` attain, cmH2O, shape ``(n,)``: an upper bound on the least error.
    error: Floats
    #: error of the rise with a fully open valve, cmH2O, shape ``(n,)``: a lower bound.
    lower: Floats
    #: by how much the error could fall at first order when every command moves by at most
    #: :data:`CERTIFICATE_RADIUS`, cmH2O, shape ``(n,)``.
    stationarity: Floats
    commands: Floats  #: %, shape ``(n, COMMANDS)``.


def _pressures(plant: Plant, cell: Scenario, u_in: Array) -> Array:
    """Airway pressures of one inspiration after the first step, cmH2O, shape ``(COMMANDS,)``."""

    def record(_: env.LoopState, after: env.LoopState, *__: Array) -> Array:
        return after.signals.scored

    return rollouts.inspiration(
        env.vary(plant, cell, 0),
        cell,
        rollouts.commanded,
        steps=len(u_in),
        inputs=u_in,
        record=record,
    )[2]


#: Pressures of n cells under commands, ``(n, COMMANDS)``, and their derivatives by the commands.
all_pressures = jax.jit(jax.vmap(_pressures))
all_slopes = jax.jit(jax.vmap(jax.jacfwd(_pressures, argnums=2)))


def pressures(plants: Plant, cells: Scenario, u_in: Floats) -> Floats:
    """Airway pressures that n commands, %, give, cmH2O, ``(n, COMMANDS)``; call it in float64."""
    return _in_batches(all_pressures, plants, cells, u_in)


def _in_batches(function: Any, plants: Plant, cells: Scenario, u_in: Floats) -> Floats:
    n = len(u_in)
    parts = []
    for first in range(0, n, BATCH):
        # The last batch is padded, so that all compile once.
        index = np.minimum(np.arange(first, first + BATCH), n - 1)
        plant, cell = jax.tree.map(lambda x, i=index: np.asarray(x)[i], (plants, cells))
        parts.append(np.asarray(function(plant, cell, u_in[index]))[: n - first])
    return np.concatenate(parts)


def attainable(
    plants: Plant, cells: Scenario, *, starts: Sequence[int | Floats] = STARTS
) -> Attainable:
    """Bound the least error of cells from above and below; see the module.

    Args:
        plants: leaves ``(n, ...)``.
        cells: batch shape ``(n,)``; their noise is not used.
        starts: see :data:`STARTS`; or commands to start at, %, shape ``(n, COMMANDS)``.
    """
    # One breath of noise is as good as any: none is used.
    cells = cells.replace(noise=np.zeros((*np.shape(cells.pip), 1, 1)))  # type: ignore[attr-defined]
    n, pip = np.shape(cells.pip)[0], np.asarray(cells.pip)[:, None]
    best, witness = np.full(n, np.inf), np.zeros((n, COMMANDS))
    with compilation.float64():
        for start in starts:
            if isinstance(start, int):
                start = np.where(np.arange(COMMANDS) < start, protocol.U_MAX, HOLD)
            u_in = np.broadcast_to(start, (n, COMMANDS)).astype(float)
            error = _descend(plants, cells, pip, u_in)
            better = error < best - 1e-12
            best, witness = np.where(better, error, best), np.where(better[:, None], u_in, witness)
        miss = pip - pressures(plants, cells, witness)
        slopes = _in_batches(all_slopes, plants, cells, witness)
        programs = LinearPrograms(COMMANDS)
        linearised = (miss, slopes, witness, np.full(n, CERTIFICATE_RADIUS))
        optima = [programs.solve(*subproblem)[1] for subproblem in zip(*linearised, strict=True)]
        gains = np.mean(np.abs(miss), axis=1) - optima
    return Attainable(best, rise_error(plants, cells), gains, witness)


def rise_error(plants: Plant, cells: Scenario) -> Floats:
    """Error of the rise with a fully open valve in n cells: a lower bound, cmH2O, ``(n,)``."""
    pip = np.asarray(cells.pip)[:, None]
    full = np.full((len(pip), COMMANDS), protocol.U_MAX)
    with compilation.float64():
        return np.mean(np.maximum(pip - pressures(plants, cells, full), 0.0), axis=1)


def _descend(plants: Plant, cells: Scenario, pip: Floats, u_in: Floats) -> Floats:
    """Improve commands in place; returns their errors, cmH2O, shape ``(n,)``."""
    n = len(u_in)
    miss = pip - pressures(plants, cells, u_in)
    error = np.mean(np.abs(miss), axis=1)
    radius, live, programs = np.full(n, FIRST_RADIUS), np.arange(n), LinearPrograms(COMMANDS)
    slopes = np.zeros((n, COMMANDS, COMMANDS))
    stale = np.ones(n, bool)
    for _ in range(ITERATIONS):
        relinearised = live[stale[live]]
        if len(relinearised):
            plant, cell = jax.tree.map(lambda x, i=relinearised: np.asarray(x)[i], (plants, cells))
            slopes[relinearised] = _in_batches(all_slopes, plant, cell, u_in[relinearised])
        trial, predicted = u_in[live].copy(), np.zeros(len(live))
        for at, i in enumerate(live):
            change, value = programs.solve(miss[i], slopes[i], u_in[i], radius[i])
            trial[at] = np.clip(u_in[i] + change, 0.0, protocol.U_MAX)
            predicted[at] = error[i] - value
        plant, cell = jax.tree.map(lambda x, i=live: np.asarray(x)[i], (plants, cells))
        missed = pip[live] - pressures(plant, cell, trial)
        reached = np.mean(np.abs(missed), axis=1)
        ratio = (error[live] - reached) / np.maximum(predicted, 1e-15)
        accepted, stale[live] = ratio > ACCEPTED, ratio > ACCEPTED
        improved = live[accepted]
        u_in[improved], miss[improved], error[improved] = (
            trial[accepted],
            missed[accepted],
            reached[accepted],
        )
        radius[live] = np.where(ratio > GOOD, np.minimum(2.0 * radius[live], 100.0), radius[live])
        radius[live] = np.where(ratio < ACCEPTED, 0.25 * radius[live], radius[live])
        converged = (radius[live] < SMALLEST_RADIUS) | (predicted < 1e-9)
        live = live[~converged]
        if not len(live):
            break
    return error


class LinearPrograms:
    """Least mean of ``|miss - slopes change|`` within the valve's range and a trust region.

    One dual simplex for all programs of one size, of which building each is most of the work.

    Args:
        count: m, pressures and commands of a program.
    """

    def __init__(self, count: int):
        self._solver = highspy.Highs()
        self._solver.silent()
        self._solver.setOptionValue("solver", "simplex")
        # miss - slopes change = above - below, with both parts at least zero.
        program = highspy.HighsLp()
        program.num_col_, program.num_row_ = 3 * count, count
        program.col_cost_ = np.repeat([0.0, 1.0 / count], [count, 2 * count])
        matrix = program.a_matrix_
        matrix.format_ = highspy.MatrixFormat.kColwise
        full = count * np.arange(count)
        matrix.start_ = np.concatenate([full, count**2 + np.arange(2 * count + 1)])
        matrix.index_ = np.tile(np.arange(count), count + 2)
        self._program, self._parts = program, np.repeat([1.0, -1.0], count)

    def solve(
        self, miss: Floats, slopes: Floats, u_in: Floats, radius: float
    ) -> tuple[Floats, float]:
        """Solve one program: change of the commands, %, and the mean, cmH2O.

        Args:
            miss: target minus pressure, cmH2O, shape ``(m,)``.
            slopes: derivative of each pressure by each command, cmH2O per %, shape ``(m, m)``.
            u_in: commands, %, shape ``(m,)``.
            radius: most that a command may change by, %.
        """
        program, m = self._program, len(miss)
        low, high = np.maximum(-radius, -u_in), np.minimum(radius, protocol.U_MAX - u_in)
        program.col_lower_ = np.concatenate([low, np.zeros(2 * m)])
        program.col_upper_ = np.concatenate([high, np.full(2 * m, np.inf)])
        program.row_lower_ = program.row_upper_ = miss
        program.a_matrix_.value_ = np.concatenate([slopes.T.ravel(), self._parts])
        self._solver.passModel(program)
        self._solver.run()
        if self._solver.getModelStatus() != highspy.HighsModelStatus.kOptimal:
            return np.zeros(m), float(np.mean(np.abs(miss)))  # degenerate to rounding: stay
        change = np.asarray(self._solver.getSolution().col_value)[:m]
        return change, self._solver.getInfo().objective_function_value


#: Random starts, and starts that open the valve for some steps.
RANDOM_STARTS, OPENED_STEPS = 4, (1, 3, 9, 20)

#: Iterations of Adam of each start, and its first rate, which falls to zero as a cosine.
ADAM_ITERATIONS, ADAM_RATE = 1500, 0.12


def second_optimum(plants: Plant, cells: Scenario) -> NDArray:
    """Least error that Adam finds in n cells, cmH2O, ``(n,)``.

    It is the mean of ``|p - PIP|`` over steps 2 to 34; noise of the cells is not used.
    """
    n = np.shape(cells.pip)[0]
    cells = cells.replace(noise=np.zeros((n, 1, 1)))  # type: ignore[attr-defined]
    opened = np.arange(COMMANDS) < np.array(OPENED_STEPS)[:, None]
    random = uniforms(DEVELOPMENT_SEED, "second optimum", (RANDOM_STARTS, COMMANDS))
    starts = np.concatenate([np.where(opened, 2.5, -2.4), 6.0 * random - 3.0])
    with compilation.float64():
        initial = np.broadcast_to(starts[:, None], (len(starts), n, COMMANDS))
        return np.asarray(_search(*jax.tree.map(jnp.asarray, (plants, cells, initial))))


@jax.jit
def _search(plants: Plant, cells: Scenario, starts: Array) -> Array:
    """All starts ``(S, n, COMMANDS)`` at once: a step of few cells takes as long as one of many."""
    optimiser = optax.adam(optax.cosine_decay_schedule(ADAM_RATE, ADAM_ITERATIONS))

    def errors(free: Array) -> tuple[Array, Array]:
        u_in = protocol.U_MAX * jax.nn.sigmoid(free)
        pressure = jax.vmap(all_pressures, (None, None, 0))(plants, cells, u_in)
        values = jnp.mean(jnp.abs(pressure - cells.pip[:, None]), axis=-1)
        return values.sum(), values

    def iterate(carry: tuple[Array, Any, Array], _: None) -> tuple[tuple[Array, Any, Array], None]:
        free, state, best = carry
        slopes, values = jax.grad(errors, has_aux=True)(free)
        updates, state = optimiser.update(jnp.nan_to_num(slopes), state)
        free, best = jnp.asarray(optax.apply_updates(free, updates)), jnp.fmin(best, values)
        return (free, state, best), None

    initial = (starts, optimiser.init(starts), jnp.full(starts.shape[:2], jnp.inf))
    (free, _, best), _ = jax.lax.scan(iterate, initial, length=ADAM_ITERATIONS)
    return jnp.fmin(best, errors(free)[1]).min(axis=0)
