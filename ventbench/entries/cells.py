"""What is scored: cells, their plants, the bounds of the score, and how a submission runs on them.

A cell is a lung on one of its rigs, a PIP, deviations of ventilator and sensor, and a condition.
All conditions share their cells, so that each stressed run has an unstressed twin. Between plants
and controllers only numbers cross, and no cell waits for another: a runner starts one fresh
controller for each cell, told its :class:`~ventbench.task.interfaces.Task`, and then answers
batches of observations, :data:`~ventbench.sandbox.child.cell.ROW` floats each, with one float.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any
from typing import Protocol as Interface

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ventbench.base import compilation
from ventbench.base.arrays import Floats, Ints
from ventbench.base.errors import InputError
from ventbench.base.executor import Progress
from ventbench.entries.folder import Submission
from ventbench.entries.reference import Reference, reference_of
from ventbench.entries.runs import pip_columns
from ventbench.plants.corrected import Stressed, stressed_plants
from ventbench.plants.rigs import Rigs
from ventbench.sandbox.child.cell import Cell, Failed, Failure, controller_class
from ventbench.sandbox.pipes import PolledControllers
from ventbench.task import draws as draw_tables
from ventbench.task import environment as env
from ventbench.task import protocol
from ventbench.task.draws import Draws
from ventbench.task.environment import Scenario
from ventbench.task.interfaces import Observation, Plant, PlantT, Task
from ventbench.task.lungs import Lung
from ventbench.task.rollouts import expiration
from ventbench.task.stressors import Condition, conditions, stressor


@dataclass(frozen=True, eq=False)
class Cells:
    """Cells of L lungs under S conditions: n draws and P PIPs of each."""

    lungs: tuple[Lung, ...]  #: length L.
    conditions: tuple[Condition, ...]  #: length S; the first is none.
    plants: Plant  #: leaves ``(L, n, 1, ...)``, or ``(L, ...)`` where each lung has one rig.
    scenario: Scenario  #: deviations, batch shape ``(L, n, P)``.
    pips: Floats  #: PIP before its deviation, cmH2O, ``(L, n, P)``.
    draw: Ints  #: counted from 1; 0 without deviations, ``(n,)``.
    rig: Ints  #: session of each lung, ``(L, n)``.
    member: Ints  #: member of the ensemble, ``(L, n)``.

    def name(self, at: tuple[int, ...]) -> tuple[str, str, float, int | None]:
        """Condition, lung, PIP and draw of a cell ``(S, L, n, P)``; the nominal run has no draw."""
        condition, lung, draw, pip = at
        return (
            self.conditions[condition].id,
            self.lungs[lung].id,
            float(self.pips[lung, draw, pip]),
            int(self.draw[draw]) or None,
        )

    def batches(self) -> Iterator[tuple[Index, Sequence[Plant], Scenario]]:
        """Cells that run side by side: index in ``(S, L, n, P)``, plants of each breath, scenario.

        Without stressors all at once; else draw by draw, all conditions and lungs of one. Call it
        within ``float64()``.
        """
        if len(self.conditions) == 1:
            plants = as_float64(self.plants, len(self.lungs))
            yield (0,), [plants] * protocol.BREATHS, self.scenario
            return
        for draw in range(len(self.draw)):
            plants, scenario = self.stressed(draw)
            yield (slice(None), slice(None), draw, 0), by_breath(plants), scenario

    def stressed(self, draw: int) -> tuple[Stressed, Scenario]:
        """One draw under every condition, as 64-bit arrays: call it within ``float64()``.

        Plants as of :func:`~ventbench.plants.corrected.stressed_plants`, and cells of batch shape
        ``(S * L,)``; there must be one PIP.
        """
        selected = jax.tree.map(
            lambda leaf: np.asarray(leaf)[None, :, draw : draw + 1, 0], self.plants
        )
        plants = stressed_plants(selected, self.lungs, self.conditions)
        scenario = jax.tree.map(
            lambda leaf: np.concatenate([np.asarray(leaf)[:, draw, 0]] * len(self.conditions)),
            self.scenario,
        )
        return jax.tree.map(lambda leaf: jnp.asarray(leaf, float), (plants, scenario))


@dataclass(frozen=True, eq=False)
class Protocol:
    """All that a score depends on besides the submission; make it with :func:`protocol_of`."""

    rigs: Rigs  #: the plants.
    pips: tuple[float, ...]  #: nominal PIPs, cmH2O, length P.
    drawn: Draws | None  #: K draws; None without.
    cells: Cells  #: nominal cells on the reference rigs in front of the draws, without a stressor.
    #: the same draws under missing physics, one PIP of each lung and draw; or None.
    stressed: Cells | None
    #: best attainable and best PID of the first cells; None where it was not computed for these
    #: simulators and draws.
    reference: Reference | None


def protocol_of(
    rigs: Rigs,
    *,
    draws: int = 0,
    drawn: Draws | None = None,
    pips: Sequence[float] = protocol.PIPS,
    stress: int = 0,
    stressors: Sequence[str] = (),
    reference: Reference | None = None,
) -> Protocol:
    """Say what is scored on some rigs: see :func:`ventbench.score` for draws, stress and stressors.

    Args:
        rigs: from :func:`ventbench.plants.rigs.load_rigs`.
        draws: how many of the development draws to run besides the nominal cells.
        drawn: other draws instead.
        pips: cmH2O.
        stress: how many ranked draws to run under missing physics.
        stressors: names of the stressors; all conditions if empty.
        reference: best attainable and best PID of these simulators and draws; the published one if
            not given and it is of these.

    Raises:
        InputError: if there are no such draws or stressors, or the reference is of others.
    """
    pips = tuple(float(pip) for pip in pips)
    if draws < 0 or stress < 0:
        raise InputError(f"{min(draws, stress)} draws: there cannot be fewer than none")
    stressed = None
    if stress:
        names = {stressor(name).name for name in stressors}
        chosen = tuple(c for c in conditions() if not names or set(c.stressors) <= names)
        every = rigs.draws(draw_tables.COUNT) if drawn is None else drawn
        ranked = every.only(np.flatnonzero(every.ranked)).first(stress)
        stressed = _stressed_cells(rigs, ranked, chosen)
    if drawn is None and draws:
        drawn = rigs.draws(draws, pips)
    if pips == protocol.PIPS:
        identity = None if drawn is None else drawn.about()
        reference = reference_of(rigs.about, identity, reference)
    nominal = _unstressed_cells(rigs, drawn, pips)
    return Protocol(rigs, pips, drawn, nominal, stressed, reference)


def _unstressed_cells(rigs: Rigs, draws: Draws | None, pips: tuple[float, ...]) -> Cells:
    plants, scenario = rigs.cells(draws, pips)
    shape = np.shape(scenario.pip)
    rig, member = np.zeros(shape[:2], np.int64), np.zeros(shape[:2], np.int64)
    if rigs.sessions is not None:
        rig[:, 0] = [sessions[0] for sessions in rigs.sessions]
    if draws is not None:
        rig[:, 1:], member[:, 1:] = draws.rig, draws.member
    nominal = np.broadcast_to(np.array(pips), shape)
    every = np.arange(shape[1])
    return Cells(rigs.lungs, (Condition(),), plants, scenario, nominal, every, rig, member)


def _stressed_cells(rigs: Rigs, draws: Draws, chosen: tuple[Condition, ...]) -> Cells:
    """One PIP of each lung and draw; each lung has each PIP once in six draws."""
    count, n = len(rigs.lungs), draws.count
    columns = pip_columns(count, n)
    at = (np.arange(count)[:, None], np.arange(n), columns)
    scenario = jax.tree.map(lambda leaf: np.asarray(leaf)[at][:, :, None], draws.cells)
    if rigs.sessions is None:
        plants = jax.tree.map(
            lambda leaf: np.repeat(np.asarray(leaf)[:, None, None], n, axis=1), rigs.plants
        )
    else:
        plants = rigs.plants_of(draws)
    nominal = np.asarray(protocol.PIPS)[columns][:, :, None]
    every = np.arange(1, n + 1)
    return Cells(rigs.lungs, chosen, plants, scenario, nominal, every, draws.rig, draws.member)


class Runner(Interface):
    """Starts sessions."""

    @property
    def sandbox(self) -> Mapping[str, Any] | None:
        """Layers that keep a submission apart, for the record; None makes a result not official."""
        ...

    def start(self, submission: Submission, tasks: Sequence[Task]) -> PolledControllers:
        """Make and reset one fresh controller of a submission for each task, which is a cell's.

        A controller that cannot be made or reset is a failure of its cell, found in the session.

        Raises:
            SubmissionError: if the code cannot be imported or lacks what it must have.
        """
        ...


def pack(observation: Observation) -> Floats:
    """Lay a batch of observations out as rows, batch axes flattened.

    Fields of shape ``(...)``, ``targets_ahead`` ``(..., TARGETS_AHEAD)``; float64, shape
    ``(cells, ROW)``, the fields in their order.
    """
    shape = np.shape(observation.pressure)
    columns = [
        np.broadcast_to(np.asarray(field, float), shape)[..., None]
        if name != "targets_ahead"
        else np.asarray(field, float)
        for name, field in zip(Observation._fields, observation, strict=True)
    ]
    rows = np.concatenate(columns, axis=-1)
    return rows.reshape(-1, rows.shape[-1])


class InProcessSession(PolledControllers):
    """Controllers of all cells in this process; :class:`InProcessRunner` starts them."""

    def __init__(self, submission: Submission, tasks: Sequence[Task]):
        controller = submission.controller
        source = None if controller is None else submission.label
        if controller is None:
            controller = controller_class(submission.folder, submission.label)
        self.failures: dict[int, Failure] = {}
        self._answers: dict[int, float] = {}
        self._cells: dict[int, Cell] = {}
        for index, task in enumerate(tasks):
            try:
                self._cells[index] = Cell(controller, task, submission.folder, source)
            except Failed as failed:
                self.failures[index] = replace(failed.failure, cause=failed.__cause__)

    def ask(self, cells: Ints, observations: Floats) -> None:
        """Ask some controllers for their next command, as of the base class."""
        for index, row in zip(cells.tolist(), observations.tolist(), strict=True):
            self._answers[index] = 0.0
            if index in self._cells:
                try:
                    self._answers[index] = self._cells[index].act(row)
                except Failed as failed:
                    self.failures[index] = replace(failed.failure, cause=failed.__cause__)
                    del self._cells[index]

    def answers(self) -> tuple[Ints, Floats]:
        """Take the commands, as of the base class."""
        commands, self._answers = self._answers, {}
        return np.array(list(commands), np.int64), np.array(list(commands.values()))

    def processor_time(self) -> float:
        """Processor time of this process, s."""
        return time.process_time()

    def close(self) -> None:
        """Forget the controllers."""
        self._cells.clear()


class InProcessRunner:
    """Runs controllers in this process, with all of its rights: for code that you trust.

    Quick, and good for one's own development. Nothing stops a submission from reading the
    simulators or keeping state from cell to cell, so results carry ``"sandbox": null`` and
    ``"official": false``.
    """

    sandbox: Mapping[str, Any] | None = None

    def start(self, submission: Submission, tasks: Sequence[Task]) -> PolledControllers:
        """Make and reset one fresh controller for each cell; see :class:`Runner`."""
        return InProcessSession(submission, tasks)


#: Rounds of a run: a command of each cell.
ROUNDS = protocol.BREATHS * protocol.INSPIRATION_STEPS


def counted(progress: Progress | None, total: int) -> Callable[[], object]:
    """What counts rounds, and tells how many of all are done."""
    rounds = itertools.count(1)
    return lambda: progress and progress(next(rounds), total)


def runner_of(submission: Submission, *, sandbox: bool) -> Runner:
    """Choose how a submission runs: a folder in locked-down processes unless ``sandbox`` is False.

    A class or function always runs in this process.

    Raises:
        SandboxError: if this machine cannot run submissions apart.
    """
    if not sandbox or submission.controller is not None:
        return InProcessRunner()
    from ventbench.sandbox.runner import SandboxRunner

    return SandboxRunner()


#: Index of some cells in arrays of batch shape ``(S, L, n, P)``.
Index = tuple[Any, ...]


@dataclass(frozen=True)
class ProtocolRun:
    """Inspirations of all cells; arrays of shape ``(..., BREATHS, INSPIRATION_STEPS)``.

    ``(...)`` is the batch shape of the cells, lungs first, or conditions and then lungs.
    """

    pressure: Floats  #: airway pressure at each step, which is scored, cmH2O.
    requested: Floats  #: what the controllers asked for, %; 0 once a cell has failed.
    u_in: Floats  #: what was applied, %.
    #: airway pressure of the expirations, cmH2O, ``(..., BREATHS, steps)``.
    expired: Floats
    volume: Floats  #: gas in the lung, mL; NaN where the plants have no such signal.
    failures: Mapping[tuple[int, ...], Failure]  #: what failed, by index of the cell.
    #: time on the clock that an answer took on average, s, each time that some came.
    act_seconds: Floats

    @property
    def breaths(self) -> Floats:
        """Airway pressure of whole breaths, cmH2O, ``(..., BREATHS, BREATH_STEPS)``."""
        return np.concatenate([self.pressure, self.expired], axis=-1)


def as_float64(plants: PlantT, count: int) -> PlantT:
    """Return plants, stacked over a number of lungs on their leading axis, with 64-bit leaves.

    Raises:
        ValueError: if a leaf has another leading axis.
    """

    def convert(leaf: Any) -> Array:
        leaf = jnp.asarray(leaf)
        if leaf.shape[:1] != (count,):
            raise ValueError(
                f"a plant's parameter of shape {leaf.shape} is not stacked over {count} lungs"
            )
        return leaf.astype(float) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf

    return jax.tree.map(convert, plants)


def by_breath(plants: PlantT) -> list[PlantT]:
    """Plants of each breath, of leaves ``(L, BREATHS, ...)``."""
    return [jax.tree.map(lambda x, k=k: x[:, k], plants) for k in range(protocol.BREATHS)]


def _strong(tree: Any) -> Any:
    """Drop weak types, which would make the second step compile anew."""
    return jax.tree.map(lambda x: jax.lax.convert_element_type(x, x.dtype), tree)


@jax.jit
def _begin(plants: Plant, scenario: Scenario, breath: Array) -> tuple[Plant, env.LoopState]:
    def begin(plant: Plant, scenario: Scenario) -> tuple[Plant, env.LoopState]:
        varied = env.vary(plant, scenario, breath)
        return varied, env.start_breath(varied, scenario)

    return _strong(jax.vmap(begin)(plants, scenario))


_observe = jax.jit(env.observe)


@jax.jit
def _inspire(
    plants: Plant, scenario: Scenario, loop: env.LoopState, u_in: Array, active: Array
) -> tuple[env.LoopState, Array]:
    """Apply commands to some cells; the others wait."""
    after, applied = _strong(jax.vmap(env.inspire)(plants, scenario, loop, u_in))
    return _select(active, after, loop), applied


@jax.jit
def _expire(plants: Plant, scenario: Scenario, loop: env.LoopState) -> Array:
    """Pressures of the expirations from the ends of inspirations, cmH2O, steps last."""
    after = jax.vmap(expiration)(plants, scenario, loop)[1]
    return jnp.moveaxis(after.pressure, 1, -1)


@jax.jit
def _select(mask: Array, new: Any, old: Any) -> Any:
    """Take the new state in some cells and the old one in the rest, mask of the batch shape.

    Several states of a part stand behind the batch, or, stacked by a mechanism, behind its leading
    axis.
    """

    def choose(x: Array, y: Array) -> Array:
        several = (1,) * (x.ndim - mask.ndim)
        shape = (*mask.shape, *several)
        if x.shape[: mask.ndim] != mask.shape:
            shape = (*mask.shape[:1], *several, *mask.shape[1:])
        return jnp.where(mask.reshape(shape), x, y)

    return jax.tree.map(choose, new, old)


def _of_cells(values: Array | float, batch: tuple[int, ...]) -> Floats:
    return np.broadcast_to(np.asarray(values), batch).ravel()


class PlantError(FloatingPointError):
    """A plant, of an index on the leading axis, answered with NaN or infinity."""

    def __init__(self, index: int) -> None:
        super().__init__(f"simulator {index} answered with NaN or infinity")
        self.index = index


def step_through(
    plants: Sequence[Plant],
    scenario: Scenario,
    runner: Runner,
    submission: Submission,
    tasks: Sequence[Task],
    count: Callable[[], object] = lambda: None,
) -> ProtocolRun:
    """Run a submission on every lung and cell. Call it within ``compilation.float64()``.

    Args:
        plants: of each breath, from :func:`as_float64`, L lungs; leaves may have the batch
            shape of the cells too, ``(L, ...)``, with axes of length 1 where cells share a plant.
        scenario: cells of each lung, batch shape ``(L, ...)``.
        runner: runs the controllers.
        submission: whose they are.
        tasks: what is told of each lung, length L.
        count: called after each round: once every cell has one more command.

    Raises:
        SubmissionError: if the submission cannot be run at all.
        PlantError: if a plant answers with NaN or infinity.
    """
    batch = np.shape(scenario.pip)
    cells, steps = int(np.prod(batch)), protocol.INSPIRATION_STEPS
    pressure, requested, applied, volume = (np.zeros((cells, ROUNDS)) for _ in range(4))
    cell_tasks = [task for task in tasks for _ in range(cells // len(tasks))]
    breaths = range(protocol.BREATHS)
    initial = [_begin(part, scenario, k) for k, part in enumerate(plants)]
    loop, seconds = initial[0][1], []
    ends = [rest for _, rest in initial]
    # Cells go on by themselves: what one takes, no other one waits for.
    answered, ready = np.zeros(cells, np.int64), np.arange(cells)
    with compilation.float32():  # a submission that uses JAX finds it as it is elsewhere
        session = runner.start(submission, cell_tasks)
    try:
        while (answered < ROUNDS).any():
            at = np.minimum(answered, ROUNDS - 1).reshape(batch)
            rows = pack(_observe(scenario, loop, at // steps, at % steps))
            pressure[ready, answered[ready]] = _of_cells(loop.signals.scored, batch)[ready]
            inside = np.nan if loop.signals.volume is None else loop.signals.volume
            volume[ready, answered[ready]] = _of_cells(inside, batch)[ready]
            start = time.perf_counter()
            with compilation.float32():
                session.ask(ready, rows[ready])
                ready, commands = session.answers()
            seconds.append((time.perf_counter() - start) / max(1, len(ready)))
            requested[ready, answered[ready]] = commands
            u_in, updated = np.zeros(cells), np.zeros(cells, bool)
            u_in[ready], updated[ready] = env.resolved(commands), True
            for k, (varied, _) in enumerate(initial):
                active = updated & (answered // steps == k)
                if active.any():
                    loop, now = _inspire(
                        varied, scenario, loop, u_in.reshape(batch), active.reshape(batch)
                    )
                    applied[active, answered[active]] = _of_cells(now, batch)[active]
            rounds = answered.min()
            answered[ready] += 1
            for _ in range(answered.min() - rounds):
                count()
            over = updated & (answered % steps == 0)
            for k in breaths:
                finished = (over & (answered // steps == k + 1)).reshape(batch)
                if finished.any():
                    ends[k] = _select(finished, loop, ends[k])
                    if k + 1 < len(initial):
                        loop = _select(finished, initial[k + 1][1], loop)
            ready = ready[answered[ready] < ROUNDS]
        failures = dict(session.failures)
    finally:
        session.close()
    expired = np.stack(
        [
            np.asarray(_expire(varied, scenario, end))
            for (varied, _), end in zip(initial, ends, strict=True)
        ],
        axis=-2,
    )
    broken = np.flatnonzero(~np.isfinite(pressure).reshape(len(tasks), -1).all(axis=1))
    if broken.size:
        raise PlantError(int(broken[0]))
    by_cell = {tuple(int(i) for i in np.unravel_index(k, batch)): v for k, v in failures.items()}
    shape = (*batch, protocol.BREATHS, steps)
    pressure, requested, applied, volume = (
        x.reshape(shape) for x in (pressure, requested, applied, volume)
    )
    return ProtocolRun(pressure, requested, applied, expired, volume, by_cell, np.array(seconds))


def run_cells(
    cells: Cells,
    runner: Runner,
    submission: Submission,
    tasks: Sequence[Task],
    count: Callable[[], object] = lambda: None,
) -> ProtocolRun:
    """Run a submission on cells, batch shape ``(S, L, n, P)``. Call it within ``float64()``.

    Arguments and errors as of :func:`step_through`.
    """
    told = list(tasks) * len(cells.conditions)

    def run(_: Index, plants: Sequence[Plant], scenario: Scenario) -> ProtocolRun:
        try:
            return step_through(plants, scenario, runner, submission, told, count)
        except PlantError as error:
            condition, lung = divmod(error.index, len(tasks))
            where = cells.conditions[condition].id
            raise FloatingPointError(f"{PlantError(lung)}, under {where}") from error

    return gather(cells, run)


def gather(
    cells: Cells, run: Callable[[Index, Sequence[Plant], Scenario], ProtocolRun]
) -> ProtocolRun:
    """Run each of :meth:`Cells.batches`, and join what comes: batch shape ``(S, L, n, P)``."""
    shape = (len(cells.conditions), *cells.pips.shape)
    index = np.moveaxis(np.indices(shape), 0, -1)
    series: dict[str, Any] = {}
    failures, seconds = {}, []
    for at, plants, scenario in cells.batches():
        part = run(at, plants, scenario)
        own = index[at].reshape(*np.shape(scenario.pip), len(shape))
        failures |= {tuple(own[cell].tolist()): what for cell, what in part.failures.items()}
        seconds.append(part.act_seconds)
        for name in ("pressure", "requested", "u_in", "expired", "volume"):
            values = getattr(part, name)
            whole = series.setdefault(name, np.empty((*shape, *values.shape[-2:])))
            whole[at] = values.reshape(whole[at].shape)
    return ProtocolRun(**series, failures=failures, act_seconds=np.concatenate(seconds))
