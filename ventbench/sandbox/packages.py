"""What a submission imports beyond numpy, found in its text without running any of it."""

from __future__ import annotations

import re
from pathlib import Path

from ventbench.sandbox.child.preload import NUMPY

#: Packages that may be imported besides numpy and the standard library, with what to load of each.
OPTIONAL = {
    "jax": ("jax", "jax.numpy", "jax.scipy", "jax.scipy.linalg"),
    "flax": ("flax", "flax.linen", "flax.nnx"),
    "safetensors": ("safetensors", "safetensors.numpy"),
}

#: Those that start threads and reserve much address space.
_HEAVY = ("jax", "flax")

_IMPORT = re.compile(rb"^\s*(?:import|from)\s+([^\s#][^#\n]*)", re.MULTILINE)


def needed(folder: Path) -> tuple[tuple[str, ...], bool]:
    """Modules to load before cells start, so that they share them.

    Args:
        folder: of the submission.

    Returns:
        The modules, and whether they need threads.
    """
    text = b"\n".join(path.read_bytes() for path in sorted(folder.rglob("*.py")) if path.is_file())
    words = {word for line in _IMPORT.findall(text) for word in re.findall(rb"\w+", line)}
    found = [name for name in OPTIONAL if name.encode() in words]
    modules = [module for name in found for module in OPTIONAL[name]]
    return (*NUMPY, *modules), any(name in _HEAVY for name in found)
