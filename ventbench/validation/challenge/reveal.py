"""Opening the seal and scoring the answers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ventbench.errors import InputError
from ventbench.training.executor import executor, results
from ventbench.validation.challenge import oracle, truth
from ventbench.validation.challenge.confusion import by_effect, confusion
from ventbench.validation.challenge.figures import Figure, figures, number, second
from ventbench.validation.challenge.folder import Folder
from ventbench.validation.challenge.judge import Judged, judge
from ventbench.validation.challenge.plan import Drawn


@dataclass(frozen=True)
class Revealed:
    """All that is printed.

    Attributes:
        commitment: hash of the answers, checked.
        unanswered: cases without an answer; in the second round, of those that asked for breaths.
        cases: the others.
        figures: measured values with their goals.
        confusion: see :func:`~.confusion.confusion`.
        parameters: see :func:`~.confusion.by_effect`.
    """

    commitment: str
    unanswered: tuple[str, ...]
    cases: tuple[Judged, ...]
    figures: tuple[Figure, ...]
    confusion: dict[str, dict[str, int]]
    parameters: dict[str, dict[str, Any]]

    def as_dict(self) -> dict[str, Any]:
        """JSON values."""
        return {
            "commitment": self.commitment,
            "unanswered": list(self.unanswered),
            "figures": [asdict(item) for item in self.figures],
            "confusion": self.confusion,
            "parameters": self.parameters,
            "cases": [_plain(case) for case in self.cases],
        }


def reveal(
    folder: Folder, secret: str, *, with_oracle: bool = False, jobs: int = 0,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Revealed:  # fmt: skip
    """Check hashes and score.

    Args:
        folder: of the challenge; of its second round, the first is read too.
        secret: that it was made with.
        with_oracle: compare with fits that know the true structure, which takes seconds a case.
        jobs: processes that fit oracles; 0 for none but this one.
        progress: told how many oracles are fitted, of how many.

    Raises:
        InputError: if the secret or a file is another one, or there is no answer.
    """
    known = folder.truth(secret)
    folder.check_recordings()
    cases = _judged(folder, known)
    if not cases:
        raise InputError(f"{folder.answer('case_0001').parent} has no answers; run `answer` first")
    found = figures(list(cases.values()))
    if folder.round == 2:
        found.append(second(_judged(Folder(folder.path), known), cases))
    if with_oracle:
        found += _against_oracle(folder, known, cases, jobs, progress)
    return Revealed(
        folder.commitment.read_text().split()[0],
        tuple(name for name in _asked(folder) if name not in cases),
        tuple(cases.values()),
        tuple(found),
        confusion(list(cases.values())),
        by_effect(list(cases.values())),
    )


def _asked(folder: Folder) -> list[str]:
    """Cases that should have an answer: in the second round those that asked for breaths."""
    first = Folder(folder.path)
    return [n for n in folder.cases() if folder.round == 1 or first.request(n).is_file()]


def _judged(folder: Folder, known: list[tuple[Drawn, list[float]]]) -> dict[str, Judged]:
    answers = folder.answers()
    if folder.round == 1:
        public = folder.cases()
        for name, found in answers.items():
            if found["recording_sha256"] != public[name]["sha256"]:
                raise InputError(f"{folder.answer(name)} answers another recording; remove it")
    return {
        drawn.case.name: judge(drawn, worth, answers[drawn.case.name])
        for drawn, worth in known
        if drawn.case.name in answers
    }


def _against_oracle(
    folder: Folder, known: list[tuple[Drawn, list[float]]], cases: dict[str, Judged],
    jobs: int, progress: Callable[[int, int], None],
) -> list[Figure]:  # fmt: skip
    """Ratios of the held-out RMSE to that of a fit with the true names."""
    answers, ratios = folder.answers(), []
    could = {
        d.case.name: (
            folder.recording(d.case.name),
            answers[d.case.name]["diagnosis"]["open_loop"]["held_out_breaths"],
            truth.names(d.case),
        )
        for d, _ in known
        if d.case.name in cases and d.kind != "outside"
    }
    with executor(jobs) as pool:
        for name, best in results(pool, oracle.of_recording, could):
            ratios.append(cases[name].after / best)
            progress(len(ratios), len(could))
    return [
        number("held-out RMSE over the oracle's, median", ratios, np.median, 1.02),
        number("held-out RMSE over the oracle's, 95th percentile", ratios,
               lambda x: np.percentile(x, 95), 1.10),
    ]  # fmt: skip


def _plain(case: Judged) -> dict[str, Any]:
    value = asdict(case) | {"right": case.right, "wrong": sorted(case.wrong)}
    for key in ("library", "seen", "named", "listed"):
        value[key] = sorted(value[key])
    return value
