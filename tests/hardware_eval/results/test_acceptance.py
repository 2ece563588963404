"""The statement of an acceptance report covers the breaths that it was made of."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hardware_eval.results.acceptance import stated


def test_a_bias_and_a_slope_are_told_apart() -> None:
    pressures = [10.0, 20.0, 30.0]
    made = stated([np.full(5, 0.5 + 0.02 * pressure) for pressure in pressures], pressures)
    assert (made.bias, made.linearity) == pytest.approx((0.5, 0.02), abs=1e-9)
    assert str(made) == "± (0.50 cmH2O + 2.0 % of the set pressure)"


def test_one_set_pressure_has_a_bias_alone() -> None:
    made = stated([np.array([0.1, 0.3]), np.array([-0.4, -0.2])], [5.0, 5.0])
    assert made.linearity == 0.0
    # Means of 0.2 and -0.3, and two standard deviations of sqrt(0.02).
    assert made.bias == pytest.approx(0.05 + 0.25 + 2.0 * np.sqrt(0.02))


@given(
    st.lists(
        st.tuples(st.sampled_from([10.0, 20.0, 35.0]), st.floats(-3.0, 3.0), st.floats(0.0, 0.5)),
        min_size=1,
        max_size=12,
    )
)
def test_every_setting_lies_within_the_statement(
    settings: list[tuple[float, float, float]],
) -> None:
    errors = [mean + sd * np.array([-1.0, 0.0, 1.0]) for _, mean, sd in settings]
    pressures = [pressure for pressure, _, _ in settings]
    made = stated(errors, pressures)
    for each, pressure in zip(errors, pressures, strict=True):
        assert np.abs(each).max() <= made.bias + made.linearity * pressure + 1e-9
