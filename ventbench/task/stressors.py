"""The stressors: one line of a table each.

A stressor changes parameters of the physics in ``with - without`` (see ``plants/stressed.py``).
Most are mechanisms of the library at a strength; some are events, some are other settings of the
test lung, some change from breath to breath. A new mechanism of the library becomes a stress test
by a line of :data:`STRESSORS`.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from ventbench.base.errors import InputError
from ventbench.task import protocol

#: Version of the table: stressors, strengths and pairs. Stress scores of two versions are not
#: compared.
VERSION = 1

Severity = Literal["mild", "strong"]
SEVERITIES: tuple[Severity, ...] = ("mild", "strong")

#: Where a stressor sits, in the order of tables and charts, and that in words.
Category = Literal["valve", "circuit", "sensor", "lung", "patient", "setting"]
CATEGORIES: dict[Category, str] = {
    "valve": "valve and supply",
    "circuit": "circuit",
    "sensor": "sensor",
    "lung": "airway and lung",
    "patient": "patient",
    "setting": "other lungs",
}

#: How a strength acts on what the reference physics has: it is added to it, it multiplies it, or it
#: is a label, in whose proportion to the lung's own label R or C changes.
Rule = Literal["add", "scale", "label"]

#: A number for all breaths, or one for each.
ByBreath = float | tuple[float, ...]

_ALWAYS = (1.0,) * protocol.BREATHS


@dataclass(frozen=True)
class Stressor:
    """One stressor at two severities."""

    name: str  #: public name.
    category: Category  #: where it sits.
    title: str  #: the stressor in a clinician's words.
    #: path of the parameter that it changes, ``mechanism.parameter`` or ``R``, ``C``.
    strength: str
    #: strength of the mild severity, in the parameter's unit; a factor for ``scale``, a label for
    #: ``label``.
    mild: float
    strong: float  #: strength of the strong severity.
    reason: str  #: where the two strengths come from.
    rule: Rule = "add"  #: how the strength acts.
    breaths: tuple[float, ...] = _ALWAYS  #: share of the strength in each breath of a run.
    #: further parameters, the same for both severities, by path.
    fixed: Mapping[str, ByBreath] = field(default_factory=dict)
    #: further parameters that differ, ``{path: (mild, strong)}``.
    by_severity: Mapping[str, tuple[ByBreath, ByBreath]] = field(default_factory=dict)

    def at(self, severity: Severity) -> float:
        """Strength of a severity."""
        return self.mild if severity == "mild" else self.strong

    def settings(self, severity: Severity) -> dict[str, ByBreath]:
        """Further parameters of a severity, by path."""
        index = SEVERITIES.index(severity)
        return {**self.fixed, **{path: both[index] for path, both in self.by_severity.items()}}


@dataclass(frozen=True)
class Condition:
    """What a run is stressed with: nothing, a stressor, or a pair."""

    stressors: tuple[str, ...] = ()  #: none, one or two names; more where :attr:`shares` are given.
    severity: Severity | None = None  #: of all of them; None without a stressor.
    #: share of the strength of each, 0..1, on a logarithmic scale where the strength is a factor or
    #: a label; empty for all of it.
    shares: tuple[float, ...] = ()

    @property
    def id(self) -> str:
        """Name in tables and JSON, such as ``leak:mild`` or ``leak+sensor_lag:mild``."""
        return f"{'+'.join(self.stressors)}:{self.severity}" if self.stressors else "none"


# Effort and changes of the lung differ from breath to breath: the first is as it always was.
_SECOND, _GROWING = (0.0, 1.0, 0.5), (0.0, 0.5, 1.0)
_STAYING = (0.0, 1.0, 1.0)

#: The table. Strengths come from recordings of the People's Ventilator Project (PVP) where they
#: were measured there, else from the literature named.
STRESSORS: tuple[Stressor, ...] = (
    Stressor(
        "valve_delay",
        "valve",
        "valve answers late",
        "valve_delay.delay",
        0.04,
        0.08,
        "Proportional valves of ventilators answer after 10 to 100 ms; 10 to 17 ms are in the "
        "scored rigs.",
    ),
    Stressor(
        "valve_lag",
        "valve",
        "valve answers slowly",
        "valve_lag.second",
        0.04,
        0.10,
        "Proportional solenoids have time constants of 5 to 100 ms.",
    ),
    Stressor(
        "valve_dead_band",
        "valve",
        "valve stays shut at small commands",
        "valve_dead_band.width",
        1.5,
        3.5,
        "Overlap and friction of the seat take 0 to 5 % of the stroke without linearisation.",
    ),
    Stressor(
        "valve_play",
        "valve",
        "play of the valve",
        "valve_hysteresis.width",
        2.0,
        5.0,
        "3.8 % of full scale was measured on the PVP's valve.",
    ),
    Stressor(
        "valve_wear",
        "valve",
        "worn valve: less flow at the top",
        "valve_curve.loss",
        0.2,
        0.5,
        "Recordings of the PVP want a saturating curve in all nine settings, 20 to 50 % over the "
        "range.",
    ),
    Stressor(
        "command_rounding",
        "valve",
        "valve takes whole percents",
        "command_rounding.amount",
        0.5,
        1.0,
        "Drivers with integer positions; mild: two steps a percent.",
    ),
    Stressor(
        "supply_high",
        "valve",
        "supply pressure too high: more flow",
        "gain",
        1.25,
        1.5,
        "Hospital gas at 2.8 to 6 bar; choked flow is in proportion to the absolute pressure.",
        "scale",
    ),
    Stressor(
        "supply_droop",
        "valve",
        "supply sags",
        "supply_droop.drop",
        0.1,
        0.3,
        "A reservoir loses 0 to 30 % of its flow at 0.5 L/s and recovers in about a second.",
    ),
    Stressor(
        "leak",
        "circuit",
        "leak",
        "leak.conductance",
        20.0,
        60.0,
        "An orifice of 6 and 18 L/min at 25 cmH2O: a cuff that does not seal, and a mask.",
    ),
    Stressor(
        "circuit_compliance",
        "circuit",
        "soft tubing",
        "circuit_compliance.compliance",
        1.2,
        3.0,
        "Adult circuits take up 0.5 to 3 mL/cmH2O.",
    ),
    Stressor(
        "exhalation_valve_late",
        "circuit",
        "expiratory valve closes late",
        "exhalation_valve_closing.closing",
        0.05,
        0.10,
        "Solenoid and diaphragm: 0 to 100 ms; 24 to 54 ms are in the scored rigs.",
    ),
    Stressor(
        "disconnection",
        "circuit",
        "tube comes off and is put back",
        "disconnection.conductance",
        1000.0,
        1000.0,
        "A tube of 22 mm open to the room. Mild: for 0.15 s of breath 2. Strong: from 0.5 s of "
        "breath 2 to 0.2 s of breath 3.",
        breaths=(0.0, 1.0, 1.0),
        by_severity={
            "disconnection.onset": ((9.0, 0.4, 9.0), (9.0, 0.5, -0.1)),
            "disconnection.duration": ((0.0, 0.15, 0.0), (0.0, 9.0, 0.3)),
        },
    ),
    Stressor(
        "sensor_lag",
        "sensor",
        "pressure is shown late",
        "sensor_lag.tau",
        0.05,
        0.12,
        "Sampling line and filter: 5 to 120 ms.",
    ),
    Stressor(
        "sensor_high",
        "sensor",
        "sensor shows too much",
        "sensor_drift.drift",
        1.2,
        3.0,
        "Piezoresistive sensors move by up to 3 cmH2O between two zeroings.",
        fixed={"position": 1.0},
    ),
    Stressor(
        "sensor_low",
        "sensor",
        "sensor shows too little",
        "sensor_drift.drift",
        -1.2,
        -3.0,
        "Piezoresistive sensors move by up to 3 cmH2O between two zeroings.",
        fixed={"position": 1.0},
    ),
    Stressor(
        "turbulent_resistance",
        "lung",
        "turbulence in the airway",
        "turbulent_resistance.quadratic",
        4.0,
        10.0,
        "Rohrer's second coefficient is 1 to 30 cmH2O s2/L2; tubes of 8 and 7 mm.",
    ),
    Stressor(
        "inertance",
        "lung",
        "heavy gas column",
        "inertance.inertance",
        0.04,
        0.10,
        "0.01 to 0.02 cmH2O s2/L in adults; long narrow tubes have more.",
    ),
    Stressor(
        "secretions",
        "lung",
        "secretions: R rises after breath 1",
        "R",
        1.5,
        3.0,
        "Tubes of patients lose half of their section by secretions within days; a plug more.",
        "scale",
        _SECOND,
    ),
    Stressor(
        "suction",
        "lung",
        "airway cleared: R falls after breath 1",
        "R",
        0.67,
        0.33,
        "The way back from `secretions`.",
        "scale",
        _STAYING,
    ),
    Stressor(
        "position",
        "lung",
        "turned patient: C falls after breath 1",
        "C",
        0.7,
        0.4,
        "Turning, a raised abdomen or insufflation takes 30 to 50 % of the compliance.",
        "scale",
        _SECOND,
    ),
    Stressor(
        "recruitment",
        "lung",
        "lung opens: C rises from breath to breath",
        "C",
        1.4,
        2.0,
        "Recruitable lungs gain 30 to 100 % of compliance.",
        "scale",
        _GROWING,
    ),
    Stressor(
        "stiffening",
        "lung",
        "lung stiffens as it fills",
        "nonlinear_compliance.stiffening",
        1 / 40,
        1 / 24,
        "Capacity at 40 and 24 cmH2O times C, the upper half of a sigmoid pressure-volume curve.",
    ),
    Stressor(
        "softening",
        "lung",
        "lung recruits as it fills",
        "nonlinear_compliance.stiffening",
        -0.02,
        -0.05,
        "The lower half of a sigmoid pressure-volume curve.",
    ),
    Stressor(
        "viscoelasticity",
        "lung",
        "tissue relaxes",
        "viscoelasticity.ratio",
        0.25,
        0.7,
        "A Maxwell element of 0.05 to 0.7 of the elastance, 0.3 to 2 s.",
        fixed={"viscoelasticity.time": 0.5},
    ),
    Stressor(
        "effort_trigger",
        "patient",
        "patient breathes in with the ventilator",
        "patient_effort.amplitude",
        5.0,
        12.0,
        "Muscle pressure of quiet breathing is 5 to 10 cmH2O, of distress 15 and more.",
        breaths=_SECOND,
        fixed={"patient_effort.onset": 0.0, "patient_effort.duration": 0.8},
    ),
    Stressor(
        "effort_fight",
        "patient",
        "patient breathes out against the ventilator",
        "patient_effort.amplitude",
        -5.0,
        -12.0,
        "Expiratory muscles in double cycling and fighting reach the same pressures.",
        breaths=_SECOND,
        fixed={"patient_effort.onset": 0.4, "patient_effort.duration": 0.8},
    ),
    Stressor(
        "low_resistance",
        "setting",
        "R 3.5 and 2",
        "R",
        3.5,
        2.0,
        "Below all settings of the training; 2 is a bare test lung.",
        "label",
    ),
    Stressor(
        "high_resistance",
        "setting",
        "R 35 and 50",
        "R",
        35.0,
        50.0,
        "Above the six; 50 was recorded, and is the highest of the ISO lungs.",
        "label",
    ),
    Stressor(
        "low_compliance",
        "setting",
        "C 15 and 8",
        "C",
        15.0,
        8.0,
        "Between two of the six; and a stiff lung beyond them.",
        "label",
    ),
    Stressor(
        "high_compliance",
        "setting",
        "C 35 and 100",
        "C",
        35.0,
        100.0,
        "Between two of the six; and an emphysematous lung beyond them.",
        "label",
    ),
    Stressor(
        "middle_resistance",
        "setting",
        "R 10 and 14",
        "R",
        10.0,
        14.0,
        "Between the two of the six.",
        "label",
    ),
)

#: Pairs that occur together, both mild.
PAIRS: tuple[tuple[str, str], ...] = (
    ("valve_delay", "valve_play"),
    ("valve_delay", "sensor_lag"),
    ("valve_wear", "supply_droop"),
    ("leak", "effort_trigger"),
    ("leak", "high_resistance"),
    ("circuit_compliance", "sensor_lag"),
    ("supply_high", "low_compliance"),
    ("sensor_low", "position"),
    ("secretions", "effort_fight"),
    ("stiffening", "effort_trigger"),
    ("disconnection", "valve_delay"),
    ("recruitment", "suction"),
)

#: Weights of conditions in the score; 1 for the others. A tube that comes off costs so much more
#: than anything else that it alone was 8 to 13 % of what stress adds to the errors of the bundled
#: entries: with this weight no condition is more than a tenth of it.
WEIGHTS = {"disconnection:strong": 0.5}


def held_out() -> frozenset[str]:
    """Stressors under which nothing may be tuned: a third, by the hash of their names."""
    names = sorted((s.name for s in STRESSORS), key=lambda x: hashlib.sha256(x.encode()).digest())
    return frozenset(names[: -(-len(names) // 3)])


#: Mechanisms of the library without a line, and why.
NOT_STRESSED: dict[str, str] = {
    "compliance_drift": "`position` and `recruitment` change C between breaths.",
    "resistance_drift": "`secretions` and `suction` change R between breaths.",
    "compliance_step": "`position` changes C between two breaths.",
    "resistance_step": "`secretions` and `suction` change R between two breaths.",
    "gain_step": "`supply_high` has its size.",
    "gain_drift": "`supply_high` has its size.",
    "zero_step": "`sensor_high` and `sensor_low` have its size.",
    "clock_offset": "`valve_delay` is the same to a controller, but for the expiratory valve.",
    "clock_skew": "For version 2 of the table; within a breath it is a small `valve_delay`.",
    "trapped_gas": "For version 2 of the table; runs start at rest.",
    "relief_leak": "For version 2 of the table; `leak` loses as much.",
    "sensor_curve": "For version 2 of the table; `sensor_high` and `sensor_low` have its size.",
    "valve_rate": "For version 2 of the table; `valve_lag` is as late.",
    "valve_stiction": "For version 2 of the table; `valve_play` loses as much.",
    "pressure_line": "For version 2 of the table; `sensor_lag` is as late.",
    "tap_constriction": "For version 2 of the table; `sensor_high` and `sensor_low` have its size.",
    "lung_hysteresis": "For version 2 of the table; `viscoelasticity` is alike within a breath.",
    "sensor_hysteresis": "For version 2 of the table; `sensor_high` has its size.",
    "airway_opening": "For version 2 of the table; `secretions` are as narrow.",
    "exhalation_valve_delay": "For version 2 of the table; it acts in expiration alone.",
    "supply_pressure": "For version 2 of the table; `supply_droop` loses flow late as well.",
}


def stressor(name: str) -> Stressor:
    """A stressor by its name.

    Raises:
        InputError: if there is none.
    """
    for candidate in STRESSORS:
        if candidate.name == name:
            return candidate
    raise InputError(f"no stressor {name!r}; choose of {', '.join(s.name for s in STRESSORS)}")


def conditions() -> tuple[Condition, ...]:
    """All conditions of the track: nothing first, then each stressor twice, then the pairs."""
    single = [Condition((s.name,), severity) for s in STRESSORS for severity in SEVERITIES]
    return (Condition(), *single, *(Condition(pair, "mild") for pair in PAIRS))
