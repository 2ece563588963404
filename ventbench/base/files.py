"""Files: written in one step, and found where ventbench lies.

Writing is never half done: it goes to a temporary file beside the target, which is then renamed.

A symbolic link keeps pointing where it did: the file that it names is replaced. A target that is no
regular file (``/dev/stdout``, ``/dev/full``, a named pipe) is written to directly, never replaced.

The files that travel with ventbench lie in the checkout or inside the installed wheel.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
import stat
import tempfile
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

from ventbench.base.errors import InputError

try:
    import fcntl
except ImportError:  # not a POSIX system
    fcntl = None


def write_atomically(path: Path, write: Callable[[IO[bytes]], object]) -> None:
    """Create or replace a file in one step, and its folder if it is missing.

    ``write`` receives a binary file object and writes the content to it.

    Raises:
        OSError: if the folder or file cannot be written; it names the target, whose old content
            stays.
    """
    unresolved, path = path, Path(os.path.realpath(path))
    try:
        if path.exists() and not path.is_file():
            _write_directly(path, write)
        else:
            path.parent.mkdir(parents=True, exist_ok=True)
            _replace(path, write)
    except OSError as error:
        # Whoever reads the message knows the target, not the temporary file beside it; a full disk
        # names no file at all.
        nameless = error.errno is not None and error.filename is None
        if nameless or Path(str(error.filename)).name.startswith(f".{path.name}."):
            error.filename = str(unresolved)
        raise


def _write_directly(path: Path, write: Callable[[IO[bytes]], object]) -> None:
    """Write the content to what is no regular file, such as a device or a pipe."""
    content = io.BytesIO()  # writers may seek, which a pipe cannot
    write(content)
    with open(path, "wb") as file:
        file.write(content.getvalue())


def _replace(path: Path, write: Callable[[IO[bytes]], object]) -> None:
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            write(file)
        umask = os.umask(0)
        os.umask(umask)
        os.chmod(temporary, 0o666 & ~umask)  # mkstemp made it private
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def write_bytes(path: Path, content: bytes) -> None:
    """Create or replace a file in one step."""
    write_atomically(path, lambda file: file.write(content))


def write_text(path: Path, text: str) -> None:
    """Create or replace a UTF-8 text file in one step."""
    write_bytes(path, text.encode())


def read_limited(path: Path, most: int) -> bytes:
    """Read a file that anybody may have written, of at most so many bytes.

    Raises:
        InputError: if it is a link or no plain file, or larger.
        OSError: if there is none, or it cannot be read.
    """
    status = path.lstat()
    if not stat.S_ISREG(status.st_mode):
        raise InputError(f"{path} is no plain file; give the file itself, and no link")
    if status.st_size > most:
        raise InputError(f"{path} has {status.st_size} bytes, and may have {most} at most")
    return path.read_bytes()


def as_json(value: Any) -> str:
    """Text of a JSON file; ValueError if a number is not finite."""
    return json.dumps(value, indent=2, allow_nan=False) + "\n"


def write_json(path: Path, value: Any) -> None:
    """Create or replace a JSON file in one step; see :func:`as_json`."""
    write_text(path, as_json(value))


def json_values(value: Any) -> Any:
    """Plain JSON values of nested dicts, sequences, and NumPy or JAX arrays and numbers.

    A number that is not finite becomes None.
    """
    if isinstance(value, dict):
        return {str(key): json_values(part) for key, part in value.items()}
    if hasattr(value, "tolist"):  # an array or a number of NumPy or JAX
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [json_values(part) for part in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


#: Locks of this process, by folder; the system releases them when it ends.
_claims: dict[Path, int] = {}


def claim_folder(folder: Path) -> None:
    """Check that results can be written to a folder, and keep other processes out of it.

    The claim lasts until this process ends, however it ends. A process may claim a folder again.
    The lock itself lies in the folder of temporary files; nothing is created in ``folder``.

    Raises:
        InputError: if it is a file, cannot be written to, or another process has claimed it.
    """
    real = Path(os.path.realpath(folder))
    if real in _claims:
        return
    if real.exists() and not real.is_dir():
        raise InputError(f"--out {folder} is a file, not a folder; choose another one")
    nearest = next(parent for parent in (real, *real.parents) if parent.exists())
    if not nearest.is_dir() or not os.access(nearest, os.W_OK | os.X_OK):
        raise InputError(f"--out {folder}: {nearest} cannot be written to; choose another folder")
    if fcntl is None:  # no locks on this system
        return
    locks = Path(tempfile.gettempdir()) / f"ventbench-locks-{os.getuid()}"
    locks.mkdir(mode=0o700, exist_ok=True)
    name = hashlib.sha256(os.fsencode(real)).hexdigest()
    lock = os.open(locks / name, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    try:
        fcntl.lockf(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        os.close(lock)
        raise InputError(
            f"--out {folder}: another ventbench writes to this folder; wait for it or choose "
            "another folder"
        ) from error
    _claims[real] = lock


def sha256(path: Path) -> str:
    """SHA-256 of a file, as hexadecimal text."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


_PACKAGE = Path(__file__).resolve().parents[1]


def _folder(name: str) -> Path:
    # Inside a wheel first: beside an installed package, `data` may be anybody's.
    installed = _PACKAGE / f"_{name}"
    return installed if installed.is_dir() else _PACKAGE.parent / name


def data_path(name: str) -> Path:
    """Path of a file below ``data``, which travels with ventbench, such as ``"draws-v1.npz"``.

    Raises:
        InputError: if it is not there.
    """
    path = _folder("data") / name
    if not path.exists():
        raise InputError(
            f"{path} is missing; it belongs to ventbench: reinstall it, or restore the file"
        )
    return path


def submissions_folder() -> Path:
    """Folder of the submissions that travel with ventbench; may be missing."""
    return _folder("submissions")


def leaderboard_folder() -> Path:
    """Folder of the leaderboard of the last round, which travels with ventbench."""
    return _folder("leaderboard")


def data_beside(module: str, name: str) -> dict[str, Any]:
    """Content of a TOML file that lies beside a module, of which this is the file's path.

    Its lists are tuples.
    """
    return _frozen(tomllib.loads(Path(module).with_name(name).read_text("utf-8")))


def _frozen(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _frozen(each) for key, each in value.items()}
    return tuple(map(_frozen, value)) if isinstance(value, list) else value


def example(name: str) -> Path:
    """Path of an example recording: synthetic breaths, described in ``manifest.toml`` beside them.

    Args:
        name: ``"concealed"`` (an effect that R-C lungs lack), ``"sound"`` (nothing is missing) or
            ``"flow"`` (pressure and flow of a lung with a wrong label); or a file of the folder.

    Raises:
        InputError: if there is no such example.

    Examples:
        >>> import ventbench
        >>> ventbench.example("sound").name
        'sound.csv'
    """
    folder = data_path("examples")
    path = folder / (name if "." in name else f"{name}.csv")
    if not path.is_file():
        examples = ", ".join(sorted(file.stem for file in folder.glob("*.csv")))
        raise InputError(f"there is no example {name!r}; choose one of {examples}")
    return path
