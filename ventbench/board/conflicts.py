"""What no record can say by itself: where it contradicts the records before it in the chain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from ventbench.board.hardware import HardwareRecord
from ventbench.board.record import AnyRecord, Record, Sealed, Withdrawal


def conflicts(records: Sequence[AnyRecord], start: int = 0) -> list[str]:
    """Find records that contradict those before them: what no record can say by itself.

    Args:
        records: in the order of the chain.
        start: index of the first one to check; those before are taken as they are.

    Returns:
        One sentence for each conflict, with the record's hash.
    """
    sentences: list[str] = []
    before = _Before()
    for index, entry in enumerate(records):
        if index >= start:
            sentences += _conflicts(entry, before)
        before.append(entry)
    return sentences


@dataclass
class _Before:
    """What the records before one say.

    Attributes:
        first_of_version: first record of each protocol version.
        first_of_name: first record of each entry's name, on any track, sealed or not.
        newest: of each entry, by version, track and name; or by season, track and name.
        known: all scores, by their hash.
        hardware: hashes of all hardware records.
        withdrawn: hashes of those that were taken back.
        inside: sealed records, by the hash of the record inside.
    """

    first_of_version: dict[int, Record] = field(default_factory=dict)
    first_of_name: dict[str, Record | Sealed] = field(default_factory=dict)
    newest: dict[tuple[int | str, str, str], Record | Sealed] = field(default_factory=dict)
    known: dict[str, Record | Sealed] = field(default_factory=dict)
    hardware: set[str] = field(default_factory=set)
    withdrawn: set[str] = field(default_factory=set)
    inside: dict[str, Sealed] = field(default_factory=dict)

    def append(self, entry: AnyRecord) -> None:
        if isinstance(entry, Withdrawal):
            self.withdrawn.add(entry.withdraws)
            return
        if isinstance(entry, HardwareRecord):
            self.hardware.add(entry.sha256)
            return
        if isinstance(entry, Sealed):
            self.inside.setdefault(entry.content.record, entry)
        elif entry.sha256 not in self.inside:  # the draws of a season are its own
            self.first_of_version.setdefault(entry.version, entry)
        self.first_of_name.setdefault(entry.name, entry)
        self.newest[entry.key] = entry
        self.known[entry.sha256] = entry


def _conflicts(entry: AnyRecord, before: _Before) -> list[str]:
    name = f"record {entry.sha256}"
    if isinstance(entry, Withdrawal):
        if entry.withdraws not in before.known and entry.withdraws not in before.hardware:
            return [f"{name} withdraws {entry.withdraws[:12]}, which is not there"]
        if entry.withdraws in before.withdrawn:
            return [f"{name} withdraws {entry.withdraws[:12]} once more"]
        return []
    if entry.sha256 in before.known or entry.sha256 in before.hardware:
        return [f"{name} is on the leaderboard already"]
    sentences = []
    sealed = before.inside.get(entry.sha256)
    if sealed is not None and isinstance(entry, Record):
        from ventbench.board.sealed import differences

        return [f"{name}: {text}" for text in differences(sealed, entry)]
    if isinstance(entry, Sealed) and entry.content.record in {*before.inside, *before.known}:
        return [f"{name}, key record: {entry.content.record[:12]} is on the leaderboard already"]
    first = before.first_of_version.get(entry.version)
    if first is not None and isinstance(entry, Record):
        # Records of one version can only be compared over the same simulators and draws.
        keys = ("simulators", "draws", "headroom")
        pairs = zip(keys, entry.basis, first.basis, strict=True)
        sentences = [
            f"{name} ({entry.name}), key {key}: differs from record {first.sha256[:12]} "
            f"({first.name}) of the same protocol version"
            for key, own, common in pairs
            if own != common
        ]
    owner = before.first_of_name.get(entry.name)
    if owner is not None and set(owner.manifest.authors) != set(entry.manifest.authors):
        sentences.append(
            f"{name} ({entry.name}), key submission.manifest.authors: the name belongs to the "
            f"authors of record {owner.sha256[:12]}; choose another name"
        )
    if isinstance(entry, HardwareRecord):
        return sentences
    header = entry.content if isinstance(entry, Sealed) else entry.header
    superseded, newest = header.supersedes, before.newest.get(entry.key)
    if superseded is None:
        if newest is not None:
            sentences.append(
                f"{name} ({entry.name}), key supersedes: the entry has record "
                f"{newest.sha256[:12]}; a new one must name it, with --supersedes and a --reason"
            )
        return sentences
    old = before.known.get(superseded)
    if old is None:
        sentences.append(f"{name}, key supersedes: {superseded[:12]} is not there")
    elif old.key != entry.key:
        sentences.append(f"{name}, key supersedes: is of another entry, track or version")
    elif newest is not None and old.sha256 != newest.sha256:
        sentences.append(
            f"{name}, key supersedes: the newest record of {entry.name} is {newest.sha256[:12]}"
        )
    elif old.official and not entry.official:
        sentences.append(f"{name} is not official and supersedes an official record")
    return sentences
