"""The chain: one line a record in the order of arrival, each with the hash of the line before.

``chain.jsonl`` makes the order and the set of records as immutable as a record itself: nothing can
be changed, swapped or left out in the middle without changing every later line, and the last line's
hash (the *head*) stands for all of them. Only the end can be cut off unseen; whoever has noted a
head can check that it is still there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from ventbench.board import canonical, forms, record
from ventbench.errors import InputError

#: Name of the file.
FILE = "chain.jsonl"

#: Stands for the hash of the line before the first.
START = "0" * 64


@dataclass(frozen=True)
class Link:
    """One line.

    Attributes:
        index: of the line, from 0.
        record: SHA-256 of the record.
        actions: SHA-256 of its action file; None for a withdrawal.
        previous: SHA-256 of the line before, newline included.
        sha256: of this line, newline included.
    """

    index: int
    record: str
    actions: str | None
    previous: str
    sha256: str


def line(index: int, added: record.Record | record.Withdrawal, previous: str) -> bytes:
    """Return the line of a record.

    Args:
        index: of the line, from 0.
        added: the record.
        previous: SHA-256 of the line before; :data:`START` for the first.
    """
    commands = None
    if isinstance(added, record.Record):
        commands = added.content["actions"]["sha256"]
    return canonical.canonical(
        {"index": index, "record": added.sha256, "actions": commands, "previous": previous}
    )


def parse(content: bytes, label: str = FILE) -> list[Link]:
    """Read and check a chain.

    Args:
        content: of the file.
        label: names it in messages.

    Raises:
        InputError: naming the first line that is wrong.
    """
    links: list[Link] = []
    seen: set[str] = set()
    for index, text in enumerate(content.splitlines(keepends=True)):
        where = f"{label} line {index + 1}"
        values = canonical.parse(text, where)
        keys = {"index", "record", "actions", "previous"}
        if not isinstance(values, dict) or values.keys() != keys:
            raise InputError(f"{where} is not a line of a chain")
        commands = values["actions"]
        hashes = [values["record"], values["previous"], *([] if commands is None else [commands])]
        if not all(isinstance(x, str) and forms.SHA256.fullmatch(x) for x in hashes):
            raise InputError(f"{where} holds something else than a SHA-256")
        if values["index"] != index or values["previous"] != head(links):
            raise InputError(f"{where} does not follow the line before; one of them was changed")
        if values["record"] in seen:
            raise InputError(f"{where} names record {values['record']} again")
        seen.add(values["record"])
        links.append(Link(**values, sha256=canonical.digest(text)))
    return links


def head(links: Sequence[Link]) -> str:
    """SHA-256 of the last line; :data:`START` if there is none."""
    return links[-1].sha256 if links else START
