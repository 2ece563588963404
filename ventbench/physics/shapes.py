"""The shape of a fitted slot, to be drawn."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from ventbench.errors import InputError
from ventbench.physics import base
from ventbench.physics.catalogue import basis_terms
from ventbench.physics.nonparametric import NONPARAMETRIC_COMPONENTS
from ventbench.physics.nonparametric._element import Element, Shape
from ventbench.precision import float64


def drawn(
    slot: str, values: Mapping[str, float], within: tuple[float, float] | None = None
) -> tuple[Shape, ...]:
    """Curves of a slot, those of its strongest element first.

    Volumes count from where a linear lung has no recoil.

    Args:
        slot: public name, such as ``f(V)``.
        values: by path, of the fit: coefficients, R, C, gain, R_ex; what is missing is neutral.
        within: range of the slot's axis that the data cover: a curve over that axis is cut to it,
            and what base parameters could absorb there (a constant, a straight line through zero)
            is taken away.

    Raises:
        InputError: if there is no such slot, or the range holds no part of the curve.
    """
    if slot not in NONPARAMETRIC_COMPONENTS:
        raise InputError(f"no slot {slot!r}; choose of {', '.join(NONPARAMETRIC_COMPONENTS)}")
    known = {item.name: float(values.get(item.name, item.neutral)) for item in base.PARAMETERS}
    found = []
    with float64():
        for name in NONPARAMETRIC_COMPONENTS[slot].terms:
            element = basis_terms()[name]
            assert isinstance(element, Element)  # as all modules there are
            own = {
                item.name: jnp.asarray(float(values.get(f"{name}.{item.name}", item.neutral)))
                for item in element.description.parameters
            }
            found.append((element.weight(own), element.shapes(own, known)))
    shapes = [shape for _, some in sorted(found, key=lambda pair: -pair[0]) for shape in some]
    if within is None:
        return tuple(shapes)
    axis = NONPARAMETRIC_COMPONENTS[slot].axis
    return tuple(_cut(shape, *within) if shape.x_unit == axis else shape for shape in shapes)


def _cut(shape: Shape, low: float, high: float) -> Shape:
    here = (shape.x >= low) & (shape.x <= high)
    x, y = shape.x[here], shape.y[here]
    if len(x) <= len(shape.absorbed):
        raise InputError(
            f"{shape.x_unit} from {low:g} to {high:g}: the curve goes from {shape.x[0]:g} to "
            f"{shape.x[-1]:g}; give a range within that"
        )
    return without_absorbed(replace(shape, x=x, y=y))


def without_absorbed(shape: Shape) -> Shape:
    """Take away what base parameters could take over: it says nothing."""
    if not shape.absorbed:
        return shape
    powers = np.stack([shape.x**power for power in shape.absorbed], axis=1)
    return replace(shape, y=shape.y - powers @ np.linalg.lstsq(powers, shape.y, rcond=None)[0])
