"""What a concealed recording is made of."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

Strength = Literal["mild", "strong"]
Style = Literal["pi", "mixed"]


@dataclass(frozen=True)
class Effect:
    """A piece of physics that the rig has beyond resistance and compliance.

    Attributes:
        name: of the library's mechanism, or of one outside it.
        strength: about how much of it.
        form: of its equation; see :mod:`~ventbench.validation.challenge.forms`.
        parameters: of that form; units as in the library, times in s, lengths of command in %.
    """

    name: str
    strength: Strength
    form: str
    parameters: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Base:
    """The rig without any effect, as it truly is.

    Attributes:
        R: airway resistance, cmH2O s/L.
        C: compliance, mL/cmH2O.
        R_ex: resistance of the expiratory valve, cmH2O s/L.
        peep: behind it, cmH2O.
        gain: flow of the inspiratory valve, mL/s per %.
    """

    R: float
    C: float
    R_ex: float = 5.0
    peep: float = 5.0
    gain: float = 22.8


@dataclass(frozen=True)
class Case:
    """One recording.

    Attributes:
        name: of its file.
        lung_R: label of the lung setting, cmH2O s/L.
        lung_C: label of the lung setting, mL/cmH2O.
        effects: what is concealed in it.
        base: the rig; drawn anew by each recording if None.
        noise: standard deviation of the sensor's noise, cmH2O.
        coloured: share of its variance that is correlated from sample to sample, 0..1.
        correlation: of that share, from one sample to the next.
        step: of the sensor's converter, cmH2O; 0 for none.
        jitter: standard deviation of the sampling interval, s.
        breaths: how many.
        samples: of a breath.
        style: ``pi``: closed loop only; ``mixed``: half of the breaths explore.
        log_step: grid of the commands, %; the rig gets what is logged.
    """

    name: str
    lung_R: float
    lung_C: float
    effects: tuple[Effect, ...] = ()
    base: Base | None = None
    noise: float = 0.2
    coloured: float = 0.0
    correlation: float = 0.6
    step: float = 0.0703
    jitter: float = 3e-4
    breaths: int = 60
    samples: int = 80
    style: Style = "mixed"
    log_step: float = 0.01

    @property
    def lung(self) -> str:
        """Label of the lung, such as ``R20C50``."""
        return f"R{self.lung_R:g}C{self.lung_C:g}"
