"""Which files make up a leaderboard; whatever else lies in its folder is refused, never published.

The job that publishes has nothing but Python's standard library, so this module needs no more.
"""

from __future__ import annotations

import json
import os
import re
import tomllib
from collections.abc import Iterable
from pathlib import Path

#: Folder of records and commands within the leaderboard's.
RECORDS = "records"

#: Name of the chain's file.
CHAIN = "chain.jsonl"

#: The page that every leaderboard has.
INDEX = "index.html"

#: End of the name of a record, of its commands and of its signature, after a SHA-256.
RECORD_SUFFIX, ACTIONS_SUFFIX, SIGNATURE_SUFFIX = ".json", ".actions", ".sig"

#: End of the name of a sealed record's ciphertext, which stands in the place of its commands.
SEALED_SUFFIX = ".sealed"

#: Folder of the season files.
SEASONS = "seasons"
#: End of the name of a season's reference errors, encrypted until the season is over.
REFERENCE_SUFFIX = ".reference"
_SEASON = re.compile(rf"{SEASONS}/[a-z0-9][a-z0-9-]{{0,39}}(\.toml|{re.escape(REFERENCE_SUFFIX)})")

#: Keys that sign records, and records that count as official without a signature.
KEYS, ACCEPTED = "keys.toml", "accepted.toml"

#: What a build writes: CSV, pages of versions, pages of entries.
BUILT = re.compile(
    r"index\.html|leaderboard\.csv|version-[0-9]{1,9}\.html"
    r"|entries/v[0-9]{1,9}/(performance|robustness)/[a-z][a-z0-9_]{0,39}\.html"
)

_SHA256 = re.compile(r"[0-9a-f]{64}")


def files_of_chain(chain: bytes) -> set[str]:
    """Relative paths of the records, commands and signatures that a chain names.

    Args:
        chain: content of the file; its lines are checked elsewhere, and what is no line of a
            chain names nothing.
    """
    names: set[str] = set()
    for line in chain.splitlines():
        try:
            link = json.loads(line)
        except (ValueError, RecursionError):
            continue
        if not isinstance(link, dict):
            continue
        for key, suffixes in (
            ("record", (RECORD_SUFFIX, SIGNATURE_SUFFIX)),
            ("actions", (ACTIONS_SUFFIX, SEALED_SUFFIX)),
        ):
            sha256 = link.get(key)
            if isinstance(sha256, str) and _SHA256.fullmatch(sha256):
                names |= {f"{RECORDS}/{sha256}{suffix}" for suffix in suffixes}
    return names


def stray(names: Iterable[str], chain: bytes) -> list[str]:
    """Relative paths that belong to no leaderboard with this chain, sorted.

    A page may have the name of a built one and still be none; a rebuild shows that.
    """
    known = {CHAIN, KEYS, ACCEPTED} | files_of_chain(chain)
    return sorted(
        name
        for name in names
        if name not in known and not BUILT.fullmatch(name) and not _SEASON.fullmatch(name)
    )


def is_season(name: str) -> bool:
    """Whether a relative path is that of a season file or its reference errors."""
    return _SEASON.fullmatch(name) is not None


def same_season(published: bytes, now: bytes) -> bool:
    """Whether a season file is still the published one, but for a seed that joined it.

    Args:
        published: its content as published.
        now: its content.
    """
    try:
        before, after = (tomllib.loads(text.decode("utf-8")) for text in (published, now))
    except (ValueError, RecursionError):
        return published == now
    if "seed" not in before:
        after.pop("seed", None)
    return before == after


def walk(folder: Path) -> tuple[set[str], list[str]]:
    """List a folder without following links.

    Returns:
        Relative paths of plain files, and those of links, devices and the like.
    """
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
