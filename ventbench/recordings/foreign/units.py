"""Units of other laboratories, as exact factors to the units of the schema."""

from __future__ import annotations

import re
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from ventbench.errors import InputError

#: Pascal in a centimetre of water (conventional, at 4 degrees Celsius) and of other units.
_PASCAL = {
    "cmH2O": Fraction("98.0665"),
    "mbar": Fraction(100),
    "hPa": Fraction(100),
    "kPa": Fraction(1000),
    "Pa": Fraction(1),
    "mmHg": Fraction("133.322387415"),
    "psi": Fraction("6894.757293168"),
}

#: Factors to the schema's unit, which is the first of each role.
UNITS: dict[str, dict[str, Fraction]] = {
    "pressure": {name: value / _PASCAL["cmH2O"] for name, value in _PASCAL.items()},
    "flow": {
        "mL/s": Fraction(1),
        "L/s": Fraction(1000),
        "L/min": Fraction(50, 3),
        "mL/min": Fraction(1, 60),
        "L/h": Fraction(5, 18),
    },
    "volume": {"mL": Fraction(1), "L": Fraction(1000)},
    "time": {
        "s": Fraction(1),
        "ms": Fraction(1, 1000),
        "us": Fraction(1, 1_000_000),
        "min": Fraction(60),
    },
    "u_in": {"%": Fraction(1), "1": Fraction(100)},
}

_SPELLINGS = {
    "lpm": "L/min", "slpm": "L/min", "l/min": "L/min", "lps": "L/s", "l/s": "L/s", "ml/s": "mL/s",
    "ml/min": "mL/min", "cmh2o": "cmH2O", "cm h2o": "cmH2O", "cmh20": "cmH2O", "ml": "mL",
    "l": "L", "sec": "s", "seconds": "s", "msec": "ms", "µs": "us", "percent": "%", "0..1": "1",
    "0-1": "1", "hpa": "hPa", "kpa": "kPa", "pa": "Pa", "mmhg": "mmHg", "l/h": "L/h",
}  # fmt: skip


@dataclass(frozen=True)
class Conversion:
    """An exact change of units.

    Attributes:
        unit: unit in the file.
        to: unit of the schema.
        factor: one ``unit`` in ``to``; its reciprocal is the exact way back.
    """

    unit: str
    to: str
    factor: Fraction

    def apply(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert; one rounding to the nearest number at most for each of two integers."""
        return _times(values, self.factor)

    def invert(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert back to the unit of the file."""
        return _times(values, 1 / self.factor)

    def __str__(self) -> str:
        """The change in words, with the way back."""
        if self.factor == 1:
            return self.to
        return f"{self.unit} -> {self.to}, x {_in_words(self.factor)} (back: x {_in_words(1 / self.factor)})"  # noqa: E501


def conversion(role: str, unit: str | None) -> Conversion:
    """Return the change from a unit to the schema's.

    Args:
        role: ``pressure``, ``flow``, ``volume``, ``time`` or ``u_in``.
        unit: unit in the file; that of the schema if None.

    Raises:
        InputError: if the role has no such unit.
    """
    known = UNITS[role]
    to = next(iter(known))
    name = to if unit is None else spelled(unit)
    if name not in known:
        raise InputError(
            f"{unit!r} is no unit of {role} that is known; choose one of {', '.join(known)}"
        )
    return Conversion(name, to, known[name])


def spelled(unit: str) -> str:
    """Return the usual spelling of a unit."""
    plain = re.sub(r"\s+", " ", unit.strip().strip("[]()")).strip()
    return _SPELLINGS.get(plain.lower(), plain)


def unit_of(header: str) -> tuple[str, str | None]:
    """Split a header such as ``Flow [L/min]`` into its name and its unit, if it has one."""
    match = re.fullmatch(r"\s*(.*?)\s*[\[(]([^\])]*)[\])]\s*", header)
    if match is None or not match[1]:
        return header.strip(), None
    return match[1], spelled(match[2])


def _times(values: NDArray[np.float64], factor: Fraction) -> NDArray[np.float64]:
    return np.asarray(values, float) * factor.numerator / factor.denominator


def _in_words(factor: Fraction) -> str:
    if factor.denominator == 1 or factor.numerator == 1 or factor.denominator < 1000:
        return str(factor)
    return f"{float(factor):.10g}"
