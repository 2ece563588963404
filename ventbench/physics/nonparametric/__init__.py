"""Nonparametric components: places in the physics where an unnamed effect may act, with any shape.

A component is a set of basis terms, which have the hooks of a mechanism and are linear, or nearly,
in their coefficients. With all coefficients at zero it does nothing. A module here holds the basis
terms that act at one place.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class NonparametricComponent:
    """A place in the physics, and the basis terms of any effect there."""

    name: str  #: public name, such as ``f(V)``.
    terms: tuple[str, ...]  #: names of its basis terms, which are fitted together.
    meaning: str  #: the component in words.


#: All nonparametric components, by public name.
NONPARAMETRIC_COMPONENTS = {
    component.name: component
    for component in (
        NonparametricComponent(
            "f(u)", ("valve_shape",),
            "flow of the inspiratory valve depends on the command in another way",
        ),
        NonparametricComponent(
            "memory of u", ("command_memory", "command_plays", "supply_memory"),
            "flow of the inspiratory valve depends on what the command was before",
        ),
        NonparametricComponent(
            "f(p)", ("leak_shape",),
            "gas leaves beside the lung, by the pressure at the airway",
        ),
        NonparametricComponent(
            "f(Q)", ("flow_shape",),
            "the pressure drop of the airway depends on flow in another way",
        ),
        NonparametricComponent(
            "R(V)", ("volume_resistance",),
            "the resistance of the airway depends on the volume of the lung",
        ),
        NonparametricComponent(
            "R(direction)", ("direction_resistance",),
            "the resistance of the airway is another one outwards than inwards",
        ),
        NonparametricComponent(
            "f(V)", ("recoil_shape",),
            "the recoil of the lung depends on volume in another way",
        ),
        NonparametricComponent(
            "memory of p", ("recoil_memory",),
            "the recoil of the lung depends on what its volume was before",
        ),
        NonparametricComponent(
            "exhalation path", ("outlet_shape", "outlet_memory"),
            "the expiratory valve conducts in another way, or opens slowly",
        ),
        NonparametricComponent(
            "measurement", ("sensor_shape", "sensor_memory", "drift_shape"),
            "the sensor shows another pressure than that at the airway",
        ),
    )
}  # fmt: skip
