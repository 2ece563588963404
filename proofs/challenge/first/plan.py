"""Cases that a challenge draws, for each kind of question."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from hardware_eval.emulation.cases import (
    EFFECTS,
    LIBRARY,
    Case,
    Effect,
    draw_base,
    draw_case,
    draw_effect,
    draw_grid,
    rotate,
)
from proofs.challenge.questions import Kind, combined
from ventbench.task.lungs import LUNGS, Lung

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

#: Effects that the library does not have, in alphabetical order.
OUTSIDE: tuple[str, ...] = tuple(sorted(name for name, e in EFFECTS.items() if not e.inside))

#: Classes of effects that the pressure of a single lung may not tell apart.
CLASSES: tuple[frozenset[str], ...] = (
    frozenset({"valve_lag", "sensor_lag", "circuit_compliance"}),
    frozenset({"leak", "valve_dead_band", "command_rounding", "viscoelasticity"}),
)

#: Never combined with other effects, among which they are below the detection limit.
_SINGLE_ONLY = ("inertance", "command_rounding")


def of_kind(kind: Kind, count: int, rng: np.random.Generator) -> Iterator[Case]:
    """Draw cases of a kind."""
    if kind in ("null", "pair", "four"):
        for lung in rotate(list(LUNGS), count, rng):
            if kind == "null":
                yield _null(lung, rng)
            else:
                names = combined(LIBRARY, 2 if kind == "pair" else 4, CLASSES, _SINGLE_ONLY, rng)
                effects = tuple(draw_effect(name, "strong", rng) for name in names)
                yield draw_case(lung, effects, rng)
        return
    several = tuple(name for name in LIBRARY if len(EFFECTS[name].forms) > 1)
    names = {"form": several, "outside": OUTSIDE}.get(kind, LIBRARY)
    for name, strength, lung, form in draw_grid(names, count, rng, other=kind == "form"):
        if kind == "masked":
            yield _masked(lung, draw_effect(name, strength, rng, form), rng)
        else:
            yield draw_case(lung, (draw_effect(name, strength, rng, form),), rng)


def _null(lung: Lung, rng: np.random.Generator) -> Case:
    """A case without effects, but with noise, gain, jitter and rounding that are no physics."""
    base = draw_base(lung.R, lung.C, rng)
    return Case(
        "",
        lung.R,
        lung.C,
        (),
        base,
        noise=float(rng.uniform(0.1, 0.3)),
        coloured=float(rng.uniform(0.0, 0.6)),
        correlation=float(rng.uniform(0.5, 0.9)),
        jitter=float(rng.choice(np.array([3e-4, 1e-3]))),
        log_step=float(rng.choice(np.array([0.01, 1.0]))),
        style="mixed" if rng.uniform() < 0.5 else "pi",
    )


def _masked(lung: Lung, effect: Effect, rng: np.random.Generator) -> Case:
    """A case with few breaths, all in closed loop."""
    return Case(
        "",
        lung.R,
        lung.C,
        (effect,),
        draw_base(lung.R, lung.C, rng),
        noise=float(rng.choice(np.array([0.1, 0.2, 0.3]))),
        breaths=int(rng.integers(8, 16)),
        style="pi",
    )
