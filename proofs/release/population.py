"""Fit of the population of rigs to recordings, and the check that holds it to account.

Around its fitted plant each session's inspirations are linearised in all numbers of a rig
(:data:`ventbench.plants.hybrid.NAMES`) and in each breath's own gain and start, which are then
integrated out. What is left says what the session knows of its rig, with its error; a mixed model
makes a population of it. The linearisation is renewed a few times around the rigs that result. What
the ventilator decides has one mean over all rigs, what the lung decides one for each lung.

**The mixed model**, :func:`fit_mixed`, is of units whose estimates have errors of their own. Unit j
has parameters ``theta_j = X_j beta + u_j`` with ``u_j ~ N(0, Sigma)``. Its data say ``log L_j =
b_j' theta - theta' A_j theta / 2``: information ``A_j``, which may be singular, and ``b_j = A_j``
times the estimate. So what the estimates scatter by their errors alone is taken off from what they
scatter, and a direction that a unit says nothing about counts for nothing.

The maximum is found by expectation and maximisation; the error of ``beta`` is part of the
expectation (restricted maximum likelihood). Variances and correlations are shrunk: with fewer
units than parameters the data alone would say that ``Sigma`` is singular. Laird and Ware,
Biometrics 38 (1982), 963.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import tomli_w
from jax import Array
from scipy.stats import chi2

from ventbench.base import compilation, files
from ventbench.base.arrays import Bools, Floats, Ints
from ventbench.plants import frozen
from ventbench.plants.hybrid import (
    NAMES,
    Hybrid,
    RigPopulation,
    from_vector,
    to_vector,
)
from ventbench.task.draws import GAIN_QUANTILES
from ventbench.train.rigs.data import InspirationData, inspirations, load_rig_recordings
from ventbench.train.rigs.fit import Noise, simulate
from ventbench.train.rigs.population import (
    PRIOR_SESSIONS,
    UNCORRELATED_SESSIONS,
    design_of,
    scales,
)
from ventbench.train.rigs.train import UNRECORDED_SLOPE

#: What the data cannot bound, as a play's weight changes nothing any more when it nears its bound:
#: its scale is given.
FIXED_SCALES = ("direction",)

#: Standard deviations of means around those of the fitted plants; the second is of what a label
#: says: that fit ties lungs of one labelled resistor or spring together, which this one does not.
LABELLED, CENTRE_SCALE, LABELLED_SCALE = ("resistance", "elastance"), 0.5, 0.05

#: Renewals of the linearisation, steps of each breath's gain and start in each, and of the mixed
#: model in each; at most so much changes in one, as the linearisation holds nearby only.
RENEWALS, BREATH_STEPS, MIXED_STEPS, LARGEST = 12, 6, 10, 0.3

#: Degrees of freedom of the errors of samples and of the gains of breaths.
TAIL = 4.0

#: Scale of a breath's gain while its rig is fitted; and while the gains are measured, wide.
GAIN, WIDE_GAIN = 0.1, 1.0

_NOISE = Noise()


@dataclass(frozen=True)
class Units:
    """What the data of J units say of p parameters."""

    information: Floats  #: ``A_j``, shape ``(J, p, p)``.
    weighted: Floats  #: ``b_j``, shape ``(J, p)``.
    design: Floats  #: ``X_j``, shape ``(J, p, q)``.

    def excluding(self, j: int) -> Units:
        """All units but one."""
        return Units(*(np.delete(part, j, axis=0) for part in vars(self).values()))


@dataclass(frozen=True)
class Prior:
    """Prior of :func:`fit_mixed`."""

    scale: Floats  #: standard deviations of the parameters between units, shape ``(p,)``.
    #: how many units each scale counts for, shape ``(p,)``; infinity for one that is given.
    units: Floats
    uncorrelated: float  #: how many units count for no correlation between parameters.
    centre: Floats  #: of ``beta``, shape ``(q,)``.
    centre_scale: Floats  #: standard deviations of ``beta`` around it, shape ``(q,)``.


@dataclass(frozen=True)
class Population:
    """Result of a fit."""

    beta: Floats  #: shape ``(q,)``.
    beta_covariance: Floats  #: shape ``(q, q)``.
    covariance: Floats  #: ``Sigma``, shape ``(p, p)``.
    units: Floats  #: posterior means of ``theta_j``, shape ``(J, p)``.

    def predictive(self, design: Floats) -> tuple[Floats, Floats]:
        """Mean and covariance of a new unit with a design ``(..., p, q)``."""
        turned = np.swapaxes(design, -1, -2)
        return design @ self.beta, self.covariance + design @ self.beta_covariance @ turned


def fit_mixed(
    units: Units, prior: Prior, *, iterations: int = 200, start: Floats | None = None
) -> Population:
    """Fit the population.

    Args:
        units: J of them.
        prior: see :class:`Prior`.
        iterations: of the expectation and maximisation.
        start: ``Sigma`` to start at; the prior's if not given.
    """
    covariance = np.diag(prior.scale**2) if start is None else start
    count = len(units.weighted)
    for _ in range(iterations):
        beta, error, means, spread = _expect(units, prior, covariance)
        apart = means - units.design @ beta
        second = apart.T @ apart + spread.sum(axis=0)
        # Variances and correlations have priors of their own (Barnard et al., 2000).
        fixed = np.isinf(prior.units)
        counts = np.where(fixed, 0.0, prior.units)
        variances = (second.diagonal() + counts * prior.scale**2) / (count + counts)
        variances = np.where(fixed, prior.scale**2, variances)
        root = np.sqrt(second.diagonal())
        correlation = second / np.outer(root, root) * count / (count + prior.uncorrelated)
        np.fill_diagonal(correlation, 1.0)
        covariance = correlation * np.sqrt(np.outer(variances, variances))
    beta, error, means, _ = _expect(units, prior, covariance)
    return Population(beta, error, covariance, means)


def _expect(
    units: Units, prior: Prior, covariance: Floats
) -> tuple[Floats, Floats, Floats, Floats]:
    """Beta, its covariance, means of all units, and covariances of their deviations."""
    A, b, X = units.information, units.weighted[..., None], units.design
    inverse = np.linalg.inv(covariance)
    posterior = np.linalg.inv(A + inverse)
    turned = X.transpose(0, 2, 1)
    precision = prior.centre_scale**-2.0
    normal = (turned @ (A - A @ posterior @ A) @ X).sum(axis=0)
    normal += np.diag(precision)
    right = (turned @ (b - A @ (posterior @ b)))[..., 0].sum(axis=0) + precision * prior.centre
    error = np.linalg.inv(normal)
    beta = error @ right
    means = (posterior @ (b + inverse @ (X @ beta[:, None])))[..., 0]
    through = posterior @ A @ X
    return beta, error, means, posterior + through @ error @ through.transpose(0, 2, 1)


def surprise(units: Units, j: int, population: Population) -> float:
    """How a unit lies in a population that was fitted without it.

    Compared is what its data say, in the directions in which they say something, with what the
    population predicts, errors of the data included.

    Returns:
        Share of the predicted units that are nearer to the middle: uniform in 0..1 if all is right.
    """
    values, vectors = np.linalg.eigh(units.information[j])
    positive = values > 1e-6 * values[-1]
    root = vectors[:, positive] * np.sqrt(values[positive])
    estimate = (vectors[:, positive] / np.sqrt(values[positive])).T @ units.weighted[j]
    mean, spread = population.predictive(units.design[j])
    covariance = np.eye(root.shape[1]) + root.T @ spread @ root
    deviation = estimate - root.T @ mean
    distance = float(deviation @ np.linalg.solve(covariance, deviation))
    return float(chi2.cdf(distance, root.shape[1]))


@dataclass(frozen=True)
class _Breaths:
    """What the breaths of the chosen sessions are, and their gains and starts so far."""

    data: InspirationData
    at: Ints
    weight: Floats
    gain: Floats
    start: Floats

    @property
    def measured_start(self) -> Bools:
        return np.asarray(self.data.start_measured) > 0

    def at_start(self) -> Floats:
        first = np.where(self.measured_start, np.asarray(self.data.start), _NOISE.unknown_start)
        return first + self.start


def _pressures(vector: Array, gain: Array, start: Array, data: InspirationData) -> Array:
    plant = from_vector(vector)
    plant = plant.replace(slopes=plant.slopes * jnp.exp(gain))  # type: ignore[attr-defined]
    return simulate(plant, start, data)


def _derivatives(*names: int) -> Callable[..., tuple[Array, ...]]:
    def both(*arguments: Any) -> tuple[Array, ...]:
        return _pressures(*arguments), *jax.jacfwd(_pressures, argnums=names)(*arguments)

    return jax.jit(jax.vmap(both))


_by_all, _by_breath = _derivatives(0, 1, 2), _derivatives(1, 2)


def _linearised(
    breaths: _Breaths, rigs: Floats, function: Callable[..., tuple[Array, ...]]
) -> tuple[Floats, Floats, list[Floats]]:
    """Residuals, their weights, and derivatives of the pressures of all breaths."""
    with compilation.float64():
        arguments = (rigs[breaths.at], breaths.gain, breaths.at_start())
        pressure, *slopes = map(np.asarray, function(*map(jnp.asarray, arguments), breaths.data))
    counted = np.asarray(breaths.data.share) > 0
    residual = np.where(counted, np.asarray(breaths.data.pressure) - pressure, 0.0)
    robust = (TAIL + 1.0) / (TAIL + (residual / _NOISE.pressure) ** 2)
    share = np.asarray(breaths.data.share)
    weight = breaths.weight[:, None] * robust * share * _NOISE.independent / _NOISE.pressure**2
    return residual, weight, slopes


def _breath_priors(breaths: _Breaths, scale: float) -> tuple[Floats, Floats]:
    """Prior precisions of each breath's gain and start, ``(n, 2)``, and their values."""
    unknown = np.hypot(_NOISE.unknown_start_scale, _NOISE.rig_start)
    start = np.where(breaths.measured_start, _NOISE.start, unknown)
    gain = scale**2 * (TAIL + (breaths.gain / scale) ** 2) / (TAIL + 1.0)
    return np.stack([1.0 / gain, start**-2.0], -1), np.stack([breaths.gain, breaths.start], -1)


def _fit_breaths(breaths: _Breaths, rigs: Floats, scale: float, steps: int) -> _Breaths:
    """Fit each breath's gain and start for given rigs."""
    for _ in range(steps):
        residual, weight, slopes = _linearised(breaths, rigs, _by_breath)
        by = np.stack(slopes, -1)
        prior, posterior = _breath_priors(breaths, scale)
        normal = np.einsum("bt,bti,btj->bij", weight, by, by)
        normal[:, [0, 1], [0, 1]] += prior
        right = np.einsum("bt,bti->bi", weight * residual, by) - prior * posterior
        change = np.linalg.solve(normal, right[..., None])[..., 0]
        gain, start = np.clip(change, -LARGEST, LARGEST).T
        breaths = replace(breaths, gain=breaths.gain + gain, start=breaths.start + start)
    return breaths


def _units(breaths: _Breaths, rigs: Floats, design: Floats) -> Units:
    """Information of the sessions, the breaths' gains and starts integrated out."""
    residual, weight, (by_rig, *slopes) = _linearised(breaths, rigs, _by_all)
    by = np.stack(slopes, -1)
    prior, posterior = _breath_priors(breaths, GAIN)
    weighted = weight[..., None] * by_rig
    inner = np.einsum("bt,bti,btj->bij", weight, by, by)
    inner[:, [0, 1], [0, 1]] += prior
    mixed = weighted.transpose(0, 2, 1) @ by
    solved = mixed @ np.linalg.inv(inner)
    inner_right = np.einsum("bt,bti->bi", weight * residual, by) - prior * posterior
    right = np.einsum("btp,bt->bp", weighted, residual)
    right -= (solved @ inner_right[..., None])[..., 0]
    information = weighted.transpose(0, 2, 1) @ by_rig - solved @ mixed.transpose(0, 2, 1)
    count, size = rigs.shape
    A, b = np.zeros((count, size, size)), np.zeros((count, size))
    np.add.at(A, breaths.at, information)
    np.add.at(b, breaths.at, right)
    A = 0.5 * (A + A.transpose(0, 2, 1))
    return Units(A, b + (A @ rigs[..., None])[..., 0], design)


@dataclass(frozen=True)
class FittedPopulation:
    """A fitted population and what it was fitted to."""

    sessions: tuple[int, ...]  #: indices of the J sessions.
    lungs: tuple[str, ...]  #: id of the lung of each.
    units: Units  #: what each session says of its rig.
    prior: Prior  #: of the fit.
    population: Population  #: the fit.
    gain: Floats  #: logarithm of each measured breath's gain around its session's median, ``(m,)``.
    gain_sd: float  #: standard deviation of it within sessions.
    gain_lag: float  #: correlation of it between neighbours in the files' order.

    def cross_validated(self) -> list[float]:
        """:func:`surprise` of each session by the others."""
        out = []
        for j in range(len(self.sessions)):
            refit = fit_mixed(
                self.units.excluding(j), self.prior, iterations=30, start=self.population.covariance
            )
            out.append(surprise(self.units, j, refit))
        return out

    def of_lungs(self, lungs: Sequence[str]) -> RigPopulation:
        """The population of rigs of L lungs, by their ids, that rigs are drawn from.

        The valve's last bend, above which hardly anything is recorded, scatters more.
        """
        first = [self.lungs.index(lung) for lung in lungs]
        mean, covariance = self.population.predictive(self.units.design[first])
        last = NAMES.index("valve_bend_12")
        covariance[:, last, last] += UNRECORDED_SLOPE**2
        return RigPopulation(mean, np.asarray(np.linalg.cholesky(covariance), float))


def fit_population(
    plants: Hybrid,
    data: InspirationData,
    sessions: Sequence[int],
    lungs: Sequence[str],
    weight: Floats,
    *,
    renewals: int = RENEWALS,
    progress: Callable[[float], object] = lambda share: None,
) -> FittedPopulation:
    """Fit the population of rigs.

    Args:
        plants: fitted plants of all sessions, leaves ``(S, ...)``.
        data: inspirations.
        sessions: J of the S, which are what their label says.
        lungs: id of the lung of each of the J.
        weight: of each breath: 1 for a measured one.
        renewals: see :data:`RENEWALS`.
        progress: called with the share that is done, 0..1.
    """
    session = np.asarray(data.groups.session)
    used = np.flatnonzero(np.isin(session, sessions))
    order = {index: j for j, index in enumerate(sessions)}
    at = np.array([order[index] for index in session[used].tolist()])
    zero = np.zeros(len(used))
    chosen = jax.tree.map(lambda x: np.asarray(x)[used], data)
    breaths = _Breaths(chosen, at, weight[used], zero, zero)
    rigs = to_vector(plants)[list(sessions)]
    design = design_of(lungs)
    fit = np.linalg.lstsq(design.reshape(-1, design.shape[2]), rigs.ravel(), rcond=None)
    centre = np.asarray(fit[0], float)
    counts = [np.inf if name.startswith(FIXED_SCALES) else PRIOR_SESSIONS for name in NAMES]
    labelled = design[:, [NAMES.index(name) for name in LABELLED]].any(axis=(0, 1))
    wide = np.where(labelled, LABELLED_SCALE, CENTRE_SCALE)
    prior = Prior(scales(), np.array(counts), UNCORRELATED_SESSIONS, centre, wide)
    start = None
    for turn in range(renewals):
        breaths = _fit_breaths(breaths, rigs, GAIN, BREATH_STEPS)
        units = _units(breaths, rigs, design)
        last = turn == renewals - 1
        fitted = fit_mixed(units, prior, iterations=200 if last else MIXED_STEPS, start=start)
        start = fitted.covariance
        if not last:
            rigs = rigs + np.clip(fitted.units - rigs, -LARGEST, LARGEST)
        progress((turn + 1) / renewals)
    breaths = _fit_breaths(breaths, rigs, WIDE_GAIN, 4 * BREATH_STEPS)
    measured = breaths.weight == 1.0
    gain, sd, lag = _scatter(breaths.gain[measured], at[measured])
    return FittedPopulation(tuple(sessions), tuple(lungs), units, prior, fitted, gain, sd, lag)


def train_population(
    recordings: Path | str,
    simulators: Path | str,
    *,
    progress: Callable[[float], object] = lambda share: None,
) -> None:
    """Fit the population of the scored rigs of simulators and add it to their folder.

    The manifest then names the file, and says how the sessions lie in a population that was fitted
    without them.

    Args:
        recordings: folder of the recordings that the simulators were learned from.
        simulators: folder that :func:`ventbench.train_rigs` wrote.
        progress: called with the share that is done, 0..1.

    Raises:
        InputError: if a folder is not what it should be.
        OSError: if a file cannot be written.
    """
    folder = Path(simulators)
    base = frozen.load(folder)
    settings = base.manifest["recipe"]["rigs"]
    data = load_rig_recordings(Path(recordings), folds=settings["folds"], seed=settings["seed"])
    weight = np.where(np.arange(len(data.breaths)) < data.measured, 1.0, settings["reconstructed"])
    with compilation.float64():
        arranged = inspirations(data.breaths, base.sessions, data.labels)
    rigs = [
        (session, lung)
        for lung, rigs_of_lung in zip(base.lung_ids, base.rigs, strict=True)
        for session in sorted(rigs_of_lung)
    ]
    scored = jax.tree.map(lambda leaf: np.asarray(leaf)[0], base.members)
    sessions, lungs = [session for session, _ in rigs], [lung for _, lung in rigs]
    fitted = fit_population(scored, arranged, sessions, lungs, weight, progress=progress)
    rounded: dict[str, Any] = {
        name: np.round(x, 8) for name, x in vars(fitted.of_lungs(base.lung_ids)).items()
    }
    files.write_atomically(folder / frozen.POPULATION, lambda file: np.savez(file, **rounded))
    sd = np.sqrt(fitted.population.covariance.diagonal())
    levels = np.linspace(0.0, 1.0, len(GAIN_QUANTILES))
    manifest = {
        "sessions": list(fitted.sessions),
        "left_out": [round(share, 4) for share in fitted.cross_validated()],
        "deviations": {name: round(float(x), 4) for name, x in zip(NAMES, sd, strict=True)},
        "gain_breaths": len(fitted.gain),
        "gain_deviation": round(fitted.gain_sd, 4),
        "gain_quantiles": np.round(np.quantile(fitted.gain, levels), 3).tolist(),
        "gain_correlation": round(fitted.gain_lag, 4),
    }
    digest = files.sha256(folder / frozen.POPULATION)
    keys = ("held_out_rigs", "seen_rigs")
    lungs_of_manifest = base.manifest["lungs"].items()
    written = {
        "format": frozen.ROLES_FORMAT,
        "lungs": {
            lung: {key: entry[key] for key in keys if key in entry}
            for lung, entry in lungs_of_manifest
        },
        "population": manifest,
        "files": {frozen.POPULATION: {"sha256": digest}},
    }
    files.write_text(folder / frozen.ROLES, tomli_w.dumps(written))


def _scatter(gain: Floats, group: Ints) -> tuple[Floats, float, float]:
    """Deviations from the median of each group, scaled to the standard deviation within groups.

    Returns:
        The deviations; the standard deviation; and the correlation between neighbours.
    """
    of_rig = pd.Series(gain).groupby(group)
    deviation = pd.Series(gain) - of_rig.transform("mean")
    sd = float(np.sqrt((deviation**2).sum() / max(len(gain) - of_rig.ngroups, 1)))
    products = deviation * deviation.groupby(group).shift()
    lag = float(products.mean() / sd**2) if products.notna().any() and sd > 0 else 0.0
    around = np.asarray(gain - of_rig.transform("median"))
    return around * (sd / max(float(np.std(around)), 1e-12)), sd, lag
