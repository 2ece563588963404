"""Residual controllers in one file, as the submissions read it: an ``.npz`` of plain arrays.

For each network, by the id of its lung or ``all``: ``ID.gains`` (P, I, D), ``ID.limit``,
``ID.windows`` (pressures, commands, ahead) and the layers ``ID.w0``, ``ID.b0``, ``ID.w1``, ...
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from ventbench import files
from ventbench.controllers.pid import PID
from ventbench.controllers.residual import Residual
from ventbench.errors import InputError

#: Name of the network that is not told the lung.
ALL = "all"


def save(path: Path, controllers: Mapping[str, Residual]) -> None:
    """Write controllers, by lung id or :data:`ALL`, in one step; equal ones give equal bytes."""
    arrays: dict[str, Any] = {}
    for name, one in controllers.items():
        windows = (one.pressures, one.commands, one.ahead)
        arrays[f"{name}.gains"] = np.array([float(x) for x in (one.pid.P, one.pid.I, one.pid.D)])
        arrays[f"{name}.limit"] = np.array(one.limit)
        arrays[f"{name}.windows"] = np.array(windows, np.int64)
        for k, (weights, biases) in enumerate(one.layers):
            arrays[f"{name}.w{k}"] = np.asarray(weights, np.float32)
            arrays[f"{name}.b{k}"] = np.asarray(biases, np.float32)
    files.write_atomically(path, lambda file: np.savez(file, **arrays))


def load(path: Path) -> dict[str, Residual]:
    """Read what :func:`save` wrote, with leaves of the precision that is in force.

    Raises:
        InputError: if it is not such a file.
        OSError: if it cannot be read.
    """
    try:
        with np.load(path, allow_pickle=False) as arrays:
            names = [key.removesuffix(".gains") for key in arrays.files if key.endswith(".gains")]
            return {name: _one(arrays, name) for name in names}
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} holds no residual controllers: {error!r}") from error


def _one(arrays: Any, name: str) -> Residual:
    count = sum(key.startswith(f"{name}.w") for key in arrays.files) - 1  # without `windows`
    dtype = jnp.zeros(()).dtype
    layers = tuple(
        (jnp.asarray(arrays[f"{name}.w{k}"], dtype), jnp.asarray(arrays[f"{name}.b{k}"], dtype))
        for k in range(count)
    )
    P, I, D = arrays[f"{name}.gains"]  # noqa: E741
    pressures, commands, ahead = (int(x) for x in arrays[f"{name}.windows"])
    return Residual(
        PID(P, I, D),
        layers,
        pressures=pressures,
        commands=commands,
        ahead=ahead,
        limit=float(arrays[f"{name}.limit"]),
    )
