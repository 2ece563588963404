"""The tubing takes up gas as pressure rises."""

from ventbench.physics.mechanism import Description, Mechanism, Network, Parameter, Values, View


class CircuitCompliance(Mechanism):
    """A compliance at the airway, in parallel to the lung."""

    description = Description(
        name="circuit_compliance", title="compliance of the circuit", site="circuit",
        equation="C_circuit dp/dt = q_in - q_lung - q_out",
        parameters=(
            Parameter("compliance", "mL/cmH2O", "of tubing, humidifier and dead space",
                      0.0, 10.0, 0.0, 1.2, 3.0),
        ),
        source=(
            "Gas that stays in the tubing as pressure rises; 0.5 to 3 mL/cmH2O for adult circuits."
        ),
        signature="Edges of pressure are rounded, the more the higher R, in inspiration and at the "
        "start of expiration.",
        confusable=("valve_lag", "sensor_lag"), detectable=0.4, least=0.3,
        least_reason="a syringe's worth of tubing; less moves no edge of 30 samples a second",
        ubiquitous=True,
    )  # fmt: skip

    # Behind 5 cmH2O/(L/s) it fills within 15 ms: at 7 ms a step, a fit finds 3 % too much of it.
    divisions = 2

    def network(self, values: Values, network: Network, view: View) -> Network:
        """Add the circuit's compliance beside the lung."""
        return network.plus(circuit=1e-3 * values["compliance"])
