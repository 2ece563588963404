"""Checks of weights: plain finite numbers, readable without pickle, of a sensible size."""

from __future__ import annotations

import json
import math
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

#: Most bytes that the arrays of one file may take once they are unpacked.
MAX_UNPACKED = 100_000_000

_SAVE = "save it with numpy.savez(path, **arrays) of finite numbers"
#: What to do, by ending.
ADVICE = {
    ".npz": _SAVE,
    ".npy": "save it with numpy.save(path, array) of finite numbers",
    ".safetensors": "save it with safetensors.numpy.save_file(arrays, path)",
}


def problems(path: Path) -> list[str]:
    """Say what is wrong with a file of arrays, each for a sentence that starts with its name.

    Args:
        path: of a ``.npz``, ``.npy`` or ``.safetensors`` file.
    """
    try:
        if path.suffix.lower() == ".safetensors":
            return _safetensors(path)
        return _npz(path) if path.suffix.lower() == ".npz" else _npy(path)
    except Exception as error:  # whatever a hostile file brings numpy and zipfile to raise
        return [f"cannot be read without pickle: {type(error).__name__}: {error}"]


def _npy(path: Path) -> list[str]:
    return _numbers({"it": np.load(path, mmap_mode="r", allow_pickle=False)})


def _npz(path: Path) -> list[str]:
    with zipfile.ZipFile(path) as archive:
        unpacked = sum(entry.file_size for entry in archive.infolist())
        names = archive.namelist()
    if unpacked > MAX_UNPACKED:
        limit = f"at most {MAX_UNPACKED / 1e6:g} MB are accepted"
        return [f"unpacks to {unpacked / 1e6:.0f} MB; {limit}"]
    if len(set(names)) < len(names):
        return ["holds two arrays of one name"]
    other = [name for name in names if not name.endswith(".npy")]
    if other:
        return [f"holds {other[0]!r}, which is no array"]
    with np.load(path, allow_pickle=False) as file:
        return _numbers({f"array {key!r}": file[key] for key in file.files})


def _numbers(arrays: Mapping[str, Any]) -> list[str]:
    found = []
    for name, values in arrays.items():
        if not isinstance(values, np.ndarray) or values.dtype.kind not in "biuf":
            found.append(f"{name} does not hold numbers")
        elif not np.isfinite(values).all():
            found.append(f"{name} holds NaN or infinity")
    return found


def _safetensors(path: Path) -> list[str]:
    content = path.read_bytes()
    size = int.from_bytes(content[:8], "little")
    if len(content) < 8 or size > len(content) - 8:
        return ["is not a safetensors file"]
    header = json.loads(content[8 : 8 + size])
    data, found = content[8 + size :], []
    for name, about in header.items():
        if name == "__metadata__":
            continue
        begin, end = about["data_offsets"]
        kind, count = about["dtype"], math.prod(about["shape"])
        if not 0 <= begin <= end <= len(data):
            found.append(f"array {name!r} lies outside of the file")
        elif kind in _FLOATS:
            values = np.frombuffer(data[begin:end], _FLOATS[kind])
            if len(values) != count:
                found.append(f"array {name!r} does not have the size of its shape")
            elif not np.isfinite(values).all():
                found.append(f"array {name!r} holds NaN or infinity")
    return found


_FLOATS = {"F16": "<f2", "F32": "<f4", "F64": "<f8"}
