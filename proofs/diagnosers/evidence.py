"""One search by evidence: a linearised experiment, forms that are uncertain, inputs in time.

A rig is the base model with a set of terms: mechanisms of the library, basis terms (something
unknown at their place), and what acts in time: events of some breaths, oscillations, commands that
were not followed. Pressures are linear in all of them at once. A mechanism carries a deviation of
its characteristic in the basis terms that contain it; every rig has a little of everything. What is
linear is integrated out, sets of terms are enumerated by their evidence, the best are fitted and
scored again, and the answer is the posterior over all that was scored.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from scipy import linalg, special

from proofs.diagnosers.common import Floats, Seen, see
from ventbench.diagnosis import latent_inputs
from ventbench.diagnosis.command_path import follow
from ventbench.diagnosis.hypothesis import Partition
from ventbench.diagnosis.identification import without_saturated
from ventbench.physics.catalogue import (
    basis_terms,
    library,
    mechanism,
    parameter,
    paths,
    strength_path,
)
from ventbench.physics.parameters import REFITTED, Parameter
from ventbench.system_id import START, Data, Fit, Noise, Predictor, fit, parameter_values
from ventbench.system_id.noise import robust_noise
from ventbench.system_id.problem import parameter_of

#: Standard deviations: of a characteristic and of what every rig has of a basis term, as shares of
#: their spread; of a mechanism, as a share of the least strength that is named; of the valve's gain
#: from breath to breath.
_FORM, _REST, _LEAST, _SCATTER = 0.15, 0.02, 0.5, 0.01

#: Most breaths, sets that are extended, sets that are fitted in either round, and steps of a fit.
_BREATHS, _BEAM, _FITS, _STEPS = 32, 24, (3, 2), 15

#: Prior odds of a term, of an unknown at a place beside those of a name, the power of the
#: likelihood (no model has what neighbouring samples share), and what is spread over all places.
_ODDS, _PLACE, _WARMTH, _UNSURE = 0.7, 0.3, 0.2, 0.05

_SITES = {"inspiratory valve": "inspiratory_valve", "alveolus": "lung", "sensor": "pressure_sensor",
          "command": "inspiratory_valve", "expiratory valve": "expiratory_valve"}  # fmt: skip

#: Standard deviations of base parameters in coordinates, around those of the base fit.
_BASE = {"R": 0.5, "C": 0.5, "R_ex": 0.5, "PEEP": 2.0, START: 1.0}

#: Effects of some breaths: sizes, their standard deviation in these, and courses. Pushes of the
#: muscles have a sign, durations and onsets, s.
_EFFORT, _OPEN = "patient_effort", "disconnection"
_CONSTANT = {"intermittent_leak": (8.0, 1.5), "secretions": (0.5, 1.5)}
_PUSHES = {
    "cough": (1.0, 8.0, (0.15, 0.22, 0.3), np.arange(0.1, 1.9, 0.1)),
    _EFFORT: (-1.0, 3.0, (0.5, 0.8, 1.1), np.arange(0.0, 1.0, 0.1)),
}

#: Spreads of a push's harmonics beside its size, as its form is uncertain.
_DEVIATIONS = (1.0, 0.5, 0.25)

#: Oscillations: place, frequencies, Hz, harmonics, and standard deviations of coefficients.
_SWINGS = {
    "supply_ripple": (latent_inputs.SUPPLY, np.arange(1.5, 9.1, 0.25), 1, (0.06, 0.15)),
    "circuit_water": (latent_inputs.CIRCUIT, np.arange(1.5, 9.1, 0.25), 1, (0.5, 1.2)),
    "unknown:muscles": (latent_inputs.ALVEOLUS, np.arange(0.7, 2.6, 0.1), 2, (0.4, 1.0)),
}

#: Shares of the commands that are expected to be lost, or late.
_COMMANDS = {"lost_commands": 0.08, "late_commands": 0.18}


@dataclass(frozen=True, eq=False)
class Term:
    """A candidate at one point of its shape.

    Attributes:
        name: of the mechanism, basis term or event.
        spread: prior standard deviations of the coefficients of its columns.
        main: these columns in the linearised experiment.
        values: values by path, the strength first; its column is the effect of these.
        limits: least and largest coefficient of a strength.
        odds: logarithm of the prior of this point.
        forms: spreads of its characteristic by column of the basis terms, as shares of its effect.
        latent: columns ``(k, n, T)`` of what acts in time, which no fit knows.
        told: parameters that are reported of these.
    """

    name: str
    spread: Sequence[float]
    main: tuple[int, ...] = ()
    values: Mapping[str, float] = field(default_factory=dict)
    limits: tuple[float, float] = (-np.inf, np.inf)
    odds: float = 0.0
    forms: Mapping[int, float] = field(default_factory=dict)
    latent: Sequence[Floats] = ()
    told: Mapping[str, float] = field(default_factory=dict)


Set = tuple[Term, ...]


def names_of(terms: Iterable[Term]) -> frozenset[str]:
    """Names of a set."""
    return frozenset(term.name for term in terms)


def gaussian(G: Floats, b: Floats, sd: Floats) -> tuple[float, Floats, Floats]:
    """Log evidence of coefficients over none, their means and standard deviations.

    Args:
        G: ``X' K^-1 X``, ``(k, k)``.
        b: ``X' K^-1 y``, ``(k,)``.
        sd: prior standard deviations ``d``, ``(k,)``.
    """
    L = np.linalg.cholesky(np.eye(len(sd)) + sd[:, None] * G * sd)
    root = linalg.solve_triangular(L, np.diag(sd), lower=True, check_finite=False)
    q = root @ b
    mean, sds = root.T @ q, np.sqrt(np.sum(root**2, axis=0))
    return 0.5 * float(q @ q) - float(np.log(np.diag(L)).sum()), mean, sds


@dataclass(frozen=True, eq=False)
class Linear:
    """The experiment, linearised around a fit.

    Attributes:
        data: n breaths of T samples.
        values: physical values of the fit, ``(n, P + 1)``.
        columns: changes of pressure, ``(n, m, T)``.
        residual: measured minus modelled at the prior means of all parameters, ``(n, T)``.
        always: standard deviations of what is integrated out, by column.
        by_breath: the same of what has a coefficient of each breath.
        where: prior mean and standard deviation of the fit's parameters in coordinates, by column.
        basis: paths and spreads of the coefficients of basis terms, by column.
        terms: candidates.
        events: change of pressure by events of each course, ``(g, n, T)``, by name.
    """

    data: Data
    values: Floats
    columns: Floats
    residual: Floats
    always: Mapping[int, float]
    by_breath: Mapping[int, float]
    where: Mapping[int, tuple[str, float, float]]
    basis: Mapping[int, tuple[str, float]]
    terms: Set = ()
    events: Mapping[str, Floats] = field(default_factory=dict)

    def noise(self, noise: Noise) -> Noise:
        """Noise beside the best nonparametric model: all basis terms at their spread."""
        spreads = {k: spread for k, (_, spread) in self.basis.items()}
        all_of_it = replace(self, always={**self.always, **spreads})
        for _ in range(2):
            left = self.residual - Known(all_of_it, noise).expected(self.always)
            left = (left * self.data.weight[:, 0])[:, None]
            noise = robust_noise(left, self.data.weight)
        return noise


class Known:
    """What is known of a linearised experiment, nuisance integrated out of all that is asked."""

    def __init__(self, linear: Linear, noise: Noise) -> None:
        """Factorise the nuisance, in units of its standard deviations."""
        self.linear, self.noise, self.n = linear, noise, len(linear.data)
        self.y = self.rows(linear.residual[:, None])[:, 0]
        self.Z = self.nuisance(self.rows(linear.columns))
        self.factor = linalg.cho_factor(np.eye(self.Z.shape[1]) + self.Z.T @ self.Z, lower=True)
        self.mean = linalg.cho_solve(self.factor, self.Z.T @ self.y)

    def rows(self, columns: Floats) -> Floats:
        """Whitened ``(n, m, T)`` as ``(n T, m)``."""
        white = self.noise.whiten(columns[:, :, None], self.linear.data.weight)[:, :, 0]
        return np.moveaxis(white, 1, 2).reshape(-1, white.shape[1])

    def nuisance(self, X: Floats) -> Floats:
        """Columns of nuisance times their standard deviations, ``(n T, z)``."""
        parts = [X[:, list(self.linear.always)] * [*self.linear.always.values()]]
        for k, spread in self.linear.by_breath.items():
            own = np.asarray(linalg.block_diag(*X[:, k].reshape(self.n, -1, 1)))
            parts.append(spread * own)
        return np.concatenate(parts, axis=1)

    def expected(self, columns: Iterable[int]) -> Floats:
        """Expected change of pressure by some columns, and by what each breath has, ``(n, T)``."""
        flat = np.moveaxis(self.linear.columns, 1, 2).reshape(-1, self.linear.columns.shape[1])
        wanted, Z = set(columns), self.nuisance(flat)
        kept = np.ones(Z.shape[1], bool)
        kept[: len(self.linear.always)] = [k in wanted for k in self.linear.always]
        return (Z[:, kept] @ self.mean[kept]).reshape(self.n, -1)

    @cached_property
    def density(self) -> float:
        """Log density of the whitened residual."""
        power = self.y @ self.y - (self.Z.T @ self.y) @ self.mean
        return -0.5 * float(power) - float(np.log(np.diag(self.factor[0])).sum())

    def products(self, X: Floats) -> tuple[Floats, Floats]:
        """``X' K^-1 X`` and ``X' K^-1 y``, ``K = 1 + Z Z'``."""
        ZX = self.Z.T @ X
        return X.T @ X - ZX.T @ linalg.cho_solve(self.factor, ZX), X.T @ self.y - ZX.T @ self.mean

    def of_breaths(self, columns: Floats) -> tuple[Floats, Floats]:
        """The same of columns ``(n, m, T)`` with coefficients of each breath, ``(n m, n m)``."""
        P = self.noise.whiten(columns[:, :, None], self.linear.data.weight)[:, :, 0]
        ZP = np.matmul(P, self.Z.reshape(self.n, P.shape[2], -1)).reshape(-1, self.Z.shape[1])
        b = np.einsum("nmt,nt->nm", P, self.y.reshape(self.n, -1)).reshape(-1) - ZP @ self.mean
        G = linalg.block_diag(*np.matmul(P, P.swapaxes(1, 2)))
        return G - ZP @ linalg.cho_solve(self.factor, ZP.T), b


def points(name: str) -> list[dict[str, float]]:
    """Values, by path, at which the effect of a mechanism is computed."""
    strength, *others = mechanism(name).description.parameters
    sizes: tuple[float, ...] = (strength.mild, strength.strong)
    if any(p.change_point for p in others):
        sizes = (strength.mild,)
    elif strength.kinked:
        sizes = tuple(strength.strong * x for x in (0.15, 0.35, 0.6, 1.0))
    elif strength.low <= -strength.mild:
        sizes += (-strength.mild,)
    grids = [_grid(p) for p in others]
    paths_of = [f"{name}.{p.name}" for p in (strength, *others)]
    return [dict(zip(paths_of, point, strict=True)) for point in product(sizes, *grids)]


def _grid(p: Parameter) -> tuple[float, ...]:
    if p.change_point:  # before the first breath
        return (-1.0,)
    return p.grid or ((0.4, 1.0, 2.5) if p.uncertain else (p.neutral,))


def linearise(
    data: Data,
    predictor: Predictor,
    around: Fit,
    base: Fit,
    latent: Set = (),
    *,
    wide: bool = False,
) -> Linear:
    """Linearise around a fit, whose parameters return to their prior means.

    Args:
        data: breaths.
        predictor: predicts them; knows library, basis terms and events.
        around: the fit; what it has is no candidate.
        base: fit of the base model, whose parameters are prior means.
        latent: what acts in time beside the fit.
        wide: whether candidates are wanted.
    """
    values, order = around.values, (*predictor.names, START)
    moved: list[Floats] = []

    def move(changes: Mapping[str, Any]) -> int:
        point = values.copy()
        for path, value in changes.items():
            point[:, order.index(path)] = value
        moved.append(point)
        return len(moved) - 1

    gain = move({"gain": 1.01 * values[:, order.index("gain")]})
    scale, basis, of_basis = {gain: np.log(1.01)}, {}, {}
    for name in (n for n in basis_terms() if n not in around.mechanisms):
        for p in mechanism(name).description.parameters:
            path = f"{name}.{p.name}"
            k = move({path: values[:, order.index(path)] + 0.1 * (spread := p.spread or 1.0)})
            scale[k], basis[k] = 0.1 * spread, (path, spread)
            of_basis.setdefault(name, []).append(k)
    found = [
        (name, point, move(point))
        for name in library()
        if name not in around.mechanisms and name != _EFFORT
        and (wide or mechanism(name).description.least)
        for point in points(name)[: None if wide else 1]
    ]  # fmt: skip
    count, events = len(moved), {}
    for name in (*_CONSTANT, _OPEN) if wide else ():
        events[name] = [move(point) for point in _courses(name)]
    seen = predictor.predict_all(np.stack([values, *moved]))[:, :, 0]
    columns = np.moveaxis(seen[1:] - seen[0], 0, 1)
    events = {name: np.moveaxis(columns[:, k], 1, 0) for name, k in events.items()}
    columns = list(np.moveaxis(columns[:, :count], 1, 0))
    for k, s in scale.items():
        columns[k] = columns[k] / s

    def added(column: Floats) -> int:
        columns.append(column)
        return len(columns) - 1

    residual, always, where = data.measured[:, 0] - seen[0], {}, {}
    by_breath = {gain: _SCATTER}
    form = {k: _REST * spread for k, (_, spread) in basis.items()}
    slopes, layout = around.problem.jacobian(around.minimum.x)[1][:, :, 0], around.problem.unknowns
    for j, path in enumerate(layout.paths):
        about, owner = parameter_of(path), path.rpartition(".")[0]
        here = around.minimum.x[layout.index[:, j]]
        leads = bool(owner) and path == strength_path(owner)
        mean, sd = about.prior() if owner else (about.coordinate(base.column(path)), _BASE[path])
        if leads:
            mean = float(about.coordinate(about.neutral))
            sd = about.spread or abs(about.strong - about.neutral)
            effect = slopes[:, j] * (here - mean)[:, None]
            for k, s in _forms(columns, effect, owner, of_basis, basis).items():
                form[k] = float(np.hypot(form[k], s))
        if about.change_point:
            continue
        residual = residual - slopes[:, j] * (mean - here)[:, None]
        k = added(slopes[:, j])
        if path == START:
            by_breath[k] = _BASE[START]
        else:
            always[k], where[k] = sd, (path, float(np.mean(mean)), sd)
    always |= form
    terms, noted = [], set()
    between = np.unique(data.position)
    between = 0.5 * (between[1:] + between[:-1])[1:-1]
    for name, point, k in found:
        about = mechanism(name).description
        size, at = point[strength_path(name)], [p.name for p in about.parameters if p.change_point]
        spread, strength = abs(about.strength.strong / size), about.strength
        limits = sorted((strength.low / size, strength.high / size))
        alike = sum(other == name for other, _, _ in found) * (len(between) if at else 1)
        odds = -float(np.log(alike))
        if about.least and name not in noted and not at:
            noted.add(name)
            always[k] = _LEAST * about.least / abs(size)
        plain = Term(name, (spread,), (k,), point, (limits[0], limits[1]), odds)
        for x in between if at and wide else ():
            set_in = added(np.where(data.position[:, None] > x, columns[k], 0.0))
            value = point | {f"{name}.{at[0]}": float(x)}
            terms.append(replace(plain, main=(set_in,), values=value))
        if not at and wide:
            terms.append(replace(plain, forms=_forms(columns, columns[k], name, of_basis, basis)))
    terms += [Term(name, [basis[j][1] for j in k], tuple(k)) for name, k in of_basis.items()]
    for term in latent:
        for column, spread in zip(term.latent, term.spread, strict=True):
            always[added(column)] = spread
    weight = data.weight[:, :1]
    return Linear(
        data, values, np.stack(columns, axis=1) * weight, residual * weight[:, 0], always,
        by_breath,
        where, basis, tuple(terms), events,
    )  # fmt: skip


def _courses(name: str) -> list[dict[str, float]]:
    """Values of an event of some breaths, by path, for each of its courses."""
    if name in _CONSTANT:
        return [{strength_path(name): _CONSTANT[name][0]}]
    _, onset, duration = mechanism(name).description.parameters
    return [
        {f"{name}.conductance": 300.0, f"{name}.onset": a, f"{name}.duration": b}
        for a, b in product(onset.grid[::2], duration.grid[1:5])
    ]


def _forms(
    columns: Sequence[Floats], effect: Floats, name: str, of_basis: Mapping[str, list[int]],
    basis: Mapping[int, tuple[str, float]],
) -> dict[int, float]:  # fmt: skip
    """Deviations of an effect's characteristic in the basis terms that contain it, by column."""
    found: dict[int, float] = {}
    for own in (of_basis.get(c, []) for c in mechanism(name).description.special_case_of):
        if own:
            width = np.array([basis[j][1] for j in own])
            A = np.stack([columns[j].reshape(-1) for j in own], axis=1) * width
            ridge = 1e-3 * np.trace(A.T @ A) / len(own)
            c = np.linalg.solve(A.T @ A + ridge * np.eye(len(own)), A.T @ effect.reshape(-1))
            found |= dict(zip(own, (_FORM * np.abs(width * c) + 1e-12).tolist(), strict=True))
    return found


def affected(G: Floats, b: Floats, sd: float, cost: float) -> tuple[Any, Floats]:
    """Breaths in which an effect acts, by flips that gain, and its sizes there.

    Args:
        G: products of a column of each breath, ``(n, n)``.
        b: their products with the residual, ``(n,)``.
        sd: standard deviation of a size, which is positive.
        cost: of each affected breath, nats.
    """
    n = len(b)

    def value(acts: Any) -> tuple[float, Floats]:
        at = np.flatnonzero(acts)
        if not len(at):
            return _share(n, 0), np.zeros(0)
        gained, mean, _ = gaussian(G[np.ix_(at, at)], b[at], np.full(len(at), sd))
        return gained + _share(n, len(at)) - cost * len(at) - 1e3 * float(np.sum(mean < 0.0)), mean

    best: tuple[float, Any] = (-np.inf, None)
    mean = gaussian(G, b, np.full(n, sd))[1]
    for acts in (np.zeros(n, bool), mean > 0.3 * max(float(mean.max()), 0.0)):
        reached, moves = value(acts)[0], True
        while moves:
            flips = [value(acts ^ (np.arange(n) == i))[0] for i in range(n)]
            moves = max(flips) > reached
            if moves:
                acts, reached = acts ^ (np.arange(n) == int(np.argmax(flips))), max(flips)
        if reached > best[0]:
            best = reached, acts
    return np.flatnonzero(best[1]), value(best[1])[1]


def _share(n: int, k: int) -> float:
    """Log prior of k affected breaths of n, whose share is uniform."""
    return float(special.betaln(k + 1, n - k + 1))


def in_time(known: Known, predictor: Predictor, around: Fit) -> list[Term]:
    """Terms that act in time."""
    linear, n = known.linear, known.n
    data, values, partition = linear.data, linear.values, Partition(linear.data, predictor)
    time, terms = np.cumsum(data.dt, axis=1) - data.dt, []
    courses = {(name, size): linear.events[name][None] for name, (_, size) in _CONSTANT.items()}
    courses[_OPEN, 1.0] = linear.events[_OPEN][None]
    push = latent_inputs.input_responses(partition, values, latent_inputs.ALVEOLUS)
    for name, (sign, size, durations, onsets) in _PUSHES.items():
        x = np.stack([(time - a) / d for a, d in product(onsets, durations)])
        shape = np.sin(np.pi * np.arange(1, 4)[:, None, None, None] * np.clip(x, 0.0, 1.0))
        courses[name, size] = sign * np.matmul(
            np.moveaxis(shape, 2, 0).reshape(n, -1, x.shape[2]), push
        ).reshape(n, 3, len(x), -1).transpose(1, 2, 0, 3)
    for (name, size), each in courses.items():  # the first, and deviations of its form
        gains = []
        for course in each[0]:
            G, b = known.of_breaths(course[:, None])
            curvature = np.diag(G) + size**-2.0
            gains.append(0.5 * np.maximum(b, 0.0) ** 2 / curvature - 0.5 * np.log(curvature))
        chosen = each[:, np.argmax(gains, axis=0), np.arange(n)]
        cost = float(np.log(each.shape[1]))
        at, mean = affected(*known.of_breaths(chosen[0, :, None]), size, cost)
        if len(at):
            which = (at[:, None] == np.arange(n))[:, :, None]
            column = np.concatenate([np.where(which, one, 0.0) for one in chosen])
            spread = np.repeat(size * np.array(_DEVIATIONS)[: len(chosen)], len(at)).tolist()
            odds = _share(n, len(at)) - cost * len(at)
            told = {"share": len(at) / n, "size": float(np.median(mean))}
            terms.append(Term(name, spread, odds=odds, latent=list(column), told=told))
    for name, (place, frequencies, harmonics, spreads) in _SWINGS.items():
        by_input = latent_inputs.input_responses(partition, values, place)
        best: tuple[float, Any] = (-np.inf, None)
        for f in frequencies:
            angle = 2.0 * np.pi * f * np.arange(1, harmonics + 1)[:, None] * time[:, None]
            swings = np.matmul(np.concatenate([np.sin(angle), np.cos(angle)], axis=1), by_input)
            G, b = known.of_breaths(swings)
            for spread in spreads:
                value, mean, _ = gaussian(G, b, np.full(len(b), spread))
                if value > best[0]:
                    best = value, (swings, spread, float(f), float(np.sqrt(2.0 * np.mean(mean**2))))
        swings, spread, f, size = best[1]
        column = np.zeros((n, swings.shape[1], n, swings.shape[2]))
        column[np.arange(n), :, np.arange(n)] = swings
        column = column.reshape(-1, *column.shape[2:])
        odds = -float(np.log(len(frequencies) * len(spreads)))
        told = {"frequency": f, "amplitude": size}
        terms.append(Term(name, [spread] * len(column), odds=odds, latent=list(column), told=told))
    problem, x, share = replace(around.problem, noise=known.noise), around.minimum.x, 0.1
    for name, lags in (("lost_commands", (None,)), ("late_commands", (2, 3, 4))):
        ways = [follow(problem, x, partition, share, lag) for lag in lags]
        way = max(ways, key=lambda each: float(each.nats.sum()))
        kept, sent = float(way.kept.sum()), float(way.sent.sum())
        if not kept:
            break
        share = kept / sent
        reached = Predictor(replace(data, u_in=way.u_in), predictor.names, sizes=(_BREATHS,))
        column = reached.predict(values)[:, 0] - predictor.predict(values)[:, 0]
        odds = kept * np.log(share) + (sent - kept) * np.log1p(-share)
        odds -= 0.5 * (np.log(share / _COMMANDS[name]) / 0.5) ** 2 + np.log(len(lags))
        told = {"share": share}
        terms.append(Term(name, [1.0], odds=float(odds), latent=[column], told=told))
    return terms


def evidence(G: Floats, b: Floats, terms: Set) -> float:
    """Log evidence of a set of terms over none, with deviations of their forms."""
    value, means = 0.0, [0.0] * len(terms)
    for _ in range(2 if any(term.forms for term in terms) else 1):
        index: list[int] = []
        spread: list[float] = []
        own = []
        for term, mean in zip(terms, means, strict=True):
            own.append(len(index))
            index += [*term.main, *(term.forms if mean else ())]
            spread += [*term.spread, *(abs(mean) * c for c in term.forms.values() if mean)]
        value, found, sds = gaussian(G[np.ix_(index, index)], b[index], np.array(spread))
        means = [float(found[k]) for k in own]
    for k, term in zip(own, terms, strict=True):
        value += term.odds
        if np.isfinite(term.limits[0]):
            value += _inside(term.limits, float(found[k]), float(sds[k]), 0.0, term.spread[0])
    return value


def _inside(
    limits: tuple[float, float], mean: float, sd: float, before: float, prior_sd: float
) -> float:
    """Log of the share of a Gaussian that lies within limits, over that of its prior."""

    def share(centre: float, width: float) -> float:
        a, b = ((end - centre) / width for end in limits)
        return max(float(special.ndtr(b) - special.ndtr(a)) if a < 5 else 0.0, 1e-12)

    return float(np.log(share(mean, sd)) - np.log(share(before, prior_sd)))


def prior(names: Iterable[str]) -> float:
    """Log prior of a set of names."""
    one, unknown = np.log(_ODDS / len(library())), np.log(_PLACE)
    return float(sum(one + unknown * (n in basis_terms() or ":" in n) for n in names))


def search(known: Known, latent: Sequence[Term], most: int) -> list[tuple[float, Set]]:
    """Sets of terms by log posterior over the empty one, likeliest first, one of each names."""
    X, numbered = [known.linear.columns], []
    count = X[0].shape[1]
    for term in latent:
        numbered.append(replace(term, main=tuple(range(count, count + len(term.latent)))))
        X.append(np.moveaxis(np.stack(term.latent) * known.linear.data.weight[:, 0], 0, 1))
        count += len(term.latent)
    G, b = known.products(known.rows(np.concatenate(X, axis=1)))
    best: dict[frozenset[str], tuple[float, Set]] = {frozenset(): (0.0, ())}

    def score(terms: Set) -> float:
        key, value = names_of(terms), evidence(G, b, terms)
        total = value + prior(key)
        if len(key) == len(terms) and (key not in best or total > best[key][0]):
            best[key] = (total, terms)
        return value

    ranked: dict[str, list[tuple[float, Term]]] = {}
    for term in (*known.linear.terms, *numbered):
        ranked.setdefault(term.name, []).append((score((term,)), term))
    for each in ranked.values():
        each.sort(key=lambda pair: -pair[0])
    kept = {name: [term for _, term in each[:2]] for name, each in ranked.items()}

    def top(size: int, count: int) -> list[Set]:
        alike = [pair for key, pair in best.items() if len(key) == size]
        return [terms for _, terms in sorted(alike, key=lambda pair: -pair[0])[:count]]

    for size in range(2, most + 1):
        sets = [(t,) for each in kept.values() for t in each] if size == 2 else top(size - 1, _BEAM)
        for terms in sets:
            for name in kept.keys() - names_of(terms):
                for term in kept[name] if size > 2 or name > terms[0].name else ():
                    score((*terms, term))
        for terms in top(size, _BEAM // 3):
            for k, term in enumerate(terms):
                for _, other in ranked[term.name]:
                    score((*terms[:k], other, *terms[k + 1 :]))
    return sorted(best.values(), key=lambda pair: -pair[0])


def fit_terms(data: Data, predictor: Predictor, base: Fit, terms: Set, noise: Noise) -> Fit:
    """Fit what of a set is a parameter of the model, from where the linear problem has it."""
    first: dict[str, Any] = {path: base.column(path) for path in REFITTED}
    free, fixed = [], {}
    for path, value in ((p, v) for term in terms for p, v in term.values.items()):
        about = parameter(path)
        if not about.shape or (about.grid and not about.discrete):
            first[path] = np.clip(value, about.low, about.high)
            free += [path] * about.shape
        else:
            fixed[path] = value
    names = tuple(term.name for term in terms if not len(term.latent))
    return fit(
        data, names, free=free, fixed=fixed, start=first, noise=noise, predictor=predictor,
        iterations=_STEPS,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Scored:
    """A fitted set of terms, linearised around its fit, and what is known of it at some noise."""

    terms: Set
    fitted: Fit
    linear: Linear
    noise: Noise

    @cached_property
    def known(self) -> Known:
        """The experiment with its nuisance integrated out."""
        return Known(self.linear, self.noise)

    @cached_property
    def names(self) -> frozenset[str]:
        """Names of its set."""
        return names_of(self.terms)

    @cached_property
    def parameters(self) -> dict[str, tuple[float, float]]:
        """Posterior mean and standard deviation, by path, in coordinates."""
        linear, order = self.linear, list(self.linear.always)
        sds = np.sqrt(np.diag(linalg.cho_solve(self.known.factor, np.eye(self.known.Z.shape[1]))))
        at = {k: order.index(k) for k in linear.where}
        return {
            path: (mean + sd * float(self.known.mean[at[k]]), sd * float(sds[at[k]]))
            for k, (path, mean, sd) in linear.where.items()
        }

    @cached_property
    def basis(self) -> dict[str, float]:
        """Posterior means of coefficients of basis terms, by path."""
        linear = self.linear
        sizes = dict(zip(linear.always, self.known.mean, strict=False))
        return {path: linear.always[k] * float(sizes[k]) for k, (path, _) in linear.basis.items()}

    @cached_property
    def latent(self) -> Floats:
        """Expected change of pressure by what acts in time, ``(n, T)``."""
        linear = self.linear
        count = sum(len(t.spread) for t in self.terms if len(t.latent))
        sizes = dict(zip(linear.always, self.known.mean, strict=False))
        found = np.zeros_like(linear.residual)
        for k in list(linear.always)[len(linear.always) - count :]:
            found += linear.always[k] * sizes[k] * linear.columns[:, k]
        return found

    @cached_property
    def evidence(self) -> float:
        """Log evidence of the set."""
        value = self.known.density + sum(term.odds for term in self.terms)
        for _, (path, mean, sd) in self.linear.where.items():
            owner, about = path.rpartition(".")[0], parameter_of(path)
            if owner and path == strength_path(owner) and owner not in basis_terms():
                ends = (float(about.coordinate(about.low)), float(about.coordinate(about.high)))
                value += _inside(ends, *self.parameters[path], mean, sd)
        return value


def without_spikes(fitted: Fit, data: Data) -> Data:
    """Take the weight off single readings that are far off, away from edges of the valves."""
    r = fitted.residual[:, 0] * data.weight[:, 0]
    away = np.abs(r - np.median([np.roll(r, k, axis=1) for k in (-2, -1, 0, 1, 2)], axis=0))
    size = 1.4826 * float(np.median(away[data.weight[:, 0] > 0])) + 0.05
    edge = np.abs(np.diff(data.u_out, axis=1, prepend=data.u_out[:, :1])) > 0
    far = (away > 8.0 * size) & ~np.any([np.roll(edge, k, axis=1) for k in range(-2, 4)], axis=0)
    far[:, :4] = far[:, -2:] = False
    return replace(data, weight=data.weight * ~far[:, None])


@dataclass(frozen=True, eq=False)
class Found:
    """What the search ends with: fitted sets, likeliest first, and the linear ones."""

    scored: Sequence[Scored]
    linear: Sequence[tuple[float, Set]]

    @cached_property
    def weights(self) -> dict[frozenset[str], float]:
        """Posterior of each set of names."""
        logs = {s.names: _WARMTH * s.evidence + prior(s.names) for s in self.scored}
        at = {names_of(terms): value - prior(names_of(terms)) for value, terms in self.linear}
        offset = max(logs.values()) - 1.0
        offset -= max(_WARMTH * at[names] + prior(names) for names in logs if names in at)
        for names, value in at.items():
            logs.setdefault(names, _WARMTH * value + prior(names) + offset)
        odds = np.exp(np.array(list(logs.values())) - max(logs.values()))
        return dict(zip(logs, (odds / odds.sum()).tolist(), strict=True))


def look(data: Data) -> Found:
    """Search for the sets of terms that make the data likeliest."""
    names = paths((*library(), *basis_terms(), *_CONSTANT, _OPEN))
    predictor = Predictor(data, names, sizes=(_BREATHS,))
    base = fit(data, (), predictor=predictor, iterations=20)
    data = without_spikes(base, data)
    base = fit(data, (), predictor=predictor, iterations=20)
    linear = linearise(data, predictor, base, base, wide=True)
    noise = linear.noise(base.problem.noise)
    known = Known(linear, noise)
    ranked = search(known, in_time(known, predictor, base), 3)
    tried: dict[frozenset[str], Scored] = {}

    def attempt(terms: Set) -> None:
        if names_of(terms) in tried:
            return
        fitted, told = base, data
        latent = tuple(t for t in terms if len(t.latent))
        for k in range(2 if latent else 1):
            if k or len(terms) > len(latent):
                fitted = fit_terms(told, predictor, base, terms, noise)
            linear = linearise(data, predictor, fitted, base, latent)
            made = Scored(terms, fitted, linear, noise)
            told = replace(data, measured=data.measured - made.latent[:, None])
        tried[made.names] = made

    def ordered() -> list[Scored]:
        return sorted(tried.values(), key=lambda s: -s.evidence - prior(s.names))

    for terms in [(), *(terms for _, terms in ranked[: _FITS[0]])]:
        attempt(terms)
    best = ordered()[0]
    if best.terms:
        latent = tuple(t for t in best.terms if len(t.latent))
        again = linearise(data, predictor, best.fitted, base, latent, wide=True)
        noise = again.noise(noise)
        own = names_of(latent)
        more = [t for _, t in search(Known(again, noise), (), 1) if t and not names_of(t) & own]
        for terms in more[: _FITS[1]]:
            attempt((*best.terms, *terms))
        for one in best.terms:
            attempt(tuple(t for t in best.terms if t is not one))
        tried = {names: replace(s, noise=noise) for names, s in tried.items()}
    return Found(ordered(), ranked)


def diagnose(folder: Path) -> dict[str, Any]:
    """Answer a case."""
    seen = see(folder)
    breaths, level = without_saturated(seen.breaths)
    data = replace(seen, breaths=breaths).observed
    every = np.linspace(0, len(data) - 1, min(_BREATHS, len(data))).round().astype(int)
    found = look(data.select(np.unique(every)))
    top = None if level is None else level[0]
    return {
        "hypotheses": hypotheses(found, seen.question["vocabulary"]["places"], top),
        "pressures": seen.pressures(predicted(found.scored[0], seen, top)),
        "parameters": parameters(found.scored[0], seen.question["vocabulary"]["names"], top),
    }


def hypotheses(found: Found, places: Sequence[str], level: float | None) -> list[dict[str, Any]]:
    """The posterior in the terms of the vocabulary; all have a sensor that saturates at a level."""
    always = frozenset() if level is None else frozenset({"saturation"})
    odds = {always | {f"unknown:{place}"}: _UNSURE / len(places) for place in places}
    for names, weight in found.weights.items():
        sites = {n: mechanism(n).description.site for n in names if n in basis_terms()}
        told = (f"unknown:{_SITES.get(sites[n], sites[n])}" if n in sites else n for n in names)
        terms = always.union(told)
        odds[terms] = odds.get(terms, 0.0) + (1.0 - _UNSURE) * weight
    kept = sorted(odds.items(), key=lambda pair: -pair[1])[:100]
    total = sum(weight for _, weight in kept)
    return [{"terms": sorted(terms), "probability": weight / total} for terms, weight in kept]


def predicted(best: Scored, seen: Seen, level: float | None) -> Floats:
    """Pressures of the withheld breaths, cmH2O, ``(k, T)``, without what acts in time."""
    names = best.fitted.problem.predictor.names
    test = seen.data.select(seen.apart)
    simulator = Predictor(test, names, sizes=(_BREATHS,))
    values, order = parameter_values(test, names, {}), (*names, START)
    told = {path: float(parameter_of(path).physical(m)) for path, (m, _) in best.parameters.items()}
    for column, name in enumerate(order):
        if name != "position":
            value = told.get(name, np.mean(best.fitted.column(name))) + best.basis.get(name, 0.0)
            values[:, column] = np.clip(value, parameter_of(name).low, parameter_of(name).high)
    pressure = simulator.predict(values)[:, 0]
    return pressure if level is None else np.minimum(pressure, level)


def parameters(
    best: Scored, vocabulary: Mapping[str, Any], level: float | None
) -> dict[str, dict[str, float]]:
    """Estimates with 95 % intervals that the vocabulary has."""
    found = {} if level is None else {"saturation.level": (level,) * 3}
    for path, (mean, sd) in best.parameters.items():
        ends = parameter_of(path).physical(np.array([mean, mean - 2.0 * sd, mean + 2.0 * sd]))
        found[path] = tuple(np.clip(ends, parameter_of(path).low, parameter_of(path).high).tolist())
    known = {f"{name}.{key}" for name, about in vocabulary.items() for key in about["parameters"]}
    return {
        path: {"value": value, "low": low, "high": high}
        for path, (value, low, high) in found.items() if path in known | {"R", "C"}
    }  # fmt: skip
