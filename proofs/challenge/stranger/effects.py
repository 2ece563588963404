"""Effects of the second generator: forms, strengths, sources; and the draw of its cases.

Sources: F. Rohrer, Pflügers Arch. 162 (1915) 225 (``K1 Q + K2 Q |Q|``); J. Mead, J. Appl. Physiol.
9 (1956) 208 (inertia of the gas); A. B. Otis et al., J. Appl. Physiol. 8 (1956) 427 (unequal time
constants); W. A. Briscoe, A. B. DuBois, J. Clin. Invest. 37 (1958) 1279 (conductance grows with
volume); E. Salazar, J. H. Knowles, J. Appl. Physiol. 19 (1964) 97 (exponential pressure-volume
curve); J. G. Venegas et al., J. Appl. Physiol. 84 (1998) 389 (sigmoid); E. D'Angelo et al., J.
Appl. Physiol. 67 (1989) 2556 and J. H. T. Bates, *Lung Mechanics* (Cambridge 2009) (viscoelastic
tissue); J. S. Mecklenburgh, W. W. Mapleson, Br. J. Anaesth. 60 (1988) 434 (course of muscle
pressure); H. Blasius (1913) (friction of turbulent flow, exponent 1.75); ISA-75.01 / IEC 60534
(valve characteristics and flow from a supply); R. Bouc (1967), Y. K. Wen, J. Eng. Mech. 102 (1976)
249 (smooth hysteresis); M. Lichtwarck-Aschoff et al., Crit. Care 18 (2014) R126 (cardiogenic
oscillation).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from hardware_eval.emulation.cases import NOMINAL_GAIN, Base, Case, Effect, Strength
from proofs.challenge.questions import Kind, combined, in_turn, read_families
from ventbench.task.lungs import Lung

#: Form of an effect whose parameter means the same as the library's of that name.
SAME = "library"


@dataclass(frozen=True)
class StrangerCase(Case):
    """A recording of the second generator, with the nuisances of its laboratory."""

    #: always ``"stranger"``; the sealed answers tell the two generators apart by it.
    generator: str = "stranger"
    interval: float = 0.032  #: mean sampling interval, s.
    inspiration: float = 1.0  #: duration of inspiration, s.
    clock_step: float = 0.0  #: resolution of the logged times, s; 0 for none.
    #: relative standard deviation of the valve's gain from breath to breath.
    gain_scatter: float = 0.0
    outliers: float = 0.0  #: share of readings that are far off.
    missing: float = 0.0  #: share of readings that are blank.
    proportional: float = 2.0  #: largest proportional gain of the controller, % per cmH2O.
    explored: float = 0.5  #: share of breaths that explore instead of following a target.
    dead_space: float = 0.03  #: compliance of the circuit that every rig has, mL/cmH2O.


EFFECTS = read_families(__file__)

INSIDE: tuple[str, ...] = tuple(name for name, family in EFFECTS.items() if family.inside)
OUTSIDE: tuple[str, ...] = tuple(name for name, family in EFFECTS.items() if not family.inside)

#: All nine settings of the QuickLung.
SETTINGS = tuple(Lung(R, C) for R in (5.0, 20.0, 50.0) for C in (10.0, 20.0, 50.0))

#: Shares of the kinds. There is no kind ``form``, since all forms are strangers.
SHARES: dict[Kind, float] = {
    "single": 0.40,
    "null": 0.16,
    "pair": 0.14,
    "four": 0.08,
    "outside": 0.16,
    "masked": 0.06,
}

#: Effects that are not combined with others: too small beside them, or no size.
_ALONE = ("inertance", "command_rounding")

#: No two of a set are combined: pressure hardly tells them apart.
_RIVALS = (
    {"valve_lag", "sensor_lag", "circuit_compliance"},
    {"leak", "valve_dead_band", "viscoelasticity"},
    {"valve_curve", "supply_droop"},
)

#: Largest relative deviation of a strength from its mean.
_VARIATION = 0.15

#: Share of the recordings whose label has another R or C by the factor of a forgotten setting, and
#: that factor's range.
_GROSS, _FACTOR = 0.08, (1.5, 1.8)

#: Sampling intervals, s, with the number of samples of a breath. Few sizes, so that few compile.
_SAMPLING = ((0.0319, 80), (0.0340, 80), (0.0250, 100))


def of_kind(kind: Kind, count: int, rng: np.random.Generator) -> Iterator[StrangerCase]:
    """Draw cases of a kind."""
    lungs = in_turn(SETTINGS, count, rng)
    names = in_turn(OUTSIDE if kind == "outside" else INSIDE, count, rng)
    flip = int(rng.integers(2))
    for k in range(count):
        strength: Strength = ("mild", "strong")[(k + flip) % 2]
        effects: tuple[Effect, ...] = ()
        if kind in ("pair", "four"):
            several = combined(INSIDE, 2 if kind == "pair" else 4, _RIVALS, _ALONE, rng)
            effects = tuple(_effect(name, "strong", rng) for name in several)
        elif kind != "null":
            effects = (_effect(names[k], strength, rng),)
        yield _laboratory(lungs[k], effects, kind, rng)


def _effect(name: str, strength: Strength, rng: np.random.Generator) -> Effect:
    family = EFFECTS[name]
    form = family.forms[int(rng.integers(len(family.forms)))]
    size = getattr(family, strength) * rng.choice(np.array(family.signs))
    if family.parameter != "amount":
        size *= rng.uniform(1.0 - _VARIATION, 1.0 + _VARIATION)
    if family.parameter == "share":
        size = min(size, 0.5)
    further = {key: float(rng.uniform(*span)) for key, span in family.ranges}
    return Effect(name, strength, form, {family.parameter: float(size)} | further)


def _laboratory(
    label: Lung, effects: tuple[Effect, ...], kind: Kind, rng: np.random.Generator
) -> StrangerCase:
    """A rig and its laboratory around a label."""
    R, C = label.R * np.exp(0.1 * rng.standard_normal()), label.C * np.exp(0.05 * rng.normal())
    if rng.uniform() < _GROSS:
        factor = rng.uniform(*_FACTOR) ** rng.choice(np.array([-1.0, 1.0]))
        R, C = (R * factor, C) if rng.uniform() < 0.5 else (R, C * factor)
    interval, samples = _SAMPLING[int(rng.integers(len(_SAMPLING)))]
    few = kind == "masked"
    breaths = int(np.round(np.exp(rng.uniform(np.log(12), np.log(24 if few else 200)))))
    base = Base(
        R=float(R),
        C=float(C),
        R_ex=float(rng.uniform(3.0, 9.0)),
        peep=float(rng.uniform(3.0, 7.0)),
        gain=float(NOMINAL_GAIN * np.exp(0.06 * rng.standard_normal())),
    )
    return StrangerCase(
        name="",
        lung_R=label.R,
        lung_C=label.C,
        effects=effects,
        base=base,
        noise=float(rng.uniform(0.1, 0.3)),
        coloured=float(rng.uniform(0.0, 0.6)) if rng.uniform() < 0.5 else 0.0,
        correlation=float(rng.uniform(0.4, 0.9)),
        step=float(rng.choice(np.array([0.0703, 0.01, 0.1]))),
        jitter=float(rng.choice(np.array([1e-4, 5e-4, 1.2e-3]))),
        breaths=breaths,
        samples=samples,
        style="pi" if few else "mixed",
        log_step=float(rng.choice(np.array([0.001, 0.01, 0.1]))),
        interval=interval,
        inspiration=float(rng.uniform(0.8, 1.2)),
        clock_step=float(rng.choice(np.array([0.0, 1e-4]))),
        gain_scatter=float(rng.choice(np.array([0.0, 0.005, 0.015]))),
        outliers=float(rng.choice(np.array([0.0, 5e-4, 2e-3]))),
        missing=float(rng.choice(np.array([0.0, 0.0, 0.01]))),
        proportional=float(rng.uniform(0.5, 10.0)),
        explored=0.0 if few else float(rng.choice(np.array([0.0, 0.3, 0.6]))),
        dead_space=float(rng.uniform(0.01, 0.05)),
    )
