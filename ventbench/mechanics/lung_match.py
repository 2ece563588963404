"""Estimates with intervals, and a lung compared with its label."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Estimate:
    """Value of a parameter with the ends of its 95 % interval, all in ``unit``."""

    value: float
    unit: str
    ci95: tuple[float, float]


@dataclass(frozen=True)
class LungMatch:
    """The lung that was recorded, compared with its label; R in cmH2O s/L, C in mL/cmH2O.

    Attributes:
        label: id of the lung in the recording, such as ``R20C50``.
        fitted_R: resistance.
        fitted_C: compliance.
        ci95_R: ends of the 95 % interval of R.
        ci95_C: ends of the 95 % interval of C.
        label_matches: whether R and C are within tolerance of the label.
        source: ``pressure`` (given the valve's gain) or ``pressure and flow``.
        settings: ids of known settings that the lung may be, the nearest first.
    """

    label: str
    fitted_R: float
    fitted_C: float
    ci95_R: tuple[float, float]
    ci95_C: tuple[float, float]
    label_matches: bool
    source: str
    settings: tuple[str, ...] = ()
