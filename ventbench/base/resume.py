"""Work that an interruption does not lose: finished results in a folder, and checkpoints.

A long computation keeps what it has finished in a :class:`WorkFolder` and, within one result, the
state between two of its steps in a :class:`Checkpoint`. Both remember the settings they were made
with and refuse to continue under others, so that a result never mixes two computations. All files
are written in one step, as plain JSON and arrays, never pickle.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Executor
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from ventbench.base import files
from ventbench.base.errors import InputError
from ventbench.base.executor import results

TreeT = TypeVar("TreeT")

#: File of a :class:`WorkFolder` that holds the settings.
SETTINGS = "settings.json"


_opened: dict[Path, None] = {}  # in order, each once


def opened() -> Path | None:
    """Return the folder or file in which this process keeps unfinished work, the newest one."""
    return next((path for path in reversed(list(_opened)) if path.exists()), None)


class Format(NamedTuple):
    """Format in which a result is stored."""

    suffix: str  #: suffix of the file name, with the dot.
    write: Callable[[Path, Any], object]  #: stores a value at a path, in one step.
    read: Callable[[Path], Any]  #: returns the value stored at a path.


#: JSON values.
JSON = Format(".json", files.write_json, lambda path: json.loads(path.read_text("utf-8")))

#: One numpy array.
ARRAY = Format(
    ".npy",
    lambda path, array: files.write_atomically(path, lambda file: np.save(file, array)),
    lambda path: np.load(path, allow_pickle=False),
)


class WorkFolder:
    """A folder of finished results, which belongs to one computation.

    Example::

        work = WorkFolder(out / "parts", {"seed": 0, "recipe": {"updates": 100}})
        errors = [work.get(lung, lambda: measure(lung)) for lung in lungs]
        work.delete()

    Args:
        folder: created if missing.
        settings: JSON values that determine every result, by name: recipe, seed, hashes of data.

    Raises:
        InputError: if the folder belongs to a computation with other settings.
    """

    def __init__(self, folder: Path, settings: Mapping[str, Any]) -> None:
        self.folder = folder
        path, expected = folder / SETTINGS, _plain(settings)
        if path.exists():
            _check(folder, _read(path, JSON), expected)
        else:
            files.write_json(path, expected)
        _opened[folder] = None

    def get(self, name: str, compute: Callable[[], Any], format: Format = JSON) -> Any:
        """Return a result: read if it is finished, else computed and kept.

        Raises:
            InputError: if the file of the result is damaged.
        """
        if not self.has(name, format):
            self.put(name, compute(), format)
        return self.read(name, format)

    def has(self, name: str, format: Format = JSON) -> bool:
        """Whether a result is finished."""
        return self.path(name, format).exists()

    def put(self, name: str, value: Any, format: Format = JSON) -> None:
        """Keep a finished result."""
        format.write(self.path(name, format), value)

    def read(self, name: str, format: Format = JSON) -> Any:
        """Return a finished result.

        Raises:
            InputError: if its file is damaged.
            FileNotFoundError: if it is not finished.
        """
        return _read(self.path(name, format), format)

    def path(self, name: str, format: Format = JSON) -> Path:
        """File of a result."""
        return self.folder / f"{name}{format.suffix}"

    def checkpoint(self, name: str) -> Path:
        """File in which the computation of a result can keep a :class:`Checkpoint`."""
        return self.folder / f"{name}.checkpoint.npz"

    def delete(self) -> None:
        """Delete the folder, once all results are used."""
        shutil.rmtree(self.folder, ignore_errors=True)


def kept_results(
    work: WorkFolder | None,
    pool: Executor,
    function: Callable[..., Any],
    jobs: Mapping[str, tuple[Any, ...]],
    format: Format = JSON,
) -> Iterator[tuple[str, Any]]:
    """Yield name and result of each job: what the folder has, then the others, which it keeps.

    Errors as of :meth:`WorkFolder.read` and :func:`ventbench.base.executor.results`.
    """
    finished = [name for name in jobs if work is not None and work.has(name, format)]
    for name in finished:
        assert work is not None
        yield name, work.read(name, format)
    waiting = {name: jobs[name] for name in jobs if name not in finished}
    for name, result in results(pool, function, waiting):
        if work is not None:
            work.put(name, result, format)
        yield name, result


class Checkpoint:
    """The state of an iterative computation on disk.

    Args:
        path: the file, ``.npz``; with None nothing is stored.
        settings: JSON values that determine the computation, by name; :func:`fingerprint` turns
            arrays into one.
    """

    def __init__(self, path: Path | None, settings: Mapping[str, Any]) -> None:
        self.path, self._settings = path, _plain(settings)

    def restore(self, start: TreeT) -> tuple[TreeT, int]:
        """Return the stored state and the number of steps done; ``(start, 0)`` if there is none.

        Args:
            start: state before the first step, a pytree of arrays; the stored state has its
                structure, and numpy arrays where it has numpy arrays.

        Raises:
            InputError: if the file is damaged or belongs to a computation with other settings.
        """
        path = self.path
        if path is None or not path.exists():
            return start, 0
        leaves, structure = jax.tree.flatten(start)
        try:
            with open(path, "rb") as file, np.load(file, allow_pickle=False) as saved:
                settings, done = json.loads(str(saved["settings"])), int(saved["done"])
                same = settings == self._settings
                stored = [saved[f"leaf{i}"] for i in range(len(leaves))] if same else []
        except _DAMAGED as error:
            raise InputError(
                f"{path} is not a checkpoint: {error}; delete it to start anew"
            ) from error
        _check(path, settings, self._settings)
        restored = [_like(old, new) for old, new in zip(leaves, stored, strict=True)]
        return jax.tree.unflatten(structure, restored), done

    def save(self, state: Any, done: int) -> None:
        """Store the state after ``done`` steps, in one step."""
        if self.path is None:
            return
        content: dict[str, Any] = {
            f"leaf{i}": _as_numpy(leaf) for i, leaf in enumerate(jax.tree.leaves(state))
        }
        content["settings"] = np.asarray(json.dumps(self._settings))
        content["done"] = np.asarray(done)
        files.write_atomically(self.path, lambda file: np.savez(file, **content))
        _opened[self.path] = None

    def delete(self) -> None:
        """Delete the file, if there is one."""
        if self.path is not None:
            self.path.unlink(missing_ok=True)


def fingerprint(tree: Any) -> str:
    """SHA-256 of the arrays of a pytree: their order, types, shapes and values."""
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(tree):
        array = np.ascontiguousarray(leaf)
        digest.update(f"{array.dtype.str} {array.shape}".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


#: What numpy and json raise for a text, an empty, a cut-off or a foreign file.
_DAMAGED = (KeyError, ValueError, TypeError, EOFError, OSError, zipfile.BadZipFile, zlib.error)


def _read(path: Path, format: Format) -> Any:
    try:
        return format.read(path)
    except FileNotFoundError:
        raise
    except _DAMAGED as error:
        raise InputError(f"{path} is damaged, delete it: {error}") from error


def _plain(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings as JSON would return them: tuples become lists."""
    return json.loads(json.dumps(dict(settings), sort_keys=True))


def _check(path: Path, stored: dict[str, Any], expected: dict[str, Any]) -> None:
    """Refuse work of other settings, naming those that differ."""
    if stored == expected:
        return
    absent = object()
    names = sorted(
        name
        for name in stored.keys() | expected.keys()
        if stored.get(name, absent) != expected.get(name, absent)
    )
    raise InputError(
        f"{path} holds work with other settings ({', '.join(names)}); delete it to start anew, or "
        "choose another folder with --out"
    )


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _as_numpy(leaf: Any) -> np.ndarray:
    return np.asarray(jax.random.key_data(leaf) if _is_key(leaf) else leaf)


def _like(old: Any, new: np.ndarray) -> Any:
    if isinstance(old, np.ndarray):
        return new
    return jax.random.wrap_key_data(jnp.asarray(new)) if _is_key(old) else jnp.asarray(new)
