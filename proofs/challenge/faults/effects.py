"""Faults of the third generator: strengths, sources; and the draw of its cases.

Sources: J. Fraden, *Handbook of Modern Sensors* (Springer 2016) (span, zero and warm-up of pressure
sensors, saturation); IEEE 1057 (clipping, delay of converters); D. L. Mills, *Computer Network Time
Synchronization* (CRC 2011) (offset and skew of clocks); J. Nilsson, *Real-Time Control Systems with
Delays* (Lund 1998) (lost and late commands); M. Basseville, I. V. Nikiforov, *Detection of Abrupt
Changes* (Prentice Hall 1993) (steps and drifts); ISO 80601-2-12 (leaks, disconnection, pressure
relief, ripple of the supply); P. E. Pepe, J. J. Marini, Am. Rev. Respir. Dis. 126 (1982) 166
(trapped gas); A. Jubran, M. J. Tobin, Am. J. Respir. Crit. Care Med. 150 (1994) 766 (secretions saw
the flow; water in a tube swings alike, but slower); J. G. Widdicombe, Eur. Respir. J. 8 (1995) 1193
(course of a cough); data sheets of stepper valves (whole steps).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from hardware_eval.emulation.cases import NOMINAL_GAIN, Base, Case, Effect, Strength
from proofs.challenge.questions import Kind, in_turn, read_families
from ventbench.base.arrays import Bools, Ints
from ventbench.task.lungs import Lung


@dataclass(frozen=True)
class FaultsCase(Case):
    """A recording of the third generator."""

    #: always ``"faults"``; the sealed answers tell the generators apart by it.
    generator: str = "faults"
    interval: float = 0.03  #: sampling interval, s.
    inspiration: float = 1.0  #: duration of inspiration, s.
    tubing: float = 0.05  #: compliance of the circuit that every rig has, mL/cmH2O.
    choice: int = 0  #: seed of which breaths and commands are affected.


FAULTS = read_families(__file__)

#: Faults that act in part of the recording: in some breaths or above a pressure.
PARTIAL = ("intermittent_leak", "disconnection", "relief_leak", "secretions", "cough")

SHARES: dict[Kind, float] = {"single": 0.62, "null": 0.18, "pair": 0.14, "masked": 0.06}

#: Share of the single faults that are below detection, and their size as a share of a mild one.
_FAINT, _FAINT_SIZE = 0.1, 0.08

#: Share of breaths below which a fault never happens.
_NEVER = 0.02

#: Largest relative deviation of a strength from its mean.
_VARIATION = 0.15

_LUNGS = tuple(Lung(R, C) for R in (5.0, 20.0, 50.0) for C in (10.0, 20.0, 50.0))

#: Sampling intervals, s, with the number of samples of a breath.
_SAMPLING = ((0.03, 84), (0.025, 100), (0.0333, 76))


def of_kind(kind: Kind, count: int, rng: np.random.Generator) -> Iterator[FaultsCase]:
    """Draw cases of a kind."""
    every = tuple(FAULTS)
    names = in_turn(every, count, rng)
    flip = int(rng.integers(2))
    for k in range(count):
        strength: Strength = ("mild", "strong")[(k + flip) % 2]
        most = 24 if kind == "masked" else 200
        breaths = int(np.round(np.exp(rng.uniform(np.log(12), np.log(most)))))
        effects: tuple[Effect, ...] = ()
        if kind == "pair":
            first, second = rng.choice(len(every), 2, replace=False)
            chosen = sorted((every[first], every[second]))
            effects = tuple(_effect(name, "strong", breaths, rng) for name in chosen)
        elif kind != "null":
            faint = kind == "single" and rng.uniform() < _FAINT
            effects = (_effect(names[k], strength, breaths, rng, faint=faint),)
        yield _case(effects, breaths, rng)


def _effect(
    name: str, strength: Strength, breaths: int, rng: np.random.Generator, *, faint: bool = False
) -> Effect:
    family = FAULTS[name]
    size = getattr(family, strength) * rng.uniform(1.0 - _VARIATION, 1.0 + _VARIATION)
    if faint:  # a level or an opening is faint where nothing reaches it
        size = 90.0 if family.parameter in ("level", "opening") else _FAINT_SIZE * family.mild
    if len(family.signs) > 1 and rng.uniform() < 0.5:
        size = -size
    values = {family.parameter: float(size)}
    values |= {key: float(rng.uniform(*span)) for key, span in family.ranges}
    if name.endswith("_step"):
        values["breath"] = float(1 + int(breaths * rng.uniform(0.3, 0.7)))
    if family.share is not None:
        values["affected"] = float(rng.uniform(*family.share))
    return Effect(name, strength, family.forms[int(rng.integers(len(family.forms)))], values)


def _case(effects: tuple[Effect, ...], breaths: int, rng: np.random.Generator) -> FaultsCase:
    label = _LUNGS[int(rng.integers(len(_LUNGS)))]
    interval, samples = _SAMPLING[int(rng.integers(len(_SAMPLING)))]
    base = Base(
        R=float(label.R * np.exp(0.1 * rng.standard_normal())),
        C=float(label.C * np.exp(0.05 * rng.standard_normal())),
        R_ex=float(rng.uniform(3.0, 8.0)),
        peep=float(rng.uniform(4.0, 6.0)),
        gain=float(NOMINAL_GAIN * np.exp(0.06 * rng.standard_normal())),
    )
    return FaultsCase(
        name="",
        lung_R=label.R,
        lung_C=label.C,
        effects=effects,
        base=base,
        noise=float(rng.uniform(0.1, 0.25)),
        coloured=float(rng.uniform(0.0, 0.4)) if rng.uniform() < 0.4 else 0.0,
        step=float(rng.choice(np.array([0.05, 0.07]))),
        jitter=float(rng.choice(np.array([1e-4, 6e-4]))),
        breaths=breaths,
        samples=samples,
        log_step=0.01,
        interval=interval,
        inspiration=float(rng.uniform(0.8, 1.1)),
        tubing=float(rng.uniform(0.02, 0.08)),
        choice=int(rng.integers(2**31)),
    )


def affected(case: FaultsCase, effect: Effect, number: Ints) -> Bools:
    """Which breaths a fault affects, by their numbers from 0, ``(n,)``."""
    share = effect.parameters["share" if effect.name == "disconnection" else "affected"]
    size = max(case.breaths, int(number.max()) + 1)
    seed = (case.choice, 3, list(FAULTS).index(effect.name))
    rank = np.random.default_rng(seed).permutation(size)
    count = 0 if share < _NEVER else int(np.ceil(share * size))
    return rank[number] < count
