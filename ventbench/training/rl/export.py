"""Trained networks as plain arrays, for a submission."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from ventbench.files import write_atomically
from ventbench.training.rl import networks


def pick(policies: Any, run: int) -> Any:
    """One policy of several whose leaves are ``(R, ...)``."""
    return jax.tree.map(lambda leaf: leaf[run], policies)


def arrays(policies: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Weights and biases by name, float32: ``R20C50.w0``, ``R20C50.b0``, ``R20C50.w1``, ...

    Layer k does ``x @ wk + bk``, with tanh between the layers.

    Args:
        policies: by the lung that they are for, ``all`` for one that does not know it.
    """
    named = {}
    for name, policy in policies.items():
        for k, layer in enumerate(networks.layers(policy.parameters)):
            for kind, array in zip("wb", layer, strict=True):
                named[f"{name}.{kind}{k}"] = np.asarray(array, np.float32)
    return named


def write(path: Path, policies: Mapping[str, Any]) -> None:
    """Write ``weights.npz``; equal networks give equal bytes."""
    content: dict[str, Any] = arrays(policies)
    write_atomically(path, lambda file: np.savez(file, **content))
