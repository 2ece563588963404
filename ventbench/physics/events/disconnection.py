"""The circuit comes off and is put back."""

from __future__ import annotations

import jax.numpy as jnp

from ventbench.physics.mechanism import Description, Mechanism, Values
from ventbench.physics.network import PneumaticNetwork, View
from ventbench.physics.parameters import Parameter


class Disconnection(Mechanism):
    """An open tube beside the lung for some time of a breath."""

    description = Description(
        name="disconnection",
        title="circuit open to the room",
        site="circuit",
        equation="q_out = conductance p while onset < t <= onset + duration",
        parameters=(
            Parameter(
                "conductance", "mL/s per cmH2O", "of the open end",
                0.0, 5000.0, 0.0, 1000.0, 1000.0, scope="breath", scan=(80.0, 150.0, 300.0, 1000.0),
            ),
            Parameter(
                "onset", "s", "after the first sample", -1.0, 5.0, 0.0, 0.3, 0.3, scope="breath",
                grid=tuple(0.1 * k for k in range(16)),
            ),
            Parameter(
                "duration", "s", "until it is put back", 0.0, 10.0, 0.3, 0.3, 1.0, scope="breath",
                grid=(0.15, 0.25, 0.35, 0.5, 1.0, 10.0),
            ),
        ),
        source=(
            "An open adult tube of 22 mm drops about 1 cmH2O at 1 L/s; the lung and the valve "
            "both empty into the room."
        ),
        signature="Pressure falls to that of the room at once and rises again from there.",
        confusable=("leak",),
    )  # fmt: skip

    def network(self, values: Values, network: PneumaticNetwork, view: View) -> PneumaticNetwork:
        """Add the open end as a conductance."""
        since = view.time - values["onset"]
        off = (since > 0.0) & (since <= values["duration"])
        return network.plus(leak=1e-3 * jnp.where(off, values["conductance"], 0.0))


MECHANISM = Disconnection()
