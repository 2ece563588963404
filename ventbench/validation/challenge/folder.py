"""The folder of a challenge: where its files are, and reading them with checks."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ventbench import files
from ventbench.errors import InputError
from ventbench.validation.challenge import seal
from ventbench.validation.challenge.plan import Drawn


@dataclass(frozen=True)
class Folder:
    """Files of a challenge.

    Attributes:
        path: of the folder.
        round: 1, or 2 with the breaths that were asked for.
    """

    path: Path
    round: int = 1

    @property
    def public(self) -> Path:
        """What everyone may know: file, lung and hash of each case."""
        return self.path / "cases.json"

    @property
    def sealed(self) -> Path:
        """The answers, encrypted."""
        return self.path / "answers.sealed"

    @property
    def commitment(self) -> Path:
        """Hash of the plain answers."""
        return self.path / "commitment.txt"

    @property
    def _suffix(self) -> str:
        return "" if self.round == 1 else f"_{self.round}"

    def recording(self, name: str) -> Path:
        """Of a case."""
        return self.path / f"recordings{self._suffix}" / f"{name}.csv"

    def answer(self, name: str) -> Path:
        """What was found in a case."""
        return self.path / f"answers{self._suffix}" / f"{name}.json"

    def request(self, name: str) -> Path:
        """Breaths that are asked for."""
        return self.path / f"requests{self._suffix}" / f"{name}.csv"

    def cases(self) -> dict[str, dict[str, str]]:
        """Public entries by name.

        Raises:
            InputError: if there is no challenge in the folder.
        """
        if not self.public.is_file():
            raise InputError(
                f"{self.path} holds no challenge; make one with `ventbench challenge make`"
            )
        entries = json.loads(self.public.read_text())["cases"]
        return {Path(entry["file"]).stem: entry for entry in entries}

    def check_recordings(self) -> None:
        """Compare the first round's recordings with their hashes.

        Raises:
            InputError: if one is missing or another one.
        """
        for name, entry in self.cases().items():
            path = Folder(self.path).recording(name)
            if not path.is_file():
                raise InputError(f"{path} is missing; make the challenge anew in another folder")
            if files.sha256(path) != entry["sha256"]:
                raise InputError(f"{path} is not the recording that was made; its hash differs")

    def answers(self) -> dict[str, dict[str, Any]]:
        """What was found, by name; cases without an answer are left out."""
        found = {}
        for name in self.cases():
            path = self.answer(name)
            if path.is_file():
                found[name] = json.loads(path.read_text())
        return found

    def truth(self, secret: str) -> list[tuple[Drawn, list[float]]]:
        """Open the seal.

        Raises:
            InputError: if the secret is not that of the challenge or files are missing.
        """
        self.cases()
        for path in (self.sealed, self.commitment):
            if not path.is_file():
                raise InputError(f"{path} is missing; the challenge cannot be revealed without it")
        promised = self.commitment.read_text().split()[0]
        text = seal.opened(self.sealed.read_bytes(), secret, self.public.read_bytes(), promised)
        return seal.parse(text)
