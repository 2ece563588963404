"""Do predicted confusions of mechanisms foretell the actual ones, on cases whose seal is open?

For each case with one effect of the library, :func:`ventbench.isolability` says from the commands
alone by how many nats each other mechanism is told apart from it; a diagnoser's answer says whether
it took another mechanism into consideration. The area under the curve (AUC) is the probability that
a confused pair has fewer nats than one that was not, with ties as halves; its interval is from a
bootstrap of cases.

Usage:

    python benchmarks/isolability_auc.py DIR --seed SEED [DIR --seed SEED ...] [--diagnoser NAME]
"""

from __future__ import annotations

import argparse
import zlib
from pathlib import Path

import numpy as np
from scipy.stats import rankdata

import ventbench
from proofs.challenge.folder import ChallengeFolder
from proofs.challenge.truth import concealed
from ventbench.base import compilation
from ventbench.physics.catalogue import library
from ventbench.recordings import load

#: Probability from which a name was considered, and resamples of the cases.
CONSIDERED, RESAMPLES = 0.05, 2000


def area(nats: np.ndarray, confused: np.ndarray) -> float:
    """Probability that a confused pair has fewer nats than another one."""
    ranks = rankdata(-nats)
    count, others = confused.sum(), (~confused).sum()
    return float((ranks[confused].sum() - count * (count + 1) / 2) / (count * others))


def pairs(folder: ChallengeFolder, seed: str, diagnoser: str) -> list[tuple[np.ndarray, ...]]:
    """Nats, and whether they were confused, of all pairs of each case."""
    found = []
    answers = folder.answers(diagnoser)
    for (name, entry), (drawn, nats) in zip(
        folder.cases().items(), folder.truth(seed), strict=True
    ):
        effects = [each for each in concealed(drawn, nats) if each.seen]
        true = [each.name for each in effects if each.name in library()]
        if len(effects) != 1 or not true or not (answers.get(name) or {}).get("answer"):
            continue
        breaths = load(folder.recording(name))
        heard = breaths.select(~np.isin(breaths.breath_id, entry["withheld"]))
        told = ventbench.isolability(heard, lung=entry["lung"], threshold=0.0)
        by_other: dict[str, float] = {}
        for pair, value in told.nats.items():
            if true[0] in pair:
                by_other[next(other for other in pair if other != true[0])] = value
        belief = dict.fromkeys(by_other, 0.0)
        for hypothesis in answers[name]["answer"]["hypotheses"]:
            for term in hypothesis["terms"]:
                if term in belief:
                    belief[term] += hypothesis["probability"]
        found.append(
            (np.array(list(by_other.values())), np.array(list(belief.values())) >= CONSIDERED)
        )
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--seed", action="append", required=True)
    parser.add_argument("--diagnoser", default="ventbench")
    given = parser.parse_args()
    if len(given.folders) != len(given.seed):
        parser.error("give a seed for each folder, in their order")
    compilation.keep()
    cases = [
        case
        for path, seed in zip(given.folders, given.seed, strict=True)
        for case in pairs(ChallengeFolder(path), seed, given.diagnoser)
    ]
    if not cases or not any(confused.any() for _, confused in cases):
        raise SystemExit("no case with one effect of the library has a confused pair")
    rng = np.random.default_rng(zlib.crc32(" ".join(given.seed).encode()))

    def whole(which: np.ndarray) -> float:
        nats, confused = (np.concatenate([cases[k][j] for k in which]) for j in (0, 1))
        return area(nats, confused) if confused.any() else float("nan")

    every = np.arange(len(cases))
    drawn = [whole(rng.choice(every, len(every))) for _ in range(RESAMPLES)]
    low, high = np.nanquantile(drawn, (0.025, 0.975))
    confused = sum(int(c.sum()) for _, c in cases)
    count = sum(len(c) for _, c in cases)
    print(f"{len(cases)} cases, {confused} of {count} pairs confused by {given.diagnoser}")
    print(f"AUC {whole(every):.3f} ({low:.3f} to {high:.3f})")


if __name__ == "__main__":
    main()
