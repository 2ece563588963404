"""Units of measured columns: exact factors to those of the schema, and how headers spell them."""

from __future__ import annotations

import re
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from ventbench.base.arrays import Floats
from ventbench.base.errors import InputError

#: Pascal in a centimetre of water (conventional, at 4 degrees Celsius) and of other units.
_PASCAL = {
    "cmH2O": Fraction("98.0665"),
    "mbar": Fraction(100),
    "hPa": Fraction(100),
    "kPa": Fraction(1000),
    "Pa": Fraction(1),
    "mmHg": Fraction("133.322387415"),
    "mmH2O": Fraction("9.80665"),
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

#: Other spellings, without blanks and in lower case. Standard litres are taken as litres.
_SPELLINGS = {
    "lpm": "L/min", "slpm": "L/min", "slm": "L/min", "sl/min": "L/min", "nl/min": "L/min",
    "lps": "L/s", "lmin-1": "L/min", "ls-1": "L/s", "mls-1": "mL/s", "mlps": "mL/s",
    "cmh20": "cmH2O", "sec": "s", "seconds": "s",
    "secs": "s", "msec": "ms", "millis": "ms", "milliseconds": "ms", "µs": "us", "μs": "us",
    "percent": "%", "0..1": "1", "0-1": "1", "minutes": "min",
}  # fmt: skip


@dataclass(frozen=True)
class Conversion:
    """An exact change of units."""

    unit: str  #: unit in the file.
    to: str  #: unit of the schema.
    factor: Fraction  #: one ``unit`` in ``to``; its reciprocal is the exact way back.

    def apply(self, values: Floats) -> Floats:
        """Convert; one rounding to the nearest number at most for each of two integers."""
        return np.asarray(values, float) * self.factor.numerator / self.factor.denominator

    def __str__(self) -> str:
        """The change in words, with the way back."""
        if self.factor == 1:
            return self.to
        return f"{self.unit} -> {self.to}, x {_in_words(self.factor)} (back: x {_in_words(1 / self.factor)})"  # noqa: E501


def conversion(role: str, unit: str | None) -> Conversion:
    """Return the change from a unit of a role in :data:`UNITS` to the schema's, which None is.

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


def in_file_unit(change: Conversion, pascal: float) -> float:
    """A pressure in the unit of a file."""
    return pascal / float(_PASCAL[change.unit])


def spelled(unit: str) -> str:
    """Return the usual spelling of a unit, or the unit as it is if it is not known."""
    plain = re.sub(r"[\s·*^_]", "", unit.strip().strip("[](){}<>")).replace("per", "/")
    return _SPELLINGS.get(plain.lower(), _BY_LOWER.get(plain.lower(), unit.strip()))


_BY_LOWER = {unit.lower(): unit for units in UNITS.values() for unit in units}


def is_unit(text: str) -> bool:
    """Whether a text spells a known unit."""
    return spelled(text) in _BY_LOWER.values() and spelled(text) != "1"


def unit_of(header: str) -> tuple[str, str | None]:
    """Split a header into its name and its unit, if it has one.

    ``Flow [L/min]`` and ``Flow, L/min`` are ``Flow``; ``Flow_LPM`` keeps its whole name.
    """
    header = header.strip()
    match = re.fullmatch(r"(.+?)\s*[\[({<]([^\])}>]*)[\])}>]", header)
    if match is not None:
        return match[1].strip(" _,"), spelled(match[2]) if match[2].strip() else None
    match = re.fullmatch(r"(.*[^\s_,;:./-])([\s_,;:.-]+)(\S+)", header)
    if match is None or not is_unit(match[3]):
        return header, None
    return header if match[2] in "_.-" else match[1], spelled(match[3])


def stem(name: str) -> str:
    """The name of a column in lower case, without its unit, blanks and marks."""
    match = re.fullmatch(r"(.+)[\s_,;:.-]+(\S+)", name.strip())
    if match is not None and is_unit(match[2]):
        name = match[1]
    return re.sub(r"[^\w]|_", "", name.rpartition(".")[2] or name).lower()


def _in_words(factor: Fraction) -> str:
    if factor.denominator == 1 or factor.numerator == 1 or factor.denominator < 1000:
        return str(factor)
    return f"{float(factor):.10g}"
