"""Opening the seal and scoring the answers, also against a fit that knows the true structure."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from proofs.challenge.figures import (
    Figure,
    by_parameter,
    confusion,
    figures,
    second_round,
    statistic,
)
from proofs.challenge.folder import ChallengeFolder, Truth
from proofs.challenge.judge import JudgedCase, judge, library_names
from proofs.challenge.stranger.effects import StrangerCase
from ventbench.base.errors import InputError
from ventbench.base.executor import executor, results
from ventbench.recordings.breaths import Breaths
from ventbench.recordings.read import load

#: Goals for the corrected simulator's held-out RMSE over the oracle's: median, 95th percentile.
_MEDIAN_RATIO, _LARGE_RATIO = 1.02, 1.10

#: Parameters of each breath's own effort.
_EFFORT = ("patient_effort.amplitude", "patient_effort.onset")


@dataclass(frozen=True)
class Draw:
    """Cases that were made with one seed.

    Attributes:
        commitment: hash of the true answers, checked.
        total: number of its cases.
        answered: number of those that have an answer.
    """

    commitment: str
    total: int
    answered: int


@dataclass(frozen=True)
class ChallengeResult:
    """Scores of a challenge, or of several draws from one generator together.

    Attributes:
        draws: where the cases are from.
        unanswered: cases without an answer; in the second round only those with a request.
        cases: the answered cases.
        figures: measured values with their goals.
        confusion: see :func:`~.figures.confusion`.
        parameters: see :func:`~.figures.by_parameter`.
        versions: code that gave the answers, as the answers say.
        generator: name of the generator.
    """

    draws: tuple[Draw, ...]
    unanswered: tuple[str, ...]
    cases: tuple[JudgedCase, ...]
    figures: tuple[Figure, ...]
    confusion: dict[str, dict[str, int]]
    parameters: dict[str, dict[str, Any]]
    versions: tuple[str, ...] = ()
    generator: str = "first"

    def as_dict(self) -> dict[str, Any]:
        """JSON values; names of cases are those within a draw, which is given by its place."""
        of_draw = [k for k, draw in enumerate(self.draws) for _ in range(draw.answered)]
        return {
            "draws": [asdict(draw) for draw in self.draws],
            "unanswered": list(self.unanswered),
            "figures": [asdict(figure) for figure in self.figures],
            "confusion": self.confusion,
            "parameters": self.parameters,
            "versions": list(self.versions),
            "cases": [
                _as_dict(case) | {"draw": draw}
                for case, draw in zip(self.cases, of_draw, strict=True)
            ],
        }


def reveal(
    folder: ChallengeFolder, secret: str, *, with_oracle: bool = False, jobs: int = 0,
    scheduler: str | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> ChallengeResult:  # fmt: skip
    """Check all hashes and score the answers.

    Args:
        folder: folder of the challenge; for the second round, the first is read too.
        secret: secret that the challenge was made with.
        with_oracle: compare with fits that know the true structure, which takes seconds a case.
        jobs: number of processes that fit; 0 to work in this process.
        scheduler: address of a Dask scheduler instead, whose workers see the same files.
        progress: called with the number of finished fits and the number of all fits.

    Raises:
        InputError: if the secret or a file is not that of the challenge, or there is no answer.
    """
    truth = folder.truth(secret)
    folder.check_recordings()
    cases = _judged(folder, truth)
    if not cases:
        raise InputError(f"{folder.answer('case_0001').parent} has no answers; run `answer` first")
    measured = figures(list(cases.values()))
    if folder.round == 2:
        measured.append(second_round(_judged(ChallengeFolder(folder.path), truth), cases))
    if with_oracle:
        measured += _against_oracle(folder, truth, cases, (jobs, scheduler), progress)
    published = folder.commitment.read_text().split()[0]
    return ChallengeResult(
        (Draw(published, len(folder.cases()), len(cases)),),
        tuple(name for name in _expected(folder) if name not in cases),
        tuple(cases.values()),
        tuple(measured),
        confusion(list(cases.values())),
        by_parameter(list(cases.values())),
        tuple(sorted({given["code"] for given in folder.answers().values() if "code" in given})),
        "stranger" if any(isinstance(d.case, StrangerCase) for d, _ in truth) else "first",
    )


def pool(results: Sequence[ChallengeResult]) -> ChallengeResult:
    """Figures of several draws from one generator together, without those of an oracle.

    Args:
        results: one or more opened challenges, first rounds.

    Raises:
        InputError: if the generators differ, or a draw is given twice.
    """
    commitments = [draw.commitment for result in results for draw in result.draws]
    twice = next((each for each in commitments if commitments.count(each) > 1), None)
    if twice is not None:
        raise InputError(f"the draw with commitment {twice} is given twice; give each draw once")
    generators = sorted({result.generator for result in results})
    if len(generators) > 1:
        raise InputError(
            f"draws from the generators {' and '.join(generators)} have figures of their own; "
            "reveal them one at a time"
        )
    if len(results) == 1:
        return results[0]
    cases = [case for result in results for case in result.cases]
    return ChallengeResult(
        tuple(draw for result in results for draw in result.draws),
        tuple(name for result in results for name in result.unanswered),
        tuple(cases),
        tuple(figures(cases)),
        confusion(cases),
        by_parameter(cases),
        tuple(sorted({version for result in results for version in result.versions})),
        generators[0],
    )


def _expected(folder: ChallengeFolder) -> list[str]:
    """Cases that should have an answer: in the second round those with a request."""
    first = ChallengeFolder(folder.path)
    return [n for n in folder.cases() if folder.round == 1 or first.request(n).is_file()]


def _judged(folder: ChallengeFolder, truth: Truth) -> dict[str, JudgedCase]:
    answers = folder.answers()
    if folder.round == 1:
        public = folder.cases()
        for name, given in answers.items():
            if given["recording_sha256"] != public[name]["sha256"]:
                raise InputError(f"{folder.answer(name)} answers another recording; remove it")
    return {
        drawn.case.name: judge(drawn, nats, answers[drawn.case.name])
        for drawn, nats in truth
        if drawn.case.name in answers
    }


def _against_oracle(
    folder: ChallengeFolder, truth: Truth, cases: dict[str, JudgedCase],
    parallel: tuple[int, str | None], progress: Callable[[int, int], None],
) -> list[Figure]:  # fmt: skip
    """Ratios of the held-out RMSE to that of a fit with the true structure.

    ``parallel`` holds the number of processes and the scheduler of :func:`reveal`.
    """
    answers, ratios = folder.answers(), []
    fits = {
        d.case.name: (
            folder.recording(d.case.name),
            answers[d.case.name]["diagnosis"]["open_loop"]["held_out_breaths"],
            library_names(d.case),
        )
        for d, _ in truth
        if d.case.name in cases and d.kind != "outside"
    }
    with executor(*parallel) as pool:
        for name, best in results(pool, oracle_rmse_of_file, fits):
            ratios.append(cases[name].after / best)
            progress(len(ratios), len(fits))
    return [
        statistic("held-out RMSE over the oracle's, median", ratios, np.median, _MEDIAN_RATIO),
        statistic("held-out RMSE over the oracle's, 95th percentile", ratios,
               lambda values: np.percentile(values, 95), _LARGE_RATIO),
    ]  # fmt: skip


def _as_dict(case: JudgedCase) -> dict[str, Any]:
    value = asdict(case) | {"right": case.right, "wrong": sorted(case.wrong)}
    for key in ("library", "seen", "named", "listed"):
        value[key] = sorted(value[key])
    return value


def oracle_rmse_of_file(path: Path, held_out: list[int], names: frozenset[str]) -> float:
    """Apply :func:`oracle_rmse` to a recording in a file."""
    return oracle_rmse(load(path), held_out, names)


def oracle_rmse(breaths: Breaths, held_out: list[int], names: frozenset[str]) -> float:
    """Held-out open-loop RMSE over inspiratory samples of a fit with the true names, cmH2O.

    Each simulated breath starts from its first reading. The effort of a future breath is unknown;
    the prediction is the mean over the efforts of the fitted breaths.

    Args:
        breaths: the recording.
        held_out: ids of the breaths on which the answer was scored.
        names: mechanisms of the library that are in the rig.

    Raises:
        InputError: if no breath or every breath is held out.
    """
    from ventbench.physics.catalogue import parameter
    from ventbench.system_id import START, Predictor, fit, make_data, parameter_values

    apart = np.isin(breaths.breath_id, held_out)
    if not apart.any() or apart.all():
        raise InputError(f"{apart.sum()} of {len(apart)} breaths are held out; both are needed")
    data = make_data(breaths)
    fitted = fit(data.select(~apart), sorted(names))
    test = data.select(apart)
    simulator = Predictor(test, fitted.problem.predictor.names)
    values = parameter_values(test, simulator.names, {})
    for column, name in enumerate(simulator.names):
        per_breath = "." in name and parameter(name).scope == "breath"
        if name != "position" and name != START and not per_breath:
            values[:, column] = fitted.column(name)[0]
    predicted = [simulator.predict(values)]
    if set(_EFFORT) <= set(simulator.names):
        columns, predicted = [simulator.names.index(path) for path in _EFFORT], []
        for effort in zip(*(fitted.column(path) for path in _EFFORT), strict=True):
            values[:, columns] = effort
            predicted.append(simulator.predict(values))
    error = np.mean(predicted, axis=0)[:, 0] - test.measured[:, 0]
    counted = (test.u_out < 0.5) & (test.weight[:, 0] > 0)
    counted[:, 0] = False  # every simulation starts there, and no answer is scored there either
    return float(np.sqrt(np.mean(error[counted] ** 2)))
