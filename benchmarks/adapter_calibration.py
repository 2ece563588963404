"""What shares do the parts of a diagnosis deserve? Fitted on cases whose seal is open.

The probabilities of ``proofs/diagnosers/ventbench.py`` follow from the stored diagnosis and two
shares. These are fitted to the log score of all cases, with a weak prior (a Beta of 2 and 2), and
judged on cases that they were not fitted to, in ten folds of cases. A calibration error is above
zero by chance: beside it stands what cases with these probabilities have on average if they are
exactly right.

Usage:

    python benchmarks/adapter_calibration.py DIR --seed SEED [DIR --seed SEED ...]
"""

from __future__ import annotations

from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from scipy.optimize import minimize
from scipy.special import expit

from proofs.challenge.contract import PUBLISHED
from proofs.challenge.figures import calibration_error, interval
from proofs.challenge.folder import ChallengeFolder
from proofs.challenge.judge import JudgedCase
from proofs.challenge.reveal import reveal
from proofs.challenge.truth import is_right
from proofs.diagnosers.ventbench import CALIBRATION, Calibration, hypotheses

#: Folds of cases, and draws of what happens by chance.
FOLDS, DRAWS = 10, 2000

Case = tuple[dict[str, Any], JudgedCase]


def rejudged(case: Case, shares: Calibration) -> JudgedCase:
    """The case as it is judged with other shares of the parts."""
    notes, judged = case
    answer = hypotheses(notes, PUBLISHED, shares)
    given = {frozenset(each["terms"]): each["probability"] for each in answer}
    right = {terms for terms in given if is_right(terms, judged.truth)}
    most = max(given.values())
    leading = tuple(terms for terms, p in given.items() if p >= most - 1e-6)
    return replace(
        judged,
        belief=sum(given[terms] for terms in right),
        leading=leading,
        confidence=min(most * len(leading), 1.0),
        isolation=float(not right.isdisjoint(leading)),
    )


def fitted(cases: list[Case]) -> Calibration:
    """The shares of the best log score."""

    def cost(z: np.ndarray) -> float:
        prior = -np.sum(np.log(expit(z)) + np.log(expit(-z)))
        shares = Calibration(*expit(z).tolist())
        return float(sum(rejudged(case, shares).log_score for case in cases) + prior)

    return Calibration(*expit(minimize(cost, np.zeros(len(fields(Calibration)))).x).tolist())


def tell(what: str, cases: list[JudgedCase]) -> None:
    """Print log score and calibration error with their intervals."""
    scores = np.array([case.log_score for case in cases])
    values = np.array([(case.confidence, float(case.isolation > 0.0)) for case in cases])
    low, high = interval(scores, lambda x: x.mean(axis=1))
    error = float(calibration_error(values[None])[0])
    span = interval(values, calibration_error)
    rng = np.random.default_rng(0)
    drawn = np.broadcast_to(values, (DRAWS, *values.shape)).copy()
    drawn[..., 1] = rng.uniform(size=drawn.shape[:2]) < values[:, 0]
    chance = float(calibration_error(drawn).mean())
    print(
        f"{what}: log score {scores.mean():.2f} ({low:.2f} to {high:.2f}), ECE {error:.3f} "
        f"({span[0]:.3f} to {span[1]:.3f}), by chance {chance:.3f}"
    )


def main(folders: list[Path], seed: Annotated[list[str], typer.Option()]) -> None:
    """What shares do the parts of a diagnosis deserve?"""
    if len(folders) != len(seed):
        raise typer.BadParameter("give a seed for each folder, in their order")
    cases: list[Case] = []
    for path, secret in zip(folders, seed, strict=True):
        folder = ChallengeFolder(path)
        answers = folder.answers("ventbench")
        judged = reveal([folder], [secret], "ventbench").cases
        cases += [
            (answers[n]["answer"]["notes"], c) for (_, n), c in judged.items() if not c.problem
        ]
    tell("as answered", [judged for _, judged in cases])
    tell("with the shares in the code", [rejudged(case, CALIBRATION) for case in cases])
    groups = np.random.default_rng(0).permutation(len(cases)) % FOLDS
    apart = []
    for fold in range(FOLDS):
        shares = fitted([case for case, group in zip(cases, groups, strict=True) if group != fold])
        apart += [rejudged(cases[k], shares) for k in np.flatnonzero(groups == fold)]
    tell("fitted, cases left out", apart)
    print({name: round(share, 2) for name, share in asdict(fitted(cases)).items()})


if __name__ == "__main__":
    typer.run(main)
