"""The one gate to every rank: simulated, under missing physics, and on hardware.

No record has a rank of any kind unless somebody vouches for how its numbers came about: a key of
the leaderboard, or the maintainers' list of second runs, for what was simulated in the full
sandbox; a bench log for what was measured. What can be computed again from a record is never taken
from it: reading a hardware record does so, and the replay of commands. What a record says in words,
or by a flag that its sender sets, can cost a rank and never give one.

A simulated record is ranked in the round in which its code was frozen. Records of other draws are
practice: shown, and never ranked.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from ventbench.board.record import HardwareRecord, Record
from ventbench.board.rounds import Round

#: Most characters of a failure's message that a reason quotes; a submission chose them.
MAX_QUOTED = 300

#: Why nothing is ranked on draws that everybody knows.
PRACTICE = "practice: its draws are published, and entries can be made for them"

#: Why a record has no rank although its sandbox was official, or although it was measured.
UNATTESTED = "not official: no key of this leaderboard has signed the record"
NO_BENCH_LOG = "no bench log of the maintainers names the record"

#: Parts of the bench's self-test without which nobody knows what was measured, or on what.
NEEDED_PARTS = {"sensor": "the sensor's zero", "lung": "which lung was mounted"}


@dataclass(frozen=True)
class Evidence:
    """What stands behind the records of a leaderboard."""

    #: hashes of records that are signed, were run again, or have a bench log.
    vouched: frozenset[str] = frozenset()
    #: why records were taken back, by hash.
    withdrawn: Mapping[str, str] = field(default_factory=dict)
    rounds: Mapping[str, Round] = field(default_factory=dict)  #: that have draws, by name.

    def official(self, record: Record) -> bool:
        """Whether its sandbox deserves the word, and somebody vouches for that."""
        return record.official and record.sha256 in self.vouched


def simulated(record: Record, evidence: Evidence) -> tuple[str, ...]:
    """Why a record has no rank on its track; empty if it has one."""
    why = list(unfit(record, evidence))
    if not record.official:
        why.insert(0, "not official: its sandbox lacked a layer, or there was none")
    elif not evidence.official(record):
        why.insert(0, UNATTESTED)
    own = evidence.rounds.get(record.header.draws.season)
    if own is None:
        why.append(PRACTICE)
    elif own.commitment != record.header.draws.sha256:
        why.append(f"its draws are not those of round {own.name}")
    elif not own.entered(record.name, record.track, record.header.submission.sha256):
        why.append(f"its code was not frozen in round {own.name}")
    return tuple(why)


def unfit(record: Record, evidence: Evidence) -> tuple[str, ...]:
    """Why a record could have no rank on any draws: withdrawn, failed, unsafe."""
    why = []
    if record.sha256 in evidence.withdrawn:
        why.append(f"withdrawn: {evidence.withdrawn[record.sha256]}")
    failed = record.header.failed_cells
    if failed:
        cells = record.nominal.size + record.drawn.size
        first = record.header.failures[0].message.removesuffix("; the entry is not ranked.")
        cut = first if len(first) <= MAX_QUOTED else f"{first[:MAX_QUOTED]}…"
        why.append(f"{failed} of {cells} cells failed, the first: {cut}")
    return (*why, *_unsafe(record.lungs, record.header.safe))


def stressed(record: Record, evidence: Evidence) -> tuple[str, ...]:
    """Why a record has no rank under missing physics; empty if it has one."""
    if record.stress is None:
        return ("it did not run under missing physics",)
    why = simulated(record, evidence)
    return why if record.stress.tables.complete else (*why, "not all conditions were run")


def measured(record: HardwareRecord, evidence: Evidence) -> tuple[str, ...]:
    """Why a hardware record has no rank; empty if it has one."""
    why = []
    if record.sha256 in evidence.withdrawn:
        why.append(f"withdrawn: {evidence.withdrawn[record.sha256]}")
    if record.emulated:
        why.append("software stood in for the ventilator and its lung")
    if record.sha256 not in evidence.vouched:
        why.append(NO_BENCH_LOG)
    for part, unknown in NEEDED_PARTS.items():
        lungs = [x for x in record.header.lungs if part in record.header.selftest.get(x, [part])]
        if lungs:
            why.append(f"no self-test of {unknown} on {', '.join(lungs)}")
    if record.header.stops:
        why.append(f"{len(record.header.stops)} runs were stopped")
    return (*why, *_unsafe(record.header.lungs, record.header.safe))


def _unsafe(lungs: Sequence[str], safe: Sequence[bool]) -> list[str]:
    unsafe = [lung for lung, passed in zip(lungs, safe, strict=True) if not passed]
    return [f"did not pass the safety gate on {', '.join(unsafe)}"] if unsafe else []
