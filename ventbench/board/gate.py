"""The one gate to every rank: simulated, under missing physics, and on hardware.

No record has a rank of any kind unless somebody vouches for how its numbers came about
(:mod:`ventbench.board.attestation`): a key of the leaderboard, or the maintainers' list of second
runs, for what was simulated in the full sandbox; a bench log for what was measured. What can be
computed again from a record is never taken from it: reading a hardware record does so, and the
replay of commands. What a record says in words, or by a flag that its sender sets, can cost a rank
and never give one.

A simulated record is ranked in the round in which its code was frozen. Records of other draws are
practice: shown, and never ranked.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from ventbench.board.record import HardwareRecord, Record
from ventbench.board.store import Store
from ventbench.task.lungs import LUNG_IDS

#: Most characters of a failure's message that a reason quotes; a submission chose them.
MAX_QUOTED = 300

#: Why nothing is ranked on draws that everybody knows.
PRACTICE = "practice: its draws are published, and entries can be made for them"

#: Why a record has no rank although its sandbox was official, or although it was measured.
UNATTESTED = "not official: no key of this leaderboard has signed the record"
NO_BENCH_LOG = "no bench log of the maintainers names the record"

#: Parts of the bench's self-test without which nobody knows what was measured, or on what.
NEEDED_PARTS = {"sensor": "the sensor's zero", "lung": "which lung was mounted"}


def official(record: Record, leaderboard: Store) -> bool:
    """Whether its sandbox deserves the word, and somebody vouches for that."""
    return record.official and record.sha256 in leaderboard.attested


def simulated(record: Record, leaderboard: Store) -> tuple[str, ...]:
    """Why a record has no rank on its track, nor under missing physics; empty if it has one."""
    why = list(unfit(record, leaderboard))
    if not record.official:
        why.insert(0, "not official: its sandbox lacked a layer, or there was none")
    elif not official(record, leaderboard):
        why.insert(0, UNATTESTED)
    round_ = leaderboard.round_of(record)
    if round_ is None:
        why.append(PRACTICE)
    elif round_.commitment != record.header.draws.sha256:
        why.append(f"its draws are not those of round {round_.name}")
    elif record.run not in round_.runs.values():
        why.append(f"its code was not frozen in round {round_.name}")
    return tuple(why)


def unfit(record: Record, leaderboard: Store) -> tuple[str, ...]:
    """Why a record could have no rank on any draws: withdrawn, failed, unsafe."""
    why = []
    if record.sha256 in leaderboard.withdrawn:
        why.append(f"withdrawn: {leaderboard.withdrawn[record.sha256]}")
    failed = len(record.header.failures)
    if failed:
        cells = record.figures.error.size
        first = record.header.failures[0].message.removesuffix("; the entry is not ranked.")
        cut = first if len(first) <= MAX_QUOTED else f"{first[:MAX_QUOTED]}…"
        why.append(f"{failed} of {cells} cells failed, the first: {cut}")
    return (*why, *_unsafe(LUNG_IDS, record.figures.safe))


def measured(record: HardwareRecord, leaderboard: Store) -> tuple[str, ...]:
    """Why a hardware record has no rank; empty if it has one."""
    why = []
    if record.sha256 in leaderboard.withdrawn:
        why.append(f"withdrawn: {leaderboard.withdrawn[record.sha256]}")
    if record.emulated:
        why.append("software stood in for the ventilator and its lung")
    if record.sha256 not in leaderboard.attested:
        why.append(NO_BENCH_LOG)
    for part, unknown in NEEDED_PARTS.items():
        lungs = [x for x in record.header.lungs if part in record.header.selftest.get(x, [part])]
        if lungs:
            why.append(f"no self-test of {unknown} on {', '.join(lungs)}")
    if record.header.stops:
        why.append(f"{len(record.header.stops)} runs were stopped")
    return (*why, *_unsafe(record.header.lungs, record.header.safe))


def _unsafe(lungs: Sequence[str], safe: Iterable[bool]) -> list[str]:
    unsafe = [lung for lung, passed in zip(lungs, safe, strict=True) if not passed]
    return [f"did not pass the safety gate on {', '.join(unsafe)}"] if unsafe else []
