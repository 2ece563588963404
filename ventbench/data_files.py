"""Paths of the files beside the code: in the checkout, or inside the installed wheel."""

from __future__ import annotations

from pathlib import Path

from ventbench.errors import InputError

_PACKAGE = Path(__file__).resolve().parent


def _folder(name: str) -> Path:
    # Inside a wheel first: beside an installed package, `data` may be anybody's.
    installed = _PACKAGE / f"_{name}"
    return installed if installed.is_dir() else _PACKAGE.parent / name


def data_path(name: str) -> Path:
    """Path of a file that travels with ventbench.

    Args:
        name: relative to the folder ``data``, such as ``"draws-v1.npz"``.

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
        known = ", ".join(sorted(file.stem for file in folder.glob("*.csv")))
        raise InputError(f"there is no example {name!r}; choose one of {known}")
    return path
