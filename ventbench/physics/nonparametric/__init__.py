"""Slots: places in the physics where an effect without a name may act, with any shape.

A slot is one element or several, each a module here under its own name, as ``MECHANISM``, with the
hooks of a mechanism. With all coefficients at zero it does nothing.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Slot:
    """A place in the physics.

    Attributes:
        name: public.
        elements: that together are the slot, to be fitted at once.
        holds: mechanisms of the library that are special cases of it, exactly or nearly.
        meaning: in words.
        axis: what its shape depends on, with the unit.
    """

    name: str
    elements: tuple[str, ...]
    holds: tuple[str, ...]
    meaning: str
    axis: str


#: All slots, by public name.
SLOTS = {
    slot.name: slot
    for slot in (
        Slot(
            "f(u)", ("valve_shape",), ("valve_curve", "valve_dead_band", "command_rounding"),
            "flow of the inspiratory valve depends on the command in another way", "command, %",
        ),
        Slot(
            "memory of u", ("command_memory", "command_plays", "supply_memory"),
            ("valve_delay", "valve_lag", "supply_droop", "valve_hysteresis"),
            "flow of the inspiratory valve depends on what the command was before",
            "time after a step, s",
        ),
        Slot(
            "f(p)", ("leak_shape",), ("leak",),
            "gas leaves beside the lung, by the pressure at the airway", "airway pressure, cmH2O",
        ),
        Slot(
            "f(Q)", ("flow_shape",), ("turbulent_resistance",),
            "the pressure drop of the airway depends on flow in another way", "flow, L/s",
        ),
        Slot(
            "R(V)", ("volume_resistance",), (),
            "the resistance of the airway depends on the volume of the lung", "volume, mL",
        ),
        Slot(
            "R(direction)", ("direction_resistance",), (),
            "the resistance of the airway is another one outwards than inwards", "flow, L/s",
        ),
        Slot(
            "f(V)", ("recoil_shape",), ("nonlinear_compliance",),
            "the recoil of the lung depends on volume in another way", "volume, mL",
        ),
        Slot(
            "memory of p", ("recoil_memory",), ("viscoelasticity",),
            "the recoil of the lung depends on what its volume was before", "time after a step, s",
        ),
        Slot(
            "exhalation path", ("outlet_shape", "outlet_memory"), ("exhalation_valve_delay",),
            "the expiratory valve conducts in another way, or opens slowly", "p - PEEP, cmH2O",
        ),
        Slot(
            "measurement", ("sensor_shape", "sensor_memory", "drift_shape"),
            ("sensor_lag", "sensor_drift"),
            "the sensor shows another pressure than that at the airway",
            "airway pressure, cmH2O",
        ),
    )
}  # fmt: skip
