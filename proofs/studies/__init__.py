"""Ablations: variants of a design that differ from a base in one thing.

:func:`trained` runs the trainings of a study that are not finished, here or beside each other.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from ventbench.base.executor import InProcess, executor
from ventbench.base.resume import WorkFolder, kept_results

VariantT = TypeVar("VariantT")

#: Name of the variant that all others are compared with.
BASE = "base"

#: Called with what is trained and the share of all that is done.
Progress = Callable[[str, float], None]

#: Takes the share of a training that is done.
Tell = Callable[[float], None]


def chosen(variants: Mapping[str, VariantT], only: Sequence[str] | None) -> dict[str, VariantT]:
    """The variants of some names, and the base; all without names."""
    return {k: v for k, v in variants.items() if only is None or k in (BASE, *only)}


def trained(
    out: Path,
    settings: Mapping[str, Any],
    function: Callable[..., Any],
    jobs: Mapping[tuple[str, ...], tuple[Any, ...]],
    workers: int,
    progress: Progress,
) -> dict[tuple[str, ...], Any]:
    """Results of all trainings; those that a folder does not have yet are computed.

    Args:
        out: folder; ``rows`` in it keeps each result as soon as it is there.
        settings: JSON values that determine every result.
        function: of a module; takes the arguments of a job, then :data:`Tell`, and returns JSON
            values.
        jobs: arguments by name of the variant, and what else tells its trainings apart.
        workers: processes, each with a training at a time; 0 for this one alone.
        progress: what happens within a training can only be told where it runs in this process.

    Raises:
        InputError: if a worker process has died, or the folder is of other trainings.
    """
    work = WorkFolder((out / "rows").resolve(), settings)
    names = {"-".join(key).replace(" ", "-"): key for key in jobs}
    done, found = 0, {}

    def tell(part: str, share: float) -> None:
        progress(names[part][0], (done + share) / len(jobs))

    with executor(workers) as pool:
        here = isinstance(pool, InProcess)
        told = {
            part: (*jobs[key], partial(tell, part) if here else _silent)
            for part, key in names.items()
        }
        for part, result in kept_results(work, pool, function, told):
            found[names[part]] = result
            done += 1
            tell(part, 0.0)
    return {key: found[key] for key in jobs}


def _silent(share: float) -> None:
    """Tell nobody."""
