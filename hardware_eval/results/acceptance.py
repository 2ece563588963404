"""An acceptance report of a bench's pressures, in the form that ISO 80601-2-12 asks for.

The standard (2020, 201.12.1.102) has a manufacturer state, for pressure-controlled breaths, the
largest bias error and linearity error of the airway pressure at the end of inspiration and at the
end of expiration, over settings of compliance, resistance and pressure. For ventilators of critical
care these statements have the form "within ± (bias + linearity of the set pressure)". This is that
statement for the settings that a session ran, without a leak and with one.

At each setting the error is the mean over breaths of the last 0.06 s before the phase ends, less
the set pressure. Bias and linearity are the line through the errors of all settings, least squares;
what the settings depart from it, and how breaths scatter about their mean (two standard
deviations), is added to the bias, so that the statement covers every breath of the session with
95 %. It is no certification: the sensor is the ventilator's, which controls by it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np

from hardware_eval.bench.plan import PERTURBED_BREATH
from hardware_eval.bench.raw_log import LoggedBreath, Session
from hardware_eval.results import page
from ventbench.base.arrays import Floats
from ventbench.base.errors import InputError
from ventbench.base.text import number
from ventbench.task import protocol

#: Readings at the end of a phase that count: 0.06 s.
LAST = 2

#: Conditions, and what tells a run of each: its kind and what happened to the tube.
CONDITIONS = {"without a leak": "", "with a leak": "leak"}


@dataclass(frozen=True)
class Setting:
    """Errors of the breaths at one setting, cmH2O."""

    lung: str  #: label.
    pip: float  #: set pressure of the inspiration, cmH2O.
    #: at the end of each inspiration, less PIP, ``(n,)``, and of each expiration, less PEEP.
    errors: tuple[Floats, ...]


@dataclass(frozen=True)
class Statement:
    """``± (bias + linearity * set pressure)``."""

    bias: float  #: largest bias error, cmH2O.
    linearity: float  #: largest linearity error, share of the set pressure.

    def __str__(self) -> str:
        return f"± ({self.bias:.2f} cmH2O + {100.0 * self.linearity:.1f} % of the set pressure)"


def stated(errors: Sequence[Floats], pressures: Sequence[float]) -> Statement:
    """The statement of settings, each with the errors of its breaths, cmH2O ``(n,)``."""
    means = np.array([each.mean() for each in errors])
    given = np.asarray(pressures, float)
    slope, offset = 0.0, float(means.mean())
    if len(set(pressures)) > 1:
        slope, offset = (float(x) for x in np.polyfit(given, means, 1))
    scatter = np.array([each.std(ddof=1) if len(each) > 1 else 0.0 for each in errors])
    rest = np.abs(means - slope * given - offset) + 2.0 * scatter
    return Statement(abs(offset) + float(rest.max()), abs(slope))


def settings_of(session: Session, entry: str, tube: str) -> list[Setting]:
    """Settings of an entry in one condition; ``tube`` as a perturbation, or nothing."""
    perturbed = {run.number for run in session.plan.runs if run.perturbation == tube and tube}
    made: dict[tuple[str, float], list[LoggedBreath]] = {}
    for each in session.breaths:
        run, wanted = each.run, each.run.kind == "scored" and each.breath in protocol.SCORED_BREATHS
        if tube:  # the tube is disturbed in the breath before those that count
            wanted = run.number in perturbed and each.breath > PERTURBED_BREATH
        if wanted and each.complete and run.entry == entry:
            made.setdefault((run.lung, run.pip), []).append(each)
    order = {lung: place for place, lung in enumerate(session.lungs)}
    return [
        Setting(lung, pip, tuple(_ends(made[lung, pip], k) - aim for k, aim in _phases(pip)))
        for lung, pip in sorted(made, key=lambda key: (order[key[0]], key[1]))
    ]


def _phases(pip: float) -> tuple[tuple[int, float], ...]:
    """Step at which each phase ends, and the pressure that is set for it, cmH2O."""
    return (protocol.INSPIRATION_STEPS, pip), (protocol.BREATH_STEPS, protocol.PEEP)


def _ends(breaths: Sequence[LoggedBreath], end: int) -> Floats:
    """Mean of the last readings of a phase of each breath that has one, cmH2O."""
    whole = [each.log.pressure[end - LAST : end] for each in breaths]
    last = np.array([each for each in whole if len(each) == LAST], float).reshape(-1, LAST)
    return np.nanmean(last[np.isfinite(last).any(axis=1)], axis=1)


def report(session: Session) -> str:
    """The page.

    Raises:
        InputError: if no scored run is complete.
    """
    parts, missing = [], []
    for entry, (condition, tube) in product(session.plan.entries, CONDITIONS.items()):
        if settings := settings_of(session, entry, tube):
            about = {"entry": entry, "condition": condition, "settings": settings}
            parts.append({**about, "statements": _statements(settings)})
        else:
            lacks = f'{entry} has no run {condition}; `perturb = ["leak"]` in the plan makes them'
            missing.append(lacks)
    if not parts:
        raise InputError(
            f"{session.path}: no scored run is complete, so there is nothing to report"
        )
    return page.rendered(
        "acceptance.html.j2",
        session,
        parts=parts,
        missing=missing,
        figures=_figures,
        protocol=protocol,
        window=1000.0 * LAST * protocol.DT,
    )


def _statements(settings: Sequence[Setting]) -> list[Statement]:
    """What holds at the end of inspiration, and of expiration."""
    statements = []
    for k in range(2):
        ended = [x for x in settings if len(x.errors[k])]
        aims = [_phases(x.pip)[k][1] for x in ended]
        statements.append(stated([x.errors[k] for x in ended], aims))
    return statements


def _figures(errors: Floats) -> list[str]:
    """Mean, standard deviation and largest of some errors; dashes where there is none."""
    spread = number(float(errors.std(ddof=1))) if len(errors) > 1 else "–"
    if not len(errors):
        return ["–"] * 3
    return [number(float(errors.mean()), sign=True), spread, number(float(np.abs(errors).max()))]


def write(folder: Path) -> Path:
    """Write the report of a session; see :func:`hardware_eval.results.page.write`."""
    return page.write(folder, report, page.ACCEPTANCE)
