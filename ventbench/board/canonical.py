"""Canonical JSON, one text for a value, and the files of a leaderboard that its SHA-256 names.

ASCII, keys sorted, no spaces, floats in the shortest form that reads back as the same float (as
Python and JavaScript print them), no NaN, no infinity, one line that ends with a newline. The bytes
of a file are what is hashed, so that ``sha256sum FILE`` gives its name.

The job that publishes has nothing but Python's standard library, so this module needs no more.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ventbench.base.errors import InputError

#: Folder of records, commands and signatures within the leaderboard's.
RECORDS = "records"

#: End of the name of a record, of its commands and of its signature, after a SHA-256.
RECORD_SUFFIX, ACTIONS_SUFFIX, SIGNATURE_SUFFIX = ".json", ".actions", ".sig"

#: Keys that sign records, and records that an official second run vouches for.
ATTESTATIONS = "attestations.toml"

#: Folder of rounds, the name of one, and its files in the order in which they come to be.
ROUNDS, ROUND_NAME = "rounds", "[a-z0-9][a-z0-9-]{0,39}"
ROUND_FILES = (
    "round.toml",
    "protocol.json",
    "frozen.toml",
    "beacon.json",
    "bounds.npz",
    "result.json",
)

#: Of a round too: what the maintainers say of entries, and commands of seeds.
NOTES, SEEDS = "notes.toml", "seeds.json"

#: Files that nothing else binds and a key signs, besides withdrawals: in the leaderboard's folder.
SIGNED = (ATTESTATIONS, f"{ROUNDS}/*/{ROUND_FILES[-1]}", f"{ROUNDS}/*/{NOTES}")

#: What a build writes: the page of the board, its CSV, pages of rounds, and pages of entries.
INDEX, CSV = "index.html", "leaderboard.csv"
BUILT = re.compile(
    rf"index\.html|leaderboard\.csv|rounds/{ROUND_NAME}\.html|"
    rf"entries/{ROUND_NAME}/(performance|robustness)/[a-z][a-z0-9_]{{0,39}}\.html"
)

_PART = re.compile(
    rf"attestations\.(toml|sig)|{RECORDS}/[0-9a-f]{{64}}\.(json|actions|sig)|"
    rf"{ROUNDS}/{ROUND_NAME}/"
    rf"((result|notes)\.sig|{'|'.join(map(re.escape, (*ROUND_FILES, NOTES, SEEDS)))})"
)


def canonical(value: Any) -> bytes:
    """Return the canonical text of a JSON value: dicts by text, lists or tuples, and scalars.

    Raises:
        ValueError: if a number is not finite.
        TypeError: if it holds anything else, or a key that is not text.
    """
    _only_text_keys(value)
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return text.encode("ascii") + b"\n"


def digest(content: bytes) -> str:
    """SHA-256 as hexadecimal text."""
    return hashlib.sha256(content).hexdigest()


def parse(content: bytes, label: str) -> Any:
    """Read a canonical text, and no other one: not even with a space more or a key twice.

    Raises:
        InputError: if it is not JSON, or not canonical; ``label`` names it.
    """
    try:
        value = json.loads(content)
    # ValueError: also not UTF-8, and integers of thousands of digits.
    except (ValueError, RecursionError) as error:
        why = "it is no text" if isinstance(error, UnicodeDecodeError) else error
        raise InputError(f"{label} is not JSON: {why}") from None
    try:
        same = canonical(value) == content
    except (ValueError, TypeError, RecursionError):
        same = False
    if not same:
        raise InputError(
            f"{label} is not in canonical form (keys sorted and once, no spaces, shortest floats, "
            "a newline at the end); records are written by ventbench and never edited"
        )
    return value


def through_json(value: Any) -> Any:
    """The value as a reader of its JSON gets it: tuples become lists."""
    return json.loads(canonical(value))


def _only_text_keys(value: Any) -> None:
    """Refuse keys like 1: json.dumps would turn it into "1", and so two keys into one."""
    if isinstance(value, Mapping):
        for key, part in value.items():
            if not isinstance(key, str):
                raise TypeError(f"key {key!r} is not text")
            _only_text_keys(part)
    elif isinstance(value, list | tuple):
        for part in value:
            _only_text_keys(part)


def named(name: str) -> bool:
    """Whether a relative path may be one of a leaderboard: of a record, a round, attestations."""
    return _PART.fullmatch(name) is not None


def walk(folder: Path) -> tuple[set[str], list[str]]:
    """List a folder, following no link: relative paths of plain files, and those of the rest."""
    plain: set[str] = set()
    odd: list[str] = []
    if folder.is_symlink():
        return plain, ["."]
    for parent, folders, names in os.walk(folder):
        for name in sorted([*folders, *names]):
            path = Path(parent) / name
            relative = path.relative_to(folder).as_posix()
            if path.is_symlink() or not (path.is_file() or path.is_dir()):
                odd.append(relative)
            elif path.is_file():
                plain.add(relative)
    return plain, odd
