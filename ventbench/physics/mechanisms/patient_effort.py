"""The patient breathes in."""

import jax.numpy as jnp

from ventbench.physics.mechanism import Description, Mechanism, Network, Parameter, Values, View

#: Where a muscle that relaxes has its peak, and its time constant after it, as shares of the
#: duration: with these, the best duration is hardly another one than that of half a sine.
_PEAK, _RELAXING = 2 / 3, 1 / 6


class PatientEffort(Mechanism):
    """A pressure source at the alveolus: half a sine, or a muscle that relaxes after its peak."""

    description = Description(
        name="patient_effort", title="effort of the patient's muscles", site="alveolus",
        equation="P_alveolus = ... - amplitude ((1 - relaxing) sin(pi x) + relaxing m(x)), x = (t "
        "- onset) / duration, m = sin(3 pi x / 4) up to x = 2/3, then exp(4 - 6 x)",
        parameters=(
            Parameter("amplitude", "cmH2O",
                      "highest pressure of the muscles, positive if inspiratory",
                      -20.0, 20.0, 0.0, 2.0, 5.0, scope="breath", scan=(2.0, -2.0)),
            Parameter("onset", "s", "after the first sample",
                      0.0, 2.5, 0.3, 0.3, 0.3, scope="breath",
                      scan=(0.05, 0.3, 0.6, 0.9, 1.2, 1.6)),
            Parameter("duration", "s", "of the effort", 0.2, 2.0, 0.8, 0.8, 0.8),
            Parameter("relaxing", "1",
                      "0 for half a sine, 1 for a muscle that relaxes exponentially after its peak",
                      0.0, 1.0, 0.0, 0.0, 0.0, shape=True, grid=(0.0, 1.0)),
        ),
        source="Half-sine muscle pressure, as active lung simulators take it: 1 to 15 cmH2O for "
        "0.4 to 1.2 s; inspiratory muscles relax exponentially, with time constants of 0.05 to 0.2 "
        "s (S. A. Esau et al., J. Appl. Physiol. 55, 1983, 731).",
        signature="A dent in pressure that the commands do not explain and that differs from "
        "breath to breath: absent in some, early or late in others.",
        confusable=("a source at the alveolus that repeats in every breath",), detectable=0.3,
        least=0.5, least_reason="a muscle pressure that a trigger would hardly see",
    )  # fmt: skip

    def network(self, values: Values, network: Network, view: View) -> Network:
        """Subtract the pressure of the muscles from the recoil."""
        phase = (view.time - values["onset"]) / values["duration"]
        sine = jnp.sin(jnp.pi * jnp.clip(phase, 0.0, 1.0))
        rise = jnp.sin(0.5 * jnp.pi / _PEAK * jnp.clip(phase, 0.0, _PEAK))
        muscle = rise * jnp.exp(-jnp.maximum(phase - _PEAK, 0.0) / _RELAXING)
        course = sine + values["relaxing"] * (muscle - sine)
        return network.plus(recoil=-values["amplitude"] * course)
