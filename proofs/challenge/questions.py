"""What all generators share: kinds of questions, families of effects, a sensor's noise, a log."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Set
from dataclasses import dataclass
from typing import Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from hardware_eval.emulation.cases import Case, Effect, EffectFamily
from ventbench.base.arrays import Floats, Ints
from ventbench.base.files import data_beside
from ventbench.recordings.breaths import Breaths, make_breaths

Kind = Literal["single", "null", "pair", "four", "outside", "form", "masked"]


@dataclass(frozen=True)
class DrawnCase:
    """A case and the kind of question that it belongs to."""

    kind: Kind
    case: Case


@dataclass(frozen=True)
class Family(EffectFamily):
    """An effect of a generator that is none of the library's."""

    forms: tuple[str, ...] = ("plain",)
    #: names of the vocabulary that are right for it, though it is outside the library.
    names: tuple[str, ...] = ()
    places: tuple[str, ...] = ()  #: places of the vocabulary that are right for it without a name.
    #: ends of the share of the breaths that it affects; None for all.
    share: tuple[float, float] | None = None


def read_families(module: str) -> dict[str, Family]:
    """Effects by name, from ``effects.toml`` beside a module's file."""
    return msgspec.convert(data_beside(module, "effects.toml"), dict[str, Family])


def parameter(effects: Mapping[str, Effect], name: str, key: str, absent: float = 0.0) -> float:
    """A parameter of one of the effects of a rig, or what stands for it where that is absent."""
    return effects[name].parameters[key] if name in effects else absent


def in_turn(values: tuple, count: int, rng: np.random.Generator) -> list:
    """At least ``count`` values, each once a round, in a new random order each round."""
    rounds = count // len(values) + 1
    return [values[i] for _ in range(rounds) for i in rng.permutation(len(values))]


def combined(
    names: tuple[str, ...],
    size: int,
    rivals: Iterable[Set[str]],
    alone: Collection[str],
    rng: np.random.Generator,
) -> list[str]:
    """Names of effects in one rig, sorted: none that comes alone, and no two of a set of rivals."""
    chosen: list[str] = []
    for index in rng.permutation(len(names)):
        name = names[index]
        if name not in alone and not any(name in r and r & set(chosen) for r in rivals):
            chosen.append(name)
        if len(chosen) == size:
            break
    return sorted(chosen)


def held_levels(
    time: Floats, end: float, rng: np.random.Generator, closed: float, highest: float
) -> Floats:
    """Relative commands that stand for 0.06 to 0.3 s each, up to an end of inspiration, ``(n, T)``.

    A share ``closed`` of them is 0, the others 0.2 to ``highest``.
    """
    levels = np.zeros(time.shape)
    for row, now in zip(levels, time, strict=True):
        at = 0.0
        while at < end:
            length = rng.uniform(0.06, 0.3)
            level = 0.0 if rng.uniform() < closed else rng.uniform(0.2, highest)
            row[(now >= at) & (now < at + length)] = level
            at += length
    return levels


def logged(
    case: Case, number: Ints, time: Floats, u_in: Floats, u_out: NDArray[np.int8], pressure: Floats
) -> Breaths:
    """Breaths as the log has them, ``(n, T)``, with the label of the case.

    ``number`` counts breaths from 0. A replay may ask for one several times, and takes the
    pressures alone: ids go on from that of the first.
    """
    n = len(number)
    return make_breaths(
        number[0] + 1 + np.arange(n),
        np.full(n, case.lung_R),
        np.full(n, case.lung_C),
        time,
        u_in,
        u_out,
        np.round(pressure, 6),
    )


def coloured_noise(
    case: Case, correlation: float, rng: np.random.Generator, shape: tuple[int, ...]
) -> Floats:
    """Noise of a sensor, cmH2O: white, and a share that is correlated from sample to sample."""
    white, slow = rng.standard_normal(shape), rng.standard_normal(shape)
    for k in range(1, shape[1]):
        slow[:, k] *= np.sqrt(1.0 - correlation**2)
        slow[:, k] += correlation * slow[:, k - 1]
    return case.noise * (np.sqrt(1.0 - case.coloured) * white + np.sqrt(case.coloured) * slow)
