"""Tissue relaxes: part of the recoil fades."""

from jax import Array

from ventbench.physics.mechanism import Description, Mechanism, Network, Parameter, Values, View


class Viscoelasticity(Mechanism):
    """A spring with a dashpot beside the lung's elastance."""

    description = Description(
        name="viscoelasticity", title="stress relaxation of the tissue", site="alveolus",
        equation="dS/dt = ratio / C Q - S / time, P = V / C + S",
        parameters=(
            Parameter("ratio", "1", "elastance of the Maxwell element over that of the lung",
                      0.0, 1.5, 0.0, 0.25, 0.7),
            Parameter("time", "s", "its relaxation time",
                      0.1, 5.0, 1.0, 1.0, 1.0, "log", grid=(0.2, 0.5, 1.5)),
        ),
        source="Maxwell element beside the elastance (Bates, Lung Mechanics, Cambridge 2009): "
        "ratio 0.05 to 0.7, 0.3 to 2 s. A second compartment has an impedance of the same order.",
        signature="Pressure creeps down while volume is held and lags behind slow changes, in "
        "inspiration and expiration; nearly all of it can hide in R and C.",
        confusable=("leak", "supply_droop"), detectable=0.02, least=0.04,
        least_reason="creep below that of rubber bellows", special_case_of=("recoil_memory",),
        # Its slow stress trades against C, and what is left of another mechanism's form decides.
        beside_error=0.2, equivalents=("second_compartment",),
    )  # fmt: skip

    stateful = True

    def network(self, values: Values, network: Network, view: View) -> Network:
        """Stress after the step: the relaxed stress and what the flow adds."""
        left = 1.0 / (1.0 + view.length / values["time"])
        elastance = values["ratio"] * view.elastance * left
        return network.plus(recoil=view.state * left, elastance=elastance)

    def next_state(self, values: Values, state: Array, flow: Array, view: View) -> Array:
        """Stress, cmH2O."""
        gained = view.length * values["ratio"] * view.elastance * flow
        return (state + gained) / (1.0 + view.length / values["time"])
