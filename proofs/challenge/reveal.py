"""Opening the seal and judging the answers of a diagnoser; comparing those of all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

import msgspec

from proofs.challenge import contract
from proofs.challenge.figures import Figure, by_kind, paired, scores
from proofs.challenge.folder import ChallengeFolder
from proofs.challenge.generators import generator_of
from proofs.challenge.judge import JudgedCase, judge
from ventbench.base.errors import InputError
from ventbench.recordings.read import load


@dataclass(frozen=True)
class Draw:
    """Cases that were made with one seed."""

    seed: str  #: what it was made with.
    commitment: str  #: hash of the true answers, checked.
    total: int  #: number of its cases.
    answered: int  #: number of those that have an answer.


@dataclass(frozen=True)
class Judged:
    """A diagnoser on draws from one generator."""

    diagnoser: str  #: who answered.
    generator: str  #: name of the generator.
    draws: tuple[Draw, ...]  #: where the cases are from.
    #: judged answers, by number of the draw and name of the case.
    cases: dict[tuple[int, str], JudgedCase]
    unanswered: tuple[str, ...] = ()  #: cases without an answer.
    versions: tuple[str, ...] = ()  #: code that ran the diagnoser, as the answers say.

    @cached_property
    def figures(self) -> tuple[Figure, ...]:
        """Everything that is measured."""
        cases = list(self.cases.values())
        return (*scores(cases), *by_kind(cases))

    def as_dict(self) -> dict[str, Any]:
        """JSON values."""
        cases = [
            asdict(case)
            | {"draw": draw, "right": case.right, "log_score": case.log_score}
            | {"leading": [sorted(terms) for terms in case.leading]}
            | {"truth": [{"name": e.name, "seen": e.seen} for e in case.truth]}
            for (draw, _), case in self.cases.items()
        ]
        return {
            "diagnoser": self.diagnoser,
            "generator": self.generator,
            "draws": [asdict(draw) for draw in self.draws],
            "unanswered": list(self.unanswered),
            "figures": [asdict(figure) for figure in self.figures],
            "versions": list(self.versions),
            "cases": cases,
        }


def reveal(folders: Sequence[ChallengeFolder], seeds: Sequence[str], diagnoser: str) -> Judged:
    """Check all hashes and judge the answers of a diagnoser to draws from one generator.

    Args:
        folders: draws.
        seeds: secret that each was made with.
        diagnoser: name of the diagnoser.

    Raises:
        InputError: if a secret or a file is not that of its challenge, a draw is given twice,
            generators differ, or there is no answer.
    """
    draws, cases, unanswered, versions, generators = [], {}, [], set(), set()
    for number, (folder, secret) in enumerate(zip(folders, seeds, strict=True)):
        found = _judge_all(folder, secret, diagnoser)
        published = folder.commitment.read_text().split()[0]
        if published in {draw.commitment for draw in draws}:
            raise InputError(f"the draw with commitment {published} is given twice")
        draws.append(Draw(secret, published, len(folder.cases()), len(found)))
        cases |= {(number, name): case for name, case in found.items()}
        unanswered += [name for name in folder.cases() if name not in found]
        versions |= {given["code"] for given in folder.answers(diagnoser).values()}
        generators.add(generator_name(folder, secret))
    if len(generators) > 1:
        raise InputError(
            f"draws from the generators {' and '.join(sorted(generators))} have figures of their "
            "own; reveal them one at a time"
        )
    if not cases:
        place = folders[0].answer("case", diagnoser).parent
        raise InputError(f"{place} has no answers; run `answer --diagnoser {diagnoser}` first")
    return Judged(
        diagnoser, generators.pop(), tuple(draws), cases, tuple(unanswered), tuple(sorted(versions))
    )


def generator_name(folder: ChallengeFolder, secret: str) -> str:
    """Name of the generator of a draw; opens its seal."""
    return generator_of(folder.truth(secret)[0][0].case).name


def _judge_all(folder: ChallengeFolder, secret: str, diagnoser: str) -> dict[str, JudgedCase]:
    """Judge every answer of a diagnoser, by name of the case."""
    truth = folder.truth(secret)
    folder.check_recordings()
    answers, public, found = folder.answers(diagnoser), folder.cases(), {}
    for drawn, nats in truth:
        name = drawn.case.name
        if name not in answers:
            continue
        given = answers[name]
        if given["recording_sha256"] != public[name]["sha256"]:
            raise InputError(
                f"{folder.answer(name, diagnoser)} answers another recording; remove it"
            )
        breaths = load(folder.recording(name))
        withheld = folder.open(name, secret)
        if not given["problem"]:
            samples = {breath: len(readings) for breath, readings in withheld.pressures.items()}
            try:  # the file may have changed since it was written
                contract.decode(msgspec.json.encode(given["answer"]), samples)
            except contract.AnswerError as error:
                given = given | {"problem": str(error)}
        found[name] = judge(drawn, nats or withheld.nats, breaths, withheld, given)
    return found


@dataclass(frozen=True)
class Board:
    """All diagnosers that have answered."""

    against: str  #: diagnoser with whom the others are compared.
    #: rows by name of the generator, the best log score first.
    tables: dict[str, tuple[Judged, ...]]

    def differences(self, row: Judged) -> dict[str, Figure]:
        """The compared one minus another, over common cases; negative: the compared one is better.

        Empty for the compared one itself, and where it has not answered the same cases.
        """
        ours = [r for r in self.tables[row.generator] if r.diagnoser == self.against]
        if not ours or row is ours[0] or not ours[0].cases.keys() & row.cases.keys():
            return {}
        return paired(ours[0].cases, row.cases)

    def as_dict(self) -> dict[str, Any]:
        """JSON values."""
        rows = {
            generator: [
                row.as_dict()
                | {"differences": {k: asdict(f) for k, f in self.differences(row).items()}}
                for row in table
            ]
            for generator, table in self.tables.items()
        }
        return {"against": self.against, "tables": rows}


def board(folders: Sequence[ChallengeFolder], seeds: Sequence[str], against: str) -> Board:
    """Judge all diagnosers that have answered draws, from any generators.

    Raises:
        InputError: as :func:`reveal`, or if nobody has answered.
    """
    by_generator: dict[str, list[tuple[ChallengeFolder, str]]] = {}
    for folder, secret in zip(folders, seeds, strict=True):
        by_generator.setdefault(generator_name(folder, secret), []).append((folder, secret))
    tables = {}
    for generator, given in by_generator.items():
        places, secrets = zip(*given, strict=True)
        names = sorted({name for folder in places for name in folder.diagnosers()})
        if not names:
            raise InputError(f"nobody has answered {places[0].path}; run `answer` first")
        rows = [reveal(places, secrets, name) for name in names]
        tables[generator] = tuple(sorted(rows, key=lambda row: row.figures[1].value or 0.0))
    return Board(against, tables)
