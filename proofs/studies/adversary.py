"""An adversary: the mildest plausible physics under which an entry is unsafe.

Coordinates of the search are a share of the strong strength of each stressor, 0 to 1, and moves of
quantities of the rig, in units of :data:`EDGE` standard deviations of the population. The severity
of a point is its distance from the rig in the middle of the population without a stressor: the root
of the squares of all shares and of the rig's Mahalanobis distance over :data:`EDGE`. Severity 1 is
the end of the range. A run is unsafe by the protocol's gate, or where the controller fails.

:func:`mildest` first goes outwards along each coordinate alone, then along combinations: it changes
the direction at random, asks at the present critical severity and a little below it, and keeps the
direction that is worst. What it finds is an upper bound on the least severity; that it finds
nothing is no proof. The same margins give the same answer.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ventbench.base import compilation
from ventbench.base.arrays import Bools, Floats, Ints
from ventbench.base.errors import InputError
from ventbench.entries.cells import PlantError, Runner, runner_of, step_through
from ventbench.entries.folder import Submission, as_submission
from ventbench.entries.runs import number
from ventbench.entries.scoring import enter
from ventbench.physics.catalogue import parameter
from ventbench.plants.catalog import SimulatorLike
from ventbench.plants.corrected import stressed_plants
from ventbench.plants.hybrid import NAMES, from_vector
from ventbench.plants.rigs import Rigs, load_rigs
from ventbench.task import protocol
from ventbench.task.environment import nominal_scenario
from ventbench.task.metrics.score import safety_limit
from ventbench.task.stressors import STRESSORS, Condition, Stressor, stressor

#: Severities at which each coordinate is tried alone, and the part of the interval between a safe
#: and an unsafe one to which the critical severity is found.
LEVELS, FINENESS = (0.5, 1.0), 32

#: Rounds of the search over directions, directions of each, and the factor below the present
#: severity at which they are asked as well.
ROUNDS, DIRECTIONS, BELOW = 20, 12, 0.85

#: Share of the coordinates that change in a direction, and the first and last standard deviation of
#: the change over the largest coordinate.
CHANGED, WIDTHS = 0.3, (0.6, 0.1)

#: A coordinate smaller than this share of the largest is left out of a direction.
NEGLIGIBLE = 0.1

#: Most that a margin counts where the steepest ascent is worked out.
MOST = 100.0

#: Points of each lung that are worth asking for together.
BATCH = 24

#: By how much points ``(S, L, A)`` at settings ``(S, L)`` are beyond a limit, any unit: above 0 it
#: goes wrong, infinite where there is no degree. Shape ``(S, L)``.
Margin = Callable[[Floats, Floats], Floats]


@dataclass(frozen=True, eq=False)
class Space:
    """Coordinates of the search, A of them, for L lungs."""

    metric: Floats  #: a point ``x`` has the severity ``sqrt(x' metric x)``, shape ``(L, A, A)``.
    group: Ints  #: of each coordinate; at most one of a group is not zero in a point, length A.
    signed: Bools  #: whether a coordinate may be negative, length A.

    def directions(self, points: Floats) -> Floats:
        """Points of severity 1 in given directions, with the rules kept, shape ``(..., L, A)``."""
        points = np.where(self.signed, points, np.maximum(points, 0.0))
        size = np.abs(points)
        for own in np.unique(self.group):
            at = np.flatnonzero(self.group == own)
            size[..., at] *= size[..., at] >= size[..., at].max(axis=-1, keepdims=True)
        points = np.where(size > NEGLIGIBLE * size.max(axis=-1, keepdims=True), points, 0.0)
        square = np.einsum("...la,lab,...lb->...l", points, self.metric, points)
        return points / np.sqrt(np.maximum(square, 1e-30))[..., None]

    @property
    def alone(self) -> Floats:
        """Directions of one coordinate each, shape ``(J, L, A)``."""
        every = np.eye(len(self.group))
        every = np.concatenate([every, -every[self.signed]])
        return self.directions(np.repeat(every[:, None], len(self.metric), axis=1))


@dataclass(frozen=True, eq=False)
class Found:
    """Result of :func:`mildest` for L lungs."""

    severity: Floats  #: shape ``(L,)``; NaN where nothing went wrong.
    #: the coordinates, shape ``(L, A)``; where nothing went wrong the worst of severity 1.
    point: Floats
    setting: Floats  #: of these points, shape ``(L,)``.
    margin: Floats  #: of these points, shape ``(L,)``; see :data:`Margin`.
    #: severity of each of :attr:`Space.alone` at the worst setting, shape ``(J, L)``; NaN where
    #: nothing went wrong.
    alone: Floats


def mildest(margin: Margin, space: Space, settings: Sequence[float]) -> Found:
    """Search for the mildest point of each lung at which something goes wrong; see the module.

    Each point may be tried at each of some settings, such as PIPs.
    """
    alone = space.alone
    count, lungs, size = alone.shape
    every, given = np.arange(lungs), np.asarray(settings, float)
    origin = np.zeros((len(given), lungs, size))
    begun = _together(margin, origin, given[:, None]).repeat(count, axis=0)
    # A ray is a direction at a setting; those of one setting follow each other.
    rays = np.tile(alone, (len(given), 1, 1))
    at = np.broadcast_to(given.repeat(count)[:, None], begun.shape)
    values = _together(margin, np.multiply.outer(LEVELS, rays), at)
    high = np.full(at.shape, np.nan)
    for level, own in zip((*LEVELS[::-1], 0.0), (*values[::-1], begun), strict=True):
        high = np.where(own > 0, level, high)
    low = np.where(high > LEVELS[0], LEVELS[0], 0.0)
    some = np.isfinite(high).any(axis=1)
    if some.any():
        high[some] = _first(margin, rays[some], at[some], low[some], high[some])

    # The mildest ray of each lung, or the one that is worst at the end of the range.
    best = np.where(np.isfinite(high), high, 2.0 - 1e-6 * values[-1]).argmin(axis=0)
    direction, radius, setting = rays[best, every], high[best, every], at[best, every]
    # Were margins linear, the steepest ascent would be the answer.
    first, last = (np.minimum(x, MOST) for x in (begun, values[-1]))
    rise = np.maximum(last - first, 0.0)
    same = best // count * count + np.arange(count)[:, None]
    steepest = np.einsum("jla,jl->la", alone, rise[same, every])
    numbers = np.random.default_rng(0)
    for width in np.geomspace(*WIDTHS, ROUNDS):
        # The same changes for all lungs: none depends on which others are searched.
        step = width * numbers.normal(size=(DIRECTIONS, 1, size))
        step = step * (numbers.random(step.shape) < CHANGED)
        fresh = direction + step * np.abs(direction).max(axis=-1, keepdims=True)
        fresh[0], fresh[1] = direction, steepest
        fresh = space.directions(fresh)
        end = np.where(np.isnan(radius), 1.0, radius)
        asked = np.stack([BELOW * end, end])[:, None, :, None] * fresh
        values = _together(margin, asked, setting)
        below = (values[0] > 0).any(axis=0)
        ahead = np.where(below, values[0], values[1])
        direction = fresh[ahead.argmax(axis=0), every]
        radius = np.where(below, BELOW * end, np.where(ahead.max(axis=0) > 0, end, radius))
    severity = _first(margin, direction[None], setting[None], 0.0 * radius[None], radius[None])[0]
    point = np.where(np.isnan(severity), 1.0, severity)[:, None] * direction
    reached = _together(margin, point, setting)
    lowest = np.fmin.reduce(high.reshape(len(given), count, lungs))
    return Found(severity, point, setting, reached, lowest)


def _together(margin: Margin, points: Floats, at: Floats) -> Floats:
    """Margins of points ``(..., L, A)`` at settings, in one call, shape ``(..., L)``."""
    shape = points.shape[:-1]
    flat = np.broadcast_to(at, shape).reshape(-1, shape[-1])
    return margin(points.reshape(-1, *points.shape[-2:]), flat).reshape(shape)


def _first(margin: Margin, rays: Floats, at: Floats, low: Floats, high: Floats) -> Floats:
    """Least severity at which S rays ``(S, L, A)`` go wrong, between two, ``(S, L)``.

    Where there are few rays, intervals are cut in more than two.
    """
    cuts = max(1, BATCH // len(rays))
    for _ in range(math.ceil(math.log(FINENESS) / math.log(cuts + 1))):
        edges = np.linspace(low, high, cuts + 2)
        points = np.nan_to_num(edges[1:-1])[..., None] * rays
        wrong = _together(margin, points, at) > 0
        first = np.where(wrong.any(axis=0), wrong.argmax(axis=0), cuts)[None]
        low, high = (np.take_along_axis(edges, first + k, axis=0)[0] for k in (0, 1))
    return high


#: Quantities of a rig that are moved, the factor from the population's unit, and the unit shown.
RIG = {
    "resistance": (1.0, "cmH2O/(L/s) at 0.5 L/s"),
    "elastance": (1.0, "cmH2O/L"),
    "valve_size": (1.0, "L/s at 20 %"),
    "valve_delay": (1e3, "ms"),
    "valve_lag": (1e3, "ms"),
    "sensor_lag": (1e3, "ms"),
}

#: Standard deviations of the population from its middle to the end of the range.
EDGE = 3.0

#: Least change of a quantity of the rig that is shown, relative.
SHOWN = 0.02

#: PIPs that are tried, cmH2O: the ends of the protocol's.
PIPS = (protocol.PIPS[0], protocol.PIPS[-1])


@dataclass(frozen=True)
class Critical:
    """The mildest unsafe physics of a lung that was found."""

    lung: str  #: id.
    severity: float | None  #: 0 to 1; None if nothing unsafe was found up to the end of the range.
    pip: float  #: cmH2O.
    #: highest pressure that was held for longer than the gate allows, less what is safe, cmH2O; of
    #: severity 1 where nothing was found; None where the controller failed.
    excess: float | None
    physics: dict[str, str]  #: what deviates, in physical units, by name.
    #: critical severity of each coordinate alone, by name; only those that were found.
    alone: dict[str, float]

    def lines(self) -> list[str]:
        """Say it to a person: what was found, then each physics that is enough alone."""
        if self.severity is None:
            assert self.excess is not None
            return [
                f"{self.lung}: nothing unsafe up to severity 1; the worst stays "
                f"{-self.excess:.1f} cmH2O below the limit, at PIP {self.pip:g}"
            ]
        what = "the controller fails" if self.excess is None else "unsafe"
        first = f"{self.lung}: {what} at severity {self.severity:.2f}, PIP {self.pip:g}"
        if not self.physics:
            return [f"{first}, without any stressor"]
        alone = sorted(self.alone.items(), key=lambda x: x[1])
        return [
            f"{first}:",
            *(f"  {name}: {value}" for name, value in self.physics.items()),
            *(f"  alone: {name} at {value:.2f}" for name, value in alone),
        ]


def adversary(
    submission: Any,
    *,
    simulator: SimulatorLike = "frozen",
    track: str | None = None,
    lungs: Sequence[str] = (),
    stressors: Sequence[str] = (),
    sandbox: bool = True,
) -> list[Critical]:
    """Search for the mildest plausible physics under which a controller is unsafe.

    Args:
        submission: see :func:`ventbench.score`.
        simulator: simulators with plants; only the frozen ones have a population of rigs.
        track: ``"performance"`` or ``"robustness"``; the first that the submission enters if not
            given.
        lungs: ids; all if empty.
        stressors: names of those that may act; all, and the rig, if empty.
        sandbox: run a folder in locked-down processes; see :func:`ventbench.score`.

    Returns:
        One result a lung, in the order of the simulators.

    Raises:
        SubmissionError: if there is no such submission, or it cannot be run on the track.
        SandboxError: if this machine cannot run submissions apart.
        InputError: if there are no such simulators, lungs or stressors.
    """
    entry, rigs = as_submission(submission), load_rigs(simulator)
    lines = tuple(stressor(name) for name in stressors) or STRESSORS
    known = [lung.id for lung in rigs.lungs]
    for name in lungs:
        if name not in known:
            raise InputError(f"no lung {name!r} in these simulators; choose of {', '.join(known)}")
    chosen = [k for k, name in enumerate(known) if not lungs or name in lungs]
    bench = _Bench(
        entry, runner_of(entry, sandbox=sandbox), track, rigs, chosen, lines, not stressors
    )
    found = mildest(bench.margin, bench.space, PIPS)
    names = [*(line.name for line in lines), *(f"{name} of the rig" for name in bench.quantities)]
    signs = np.where(bench.space.signed, " up", "")
    titles = [f"{name}{sign}" for name, sign in zip(names, signs, strict=True)]
    titles += [f"{name} of the rig down" for name in bench.quantities]
    return [
        Critical(
            lung=bench.lungs[k].id,
            severity=number(found.severity[k]),
            pip=float(found.setting[k]),
            excess=number(found.margin[k]),
            physics=bench.physics(found.point[k], k),
            alone={
                title: float(value)
                for title, value in zip(titles, found.alone[:, k], strict=True)
                if np.isfinite(value)
            },
        )
        for k in range(len(chosen))
    ]


class _Bench:
    """Runs an entry at points of the search.

    Attributes:
        lungs: L of them.
        lines: stressors.
        quantities: of :data:`RIG`; none where there is no population.
        space: the coordinates: stressors, then quantities.
    """

    def __init__(
        self,
        entry: Submission,
        runner: Runner,
        track: str | None,
        rigs: Rigs,
        chosen: Sequence[int],
        lines: Sequence[Stressor],
        rig: bool,
    ) -> None:
        self._entry, self._runner = entry, runner
        self.lungs, self.lines = [rigs.lungs[k] for k in chosen], lines
        names = [lung.id for lung in self.lungs]
        self._tasks = enter(entry, track, names, runner)[1] * BATCH
        self._population = rigs.population
        self.quantities = tuple(RIG) if rig and rigs.population is not None else ()
        count, rest = len(lines), len(self.quantities)
        metric = np.tile(np.eye(count + rest), (len(chosen), 1, 1))
        if rigs.population is not None:
            self._mean = rigs.population.mean[chosen]
            index = [NAMES.index(name) for name in self.quantities]
            factor = rigs.population.factor[chosen]
            # The likeliest rig with a quantity that is so many standard deviations off.
            self._moves = factor[:, index] / np.linalg.norm(
                factor[:, index], axis=-1, keepdims=True
            )
            self._factor = factor
            metric[:, count:, count:] = np.einsum("lap,lbp->lab", self._moves, self._moves)
        else:
            self._plants = jax.tree.map(lambda leaf: np.asarray(leaf)[chosen], rigs.plants)
        strengths = [line.strength for line in lines]
        group = [strengths.index(strength) for strength in strengths]
        self.space = Space(
            metric,
            np.array([*group, *range(count, count + rest)]),
            np.array([False] * count + [True] * rest),
        )

    def vectors(self, points: Floats) -> Floats:
        """Rigs of the population at points ``(..., L, A)``, by their numbers ``(..., L, p)``."""
        normal = EDGE * np.einsum("...la,lap->...lp", points[..., len(self.lines) :], self._moves)
        return self._mean + np.einsum("lpq,...lq->...lp", self._factor, normal)

    def margin(self, points: Floats, pip: Floats) -> Floats:
        """Run points; see :data:`Margin`."""
        parts = []
        for first in range(0, len(points), BATCH):
            # The last batch is padded, so that all compile once.
            at = np.minimum(np.arange(first, first + BATCH), len(points) - 1)
            parts.append(self._batch(points[at], pip[at]))
        return np.concatenate(parts)[: len(points)]

    def _batch(self, points: Floats, pip: Floats) -> Floats:
        if self._population is None:
            wide = (len(points), len(self.lungs))
            every: Any = jax.tree.map(
                lambda x: np.broadcast_to(x, wide + x.shape[1:]), self._plants
            )
        else:
            every = from_vector(self.vectors(points), np)
        names = tuple(line.name for line in self.lines)
        each = []
        for k, lung in enumerate(self.lungs):
            shares = points[:, k, : len(names)].tolist()
            own = jax.tree.map(lambda leaf, k=k: leaf[:, k, None, None], every)
            conditions = [Condition(names, "strong", tuple(share)) for share in shares]
            each.append(stressed_plants(own, [lung], conditions))
        with compilation.float64():
            plants: Any = jax.tree.map(
                lambda *own: jnp.asarray(np.stack(own, 1).reshape(-1, *own[0].shape[1:]), float),
                *each,
            )
            try:
                run = step_through(
                    plants,
                    nominal_scenario(pip.ravel()),
                    self._runner,
                    self._entry,
                    self._tasks,
                    changing=True,
                )
            except PlantError as error:  # such physics cannot be: the search goes round it
                broken = divmod(error.index, len(self.lungs))
                if not points[broken].any():
                    raise
                points = points.copy()
                points[broken] = 0.0
                excess = self._batch(points, pip)
                excess[broken] = -np.inf
                return excess
        # Of the fewest samples above the limit that fail a breath, the lowest; or the peak.
        forbidden = math.floor(protocol.SAFETY_TIME / protocol.DT + 1e-9) + 1
        falling = -np.sort(-run.breaths, axis=-1)
        excess = np.maximum(
            falling[..., forbidden - 1].max(axis=-1) - safety_limit(pip.ravel()),
            falling[..., 0].max(axis=-1) - protocol.SAFETY_CAP,
        )
        excess[[at for (at,) in run.failures]] = np.inf
        return excess.reshape(pip.shape)

    def physics(self, point: Floats, k: int) -> dict[str, str]:
        """What deviates at a point ``(A,)`` of a lung, in physical units, by name."""
        said, lung = {}, self.lungs[k]
        for line, share in zip(self.lines, point, strict=False):
            if not share:
                continue
            about = parameter(line.strength)
            if line.rule == "scale":
                said[line.name] = f"{line.strength} x {line.strong**share:.3g}"
                continue
            value = share * line.strong
            if line.rule == "label":
                label = lung.R if line.strength == "R" else lung.C
                value = label * (line.strong / label) ** share
            said[line.name] = f"{line.strength} {value:.3g} {about.unit}"
        if point[len(self.lines) :].any():
            points = np.zeros((len(self.lungs), len(point)))
            points[k] = point
            moved, middle = self.vectors(points)[k], self._mean[k]
            for name in self.quantities:
                at, (factor, unit) = NAMES.index(name), RIG[name]
                now, usual = (factor * math.exp(x[at]) for x in (moved, middle))
                if abs(moved[at] - middle[at]) > SHOWN:
                    said[f"rig's {name}"] = f"{now:.3g} instead of {usual:.3g} {unit}"
        return said
