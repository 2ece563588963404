"""Which cases are drawn, for each kind of question that is put."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from ventbench.errors import InputError
from ventbench.lungs import LUNGS, Lung
from ventbench.validation.challenge.cases import Case, Effect, Strength
from ventbench.validation.challenge.forms import ENTRIES, LIBRARY, OUTSIDE, effect
from ventbench.validation.challenge.rig import draw_base

Kind = Literal["single", "null", "pair", "four", "outside", "form", "masked"]
KINDS: tuple[Kind, ...] = get_args(Kind)

#: Share of the cases of each kind when all are drawn.
SHARES: dict[Kind, float] = {
    "single": 0.34,
    "null": 0.18,
    "pair": 0.10,
    "four": 0.07,
    "outside": 0.13,
    "form": 0.11,
    "masked": 0.07,
}

#: Classes within which one lung's pressure may not tell one effect from the other.
CLASSES: tuple[frozenset[str], ...] = (
    frozenset({"valve_lag", "sensor_lag", "circuit_compliance"}),
    frozenset({"leak", "valve_dead_band", "command_rounding", "viscoelasticity"}),
)

#: Not put into company: with others it is below the detection limit.
_ALONE = ("inertance", "command_rounding")

_BOTH: tuple[Strength, ...] = ("mild", "strong")


@dataclass(frozen=True)
class Drawn:
    """A case and the question that it belongs to."""

    kind: Kind
    case: Case


def draw(kind: Kind | Literal["all"], count: int, rng: np.random.Generator) -> list[Drawn]:
    """Draw cases of a kind or of all, in an order that tells nothing.

    Args:
        kind: which.
        count: how many.
        rng: what they are drawn from.

    Raises:
        InputError: if there are fewer cases than kinds.
    """
    if count < (len(KINDS) if kind == "all" else 1):
        raise InputError(f"{count} cases are too few for {kind}; ask for at least {len(KINDS)}")
    sizes: list[tuple[Kind, int]] = _sizes(count) if kind == "all" else [(kind, count)]
    cases = [Drawn(k, case) for k, n in sizes for case in _of_kind(k, n, rng)]
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
            yield _case(lung, (effect(name, strength, rng, form),), rng)
    elif kind == "form":
        names = tuple(name for name in LIBRARY if len(ENTRIES[name].forms) > 1)
        for name, strength, lung, form in _grid(names, count, rng, other=True):
            yield _case(lung, (effect(name, strength, rng, form),), rng)
    elif kind == "outside":
        for name, strength, lung, form in _grid(OUTSIDE, count, rng, other=False):
            yield _case(lung, (effect(name, strength, rng, form),), rng)
    elif kind == "masked":
        for name, strength, lung, form in _grid(LIBRARY, count, rng, other=False):
            yield _masked(lung, effect(name, strength, rng, form), rng)
    else:
        for lung in _round(list(LUNGS), count, rng):
            if kind == "null":
                yield _null(lung, rng)
            else:
                yield _case(lung, _company(2 if kind == "pair" else 4, rng), rng)


def _grid(
    names: tuple[str, ...], count: int, rng: np.random.Generator, *, other: bool
) -> Iterator[tuple[str, Strength, Lung, str]]:
    """Draw evenly from names x strengths x lungs; ``other``: in turn the forms but the first."""
    cells = {}
    for name in names:
        mixed = [list(rng.permutation(len(LUNGS))) for _ in _BOTH]
        first = int(rng.integers(2))
        order = [(_BOTH[(first + k) % 2], mixed[(first + k) % 2][k // 2]) for k in range(12)]
        forms = ENTRIES[name].forms[1:] if other else ENTRIES[name].forms[:1]
        cells[name] = [
            (strength, LUNGS[int(place)], forms[k % len(forms)])
            for k, (strength, place) in enumerate(order)
        ]
    turns = dict.fromkeys(names, 0)
    for name in _round(list(names), count, rng):
        strength, lung, form = cells[name][turns[name] % 12]
        turns[name] += 1
        yield name, strength, lung, form


def _round(items: list, count: int, rng: np.random.Generator) -> Iterator:
    """Take items in turn, each round in another order."""
    for k in range(count):
        if k % len(items) == 0:
            order = rng.permutation(len(items))
        yield items[order[k % len(items)]]


def _company(size: int, rng: np.random.Generator) -> tuple[Effect, ...]:
    """Strong effects, no two of one class."""
    found: list[str] = []
    for index in rng.permutation(len(LIBRARY)):
        name = LIBRARY[index]
        if name in _ALONE or any(name in c and c & set(found) for c in CLASSES):
            continue
        found.append(name)
        if len(found) == size:
            break
    return tuple(effect(name, "strong", rng) for name in sorted(found))


def _case(lung: Lung, effects: tuple[Effect, ...], rng: np.random.Generator) -> Case:
    """Noise is white in half of the cases, else up to 0.6 of its variance is correlated."""
    return Case(
        "", lung.R, lung.C, effects, draw_base(lung.R, lung.C, rng),
        coloured=float(rng.uniform(0.1, 0.6)) if rng.uniform() < 0.5 else 0.0,
        correlation=float(rng.uniform(0.5, 0.9)),
        noise=float(rng.uniform(0.1, 0.3)),
    )  # fmt: skip


def _null(lung: Lung, rng: np.random.Generator) -> Case:
    """Nothing but what is no physics: noise of any colour, gain, jitter, a rounded log."""
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


def _masked(lung: Lung, item: Effect, rng: np.random.Generator) -> Case:
    """Closed loop only, few breaths."""
    return Case(
        "", lung.R, lung.C, (item,), draw_base(lung.R, lung.C, rng),
        noise=float(rng.choice(np.array([0.1, 0.2, 0.3]))),
        breaths=int(rng.integers(8, 16)),
        style="pi",
    )  # fmt: skip
