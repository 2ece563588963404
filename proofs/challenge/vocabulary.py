"""The published vocabulary of the challenge: what may be missing, where it acts, its parameters.

A *term* of an answer is a name, or ``unknown:PLACE`` for an effect without a name. The vocabulary
itself is ``vocabulary.toml``.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import msgspec


class Name(msgspec.Struct, frozen=True):
    """A name of the vocabulary."""

    place: str  #: where it acts, one of :data:`PLACES`.
    meaning: str  #: in words.
    parameters: dict[str, str]  #: unit of each parameter, the strength first.


#: The vocabulary as JSON values, as every case holds it.
PUBLISHED: dict[str, Any] = tomllib.loads(Path(__file__).with_suffix(".toml").read_text("utf-8"))

#: Parts of the rig, from the supply to the log.
PLACES: tuple[str, ...] = tuple(PUBLISHED["places"])

VOCABULARY: dict[str, Name] = msgspec.convert(PUBLISHED["names"], dict[str, Name])

#: Prefix of a term without a name.
UNKNOWN = "unknown:"

TERMS: frozenset[str] = frozenset(VOCABULARY) | {UNKNOWN + place for place in PLACES}

#: Paths of the parameters that an answer may give.
PARAMETERS: frozenset[str] = frozenset({"R", "C"}) | {
    f"{name}.{key}" for name, about in VOCABULARY.items() for key in about.parameters
}


def place_of(term: str) -> str:
    """Where a term acts."""
    return term.removeprefix(UNKNOWN) if term.startswith(UNKNOWN) else VOCABULARY[term].place
