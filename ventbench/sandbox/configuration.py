"""What the scorer tells a zygote about a submission and its cells."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ventbench.interfaces import Task
from ventbench.sandbox import packages
from ventbench.sandbox.allowance import GIB, Allowance

#: JAX reserves address space that it does not use.
_HEAVY = 4 * GIB


def configuration(
    folder: str, label: str, tasks: Sequence[Task], allowance: Allowance
) -> dict[str, object]:
    """What a zygote is told.

    Args:
        folder: of the submission, absolute.
        label: how messages name it.
        tasks: that its cells may have.
        allowance: what they may use.
    """
    modules, threads = packages.needed(Path(folder))
    memory = max(allowance.memory, _HEAVY) if threads else allowance.memory
    return {
        "folder": folder,
        "label": label,
        "packages": modules,
        "tasks": tasks,
        "limits": {"memory": memory, "cpu_s": allowance.cpu_s, "threads": threads},
    }
