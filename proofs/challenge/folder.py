"""Files of a challenge: where they are, and the answers under seal.

The answers are encrypted with the secret, and their hash is published before anyone answers.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import msgspec

from hardware_eval.emulation.cases import random_generator
from proofs.challenge.generators import GENERATORS
from proofs.challenge.questions import DrawnCase
from proofs.challenge.seal import encrypt, unseal
from ventbench.base import files
from ventbench.base.errors import InputError

_FORMAT = "ventbench-challenge-2"


class Withheld(msgspec.Struct, frozen=True):
    """What a diagnoser does not see of a recording."""

    #: readings of the withheld breaths, cmH2O, None where blank, by id.
    pressures: dict[int, tuple[float | None, ...]]
    #: where an effect acts that acts in part of the recording only: intervals of time, s, by id of
    #: the breath; None if there is no such effect.
    active: dict[int, tuple[tuple[float, float], ...]] | None = None
    #: log-likelihood that is lost without each effect of the case, nats, from
    #: :func:`~proofs.challenge.detectability.log_likelihood_loss`. Machines differ in its digits,
    #: so that no answer holds it, whose hash is published.
    nats: tuple[float, ...] = ()


#: Cases, each with the nats of its effects if they are among the answers, as they once were.
Truth = list[tuple[DrawnCase, tuple[float, ...]]]


def encode_answers(secret: str, drawn: list[DrawnCase]) -> bytes:
    """Return the plain text of the answers; a random nonce keeps their hash from being guessed.

    It is of what is drawn alone, and so the same on every machine.

    Args:
        secret: secret of the challenge.
        drawn: cases of the challenge.
    """
    cases = [{"kind": question.kind, "case": asdict(question.case)} for question in drawn]
    nonce = random_generator(secret, "nonce").bytes(32).hex()
    value = {"format": _FORMAT, "nonce": nonce, "cases": cases}
    return (json.dumps(value, indent=1, allow_nan=False) + "\n").encode()


def decode_answers(text: bytes) -> Truth:
    """Return what the plain text of the answers holds."""
    truth = []
    for entry in json.loads(text)["cases"]:
        generator = GENERATORS[entry["case"].get("generator", "first")]
        case = msgspec.convert(entry["case"], generator.case)
        truth.append((DrawnCase(entry["kind"], case), tuple(entry.get("nats", ()))))
    return truth


@dataclass(frozen=True)
class ChallengeFolder:
    """Paths of a challenge's files."""

    path: Path  #: path of the folder.

    @property
    def public(self) -> Path:
        """Public facts: file, lung and hash of each case."""
        return self.path / "cases.json"

    @property
    def sealed(self) -> Path:
        """The answers, encrypted."""
        return self.path / "answers.sealed"

    @property
    def commitment(self) -> Path:
        """Hash of the plain answers."""
        return self.path / "commitment.txt"

    def recording(self, name: str) -> Path:
        """Recording of a case."""
        return self.path / "recordings" / f"{name}.csv"

    def withheld(self, name: str) -> Path:
        """What is withheld of a recording, encrypted."""
        return self.path / "withheld" / f"{name}.sealed"

    def answer(self, name: str, diagnoser: str) -> Path:
        """A diagnoser's answer to a case."""
        return self.path / "answers" / diagnoser / f"{name}.json"

    def cases(self) -> dict[str, dict[str, Any]]:
        """Return the public entries by name.

        Raises:
            InputError: if there is no challenge in the folder.
        """
        if not self.public.is_file():
            raise InputError(
                f"{self.path} holds no challenge; make one with `python -m proofs challenge make`"
            )
        entries = json.loads(self.public.read_text())["cases"]
        return {Path(entry["file"]).stem: entry for entry in entries}

    def check_recordings(self) -> None:
        """Compare the recordings with their hashes.

        Raises:
            InputError: if a recording is missing or has another hash.
        """
        for name, entry in self.cases().items():
            path = self.recording(name)
            if not path.is_file():
                raise InputError(f"{path} is missing; make the challenge again in another folder")
            if files.sha256(path) != entry["sha256"]:
                raise InputError(
                    f"{path} is not the recording that the challenge was made with; its hash "
                    "differs"
                )

    def diagnosers(self) -> tuple[str, ...]:
        """Names of those who have answered."""
        folders = self.answer("case", "name").parents[1]
        return tuple(sorted(path.name for path in folders.glob("*") if path.is_dir()))

    def answers(self, diagnoser: str) -> dict[str, dict[str, Any]]:
        """Return a diagnoser's answers by name; cases without an answer are left out."""
        paths = {name: self.answer(name, diagnoser) for name in self.cases()}
        return {
            name: json.loads(path.read_text()) for name, path in paths.items() if path.is_file()
        }

    def keep(self, name: str, secret: str, withheld: Withheld) -> None:
        """Seal what is withheld of a recording."""
        sealed = encrypt(msgspec.json.encode(withheld), secret, name.encode())
        files.write_atomically(self.withheld(name), lambda file: file.write(sealed))

    def open(self, name: str, secret: str) -> Withheld:
        """Open what is withheld of a recording.

        Raises:
            InputError: if the file is missing or damaged, or the secret is another one.
        """
        path = self.withheld(name)
        if not path.is_file():
            raise InputError(f"{path} is missing; make the challenge again in another folder")
        try:
            plain = encrypt(path.read_bytes(), secret, name.encode())
            return msgspec.json.decode(plain, type=Withheld)
        except (msgspec.DecodeError, UnicodeDecodeError):
            raise InputError(f"{path} is damaged, or sealed with another seed") from None

    def truth(self, secret: str) -> Truth:
        """Open the seal; returns what it holds.

        Raises:
            InputError: if the secret is not that of the challenge, or files are missing.
        """
        self.cases()
        for path in (self.sealed, self.commitment):
            if not path.is_file():
                raise InputError(f"{path} is missing; the challenge cannot be revealed without it")
        published = self.commitment.read_text().split()[0]
        text = unseal(self.sealed.read_bytes(), secret, self.public.read_bytes(), published)
        return decode_answers(text)
