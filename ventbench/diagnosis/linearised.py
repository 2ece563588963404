"""A rig to first order around a fit: what candidates change, and what is integrated out beside."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
from scipy import linalg, special
from scipy.linalg import lapack

from ventbench.base.arrays import Floats
from ventbench.base.linear import cholesky
from ventbench.diagnosis.hypothesis import FittedModel
from ventbench.physics.catalogue import library, mechanism, strength_path
from ventbench.physics.mechanism import Parameter
from ventbench.system_id.data import Data, Noise, robust_noise
from ventbench.system_id.predictor import START, UNSTABLE, Predictor
from ventbench.system_id.problem import parameter_of

#: Standard deviations: of a characteristic and of what every rig has of a basis term, as shares of
#: their spread; of a mechanism, as a share of the least strength that is named, and of one
#: that every rig has.
_FORM, _REST, _LEAST, _UBIQUITOUS = 0.15, 0.01, 0.1, 0.3

#: Standard deviation of the logarithm of the valve's gain from breath to breath.
SCATTER = 0.01

#: Standard deviations of base parameters in coordinates, around those of the base fit.
_BASE = {"R": 0.5, "C": 0.5, "R_ex": 0.5, "PEEP": 2.0, START: 1.0}

#: Effects of some breaths: size that is simulated, and standard deviation of its multiple; one that
#: has a course as well; and one that is no parameter of a fit.
CONSTANT = {"intermittent_leak": (8.0, 1.5), "secretions": (0.5, 1.5)}
OPEN, EFFORT = "disconnection", "patient_effort"


@dataclass(frozen=True, eq=False)
class Term:
    """A candidate at one point of its shape."""

    name: str  #: of the mechanism, basis term or event.
    spread: Sequence[float]  #: prior standard deviations of the coefficients of its columns.
    main: tuple[int, ...] = ()  #: these columns in the linearised experiment.
    #: values by path, the strength first; its column is the effect of these.
    values: Mapping[str, float] = field(default_factory=dict)
    limits: tuple[float, float] = (-np.inf, np.inf)  #: least and largest coefficient of a strength.
    odds: float = 0.0  #: logarithm of the prior of this point.
    #: spreads of its characteristic by column of the basis terms.
    forms: Mapping[int, float] = field(default_factory=dict)
    #: changes of pressure ``(n, T)`` by what acts in time, which no fit knows.
    latent: Sequence[Floats] = ()
    #: frequency, Hz, and spread of a swing.
    swing: Mapping[str, float] = field(default_factory=dict)


Set = tuple[Term, ...]


def names_of(terms: Iterable[Term]) -> frozenset[str]:
    """Names of a set."""
    return frozenset(term.name for term in terms)


def latent_of(terms: Iterable[Term]) -> Set:
    """Those that act in time."""
    return tuple(term for term in terms if len(term.latent))


def solve_lower(L: Floats, right: Floats) -> Floats:
    """Solution ``x`` of ``L @ x = right`` for a lower triangular factor ``(k, k)``, ``(k, m)``.

    LAPACK directly: of matrices as small as those of a search, the checks of
    :func:`scipy.linalg.solve_triangular` take five times as long as the solution.
    """
    if not len(L):
        return right
    x, _ = lapack.dtrtrs(L, right, lower=1)  # type: ignore[attr-defined]
    return np.asarray(x, np.float64)


def gaussian(G: Floats, b: Floats, sd: Floats) -> tuple[float, Floats, Floats]:
    """Log evidence of coefficients over none, their means and standard deviations.

    Args:
        G: ``X' K^-1 X``, ``(k, k)``.
        b: ``X' K^-1 y``, ``(k,)``.
        sd: prior standard deviations, ``(k,)``.
    """
    precision = np.multiply(sd[:, None] * G, sd)
    precision.flat[:: len(sd) + 1] += 1.0
    L, failed = lapack.dpotrf(precision, lower=1)  # type: ignore[attr-defined]
    root = solve_lower(cholesky(precision) if failed else L, np.diag(sd))
    q = root @ b
    mean, sds = root.T @ q, np.sqrt(np.sum(root**2, axis=0))
    return 0.5 * float(q @ q) - float(np.log(np.diag(L)).sum()), mean, sds


@dataclass(frozen=True, eq=False)
class CandidateEffects:
    """Effects of candidates on the pressure, simulated around a fit."""

    data: Data  #: n breaths of T samples.
    values: Floats  #: physical values of the fit, ``(n, P + 1)``.
    #: changes of pressure, ``(n, T)`` each, of which the first is that of the gain.
    columns: Sequence[Floats]
    #: paths and spreads of the coefficients of basis terms, by column.
    basis: Mapping[int, tuple[str, float]]
    of_basis: Mapping[str, list[int]]  #: columns of each basis term.
    #: standard deviations of mechanisms that every rig has a little of, by column.
    least: dict[int, float]
    terms: Set  #: candidates.
    #: changes of pressure by events of each course, ``(g, n, T)``, by name.
    events: Mapping[str, Floats]

    def forms(self, effect: Floats, name: str) -> dict[int, float]:
        """Deviations of an effect's characteristic in the basis terms that contain it."""
        deviations: dict[int, float] = {}
        for basis in mechanism(name).description.special_case_of:
            if indices := self.of_basis.get(basis):
                width = np.array([self.basis[j][1] for j in indices])
                A = np.stack([self.columns[j].reshape(-1) for j in indices], axis=1) * width
                ridge = 1e-3 * np.trace(A.T @ A) / len(indices) * np.eye(len(indices))
                c = width * (np.linalg.pinv(A.T @ A + ridge) @ (A.T @ effect.reshape(-1)))
                deviations |= dict(zip(indices, (_FORM * np.abs(c) + 1e-12).tolist(), strict=True))
        return deviations


def points(name: str) -> list[dict[str, float]]:
    """Values, by path, at which the effect of a mechanism is computed."""
    strength, *secondary = mechanism(name).description.parameters
    sizes: tuple[float, ...] = (strength.mild, strength.strong)
    if any(p.change_point for p in secondary):
        sizes = (strength.mild,)
    elif strength.kinked and strength.unit == "s":  # beyond a sample, it acts in proportion
        sizes = tuple(strength.strong * x for x in (0.15, 0.35, 0.6, 1.0))
    elif strength.kinked and strength.scan:  # what one threshold does says nothing of another
        sizes = tuple(x for x in strength.scan if x != strength.neutral)
    elif strength.low <= -strength.mild:
        sizes += (-strength.mild,)

    def grid(p: Parameter) -> tuple[float, ...]:
        if p.change_point:  # before the first breath
            return (-1.0,)
        return p.grid or ((0.4, 1.0, 2.5) if p.uncertain else (p.neutral,))

    paths = [f"{name}.{p.name}" for p in (strength, *secondary)]
    every = product(sizes, *(grid(p) for p in secondary))
    return [dict(zip(paths, point, strict=True)) for point in every]


def courses(name: str) -> list[dict[str, float]]:
    """Values of an event of some breaths, by path, for each of its courses."""
    if name in CONSTANT:
        return [{strength_path(name): CONSTANT[name][0]}]
    _, onset, duration, exponent = mechanism(name).description.parameters
    every = product((300.0,), onset.grid[::2], duration.grid[1:5], exponent.grid[:1])
    paths = [f"{name}.{p.name}" for p in mechanism(name).description.parameters]
    return [dict(zip(paths, point, strict=True)) for point in every]


def simulate(
    data: Data,
    predictor: Predictor,
    around: FittedModel,
    names: Sequence[str],
    unnamed: Sequence[str],
    events: Collection[str],
    screened: Mapping[str, Sequence[dict[str, float]]],
) -> CandidateEffects:
    """Simulate all candidates around a fit; what it has is no candidate.

    Args:
        data: n breaths.
        predictor: predictor of these, with the parameters of all candidates.
        around: the fit.
        names: mechanisms that all breaths share.
        unnamed: basis terms.
        events: effects of some breaths.
        screened: points of mechanisms of which a parameter is screened.
    """
    values, order = around.values, (*predictor.names, START)
    perturbed, scale = [values], {0: 0.01}

    def perturb(changes: Mapping[str, Any]) -> int:
        point = values.copy()
        for path, value in changes.items():
            point[:, order.index(path)] = value
        perturbed.append(point)
        return len(perturbed) - 2

    perturb({"gain": 1.01 * values[:, order.index("gain")]})
    basis: dict[int, tuple[str, float]] = {}
    of_basis: dict[str, list[int]] = {}
    for name in unnamed:
        for p in mechanism(name).description.parameters:
            path, spread = f"{name}.{p.name}", p.spread or 1.0
            k = perturb({path: values[:, order.index(path)] + 0.1 * spread})
            scale[k], basis[k] = 0.1 * spread, (path, spread)
            of_basis.setdefault(name, []).append(k)
    candidates = [n for n in names if n not in around.names]
    evaluations = [
        (name, point, perturb(point))
        for name in candidates
        for point in (screened[name] if name in screened else points(name))
    ]
    acting = {n: [perturb(point) for point in courses(n)] for n in (*CONSTANT, OPEN) if n in events}
    predicted = predictor.predict_all(np.stack(perturbed))[:, :, 0]
    # a point that the model cannot simulate changes nothing, so no evidence chooses it
    predicted = np.where(
        (np.abs(predicted) < UNSTABLE).all(axis=(1, 2), keepdims=True), predicted, predicted[0]
    )
    columns = [
        (pressure - predicted[0]) / scale.get(k, 1.0) for k, pressure in enumerate(predicted[1:])
    ]
    courses_of = {name: np.stack([columns[k] for k in indices]) for name, indices in acting.items()}
    effects = CandidateEffects(data, values, columns, basis, of_basis, {}, (), courses_of)
    terms, least = [], {}
    places = np.unique(data.position)
    between = (0.5 * (places[1:] + places[:-1])[1:-1]).tolist()
    for name, point, k in evaluations:
        description, size = mechanism(name).description, point[strength_path(name)]
        at = [f"{name}.{p.name}" for p in description.parameters if p.change_point]
        count = sum(candidate == name for candidate, _, _ in evaluations)
        count *= len(between) if at else 1
        count *= int(np.prod([len(p.grid) for p in description.parameters if p.screened]))
        low, high = sorted((description.strength.low / size, description.strength.high / size))
        term = Term(
            name,
            (abs(description.strength.strong / size),),
            (k,),
            point,
            (low, high),
            -float(np.log(max(count, 1))),
        )
        for x in between if at else ():
            columns.append(np.where(data.position[:, None] > x, columns[k], 0.0))
            terms.append(replace(term, main=(len(columns) - 1,), values=point | {at[0]: x}))
        if not at:
            terms.append(replace(term, forms=effects.forms(columns[k], name)))
            if description.least and not any(t.name == name for t in terms[:-1]):
                share = _UBIQUITOUS if description.ubiquitous else _LEAST
                least[k] = share * description.least / abs(size)
    terms += [
        Term(name, [basis[j][1] for j in indices], tuple(indices))
        for name, indices in of_basis.items()
    ]
    return replace(effects, least=least, terms=tuple(terms))


class LinearModel:
    """An experiment, linearised around a fit whose parameters return to their prior means.

    These are the labels of R and C, and the base fit's R_ex, PEEP and starts.

    All nuisance is integrated out: the parameters of the fit, what every rig has, deviations of
    forms, and what acts in time beside the fit.
    """

    def __init__(
        self,
        around: CandidateEffects,
        fitted: FittedModel,
        base: FittedModel,
        noise: Noise,
        terms: Set = (),
        *,
        scatter: float = SCATTER,
        loose: bool = False,
    ) -> None:
        """Linearise.

        Args:
            around: what candidates change.
            fitted: fit of what of the terms is a parameter of the model.
            base: fit of the base model, whose parameters are prior means.
            noise: measurement noise.
            terms: the terms of the rig.
            scatter: standard deviation of the logarithm of the gain from breath to breath.
            loose: whether basis terms have their whole spread.
        """
        self.fitted, self.terms, latent = fitted, terms, latent_of(terms)
        self.around, self.noise, self.n = around, noise, len(around.data)
        self.scatter = scatter
        measured, weight = around.data.measured[:, 0], around.data.weight[:, 0]
        residual, slopes = fitted.jacobian
        remainder = weight * (measured - residual[:, 0] - fitted.problem.data.measured[:, 0])
        free = {k: s for k, (p, s) in around.basis.items() if owner_of(p) not in fitted.names}
        form = {k: (1.0 if loose else _REST) * s for k, s in free.items()}
        shared_columns, breath_columns = [], [scatter * around.columns[0]]
        self.paths: list[tuple[str, float, float]] = []
        layout = fitted.problem.unknowns
        for j, path in enumerate(layout.paths):
            parameter, estimate = parameter_of(path), fitted.minimum.x[layout.index[:, j]]
            if parameter.change_point:
                continue
            mean: Any = (
                parameter.prior()[0] if "." in path else parameter.coordinate(base.column(path))
            )
            if path in ("R", "C"):
                mean = parameter.coordinate(getattr(around.data, path))
            sd = _BASE[path] if "." not in path else parameter.prior()[1]
            if "." in path and path == strength_path(owner_of(path)):
                mean = float(parameter.coordinate(parameter.neutral))
                sd = parameter.spread or abs(parameter.strong - parameter.neutral)
                forms = around.forms(slopes[:, j, 0] * (estimate - mean)[:, None], owner_of(path))
                form |= {k: float(np.hypot(form[k], s)) for k, s in forms.items() if k in form}
            mean = np.broadcast_to(mean, estimate.shape)
            remainder = remainder - slopes[:, j, 0] * (mean - estimate)[:, None]
            if path == START:
                breath_columns.append(sd * slopes[:, j, 0])
                continue
            for unknown in np.unique(layout.index[:, j]):  # one of each lung that has its own
                which = layout.index[:, j] == unknown
                shared_columns.append(sd * slopes[:, j, 0] * which[:, None])
                self.paths.append((path, float(np.mean(mean[which])), sd))
        shared_columns += [s * around.columns[k] for k, s in (form | around.least).items()]
        shared_columns += [
            s * column for t in latent for column, s in zip(t.latent, t.spread, strict=True)
        ]
        self.latent = sum(len(t.latent) for t in latent)
        shared = np.stack(shared_columns, axis=1) * weight[:, None]  # (n, z, T)
        self.residual = remainder * weight
        self.breathwise = np.stack(breath_columns, axis=1) * weight[:, None]
        self.shared = shared
        self.y = self.rows(self.residual[:, None])[:, 0]
        white = np.moveaxis(self.rows(self.breathwise).reshape(self.n, -1, 2), 2, 0)
        blocks = [np.asarray(linalg.block_diag(*x[:, :, None])) for x in white]
        self.Z = np.concatenate([self.rows(shared), *blocks], axis=1)
        self.factor = cholesky(np.eye(self.Z.shape[1]) + self.Z.T @ self.Z), True
        self.mean = linalg.cho_solve(self.factor, self.Z.T @ self.y)

    def rows(self, columns: Floats) -> Floats:
        """Whitened ``(n, m, T)`` as ``(n T, m)``."""
        white = self._white(columns)
        return np.moveaxis(white, 1, 2).reshape(-1, white.shape[1])

    def _white(self, columns: Floats) -> Floats:
        return self.noise.whiten(columns[:, :, None], self.around.data.weight)[:, :, 0]

    def products(self, X: Floats) -> tuple[Floats, Floats]:
        """``X' K^-1 X`` and ``X' K^-1 y``, ``K = 1 + Z Z'``."""
        ZX = self.Z.T @ X
        return X.T @ X - ZX.T @ linalg.cho_solve(self.factor, ZX), X.T @ self.y - ZX.T @ self.mean

    def of_breaths(self, columns: Floats) -> tuple[Floats, Floats]:
        """The same of columns ``(n, m, T)`` with coefficients of each breath, ``(n m, n m)``."""
        P = self._white(columns)
        ZP = np.matmul(P, self.Z.reshape(self.n, P.shape[2], -1)).reshape(-1, self.Z.shape[1])
        b = np.einsum("nmt,nt->nm", P, self.y.reshape(self.n, -1)).reshape(-1) - ZP @ self.mean
        G = linalg.block_diag(*np.matmul(P, P.swapaxes(1, 2)))
        return G - ZP @ linalg.cho_solve(self.factor, ZP.T), b

    def breath_diagonal(self, course: Floats) -> tuple[Floats, Floats]:
        """Diagonal of the same, and products with the residual, of a course ``(n, T)``."""
        P = self._white(course[:, None])[:, 0]
        ZP = np.einsum("nt,ntz->nz", P, self.Z.reshape(self.n, P.shape[1], -1))
        b = np.einsum("nt,nt->n", P, self.y.reshape(self.n, -1)) - ZP @ self.mean
        return np.sum(P**2, axis=1) - np.sum(ZP * linalg.cho_solve(self.factor, ZP.T).T, axis=1), b

    @cached_property
    def evidence(self) -> float:
        """Log evidence of the terms."""
        power = self.y @ self.y - (self.Z.T @ self.y) @ self.mean
        value = -0.5 * float(power) - float(np.log(np.diag(self.factor[0])).sum())
        value += sum(term.odds for term in self.terms)
        for (path, mean, sd), posterior in zip(self.paths, self._parameters, strict=True):
            if owner_of(path) in library() and path == strength_path(owner_of(path)):
                parameter = parameter_of(path)
                ends = (
                    float(parameter.coordinate(parameter.low)),
                    float(parameter.coordinate(parameter.high)),
                )
                value += within(ends, *posterior, mean, sd)
        return value

    @cached_property
    def _parameters(self) -> list[tuple[float, float]]:
        """Posterior mean and standard deviation of each path, in coordinates."""
        sds = np.sqrt(np.diag(linalg.cho_solve(self.factor, np.eye(len(self.mean)))))
        return [
            (mean + sd * float(self.mean[k]), sd * float(sds[k]))
            for k, (_, mean, sd) in enumerate(self.paths)
        ]

    @cached_property
    def in_time(self) -> Floats:
        """Expected change of pressure by what acts in time, cmH2O, ``(n, T)``."""
        which = slice(self.shared.shape[1] - self.latent, self.shared.shape[1])
        return np.einsum("nkt,k->nt", self.shared[:, which], self.mean[which])

    @property
    def residual_noise(self) -> Noise:
        """Noise that the fit and the posterior means of all coefficients leave."""
        count = self.shared.shape[1]
        explained = np.einsum("nkt,k->nt", self.shared, self.mean[:count])
        explained += np.einsum("nkt,kn->nt", self.breathwise, self.mean[count:].reshape(2, self.n))
        weight = self.around.data.weight
        return robust_noise((self.residual - explained)[:, None] * weight, weight)


def owner_of(path: str) -> str:
    """Mechanism of a parameter; none if it is of the base model."""
    return path.rpartition(".")[0]


def within(
    limits: tuple[float, float], mean: float, sd: float, before: float, sd_before: float
) -> float:
    """Log of the share of a Gaussian that lies within limits, over that of its prior."""

    def share(centre: float, width: float) -> float:
        a, b = ((end - centre) / width for end in limits)
        return max(float(special.ndtr(b) - special.ndtr(a)) if a < 5 else 0.0, 1e-12)

    return float(np.log(share(mean, sd)) - np.log(share(before, sd_before)))
