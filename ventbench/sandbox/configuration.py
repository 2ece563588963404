"""What a submission may use, what it imports, and what the scorer tells a zygote of both."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ventbench.base.errors import InputError
from ventbench.sandbox.child.cell import SubmissionError
from ventbench.sandbox.child.zygote import NUMPY
from ventbench.sandbox.reader import UnreadableError, read_apart


class SandboxError(InputError):
    """This machine cannot run submissions apart as was asked for; the message says what to do."""


MIB, GIB = 1 << 20, 1 << 30


@dataclass(frozen=True)
class Allowance:
    """Limits of a session; the processor is shared by all its cells, hence patience, not a pace."""

    memory: int = 512 * MIB  #: bytes of one cell beyond the interpreter with its libraries.
    cpu_s: int = 60  #: seconds of processor time of one cell: import, reset and three breaths.
    start_patience_s: float = 20.0  #: processor time in which a controller is imported and reset.
    #: processor time of one answer. Cells that wait for something, or for a processor, time out
    #: when none of them has answered for a multiple of it on the clock.
    patience_s: float = 5.0
    #: all cells time out when a session has taken this long on the clock, so that no entry keeps
    #: others waiting for longer.
    total_s: float = 900.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not value > 0:
                raise ValueError(f"allowance {name} is {value}, it must be positive")


#: Packages that may be imported besides numpy and the standard library, with what to load of each.
OPTIONAL = {
    "jax": ("jax", "jax.numpy", "jax.scipy", "jax.scipy.linalg"),
    "flax": ("flax", "flax.linen", "flax.nnx"),
    "safetensors": ("safetensors", "safetensors.numpy"),
}

#: Those that start threads and reserve much address space.
_THREADED = ("jax", "flax")


def modules_needed(folder: Path) -> tuple[tuple[str, ...], bool]:
    """Modules to load before cells start, so that they share them, and whether they need threads.

    Raises:
        SubmissionError: if the sources cannot be read within the limits.
    """
    try:
        packages = read_apart("ventbench.sandbox.child.sources:imported_packages", folder)
    except UnreadableError as error:
        raise SubmissionError(f"{folder.name}: a source {error}") from None
    imported = [name for name in OPTIONAL if name in packages]
    modules = [module for name in imported for module in OPTIONAL[name]]
    return (*NUMPY, *modules), any(name in _THREADED for name in imported)


#: JAX reserves address space that it does not use.
_THREADED_MEMORY = 4 * GIB


def configuration(folder: str, label: str, allowance: Allowance) -> dict[str, object]:
    """What a zygote is told of a submission: folder, name in messages, and what cells may use."""
    modules, threads = modules_needed(Path(folder))
    memory = max(allowance.memory, _THREADED_MEMORY) if threads else allowance.memory
    return {
        "folder": folder,
        "label": label,
        "packages": modules,
        "limits": {"memory": memory, "cpu_s": allowance.cpu_s, "threads": threads},
    }
