"""Whether records fit together: what no record can say by itself."""

from __future__ import annotations

from collections.abc import Sequence

from ventbench.board.record import Record, Withdrawal


def problems(records: Sequence[Record | Withdrawal], start: int = 0) -> list[str]:
    """Find records that do not fit those before them.

    Args:
        records: in the order of the chain.
        start: index of the first one that is looked at; those before are taken as they are.

    Returns:
        One sentence for each problem, with the record's hash.
    """
    found: list[str] = []
    first: dict[int, Record] = {}
    known: dict[str, Record] = {}
    withdrawn: set[str] = set()
    for index, item in enumerate(records):
        if index >= start:
            found += _problems(item, first, known, withdrawn)
        if isinstance(item, Record):
            first.setdefault(item.version, item)
            known[item.sha256] = item
        else:
            withdrawn.add(item.withdraws)
    return found


def _problems(
    item: Record | Withdrawal,
    first: dict[int, Record],
    known: dict[str, Record],
    withdrawn: set[str],
) -> list[str]:
    name = f"record {item.sha256}"
    if isinstance(item, Withdrawal):
        if item.withdraws not in known:
            return [f"{name} withdraws {item.withdraws[:12]}, which is not there"]
        if item.withdraws in withdrawn:
            return [f"{name} withdraws {item.withdraws[:12]} once more"]
        return []
    if item.sha256 in known:
        return [f"{name} is on the leaderboard already"]
    return _other_basis(item, first.get(item.version), name) + _correction(item, known, name)


def _other_basis(item: Record, other: Record | None, name: str) -> list[str]:
    """Records of one version can only be compared over the same simulators and draws."""
    if other is None:
        return []
    pairs = zip(("simulators", "draws"), item.basis, other.basis, strict=True)
    return [
        f"{name} ({item.name}), key {what}: differs from record {other.sha256[:12]} "
        f"({other.name}) of the same protocol version"
        for what, a, b in pairs
        if a != b
    ]


def _correction(item: Record, known: dict[str, Record], name: str) -> list[str]:
    superseded = item.content["supersedes"]
    if superseded is None:
        return []
    other = known.get(superseded)
    if other is None:
        return [f"{name}, key supersedes: {superseded[:12]} is not there"]
    if (other.name, other.track, other.version) != (item.name, item.track, item.version):
        return [f"{name}, key supersedes: is of another entry, track or version"]
    if other.official and not item.official:
        return [f"{name} is not official and supersedes an official record"]
    return []
