"""Curves of fitted nonparametric components, for plots and reports."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from ventbench.base.errors import InputError
from ventbench.base.precision import float64
from ventbench.physics.catalogue import basis_terms
from ventbench.physics.nonparametric import NONPARAMETRIC_COMPONENTS
from ventbench.physics.nonparametric.basis import BasisTerm, Curve
from ventbench.physics.parameters import BASE_PARAMETERS


def component_curves(
    component: str, values: Mapping[str, float], within: tuple[float, float] | None = None
) -> tuple[Curve, ...]:
    """Curves of a nonparametric component; those of its strongest basis term come first.

    Volumes count from where a linear lung has no recoil.

    Args:
        component: public name, such as ``f(V)``.
        values: fitted values by path: coefficients, R, C, gain, R_ex. What is missing is neutral.
        within: range of the component's axis that the data cover. A curve over that axis is cut to
            it, and what base parameters could absorb there (a constant, a straight line through
            zero) is subtracted.

    Raises:
        InputError: if there is no such component, or the range contains no part of the curve.
    """
    if component not in NONPARAMETRIC_COMPONENTS:
        raise InputError(
            f"no nonparametric component {component!r}; choose one of "
            f"{', '.join(NONPARAMETRIC_COMPONENTS)}"
        )
    about = NONPARAMETRIC_COMPONENTS[component]
    base = {p.name: float(values.get(p.name, p.neutral)) for p in BASE_PARAMETERS}
    weighted = []
    with float64():
        for name in about.terms:
            term = basis_terms()[name]
            assert isinstance(term, BasisTerm)  # as all terms of the package are
            own = {
                p.name: jnp.asarray(float(values.get(f"{name}.{p.name}", p.neutral)))
                for p in term.description.parameters
            }
            weighted.append((term.magnitude(own), term.curves(own, base)))
    weighted.sort(key=lambda pair: -pair[0])
    curves = [curve for _, of_term in weighted for curve in of_term]
    if within is None:
        return tuple(curves)
    return tuple(_cut(curve, *within) if curve.x_unit == about.axis else curve for curve in curves)


def _cut(curve: Curve, low: float, high: float) -> Curve:
    covered = (curve.x >= low) & (curve.x <= high)
    x, y = curve.x[covered], curve.y[covered]
    if len(x) <= len(curve.absorbed):
        raise InputError(
            f"{curve.x_unit} from {low:g} to {high:g}: the curve goes from {curve.x[0]:g} to "
            f"{curve.x[-1]:g}; give a range within that"
        )
    return without_absorbed(replace(curve, x=x, y=y))


def without_absorbed(curve: Curve) -> Curve:
    """Subtract the part that a change of base parameters would produce as well."""
    if not curve.absorbed:
        return curve
    powers = np.stack([curve.x**power for power in curve.absorbed], axis=1)
    return replace(curve, y=curve.y - powers @ np.linalg.lstsq(powers, curve.y, rcond=None)[0])
