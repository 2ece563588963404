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
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from scipy import special

from proofs.diagnosers._linearised import (
    CONSTANT,
    EFFORT,
    OPEN,
    Known,
    Set,
    Term,
    gaussian,
    latent_of,
    names_of,
    simulate,
    within,
)  # fmt: skip
from proofs.diagnosers.common import Floats, Seen, see
from ventbench.diagnosis import latent_inputs
from ventbench.diagnosis.command_path import follow
from ventbench.diagnosis.hypothesis import Partition
from ventbench.diagnosis.identification import without_saturated
from ventbench.physics import catalogue
from ventbench.physics.catalogue import basis_terms, library, mechanism
from ventbench.physics.parameters import REFITTED
from ventbench.system_id import START, Data, Fit, Noise, Predictor, fit, parameter_values
from ventbench.system_id.problem import parameter_of

#: Most breaths, sets that are extended, sets that are fitted in either round, and steps of a fit.
_BREATHS, _BEAM, _FITS, _STEPS = 32, 24, (4, 3), 15

#: Prior odds of a term, of an unknown at a place beside those of a name, the power of the
#: likelihood (no model has what neighbouring samples share), and what is spread over all places.
_ODDS, _PLACE, _WARMTH, _UNSURE = 0.7, 0.3, 0.2, 0.05

_SITES = {"inspiratory valve": "inspiratory_valve", "alveolus": "lung", "sensor": "pressure_sensor",
          "command": "inspiratory_valve", "expiratory valve": "expiratory_valve"}  # fmt: skip

#: Pushes of the muscles: sign, size, cmH2O, durations and onsets, s; and shares of the size that
#: harmonics have, as forms are unsure.
_PUSHES = {
    "cough": (1.0, 8.0, (0.15, 0.22, 0.3), np.arange(0.1, 1.9, 0.1)),
    EFFORT: (-1.0, 3.0, (0.5, 0.8, 1.1), np.arange(0.0, 1.0, 0.1)),
}
_HARMONICS = (1.0, 0.5, 0.25)

#: Oscillations: place, frequencies, Hz, harmonics, and standard deviations of coefficients.
_SWINGS = {
    "supply_ripple": (latent_inputs.SUPPLY, np.arange(1.5, 9.1, 0.25), 1, (0.06, 0.15)),
    "circuit_water": (latent_inputs.CIRCUIT, np.arange(1.5, 9.1, 0.25), 1, (0.5, 1.2)),
    "unknown:muscles": (latent_inputs.ALVEOLUS, np.arange(0.7, 2.6, 0.1), 2, (0.4, 1.0)),
}

#: Shares of the commands that are expected to be lost, or late; samples by which they are late.
_COMMANDS = {"lost_commands": (0.08, (None,)), "late_commands": (0.18, (2, 3, 4))}


def _share(n: int, k: int) -> float:
    """Log prior of k affected breaths of n, whose share is uniform."""
    return float(special.betaln(k + 1, n - k + 1))


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


def in_time(known: Known, predictor: Predictor, around: Fit) -> list[Term]:
    """Terms that act in time."""
    data, values, n = known.around.data, known.around.values, known.n
    partition, time, terms = Partition(data, predictor), np.cumsum(data.dt, axis=1) - data.dt, []
    sizes = {name: size for name, (_, size) in CONSTANT.items()} | {OPEN: 1.0}
    every = {(name, size): known.around.events[name][None] for name, size in sizes.items()}
    push = latent_inputs.input_responses(partition, values, latent_inputs.ALVEOLUS)
    for name, (sign, size, durations, onsets) in _PUSHES.items():
        x = np.clip([(time - a) / d for a, d in product(onsets, durations)], 0.0, 1.0)
        shape = [sign * np.sin(np.pi * h * x) for h in range(1, len(_HARMONICS) + 1)]
        every[name, size] = np.matmul(np.stack(shape)[:, :, :, None], push)[:, :, :, 0]
    for (name, size), each in every.items():  # the first, and deviations of its form
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
            columns = [one for form in chosen for one in np.where(which, form, 0.0)]
            spread = [size * h for h in _HARMONICS[: len(chosen)] for _ in at]
            odds = _share(n, len(at)) - cost * len(at)
            told = {"share": len(at) / n, "size": float(np.median(mean))}
            terms.append(Term(name, spread, odds=odds, latent=columns, told=told))
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
        which = np.eye(n, dtype=bool)[:, :, None]
        columns = [
            one for m in range(swings.shape[1]) for one in np.where(which, swings[:, m], 0.0)
        ]
        odds = -float(np.log(len(frequencies) * len(spreads)))
        told = {"frequency": f, "amplitude": size}
        terms.append(Term(name, [spread] * len(columns), odds=odds, latent=columns, told=told))
    problem, x, share = replace(around.problem, noise=known.noise), around.minimum.x, 0.1
    for name, (expected, lags) in _COMMANDS.items():
        ways = [follow(problem, x, partition, share, lag) for lag in lags]
        way = max(ways, key=lambda each: float(each.nats.sum()))
        kept, sent = float(way.kept.sum()), float(way.sent.sum())
        if not kept:
            break
        share = min(kept / sent, 0.5)  # a valve that waits counts at every sample
        reached = Predictor(replace(data, u_in=way.u_in), predictor.names, sizes=(_BREATHS,))
        column = reached.predict(values)[:, 0] - predictor.predict(values)[:, 0]
        odds = kept * np.log(share) + max(sent - kept, 0.0) * np.log1p(-share)
        odds -= 0.5 * (np.log(share / expected) / 0.5) ** 2 + np.log(len(lags))
        terms.append(Term(name, [1.0], odds=float(odds), latent=[column], told={"share": share}))
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
            value += within(term.limits, float(found[k]), float(sds[k]), 0.0, term.spread[0])
    return value


def prior(names: Iterable[str]) -> float:
    """Log prior of a set of names."""
    one, unknown = np.log(_ODDS / len(library())), np.log(_PLACE)
    return float(sum(one + unknown * (n in basis_terms() or ":" in n) for n in names))


def search(known: Known, latent: Sequence[Term], most: int) -> list[tuple[float, Set]]:
    """Sets of terms by log posterior over the empty one, likeliest first, one of each names."""
    columns, numbered = [*known.around.columns], []
    for term in latent:
        own = tuple(range(len(columns), len(columns) + len(term.latent)))
        numbered.append(replace(term, main=own))
        columns += term.latent
    weight = known.around.data.weight
    G, b = known.products(known.rows(np.stack(columns, axis=1) * weight))
    best: dict[frozenset[str], tuple[float, Set]] = {frozenset(): (0.0, ())}

    def score(terms: Set) -> float:
        key, value = names_of(terms), evidence(G, b, terms)
        total = value + prior(key)
        if len(key) == len(terms) and (key not in best or total > best[key][0]):
            best[key] = (total, terms)
        return value

    ranked: dict[str, list[tuple[float, Term]]] = {}
    for term in (*known.around.terms, *numbered):
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
        about = parameter_of(path)
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


def without_spikes(fitted: Fit, data: Data) -> Data:
    """Take the weight off single readings that are far off, away from edges of the valves."""
    r = fitted.residual[:, 0] * data.weight[:, 0]
    away = np.abs(r - np.median([np.roll(r, k, axis=1) for k in (-2, -1, 0, 1, 2)], axis=0))
    size = 1.4826 * float(np.median(away[data.weight[:, 0] > 0])) + 0.05
    edge = np.abs(np.diff(data.u_out, axis=1, prepend=data.u_out[:, :1])) > 0
    far = (away > 8.0 * size) & ~np.any([np.roll(edge, k, axis=1) for k in range(-2, 4)], axis=0)
    far[:, :4] = far[:, -2:] = False
    return replace(data, weight=data.weight * ~far[:, None])


def look(data: Data) -> tuple[list[Known], list[tuple[float, Set]]]:
    """Fitted sets of terms, likeliest first, and those of the linear problem."""
    names = catalogue.paths((*library(), *basis_terms(), *CONSTANT, OPEN))
    predictor = Predictor(data, names, sizes=(_BREATHS,))
    data = without_spikes(fit(data, (), predictor=predictor, iterations=20), data)
    base = fit(data, (), predictor=predictor, iterations=20)
    around, noise = simulate(data, predictor, base), base.problem.noise
    for _ in range(2):
        noise = Known(around, base, base, noise, loose=True).left
    known = Known(around, base, base, noise)
    ranked = search(known, in_time(known, predictor, base), 3)
    tried = {frozenset[str](): known}

    def attempt(terms: Set) -> None:
        if names_of(terms) in tried:
            return
        fitted, told, latent = base, data, latent_of(terms)
        for k in range(2 if latent else 1):
            if k or len(terms) > len(latent):
                fitted = fit_terms(told, predictor, base, terms, noise)
            made = tried[names_of(terms)] = Known(around, fitted, base, noise, terms)
            told = replace(data, measured=data.measured - made.in_time[:, None])

    def ordered() -> list[Known]:
        return sorted(tried.values(), key=lambda s: -s.evidence - prior(names_of(s.terms)))

    for _, terms in ranked[: _FITS[0]]:
        attempt(terms)
    best = ordered()[0]
    if best.terms:
        around, own = simulate(data, predictor, best.fitted), names_of(best.terms)
        noise = Known(around, best.fitted, base, noise, best.terms, loose=True).left
        more = search(Known(around, best.fitted, base, noise, best.terms), (), 1)
        for terms in [t for _, t in more if t and not names_of(t) & own][: _FITS[1]]:
            attempt((*best.terms, *terms))
        for one in best.terms:
            attempt(tuple(t for t in best.terms if t is not one))
        for key, s in tried.items():
            tried[key] = Known(around, s.fitted, base, noise, s.terms)
    return ordered(), ranked


def weigh(
    scored: Sequence[Known], linear: Sequence[tuple[float, Set]]
) -> dict[frozenset[str], float]:
    """Posterior of each set of names; those that were not fitted are a nat less likely."""
    logs = {names_of(s.terms): _WARMTH * s.evidence for s in scored}
    at = {names_of(terms): _WARMTH * (value - prior(names_of(terms))) for value, terms in linear}
    logs = {names: value + prior(names) for names, value in logs.items()}
    offset = max(logs.values()) - 1.0 - max(at[k] + prior(k) for k in logs if k in at)
    for names, value in at.items():
        logs.setdefault(names, value + prior(names) + offset)
    odds = np.exp(np.array(list(logs.values())) - max(logs.values()))
    return dict(zip(logs, (odds / odds.sum()).tolist(), strict=True))


def hypotheses(
    weights: Mapping[frozenset[str], float], places: Sequence[str], level: float | None
) -> list[dict[str, Any]]:
    """The posterior in the terms of the vocabulary; all have a sensor that saturates at a level."""
    always = frozenset() if level is None else frozenset({"saturation"})
    odds = {always | {f"unknown:{place}"}: _UNSURE / len(places) for place in places}
    for names, weight in weights.items():
        sites = {n: mechanism(n).description.site for n in names if n in basis_terms()}
        told = (f"unknown:{_SITES.get(sites[n], sites[n])}" if n in sites else n for n in names)
        terms = always.union(told)
        odds[terms] = odds.get(terms, 0.0) + (1.0 - _UNSURE) * weight
    kept = sorted(odds.items(), key=lambda pair: -pair[1])[:100]
    total = sum(weight for _, weight in kept)
    return [{"terms": sorted(terms), "probability": weight / total} for terms, weight in kept]


def predicted(best: Known, seen: Seen, level: float | None) -> Floats:
    """Pressures of the withheld breaths, cmH2O, ``(k, T)``, without what acts in time."""
    names, test = best.fitted.problem.predictor.names, seen.data.select(seen.apart)
    values, order = parameter_values(test, names, {}), (*names, START)
    told = best.parameters
    for column, name in enumerate(order):
        if name != "position":
            about = parameter_of(name)
            value = np.mean(best.fitted.column(name))
            if name in told:
                value = float(about.physical(told[name][0]))
            value += best.deviations.get(name, 0.0)
            values[:, column] = np.clip(value, about.low, about.high)
    pressure = Predictor(test, names, sizes=(_BREATHS,)).predict(values)[:, 0]
    return pressure if level is None else np.minimum(pressure, level)


def diagnose(folder: Path) -> dict[str, Any]:
    """Answer a case."""
    seen = see(folder)
    breaths, saturated = without_saturated(seen.breaths)
    level = None if saturated is None else saturated[0]
    data = replace(seen, breaths=breaths).observed
    every = np.linspace(0, len(data) - 1, min(_BREATHS, len(data))).round().astype(int)
    scored, linear = look(data.select(np.unique(every)))
    vocabulary = seen.question["vocabulary"]
    known = {f"{n}.{key}" for n, each in vocabulary["names"].items() for key in each["parameters"]}
    told = {} if level is None else {"saturation.level": [level] * 3}
    for path, (mean, sd) in scored[0].parameters.items():
        about = parameter_of(path)
        ends = about.physical(np.array([mean, mean - 2.0 * sd, mean + 2.0 * sd]))
        told[path] = np.clip(ends, about.low, about.high).tolist()
    return {
        "hypotheses": hypotheses(weigh(scored, linear), vocabulary["places"], level),
        "pressures": seen.pressures(predicted(scored[0], seen, level)),
        "parameters": {
            path: dict(zip(("value", "low", "high"), ends, strict=True))
            for path, ends in told.items() if path in known | {"R", "C"}
        },
    }  # fmt: skip
