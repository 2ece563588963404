"""Concealed cases: effects with forms and strengths, rigs and draws."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Literal

import msgspec
import numpy as np

from ventbench.base.errors import InputError
from ventbench.base.files import data_beside
from ventbench.task.lungs import LUNGS, Lung

#: Begins what random numbers are drawn from; another text would change every case ever sealed.
_FORMAT = "ventbench-challenge-1"


def random_generator(secret: str, *purpose: str) -> np.random.Generator:
    """Return random numbers that only the secret determines, different ones for each purpose."""
    text = "\n".join((_FORMAT, secret, *purpose))
    digest = hashlib.sha256(text.encode()).digest()
    return np.random.default_rng(np.random.SeedSequence(int.from_bytes(digest, "big")))


Strength = Literal["mild", "strong"]
Style = Literal["pi", "mixed"]

#: Flow of the inspiratory valve that a fit assumes, mL/s per %.
NOMINAL_GAIN = 22.8


@dataclass(frozen=True)
class Effect:
    """A piece of physics that the rig has beyond resistance and compliance."""

    name: str  #: name of the library's mechanism, or of an effect that the library does not have.
    strength: Strength  #: mild or strong, as :data:`EFFECTS` quantifies them.
    form: str  #: form of its equation, one of :attr:`EffectFamily.forms`.
    #: parameters of that form, in the units of :mod:`ventbench.physics`; times in s, lengths of
    #: command in %.
    parameters: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Base:
    """True values of the rig without any effect."""

    R: float  #: airway resistance, cmH2O/(L/s).
    C: float  #: compliance, mL/cmH2O.
    R_ex: float = 5.0  #: resistance of the expiratory valve, cmH2O/(L/s).
    peep: float = 5.0  #: pressure behind the expiratory valve, cmH2O.
    gain: float = NOMINAL_GAIN  #: flow of the inspiratory valve, mL/s per %.


@dataclass(frozen=True)
class Case:
    """One recording."""

    name: str  #: name of its file, without suffix.
    lung_R: float  #: label of the lung setting, cmH2O/(L/s).
    lung_C: float  #: label of the lung setting, mL/cmH2O.
    effects: tuple[Effect, ...] = ()  #: what the recording conceals.
    base: Base | None = None  #: the rig; each recording draws its own if None.
    noise: float = 0.2  #: standard deviation of the sensor's noise, cmH2O.
    #: share of the noise variance that is correlated from sample to sample, 0..1.
    coloured: float = 0.0
    correlation: float = 0.6  #: correlation of the coloured share, from one sample to the next.
    step: float = 0.0703  #: step of the sensor's converter, cmH2O; 0 for none.
    jitter: float = 3e-4  #: standard deviation of the sampling interval, s.
    breaths: int = 60  #: number of breaths.
    samples: int = 80  #: number of samples in a breath.
    style: Style = "mixed"  #: ``pi``: closed loop only; ``mixed``: half of the breaths explore.
    #: resolution of the logged commands, %; the rig receives what is logged.
    log_step: float = 0.01

    @property
    def lung(self) -> str:
        """Label of the lung, such as ``R20C50``."""
        return f"R{self.lung_R:g}C{self.lung_C:g}"


@dataclass(frozen=True)
class EffectFamily:
    """Strengths, forms and parameter ranges of an effect."""

    parameter: str  #: the parameter that carries the strength.
    mild: float  #: mean of that parameter in a mild effect.
    strong: float  #: mean of that parameter in a strong effect.
    forms: tuple[str, ...]  #: forms of the equation; the first is the library's if ``inside``.
    #: further parameters, each with the low and high end of a uniform distribution.
    ranges: tuple[tuple[str, tuple[float, float]], ...] = ()
    signs: tuple[float, ...] = (1.0,)  #: signs of the strength that are drawn.
    inside: bool = True  #: whether the library has a mechanism of this name.


EFFECTS = msgspec.convert(data_beside(__file__, "effects.toml"), dict[str, EffectFamily])

#: Mechanisms of the library, in alphabetical order.
LIBRARY: tuple[str, ...] = tuple(sorted(name for name, e in EFFECTS.items() if e.inside))

#: Largest relative deviation of a strength from its mean.
_VARIATION = 0.15

#: Parameters whose strength does not vary.
_FIXED = ("amount", "share")

#: Limits of the ratio of expiratory to inspiratory resistance: what a laboratory would still call
#: an airway.
_DIRECTION_RATIO = (1.6, 2.2)


def draw_effect(
    name: str, strength: Strength, rng: np.random.Generator, form: str | None = None
) -> Effect:
    """Draw an effect: its strength within 15 % of the mean, its other parameters in their ranges.

    Without a form of its equation, the first is taken: the library's if it has the effect.

    Raises:
        InputError: if there is no such effect or form.
    """
    if name not in EFFECTS:
        raise InputError(f"there is no effect {name!r}; choose one of {', '.join(EFFECTS)}")
    family = EFFECTS[name]
    form = form or family.forms[0]
    if form not in family.forms:
        raise InputError(f"{name} has no form {form!r}; choose one of {', '.join(family.forms)}")
    fixed = family.parameter in _FIXED
    varied = 1.0 if fixed else rng.uniform(1 - _VARIATION, 1 + _VARIATION)
    value = getattr(family, strength) * varied * rng.choice(np.array(family.signs))
    further = {key: float(rng.uniform(*span)) for key, span in family.ranges}
    if name == "direction_resistance":
        value = float(np.clip(value, *_DIRECTION_RATIO))
    return Effect(name, strength, form, {family.parameter: float(value)} | further)


def draw_base(lung_R: float, lung_C: float, rng: np.random.Generator) -> Base:
    """Draw a rig around a lung's label: R off by up to 15 %, C by up to 7 %, and the rest."""
    return Base(
        R=float(lung_R * rng.uniform(0.85, 1.15)),
        C=float(lung_C * rng.uniform(0.93, 1.07)),
        R_ex=float(rng.uniform(4.0, 7.0)),
        peep=float(rng.uniform(4.5, 5.5)),
        gain=float(NOMINAL_GAIN * rng.uniform(0.9, 1.1)),
    )


_STRENGTHS: tuple[Strength, ...] = ("mild", "strong")


def draw_grid(
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
    for name in rotate(list(names), count, rng):
        strength, lung, form = cells[name][turns[name] % 12]
        turns[name] += 1
        yield name, strength, lung, form


def rotate(values: list, count: int, rng: np.random.Generator) -> Iterator:
    """Take values in turn, in a new random order each time round."""
    for k in range(count):
        if k % len(values) == 0:
            order = rng.permutation(len(values))
        yield values[order[k % len(values)]]


def draw_case(lung: Lung, effects: tuple[Effect, ...], rng: np.random.Generator) -> Case:
    """A case with effects; half of the cases have white noise, the others coloured noise."""
    return Case(
        "",
        lung.R,
        lung.C,
        effects,
        draw_base(lung.R, lung.C, rng),
        coloured=float(rng.uniform(0.1, 0.6)) if rng.uniform() < 0.5 else 0.0,
        correlation=float(rng.uniform(0.5, 0.9)),
        noise=float(rng.uniform(0.1, 0.3)),
    )
