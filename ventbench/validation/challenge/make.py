"""Making a challenge: recordings for everyone, answers under seal, their hash first."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from ventbench import files
from ventbench.errors import InputError
from ventbench.recordings.breaths import Breaths
from ventbench.recordings.schema import COLUMNS
from ventbench.recordings.write import write
from ventbench.training.executor import executor, results
from ventbench.validation.challenge import seal
from ventbench.validation.challenge.detect import nats
from ventbench.validation.challenge.folder import Folder
from ventbench.validation.challenge.plan import Drawn, Kind, draw
from ventbench.validation.challenge.rig import record

#: What a recording's pressure may be, and how often a case is recorded anew that leaves it: first
#: with other commands, then with gentler ones, each time this share of those before.
PRESSURE = COLUMNS["pressure"]
_ATTEMPTS, _MORE, _GENTLER = 10, 10, 0.85


def make(
    secret: str, out: Path, kind: Kind | Literal["all"], count: int, *, jobs: int = 1,
    progress: Callable[[int], None] = lambda done: None,
) -> str:  # fmt: skip
    """Write a challenge.

    The same secret, kind and count give the same bytes.

    Args:
        secret: what everything is drawn from.
        out: folder, which must not hold a challenge yet.
        kind: of the cases.
        count: of the cases.
        jobs: processes.
        progress: told how many recordings are made.

    Returns:
        The commitment: SHA-256 of the answers.

    Raises:
        InputError: if the folder holds a challenge, or there is nothing to draw.
    """
    folder = Folder(out)
    if folder.sealed.exists():
        raise InputError(f"{out} holds a challenge already; choose another folder")
    drawn = [
        Drawn(item.kind, replace(item.case, name=f"case_{k:04d}"))
        for k, item in enumerate(draw(kind, count, seal.generator(secret, "plan")), start=1)
    ]
    worth: dict[str, list[float]] = {}
    with executor(jobs if jobs > 1 else 0) as pool:
        work = {item.case.name: (secret, folder, item) for item in drawn}
        for name, found in results(pool, _one, work):
            worth[name] = found
            progress(len(worth))
    text = seal.plain(secret, drawn, [worth[item.case.name] for item in drawn])
    files.write_text(folder.commitment, seal.commitment(text) + "\n")
    entries = [
        {
            "file": f"recordings/{item.case.name}.csv",
            "lung": item.case.lung,
            "sha256": files.sha256(folder.recording(item.case.name)),
        }
        for item in drawn
    ]
    files.write_json(folder.public, {"cases": entries})
    data = seal.sealed(text, secret, folder.public.read_bytes())
    files.write_atomically(folder.sealed, lambda file: file.write(data))
    return seal.commitment(text)


def _one(secret: str, folder: Folder, item: Drawn) -> list[float]:
    """Record one case; returns what each of its effects is worth."""
    breaths = _recorded(secret, item)
    write(breaths, folder.recording(item.case.name))
    return [round(nats(item.case, breaths, k), 1) for k in range(len(item.case.effects))]


def _recorded(secret: str, item: Drawn) -> Breaths:
    """A recording within a sensor's range: with other commands, if those of before left it.

    Lungs that stiffen steeply leave it with all of the usual ones.
    """
    name = item.case.name
    for attempt in range(_ATTEMPTS + _MORE):
        more = () if attempt == 0 else (f"again {attempt}",)
        share = _GENTLER ** max(attempt - _ATTEMPTS + 1, 0)
        rng = seal.generator(secret, "recording", name, *more)
        breaths = record(item.case, rng, share=share)
        if np.all((breaths.pressure >= PRESSURE.low) & (breaths.pressure <= PRESSURE.high)):
            return breaths
    span = f"{PRESSURE.low:g}..{PRESSURE.high:g} cmH2O"
    raise InputError(f"{name} leaves {span} at every attempt; take another seed")
