"""Headers of columns by a grammar: quantity, place, device, unit, direction.

A header is words and marks; its unit is the longest run of its last ones that spells one. What is
left is a quantity, with words that change nothing, or one that makes it something else. A device
stands before a mark such as ``/``. Whatever has another word in it is uncertain: it is asked for,
never guessed. Words and units are data: ``headers.toml``.
"""

from __future__ import annotations

import re
import unicodedata
from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from itertools import product

import numpy as np

from ventbench.base.arrays import Floats
from ventbench.base.errors import InputError
from ventbench.base.files import data_beside

_DATA = data_beside(__file__, "headers.toml")

#: Factors to the schema's unit, which is the first of each quantity; they are exact.
UNITS: dict[str, dict[str, Fraction]] = {
    quantity: {
        name: Fraction(size) / Fraction(next(iter(sizes.values()))) for name, size in sizes.items()
    }
    for quantity, sizes in _DATA["units"].items()
}

#: Sizes of a ventilator's signals, in the schema's unit, and units that are taken for one another.
USUAL: dict[str, tuple[float, float, list[str]]] = _DATA["usual"]

#: Numbers at which clocks begin anew, in the unit of the file.
WRAPS: list[int] = _DATA["clocks"]["wraps"]


@dataclass(frozen=True)
class States:
    """Two words in cells for a valve that is open or not."""

    one: str  #: for open; of a phase, for expiration.
    zero: str  #: for closed; of a phase, for inspiration.
    phase: bool  #: whether they are phases of the breath.


#: By the pair of words in lower case.
STATES: dict[frozenset[str], States] = {
    frozenset(pair.split()): States(*pair.split(), phase=kind == "expiration")
    for kind, pairs in _DATA["states"].items()
    for pair in pairs
}


@dataclass(frozen=True)
class Conversion:
    """An exact change of units."""

    unit: str  #: unit in the file.
    to: str  #: unit of the schema.
    factor: Fraction  #: one ``unit`` in ``to``; its reciprocal is the exact way back.
    stated: bool = True  #: whether anybody said the unit; else it is taken for the schema's.

    def apply(self, values: Floats) -> Floats:
        """Convert; one rounding to the nearest number at most for each of two integers."""
        values = np.asarray(values, float)
        if self.factor == 1:
            return values
        return values * self.factor.numerator / self.factor.denominator

    def __str__(self) -> str:
        """The change in words, with the way back."""
        if self.factor == 1:
            return self.to
        forth, back = _in_words(self.factor), _in_words(1 / self.factor)
        return f"{self.unit} -> {self.to}, x {forth} (back: x {back})"


def conversion(quantity: str, unit: str | None) -> Conversion:
    """Return the change from a unit of a quantity in :data:`UNITS` to the schema's (None).

    Raises:
        InputError: if the quantity has no such unit.
    """
    spellings = UNITS[quantity]
    to = next(iter(spellings))
    name = to if unit is None else _spelled(quantity).get(_key(unit), unit)
    if name not in spellings:
        raise InputError(
            f"{unit!r} is no unit of {quantity} that is known; choose one of {', '.join(spellings)}"
        )
    return Conversion(name, to, spellings[name], unit is not None)


def _in_words(factor: Fraction) -> str:
    if factor.denominator == 1 or factor.numerator == 1 or factor.denominator < 1000:
        return str(factor)
    return f"{float(factor):.10g}"


@cache
def _spelled(quantity: str) -> dict[str, str]:
    """Units of a quantity by every spelling of theirs."""
    atoms = {unit: {unit, *synonyms.split()} for unit, synonyms in _DATA["spellings"].items()}
    table: dict[str, str] = {}
    for unit in UNITS[quantity]:
        over, _, under = unit.partition("/")
        ways = atoms.get(unit, {unit})
        if under:
            pairs = product(atoms[over], ("", "per", "p"), atoms[under], ("", "1"))
            ways = (
                ways
                | {"".join(parts) for parts in pairs}
                | {f"{x}p{under[0]}" for x in atoms[over]}
            )
        table |= {_key(spelling): unit for spelling in ways}
    return table


def _key(text: str) -> str:
    """A unit without case and marks."""
    plain = unicodedata.normalize("NFKC", text.strip()).lower()
    return plain if plain == "%" else re.sub(r"[^\w%]|_", "", plain)


def known_words(text: str) -> int:
    """How many words of headers stand somewhere in a text."""
    plain = _plain(text).casefold()
    return sum(word in plain for word in _KINDS)


@cache
def is_unit(text: str) -> bool:
    """Whether a text spells a unit of some quantity."""
    return _key(text) != "1" and any(_key(text) in _spelled(quantity) for quantity in UNITS)


@dataclass(frozen=True)
class Header:
    """What a header says."""

    name: str  #: the header without a unit in brackets or behind a comma.
    role: str | None = None  #: what the column may be, or None.
    unit: str | None = None  #: its unit, or None.
    side: str = ""  #: ``in`` or ``out`` of a flow or a valve in one direction.
    certain: bool = False  #: whether every part of the header was understood.
    interval: float | None = None  #: s between samples, where the header says it.

    @property
    def excluded(self) -> bool:
        """Whether a word makes the column something else than a waveform at the airway."""
        return any(_KINDS.get(word, ("", ""))[0] == "others" for word in _words(self.name))


_KINDS = {
    word: (kind, name)
    for kind in ("words", "places", "sides", "others")
    for name, words in _DATA[kind].items()
    for word in words.split()
}
_LETTERS = {letter: name for name, letter in _DATA["letters"].items()}

#: A derivative as it is printed: V', V with a dot, dV/dt.
_DOTTED = re.compile(r"(?<![^\W_])(?:d([vq])\s*/\s*dt|([vq])\s*(?:['’‘′`´]|\u0307))", re.I)
_SAMPLED = re.compile(r"(.*[^\W\d].*?)[\s._-]*\b(\d+(?:\.\d+)?)\s*(ms|hz)", re.I)
_BRACKETS = re.compile(r"[\[({<]([^\[({<\])}>]*)[\])}>]")
_PATH = re.compile(r"[/:|.\\]+")


@cache
def read_header(text: str) -> Header:
    """Read a header.

    Example:
        >>> read_header("Flow_L_min").role, read_header("Flow_L_min").unit
        ('flow', 'L/min')
    """
    plain = unicodedata.normalize("NFKC", text).strip()
    plain = _DOTTED.sub(lambda matched: f" {(matched[1] or matched[2]).lower()}dot ", plain).strip()
    interval = None
    if (sampled := _SAMPLED.fullmatch(plain)) is not None:
        number, plain = float(sampled[2]), sampled[1]
        interval = 1.0 / number if sampled[3].lower() == "hz" else 0.001 * number
    name, rest, unit = _unit_apart(text, plain)
    role, side, certain = _meaning(rest, unit)
    tables = [_spelled(q) for q in ([role] if role in UNITS else UNITS)]
    canonical = next((t[_key(unit)] for t in tables if unit and _key(unit) in t), unit)
    return Header(name, role, canonical, side, certain, interval)


def _unit_apart(text: str, plain: str) -> tuple[str, str, str | None]:
    """Name of a header, its text without a unit, and the unit: in brackets, or its last words."""
    bracketed = [inside for inside in _BRACKETS.findall(plain) if inside.strip()]
    units = [inside for inside in bracketed if is_unit(inside)]
    bare = _BRACKETS.sub(" ", plain).strip(" ,;")
    rest = " ".join([bare, *(inside for inside in bracketed if inside not in units)])
    stripped = text.strip()
    if units:
        matched = next(x for x in _BRACKETS.finditer(text) if is_unit(x[1]))
        short = (text[: matched.start()] + text[matched.end() :]).strip(" _,;")
        return short or stripped, rest, units[0]
    for at in sorted(
        {matched.start() for matched in re.finditer(r"(?<![^\W_])\w|(?<=[a-z])[A-Z]|%", rest)}
    ):
        tail, before = rest[at:], rest[:at]
        alone = not before.strip(" _,;:.-/")
        spelled = is_unit(tail) and not (alone and (len(tail) < 2 or tail.lower() in _KINDS))
        if spelled and _meaning(before, tail)[2]:
            comma = re.search(r"[,;]\s*$|\s$", before) is not None
            short = before.strip(" ,;") if comma and before.strip(" ,;") in text else stripped
            return short, before, tail
    return stripped, rest, None


def _meaning(text: str, unit: str | None) -> tuple[str | None, str, bool]:
    """Role, direction, and whether all of a name was understood; it has the unit, or none."""
    measured = [q for q in UNITS if unit is not None and _key(unit) in _spelled(q)]
    *devices, last = [_words(part) for part in _PATH.split(text) if part.strip(" _-")] or [[]]
    # A device may have any name.
    spoken = [part for part in devices if all(w in _KINDS or w in _LETTERS for w in part)]
    words = [word for part in spoken for word in part] + last
    if "".join(words) in _KINDS:
        words = ["".join(words)]
    letters = [w for w in words if w in _LETTERS and w not in _KINDS]
    kinds = [_KINDS.get(w, ("", "")) for w in words if w not in letters and not w.isdigit()]
    names = {name for kind, name in kinds if kind == "words"}
    sides = {name for kind, name in kinds if kind == "sides"}
    certain = len(sides) < 2 and not any(kind in ("", "others") for kind, _ in kinds)
    if len(letters) == 1 and not names:
        role = _LETTERS[letters[0]]
        names = set(measured[:1] or [role])
        certain &= role not in ("R", "C", "f") or len(words) == 1
    elif letters:
        certain = False
    elif all(map(str.isdigit, words)):  # a unit alone, or beside a number
        names = set(measured[:1])
    side = next(iter(sides)) if len(sides) == 1 else ""
    if names == {"valve"} and side:
        names, side = {f"u_{side}"}, ""
    role = next(iter(names)) if len(names) == 1 else None
    certain &= not side or role == "flow"
    certain &= not measured or role in measured
    if role in (None, "valve", "f") or any(kind == "others" for kind, _ in kinds):
        return None, "", False
    return role, side, certain


def _words(text: str) -> list[str]:
    """Words of a name: parted by marks and by capitals, or made of words that are known."""
    words = []
    for part in re.findall(r"[^\W_]+", _plain(text)):
        if part.lower() in _KINDS or part.lower() in _LETTERS:
            words.append(part.lower())
            continue
        for piece in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[^\WA-Z\d_]+|\d+", part):
            words += _parted(piece.casefold())
    return words


def _plain(text: str) -> str:
    """A text without accents, and without the letters of Turkish and Polish that have a stroke."""
    letters = unicodedata.normalize("NFD", text.translate(str.maketrans("ıłŁ", "ilL")))
    return unicodedata.normalize("NFC", re.sub("[\u0300-\u036f]", "", letters))


@cache
def _parted(word: str) -> tuple[str, ...]:
    """A word as known ones that are written together, such as ``airwaypressure`` and ``paw``."""
    if word in _KINDS or word in _LETTERS or word.isdigit():
        return (word,)
    if word[:1] in _LETTERS and word[1:] in _KINDS:
        return word[:1], word[1:]
    for at in range(len(word) - 2, 2, -1):
        rest = _parted(word[at:])
        if word[:at] in _KINDS and all(part in _KINDS for part in rest):
            return word[:at], *rest
    return (word,)
