"""Rounds of diagnosers: all are frozen, and a public beacon then says what cases they get.

A round is a folder; each file is bound by the next one:

- ``frozen.json``: when, the delay, the beacon's chain, the worlds, and hashes of the code that
  makes, answers and judges, and of each diagnoser;
- ``diagnosers/NAME/``: what outsiders sent, as it was frozen;
- ``beacon.json``: the beacon's first value after freeze and delay;
- a challenge for each world, and ``board.md`` and ``board.json``: all diagnosers side by side.

The seed of the cases follows from the value and the hash of ``frozen.json`` as that of the draws of
a round of controllers does, so that nobody can know it before the freeze, or choose it.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import msgspec

from proofs.challenge.answer import answer
from proofs.challenge.folder import ChallengeFolder
from proofs.challenge.generators import generator
from proofs.challenge.make import make
from proofs.challenge.questions import Kind
from proofs.challenge.reveal import Board, board
from proofs.challenge.run import Diagnoser, Limits, find
from proofs.results_page import board_section
from ventbench.base import files
from ventbench.base.errors import InputError
from ventbench.board import beacon, schema
from ventbench.board.beacon import QUICKNET, Chain, Value
from ventbench.entries.folder import combined_hash, file_hashes

FROZEN, BEACON, DIAGNOSERS, BOARD = "frozen.json", "beacon.json", "diagnosers", "board"

#: What the figures of a round depend on besides cases and diagnosers, in the checkout.
_CODE = ("proofs", "ventbench", "hardware_eval", "data", "requirements.lock")

_ROOT = Path(__file__).parents[1]


class Frozen(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Content of ``frozen.json``."""

    frozen: datetime  #: when, UTC.
    #: least time from the freeze to the beacon's value, s.
    delay_s: Annotated[int, msgspec.Meta(ge=1, le=10**7)]
    chain: Chain  #: of the beacon.
    #: number of cases by name of the generator.
    worlds: dict[str, Annotated[int, msgspec.Meta(ge=1)]]
    kind: Kind | Literal["all"]  #: of the cases.
    seconds: float  #: processor time of a diagnoser on a case.
    code: schema.Sha256  #: hash of the code.
    #: hash of each one's folder by name; empty for the project's own, which are part of the code.
    diagnosers: dict[str, str]


@dataclass(frozen=True)
class Round:
    """A round as far as it has come; make one with :func:`load`."""

    folder: Path  #: of the round.
    frozen: Frozen  #: what was frozen.
    sha256: str  #: of ``frozen.json``.
    value: Value | None = None  #: of the beacon, checked; None before.

    @property
    def number(self) -> int:
        """Round of the beacon whose value it must take."""
        return self.frozen.chain.first_at(self.frozen.frozen, self.frozen.delay_s)

    @property
    def seed(self) -> str:
        """Seed of the cases.

        Raises:
            InputError: if the beacon's value is not there yet.
        """
        if self.value is None:
            raise InputError(f"{self.folder / BEACON} is missing: the round is not drawn yet")
        return self.value.seed(self.sha256).hex()

    def diagnoser(self, name: str) -> Diagnoser:
        """A diagnoser as it was frozen."""
        return find(str(self.folder / DIAGNOSERS / name) if self.frozen.diagnosers[name] else name)


def freeze(
    folder: Path,
    diagnosers: Iterable[str],
    worlds: Mapping[str, int],
    *,
    delay_s: int = 600,
    seconds: float = 300.0,
    kind: Kind | Literal["all"] = "all",
    chain: Chain = QUICKNET,
    now: datetime | None = None,
) -> Round:
    """Take the hashes of the code and of all diagnosers; later changes do not count.

    Args:
        folder: of the round, which must not be one yet.
        diagnosers: folders of outsiders, which are copied, and names of the project's own.
        worlds: number of cases by name of the generator.
        delay_s: least time from the freeze to the beacon's value, s.
        seconds: processor time of a diagnoser on a case.
        kind: of the cases.
        chain: of the beacon.
        now: time of the freeze; the clock's if not given.

    Raises:
        InputError: if there is such a round, a diagnoser is none or not the only one of its name,
            or there is no such world.
    """
    path = folder / FROZEN
    if path.exists():
        raise InputError(f"{path} is there already; choose another folder")
    for world in worlds:
        generator(world)
    found: dict[str, Diagnoser] = {}
    for given in diagnosers:
        who = find(given)
        if who.folder is None and ":" in given:
            raise InputError(f"{given}: a function has no hash; give a folder with diagnoser.toml")
        if who.name in found:
            raise InputError(f"{given}: there is a diagnoser {who.name} already; rename one")
        found[who.name] = who
    hashes = {}
    for name, who in sorted(found.items()):
        if who.folder is not None:
            shutil.copytree(who.folder, folder / DIAGNOSERS / name)
        hashes[name] = _hash(folder / DIAGNOSERS / name) if who.folder is not None else ""
    at = (now or datetime.now(UTC)).astimezone(UTC).replace(microsecond=0)
    frozen = Frozen(at, delay_s, chain, dict(worlds), kind, seconds, _code(), hashes)
    files.write_json(path, msgspec.to_builtins(frozen))
    return load(folder)


def load(folder: Path) -> Round:
    """Read a round.

    Raises:
        InputError: if there is none, or a file of it is not what it must be.
    """
    path = folder / FROZEN
    if not path.is_file():
        raise InputError(f"{path} is missing: there is no round; `challenge freeze` begins one")
    frozen = schema.decoded(Frozen, path.read_bytes(), str(path))
    made = Round(folder, frozen, files.sha256(path))
    path = folder / BEACON
    if not path.is_file():
        return made
    value = beacon.read(path.read_bytes(), str(path))
    beacon.check(value, frozen.chain, made.number, str(path))
    return replace(made, value=value)


def draw(own: Round, content: bytes, *, now: datetime | None = None) -> Round:
    """Take the beacon's value, as relays publish it; ``now`` is the clock's if not given.

    Raises:
        InputError: if the time has not come, or the value is not the one that it must take.
    """
    value = beacon.take(content, own.frozen.chain, own.number, now)
    files.write_json(own.folder / BEACON, msgspec.to_builtins(value))
    return replace(own, value=value)


def play(
    own: Round,
    *,
    workers: int = 0,
    tell: Callable[[str, int, int], object] = lambda what, done, total: None,
) -> Board:
    """Make the cases, let all answer, judge, and write the board; what is finished is kept.

    Args:
        own: round that is drawn.
        workers: number of processes; 0 for this one alone.
        tell: called with what is done, how much of it, and of how much.

    Raises:
        InputError: if the code or a diagnoser is not that of the freeze, or as
            :func:`~proofs.challenge.reveal.board`.
    """
    if _code() != own.frozen.code:
        raise InputError(
            f"the code is not that of {own.folder / FROZEN}; check out the commit that was frozen"
        )
    for name, hashed in own.frozen.diagnosers.items():
        if hashed and _hash(own.folder / DIAGNOSERS / name) != hashed:
            raise InputError(f"{own.folder / DIAGNOSERS / name} has been changed since the freeze")
    folders = [ChallengeFolder(own.folder / world) for world in own.frozen.worlds]
    limits = Limits(own.frozen.seconds)
    for folder, (world, count) in zip(folders, own.frozen.worlds.items(), strict=True):
        if not folder.sealed.exists():
            make(
                own.seed,
                folder.path,
                own.frozen.kind,
                count,
                workers=workers,
                source=world,
                progress=partial(tell, f"make {world}"),
            )
        for name in own.frozen.diagnosers:
            tell_this = partial(tell, f"{name}, {world}")
            answer(folder, own.diagnoser(name), limits=limits, workers=workers, progress=tell_this)
    ours = "ventbench" if "ventbench" in own.frozen.diagnosers else min(own.frozen.diagnosers)
    result = board(folders, [own.seed] * len(folders), ours)
    files.write_json(own.folder / f"{BOARD}.json", result.as_dict())
    files.write_text(own.folder / f"{BOARD}.md", board_section(result) + "\n")
    return result


def _hash(folder: Path) -> str:
    return combined_hash(file_hashes(folder))


def _code() -> str:
    hashes = {}
    for path in (_ROOT / name for name in _CODE):
        inside = file_hashes(path) if path.is_dir() else {"": files.sha256(path)}
        hashes |= {f"{path.name}/{name}": digest for name, digest in inside.items()}
    return combined_hash(hashes)
