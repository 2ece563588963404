"""Making a challenge: recordings for everyone, answers under seal, and the hash of the answers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np

from hardware_eval.emulation.cases import Case, random_generator
from proofs.challenge.detectability import log_likelihood_loss
from proofs.challenge.folder import ChallengeFolder, Withheld, encode_answers
from proofs.challenge.generators import generator, generator_of
from proofs.challenge.questions import DrawnCase, Kind
from proofs.challenge.seal import commitment, encrypt
from ventbench.base import files
from ventbench.base.arrays import Bools, runs
from ventbench.base.errors import InputError
from ventbench.base.executor import executor, results
from ventbench.recordings.breaths import Breaths, write
from ventbench.recordings.schema import COLUMNS

#: Limits of a recorded pressure.
PRESSURE = COLUMNS["pressure"]

#: Attempts to stay within the limits: with other commands of the usual size first, then with
#: gentler ones, each this share of the attempt before.
_USUAL_ATTEMPTS, _GENTLE_ATTEMPTS, _GENTLER = 10, 10, 0.85

#: One breath in so many is withheld.
_WITHHELD = 6

#: Records a case; has the arguments of :func:`~proofs.challenge.first.rig.record`. That of
#: the case's generator if None.
Record = Callable[..., Breaths] | None


def make(
    secret: str,
    out: Path,
    kind: Kind | Literal["all"],
    count: int,
    *,
    workers: int = 0,
    source: str = "first",
    record: Record = None,
    progress: Callable[[int, int], object] = lambda done, total: None,
) -> str:
    """Write a challenge.

    The same secret, kind, count and generator give the same bytes.

    Args:
        secret: seed of everything that is drawn.
        out: folder, which must not hold a challenge yet.
        kind: kind of the cases.
        count: number of cases.
        workers: number of processes; 0 for this one alone.
        source: name of the generator, one of :data:`~proofs.challenge.generators.GENERATORS`.
        record: see :data:`Record`; a function of a module if there are processes.
        progress: called with the numbers of finished and of all recordings.

    Returns:
        The commitment: SHA-256 of the answers.

    Raises:
        InputError: if the folder holds a challenge, or there are too few cases for all kinds.
    """
    folder = ChallengeFolder(out)
    if folder.sealed.exists():
        raise InputError(f"{out} holds a challenge already; choose another folder")
    drawn = [
        DrawnCase(question.kind, replace(question.case, name=f"case_{k:04d}"))
        for k, question in enumerate(
            generator(source).draw(kind, count, random_generator(secret, "plan")), start=1
        )
    ]
    with executor(workers) as pool:
        work = {question.case.name: (secret, folder, question, record) for question in drawn}
        for done, _ in enumerate(results(pool, _make_case, work), start=1):
            progress(done, count)
    text = encode_answers(secret, drawn)
    files.write_text(folder.commitment, commitment(text) + "\n")
    entries = [
        {
            "file": f"recordings/{question.case.name}.csv",
            "lung": question.case.lung,
            "sha256": files.sha256(folder.recording(question.case.name)),
            "withheld": withheld_breaths(secret, question.case),
        }
        for question in drawn
    ]
    files.write_json(folder.public, {"cases": entries})
    sealed = encrypt(text, secret, folder.public.read_bytes())
    files.write_atomically(folder.sealed, lambda file: file.write(sealed))
    return commitment(text)


def _make_case(secret: str, folder: ChallengeFolder, drawn: DrawnCase, record: Record) -> None:
    """Record one case."""
    case = drawn.case
    breaths = record_within_limits(secret, drawn, record=record)
    apart = np.isin(breaths.breath_id, withheld_breaths(secret, case))
    active = generator_of(case).active(case, breaths)
    folder.keep(
        case.name,
        secret,
        Withheld(
            {
                int(breaths.breath_id[k]): _readings(breaths, k)
                for k in np.flatnonzero(apart).tolist()
            },
            None if active is None else _intervals(breaths, active),
            tuple(log_likelihood_loss(case, breaths, k) for k in range(len(case.effects))),
        ),
    )
    blank = np.where(apart[:, None], np.nan, breaths.pressure)
    write(replace(breaths, pressure=blank), folder.recording(case.name))


def withheld_breaths(secret: str, case: Case) -> list[int]:
    """Ids of the breaths whose pressures no diagnoser sees: every sixth, two at least."""
    count = max(2, case.breaths // _WITHHELD)
    rng = random_generator(secret, "withheld", case.name)
    # One of each stretch of the session, and neither its first nor its last breath.
    edges = np.linspace(1, case.breaths - 1, count + 1).astype(int)
    return [int(rng.integers(low, high)) + 1 for low, high in pairwise(edges)]


def _readings(breaths: Breaths, k: int) -> tuple[float | None, ...]:
    return tuple(None if np.isnan(p) else float(p) for p in breaths.pressure[k])


def _intervals(breaths: Breaths, active: Bools) -> dict[int, tuple[tuple[float, float], ...]]:
    """Where an effect acts, as intervals of time of the breaths."""
    found = {}
    for number, time, flags in zip(breaths.breath_id, breaths.time, active, strict=True):
        spans = [(float(time[a]), float(time[b - 1])) for a, b in runs(flags)]
        if spans:
            found[int(number)] = tuple(spans)
    return found


def record_within_limits(
    secret: str,
    drawn: DrawnCase,
    *,
    usual: int = _USUAL_ATTEMPTS,
    gentle: int = _GENTLE_ATTEMPTS,
    record: Record = None,
) -> Breaths:
    """Record a case, repeatedly until the pressures are within the limits of a recording.

    Lungs that stiffen steeply leave the limits under all usual commands.

    Args:
        secret: secret of the challenge.
        drawn: the case.
        usual: number of attempts with commands of the usual size.
        gentle: number of attempts with smaller and smaller ones after these.
        record: see :data:`Record`.

    Raises:
        InputError: if every attempt leaves the limits.
    """
    name, take = drawn.case.name, record or generator_of(drawn.case).record
    for attempt in range(usual + gentle):
        repeated = () if attempt == 0 else (f"again {attempt}",)
        share = _GENTLER ** max(attempt - usual + 1, 0)
        rng = random_generator(secret, "recording", name, *repeated)
        breaths = take(drawn.case, rng, share=share)
        pressure = breaths.pressure[np.isfinite(breaths.pressure)]
        if np.all((pressure >= PRESSURE.low) & (pressure <= PRESSURE.high)):
            return breaths
    span = f"{PRESSURE.low:g}..{PRESSURE.high:g} cmH2O"
    raise InputError(f"{name} leaves {span} at every attempt; take another seed")
