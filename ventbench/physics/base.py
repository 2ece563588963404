"""Parameters of the base model: the lung, the valves, and how a breath begins."""

from __future__ import annotations

from ventbench.physics.parameters import Parameter
from ventbench.plants.single_compartment import EXPIRATORY_RESISTANCE, VALVE_GAIN

#: What every fit refits, so that a wrong label cannot pass for a mechanism.
REFITTED = ("R", "C", "R_ex", "PEEP")

#: ``neutral`` is the value in a plant that does not name the parameter; a plant without ``PEEP``
#: takes the pressure that a breath starts from. R and C stand for a label that must be given.
PARAMETERS = (
    Parameter(
        "R", "cmH2O s/L", "resistance of the airway", 0.5, 200.0, 20.0, 20.0, 50.0, "log",
        follows="R",
    ),
    Parameter(
        "C", "mL/cmH2O", "compliance of the lung at low volume", 2.0, 250.0, 20.0, 20.0, 50.0,
        "log", follows="C",
    ),
    Parameter(
        "gain", "mL/s per %", "flow of the inspiratory valve", 2.0, 100.0, VALVE_GAIN, VALVE_GAIN,
        VALVE_GAIN, "log",
    ),
    Parameter(
        "R_ex", "cmH2O s/L", "resistance of the expiratory path", 0.3, 100.0,
        EXPIRATORY_RESISTANCE, EXPIRATORY_RESISTANCE, EXPIRATORY_RESISTANCE, "log",
    ),
    Parameter(
        "PEEP", "cmH2O", "pressure behind the expiratory valve", -10.0, 30.0, 5.0, 5.0, 5.0
    ),
    Parameter(
        "rest", "%", "command before the first sample of a breath", 0.0, 100.0, 0.0, 0.0, 0.0,
        shape=True,
    ),
    Parameter(
        "offset", "cmH2O", "recoil minus airway pressure at the first sample", -10.0, 10.0, 0.0,
        0.0, 0.0, shape=True,
    ),
    Parameter(
        "position", "1", "of the breath in its recording, 0 first, 1 last", 0.0, 1.0, 0.0, 0.0,
        1.0, "linear", "breath", shape=True,
    ),
)  # fmt: skip
