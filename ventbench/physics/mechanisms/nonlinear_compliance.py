"""The lung has a capacity: it stiffens as it fills."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from ventbench.physics.mechanism import Description, Mechanism, Values
from ventbench.physics.network import PneumaticNetwork, View
from ventbench.physics.parameters import Parameter

#: Share of the capacity up to which the curve is followed.
_FULL = 0.97


class NonlinearCompliance(Mechanism):
    """A recoil that rises faster than volume."""

    description = Description(
        name="nonlinear_compliance",
        title="lung that stiffens as it fills",
        site="alveolus",
        equation=(
            "P_elastic = (-(1 - sigmoid) ln(1 - x) + sigmoid artanh x) / stiffening, "
            "x = stiffening V / C"
        ),
        parameters=(
            Parameter(
                "stiffening",
                "1/cmH2O",
                "1 over (capacity / C); negative: the lung softens",
                -0.05,
                0.08,
                0.0,
                1 / 40,
                1 / 24,
            ),
            Parameter(
                "sigmoid",
                "1",
                "0 for an exponential curve, 1 for the upper half of a sigmoid",
                0.0,
                1.0,
                0.0,
                0.0,
                0.0,
                shape=True,
                grid=(0.0, 1.0),
            ),
        ),
        source=(
            "Exponential pressure-volume curve of Salazar and Knowles (J. Appl. Physiol. "
            "19, 1964, 97), or the upper half of the sigmoid of Venegas, Harris and Simon (J. "
            "Appl. Physiol. 84, 1998, 389). 5 to 50 % of the volume missing at 30 cmH2O."
        ),
        signature=(
            "Pressure rises faster at high volume: end of inspiration of big breaths; "
            "expiration begins faster."
        ),
        confusable=("valve_curve", "leak"),
        detectable=0.01,
        least=0.003,
        least_reason="stiffening by 5 % at 15 cmH2O; less is within the spread of springs",
        special_case_of=("recoil_shape",),
    )

    def network(self, values: Values, network: PneumaticNetwork, view: View) -> PneumaticNetwork:
        """Tangent of the curve at the last volume, less the linear lung's.

        The curve is that of the lung as it has become: mechanisms come in the order of their names,
        and `compliance_drift` has changed the network's elastance before. Two changes of one linear
        lung could add up to a recoil that falls as the lung fills.
        """
        k = values["stiffening"]
        linear = network.elastance * view.volume  # cmH2O
        full = k * linear > _FULL  # from here on the curve goes on as its tangent
        within = jnp.where(full, _FULL / jnp.where(full, k, 1.0), linear)
        x, share = k * within, jnp.where(k > 0.0, values["sigmoid"], 0.0)  # none softens
        rising = jnp.maximum(x, 0.0)
        slope = (1.0 - share) / (1.0 - x) + share / (1.0 - rising**2)
        ratio = (1.0 - share) * _log_ratio(x) + share * _artanh_ratio(rising)
        recoil = within * ratio + (linear - within) * slope
        return network.plus(recoil=recoil - linear, elastance=(slope - 1.0) * network.elastance)


def _log_ratio(x: Array) -> Array:
    """Return ``-ln(1 - x) / x``, for any ``x`` below 1 and with its derivatives at zero."""
    small = jnp.abs(x) < 1e-2
    safe = jnp.where(small, 0.5, x)
    series = 1.0 + x * (1 / 2 + x * (1 / 3 + x * (1 / 4 + x * (1 / 5 + x * (1 / 6 + x / 7)))))
    return jnp.where(small, series, -jnp.log1p(-safe) / safe)


def _artanh_ratio(x: Array) -> Array:
    """Return ``artanh(x) / x``, for any ``x`` within -1..1 and with its derivatives at zero."""
    small = jnp.abs(x) < 1e-2
    safe = jnp.where(small, 0.5, x)
    series = 1.0 + x**2 * (1 / 3 + x**2 * (1 / 5 + x**2 / 7))
    return jnp.where(small, series, jnp.arctanh(safe) / safe)


MECHANISM = NonlinearCompliance()
