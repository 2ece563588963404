"""The patient coughs."""

from __future__ import annotations

import jax.numpy as jnp

from ventbench.physics.mechanism import Description, Mechanism, Values
from ventbench.physics.network import PneumaticNetwork, View
from ventbench.physics.parameters import Parameter


class Cough(Mechanism):
    """A short push of the expiratory muscles: half a sine of pressure at the alveolus."""

    description = Description(
        name="cough",
        title="cough",
        site="alveolus",
        equation="P_alveolus = ... + pressure sin(pi (t - onset) / duration) while it lasts",
        parameters=(
            Parameter(
                "pressure", "cmH2O", "highest pressure of the muscles",
                0.0, 100.0, 0.0, 5.0, 15.0, scope="breath", scan=(3.0, 6.0, 12.0, 24.0),
            ),
            Parameter(
                "onset", "s", "after the first sample", 0.0, 3.0, 0.3, 0.3, 0.3, scope="breath",
                grid=tuple(0.1 * k for k in range(19)),
            ),
            Parameter(
                "duration", "s", "of the push", 0.05, 0.5, 0.2, 0.2, 0.2, scope="breath",
                grid=(0.14, 0.25),
            ),
        ),
        source=(
            "A cough lasts 0.2 to 0.5 s and raises the pressure in the chest by 5 to 100 cmH2O "
            "(J. G. Widdicombe, Eur. Respir. J. 8, 1995, 1193)."
        ),
        signature="A short hump of pressure in some breaths, at any time.",
        confusable=("patient_effort",),
        least=1.0,
        least_reason="less than the beating of a heart and the noise of a sensor",
    )  # fmt: skip

    def network(self, values: Values, network: PneumaticNetwork, view: View) -> PneumaticNetwork:
        """Add the push to the recoil."""
        phase = jnp.clip((view.time - values["onset"]) / values["duration"], 0.0, 1.0)
        return network.plus(recoil=values["pressure"] * jnp.sin(jnp.pi * phase))


MECHANISM = Cough()
