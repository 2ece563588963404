"""What changes in the course of a session: a step between two breaths, or a drift over all.

The position of a breath in its recording is 0 for the first and 1 for the last. A step has set in
after the position ``at``. A drift sets in steadily, or fades, as what warms up does.
"""

import jax.numpy as jnp
import numpy as np
from jax import Array

from ventbench.base.files import data_beside
from ventbench.physics.mechanism import Description, Mechanism, Parameter, Site, Values

#: Added to the fading, so that a steady drift is no division by zero.
_STEADY = 1e-4

#: Where a step is, which a fit finds by trying each breath; there is no slope towards it.
_AT = Parameter(
    "at",
    "1",
    "position of the change between two breaths of the recording, 0..1",
    0.0,
    1.0,
    0.5,
    0.5,
    0.5,
    spread=np.inf,
    change_point=True,
)

#: How a drift fades.
_WARMING = Parameter(
    "warming",
    "1",
    "times that the drift fades by e in the recording; 0: it is steady",
    0.0,
    10.0,
    0.0,
    0.0,
    0.0,
    shape=True,
)

_POSITION = "x = position of the breath in the recording, 0..1"
_GROWN = f"g = (1 - exp(-warming x)) / (1 - exp(-warming)), {_POSITION}"


def _since(values: Values, position: Array) -> Array:
    """Share of a change that has set in at a position of the recording, 0..1."""
    if "at" in values:
        return jnp.where(position > values["at"], 1.0, 0.0)
    fading = values["warming"] + _STEADY
    return jnp.expm1(-fading * position) / jnp.expm1(-fading)


class ChangedParameter(Mechanism):
    """A parameter of the base model that changes by a share of itself."""

    uses_position = True

    def __init__(self, description: Description, path: str) -> None:
        """Describe a change of the base parameter ``path``."""
        self.description, self._path = description, path

    def of_breath(self, values: Values, base: Values) -> Values:
        """The parameter at the breath."""
        changed = 1.0 + values["change"] * _since(values, base["position"])
        return {**base, self._path: base[self._path] * changed}


class SensorChange(Mechanism):
    """A zero of the pressure sensor that changes, and perhaps its gain."""

    rank = 1
    uses_position = True

    def __init__(self, description: Description) -> None:
        """Describe the change; its strength is that of the zero, cmH2O."""
        self.description = description

    def sensor_output(self, values: Values, pressure: Array, position: Array) -> Array:
        """Pressure as it is shown."""
        share = _since(values, position)
        gain, zero = values.get("gain", 0.0), values[self.description.strength.name]
        return pressure * (1.0 + gain * share) + zero * share

    def sensor_input(self, values: Values, recorded: Array, position: Array) -> Array:
        """True pressure of a reading."""
        share = _since(values, position)
        gain, zero = values.get("gain", 0.0), values[self.description.strength.name]
        return (recorded - zero * share) / (1.0 + gain * share)


def _pair(
    path: str,
    short: str,
    words: str,
    site: Site,
    bounds: tuple[float, float],
    sizes: tuple[float, float],
    least: float,
    reason: str,
    step: str,
    drift: str,
    sign: str,
    confusable: tuple[tuple[str, ...], tuple[str, ...]],
) -> tuple[ChangedParameter, ChangedParameter]:
    """A step and a drift of one parameter; ``step`` and ``drift`` are their sources."""
    mild, scan = sizes[0], (sizes[0], -sizes[0])

    def described(
        kind: str, title: str, equation: str, form: Parameter, source: str, signature: str
    ) -> Description:
        when = "before" if kind == "step" else "from the first breath to the last"
        change = Parameter(
            "change",
            "1",
            f"change, as a share of {path} {when}",
            *bounds,
            0.0,
            mild,
            sizes[1],
            scan=scan if kind == "step" else (),
            share=True,
        )
        return Description(
            name=f"{short}_{kind}",
            title=title,
            site=site,
            equation=equation,
            parameters=(change, form),
            confusable=confusable[kind == "drift"],
            least=least,
            least_reason=reason,
            source=source,
            signature=signature,
        )

    return (
        ChangedParameter(
            described(
                "step",
                f"step of the {words}",
                f"{path} = {path} (1 + change) where x > at, {_POSITION}",
                _AT,
                source=step,
                signature=f"From one breath on, {sign}.",
            ),
            path,
        ),
        ChangedParameter(
            described(
                "drift",
                f"drift of the {words}",
                f"{path} = {path} (1 + change g), {_GROWN}",
                _WARMING,
                source=drift,
                signature=f"With the number of the breath, {sign} more or less.",
            ),
            path,
        ),
    )


MECHANISMS = (
    *(x for path, row in data_beside(__file__, "session.toml").items() for x in _pair(path, **row)),
    SensorChange(
        Description(
            name="zero_step",
            title="step of the pressure sensor's zero",
            site="sensor",
            equation=f"y = p + change where x > at, {_POSITION}",
            parameters=(
                Parameter(
                    "change",
                    "cmH2O",
                    "change of the offset",
                    -8.0,
                    8.0,
                    0.0,
                    1.2,
                    3.0,
                    scan=(1.2, -1.2),
                ),
                _AT,
            ),
            source="A sensor that is zeroed, knocked or plugged in anew between two breaths.",
            signature="From one breath on, an error that is the same at all samples.",
            confusable=("sensor_drift", "a PEEP that is set anew"),
            least=0.15,
            least_reason="two steps of a usual converter",
        )
    ),
    SensorChange(
        Description(
            name="sensor_drift",
            title="drift of the pressure sensor",
            site="sensor",
            equation=f"y = p (1 + gain g) + drift g, {_GROWN}",
            parameters=(
                Parameter(
                    "drift",
                    "cmH2O",
                    "change of the offset from the first breath to the last",
                    -8.0,
                    8.0,
                    0.0,
                    1.2,
                    3.0,
                ),
                Parameter(
                    "gain",
                    "1",
                    "change of the gain over the recording",
                    -0.3,
                    0.3,
                    0.0,
                    0.0,
                    0.0,
                    shape=True,
                    share=True,
                ),
                _WARMING,
            ),
            source="Temperature and ageing of piezoresistive sensors between two zeroings: up to 3 "
            "cmH2O a recording.",
            signature=(
                "An error that grows with the number of the breath, the same at all its samples."
            ),
            confusable=("zero_step", "a PEEP that changes during the recording"),
            least=0.15,
            least_reason="two steps of a usual converter",
            special_case_of=("drift_shape",),
        )
    ),
)
