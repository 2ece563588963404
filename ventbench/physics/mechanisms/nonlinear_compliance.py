"""The lung has a capacity: it stiffens as it fills."""

import jax.numpy as jnp
from jax import Array

from ventbench.physics.mechanism import Description, Mechanism, Network, Parameter, Values, View

#: Share of the capacity up to which the curve is followed.
_FULL = 0.97

#: Order of the recoil's series near zero, whose next term is below 1e-10.
_ORDER = 6


class NonlinearCompliance(Mechanism):
    """A recoil that rises faster than volume."""

    description = Description(
        name="nonlinear_compliance", title="lung that stiffens as it fills", site="alveolus",
        equation="P_elastic = (ln(1 + sigmoid x) - ln(1 - x)) / (1 + sigmoid) / stiffening, x = "
        "stiffening V / C",
        parameters=(
            Parameter("stiffening", "1/cmH2O", "1 over (capacity / C); negative: the lung softens",
                      -0.05, 0.08, 0.0, 1 / 40, 1 / 24),
            Parameter("sigmoid", "1",
                      "0 for an exponential curve, 1 for the upper half of a sigmoid, more for one "
                      "whose middle lies above zero pressure",
                      0.0, 4.0, 0.0, 0.0, 0.0, shape=True, grid=(0.0, 1.0)),
        ),
        source="Exponential pressure-volume curve of Salazar and Knowles (J. Appl. Physiol. 19, "
        "1964, 97), or the sigmoid of Venegas, Harris and Simon (J. Appl. Physiol. 84, 1998, 389), "
        "as a function of the volume above that at zero pressure. 5 to 50 % of the volume missing "
        "at 30 cmH2O.",
        signature="Pressure rises faster at high volume: end of inspiration of big breaths; "
        "expiration begins faster.",
        confusable=("valve_curve", "leak"), detectable=0.01, least=0.003,
        least_reason="stiffening by 5 % at 15 cmH2O; less is within the spread of springs",
        special_case_of=("recoil_shape",),
    )  # fmt: skip

    def network(self, values: Values, network: Network, view: View) -> Network:
        """Tangent of the curve at the last volume, less the linear lung's.

        The curve is that of the lung as it has become in the session.
        """
        k = values["stiffening"]
        linear = network.elastance * view.volume  # cmH2O
        full = k * linear > _FULL  # from here on the curve goes on as its tangent
        within = jnp.where(full, _FULL / jnp.where(full, k, 1.0), linear)
        x = k * within
        # Below the volume at zero pressure, and where the lung softens, the curve is exponential.
        sigmoid = jnp.where(x > 0.0, jnp.where(k > 0.0, values["sigmoid"], 0.0), 0.0)
        slope = 1.0 / ((1.0 - x) * (1.0 + sigmoid * x))
        recoil = within * _recoil_ratio(x, sigmoid) + (linear - within) * slope
        return network.plus(recoil=recoil - linear, elastance=(slope - 1.0) * network.elastance)


def _recoil_ratio(x: Array, sigmoid: Array) -> Array:
    """Recoil over the linear lung's, for any ``x`` below 1 and with its derivatives at zero.

    The slope ``1 / ((1 - x)(1 + sigmoid x))`` is the series of ``c_n x^n`` with
    ``c_n = 1 - sigmoid c_(n - 1)``.
    """
    small = jnp.abs(x) < 1e-2
    safe = jnp.where(small, 0.5, x)
    c, series = jnp.ones_like(x), jnp.ones_like(x)
    for power in range(1, _ORDER + 1):
        c = 1.0 - sigmoid * c
        series = series + c * x**power / (power + 1)
    exact = (jnp.log1p(sigmoid * safe) - jnp.log1p(-safe)) / ((1.0 + sigmoid) * safe)
    return jnp.where(small, series, exact)
