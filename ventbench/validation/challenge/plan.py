"""Cases that a challenge draws, for each kind of question."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import numpy as np

from ventbench.errors import InputError
from ventbench.lungs import LUNGS, Lung
from ventbench.validation.challenge.cases import (
    EFFECTS,
    KINDS,
    LIBRARY,
    OUTSIDE,
    Case,
    DrawnCase,
    Effect,
    Kind,
    Strength,
    draw_base,
    draw_effect,
)

#: Share of each kind in a challenge of all kinds.
SHARES: dict[Kind, float] = {
    "single": 0.34,
    "null": 0.18,
    "pair": 0.10,
    "four": 0.07,
    "outside": 0.13,
    "form": 0.11,
    "masked": 0.07,
}

#: Classes of effects that the pressure of a single lung may not tell apart.
CLASSES: tuple[frozenset[str], ...] = (
    frozenset({"valve_lag", "sensor_lag", "circuit_compliance"}),
    frozenset({"leak", "valve_dead_band", "command_rounding", "viscoelasticity"}),
)

#: Never combined with other effects, among which they are below the detection limit.
_SINGLE_ONLY = ("inertance", "command_rounding")

_STRENGTHS: tuple[Strength, ...] = ("mild", "strong")


def draw(kind: Kind | Literal["all"], count: int, rng: np.random.Generator) -> list[DrawnCase]:
    """Draw cases of one kind or of all kinds, in random order.

    Args:
        kind: kind of the cases.
        count: number of cases.
        rng: source of random numbers.

    Raises:
        InputError: if there are fewer cases than kinds.
    """
    if count < (len(KINDS) if kind == "all" else 1):
        raise InputError(f"{count} cases are too few for {kind}; ask for at least {len(KINDS)}")
    sizes: list[tuple[Kind, int]] = _sizes(count) if kind == "all" else [(kind, count)]
    cases = [DrawnCase(k, case) for k, n in sizes for case in _of_kind(k, n, rng)]
    return [cases[i] for i in rng.permutation(len(cases))]


def _sizes(count: int) -> list[tuple[Kind, int]]:
    """Whole numbers near the shares, at least one of each; single effects take what is left."""
    sizes: list[tuple[Kind, int]] = [
        (kind, max(1, int(share * count))) for kind, share in SHARES.items() if kind != "single"
    ]
    return [("single", count - sum(size for _, size in sizes)), *sizes]


def _of_kind(kind: Kind, count: int, rng: np.random.Generator) -> Iterator[Case]:
    if kind == "single":
        for name, strength, lung, form in _grid(LIBRARY, count, rng, other=False):
            yield _case(lung, (draw_effect(name, strength, rng, form),), rng)
    elif kind == "form":
        names = tuple(name for name in LIBRARY if len(EFFECTS[name].forms) > 1)
        for name, strength, lung, form in _grid(names, count, rng, other=True):
            yield _case(lung, (draw_effect(name, strength, rng, form),), rng)
    elif kind == "outside":
        for name, strength, lung, form in _grid(OUTSIDE, count, rng, other=False):
            yield _case(lung, (draw_effect(name, strength, rng, form),), rng)
    elif kind == "masked":
        for name, strength, lung, form in _grid(LIBRARY, count, rng, other=False):
            yield _masked(lung, draw_effect(name, strength, rng, form), rng)
    else:
        for lung in _rotate(list(LUNGS), count, rng):
            if kind == "null":
                yield _null(lung, rng)
            else:
                yield _case(lung, _combination(2 if kind == "pair" else 4, rng), rng)


def _grid(
    names: tuple[str, ...], count: int, rng: np.random.Generator, *, other: bool
) -> Iterator[tuple[str, Strength, Lung, str]]:
    """Draw evenly from names x strengths x lungs; ``other``: from all forms but the first."""
    cells = {}
    for name in names:
        mixed = [list(rng.permutation(len(LUNGS))) for _ in _STRENGTHS]
        first = int(rng.integers(2))
        order = [(_STRENGTHS[(first + k) % 2], mixed[(first + k) % 2][k // 2]) for k in range(12)]
        forms = EFFECTS[name].forms[1:] if other else EFFECTS[name].forms[:1]
        cells[name] = [
            (strength, LUNGS[int(place)], forms[k % len(forms)])
            for k, (strength, place) in enumerate(order)
        ]
    turns = dict.fromkeys(names, 0)
    for name in _rotate(list(names), count, rng):
        strength, lung, form = cells[name][turns[name] % 12]
        turns[name] += 1
        yield name, strength, lung, form


def _rotate(values: list, count: int, rng: np.random.Generator) -> Iterator:
    """Take values in turn, in a new random order each time round."""
    for k in range(count):
        if k % len(values) == 0:
            order = rng.permutation(len(values))
        yield values[order[k % len(values)]]


def _combination(size: int, rng: np.random.Generator) -> tuple[Effect, ...]:
    """Strong effects, no two of the same class."""
    chosen: list[str] = []
    for index in rng.permutation(len(LIBRARY)):
        name = LIBRARY[index]
        if name in _SINGLE_ONLY or any(name in c and c & set(chosen) for c in CLASSES):
            continue
        chosen.append(name)
        if len(chosen) == size:
            break
    return tuple(draw_effect(name, "strong", rng) for name in sorted(chosen))


def _case(lung: Lung, effects: tuple[Effect, ...], rng: np.random.Generator) -> Case:
    """A case with effects; half of the cases have white noise, the others coloured noise."""
    return Case(
        "", lung.R, lung.C, effects, draw_base(lung.R, lung.C, rng),
        coloured=float(rng.uniform(0.1, 0.6)) if rng.uniform() < 0.5 else 0.0,
        correlation=float(rng.uniform(0.5, 0.9)),
        noise=float(rng.uniform(0.1, 0.3)),
    )  # fmt: skip


def _null(lung: Lung, rng: np.random.Generator) -> Case:
    """A case without effects, but with noise, gain, jitter and rounding that are no physics."""
    base = draw_base(lung.R, lung.C, rng)
    return Case(
        "", lung.R, lung.C, (), base,
        noise=float(rng.uniform(0.1, 0.3)),
        coloured=float(rng.uniform(0.0, 0.6)),
        correlation=float(rng.uniform(0.5, 0.9)),
        jitter=float(rng.choice(np.array([3e-4, 1e-3]))),
        log_step=float(rng.choice(np.array([0.01, 1.0]))),
        style="mixed" if rng.uniform() < 0.5 else "pi",
    )  # fmt: skip


def _masked(lung: Lung, effect: Effect, rng: np.random.Generator) -> Case:
    """A case with few breaths, all in closed loop."""
    return Case(
        "", lung.R, lung.C, (effect,), draw_base(lung.R, lung.C, rng),
        noise=float(rng.choice(np.array([0.1, 0.2, 0.3]))),
        breaths=int(rng.integers(8, 16)),
        style="pi",
    )  # fmt: skip
