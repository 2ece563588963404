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

from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np
import typer
from scipy.optimize import minimize
from scipy.special import expit

from proofs.challenge.contract import PUBLISHED
from proofs.challenge.figures import calibration_error, interval
from proofs.challenge.folder import ChallengeFolder
from proofs.challenge.judge import FLOOR, JudgedCase
from proofs.challenge.reveal import reveal
from proofs.challenge.truth import is_right
from proofs.diagnosers.ventbench import CALIBRATION, Calibration, hypotheses

#: Folds of cases, and draws of what happens by chance.
FOLDS, DRAWS = 10, 2000

Case = tuple[dict[str, Any], JudgedCase]


def told(case: Case, shares: Calibration) -> dict[frozenset[str], float]:
    """Probabilities that a verdict gets, by terms."""
    answer = hypotheses(case[0], PUBLISHED, shares)
    return {frozenset(each["terms"]): each["probability"] for each in answer}


def log_score(case: Case, given: dict[frozenset[str], float]) -> float:
    """As the judge has it."""
    belief = sum(p for terms, p in given.items() if is_right(terms, case[1].truth))
    return -float(np.log(max(belief, FLOOR)))


def fitted(cases: list[Case]) -> Calibration:
    """The shares of the best log score."""

    def cost(z: np.ndarray) -> float:
        prior = -np.sum(np.log(expit(z)) + np.log(expit(-z)))
        shares = Calibration(*expit(z).tolist())
        return float(sum(log_score(case, told(case, shares)) for case in cases) + prior)

    return Calibration(*expit(minimize(cost, np.zeros(len(fields(Calibration)))).x).tolist())


def told_and_right(case: Case, given: dict[frozenset[str], float]) -> tuple[float, float]:
    """Confidence in the likeliest hypotheses, and whether one of them is right."""
    most = max(given.values())
    leading = [terms for terms, p in given.items() if p >= most - 1e-6]
    right = any(is_right(terms, case[1].truth) for terms in leading)
    return min(most * len(leading), 1.0), float(right)


def tell(what: str, scores: list[float], believed: list[tuple[float, float]]) -> None:
    """Print log score and calibration error with their intervals."""
    values = np.array(believed)
    low, high = interval(np.array(scores), lambda x: x.mean(axis=1))
    error = float(calibration_error(values[None])[0])
    span = interval(values, calibration_error)
    rng = np.random.default_rng(0)
    drawn = np.broadcast_to(values, (DRAWS, *values.shape)).copy()
    drawn[..., 1] = rng.uniform(size=drawn.shape[:2]) < values[:, 0]
    chance = float(calibration_error(drawn).mean())
    print(
        f"{what}: log score {np.mean(scores):.2f} ({low:.2f} to {high:.2f}), ECE {error:.3f} "
        f"({span[0]:.3f} to {span[1]:.3f}), by chance {chance:.3f}"
    )


def main(folders: list[Path], seed: list[str]) -> None:
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
    tell(
        "as answered",
        [c.log_score for _, c in cases],
        [(c.confidence, float(c.isolation > 0.0)) for _, c in cases],
    )
    groups = np.random.default_rng(0).permutation(len(cases)) % FOLDS
    apart: list[dict[frozenset[str], float]] = [{} for _ in cases]
    for fold in range(FOLDS):
        shares = fitted([case for case, group in zip(cases, groups, strict=True) if group != fold])
        for k in np.flatnonzero(groups == fold):
            apart[k] = told(cases[k], shares)
    for what, every in (
        ("with the shares in the code", [told(case, CALIBRATION) for case in cases]),
        ("fitted, cases left out", apart),
    ):
        pairs = list(zip(cases, every, strict=True))
        tell(what, [log_score(*pair) for pair in pairs], [told_and_right(*pair) for pair in pairs])
    print({name: round(share, 2) for name, share in asdict(fitted(cases)).items()})


if __name__ == "__main__":
    typer.run(main)
