"""What ``--plant`` means: the official simulators, R-C lungs, or those of a file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ventbench.errors import InputError
from ventbench.interfaces import Plant
from ventbench.lungs import LUNGS, Lung, lung
from ventbench.plants import alike, frozen, text_files


@dataclass(frozen=True, eq=False)
class Chosen:
    """Simulators of some lungs.

    Attributes:
        plants: stacked over the lungs.
        lungs: in their order.
        about: what a score must say of them.
        official: the official simulators if they are these, else None.
    """

    plants: Plant
    lungs: tuple[Lung, ...]
    about: dict[str, Any]
    official: frozen.Frozen | None = None


def choose(text: str) -> Chosen:
    """Simulators by what ``--plant`` says: ``frozen``, ``hybrid``, ``physics`` or a file.

    Raises:
        InputError: if there is no such file, or it is none of plants.
    """
    if text in ("frozen", "hybrid"):  # the official ones are hybrids
        found = frozen.load()
        return Chosen(found.plants, LUNGS, found.about(), found)
    if text == "physics":
        return Chosen(physics_lungs(), LUNGS, {"kind": "physics"})
    plants = read(Path(text))
    return Chosen(
        alike.stacked(list(plants.values())),
        tuple(lung(name) for name in plants),
        {"kind": "file", "file": Path(text).name, "sha256": _sha256(Path(text))},
    )


def read(path: Path) -> dict[str, Plant]:
    """Plants of a file by lung; see :func:`ventbench.plants.text_files.load`.

    Raises:
        InputError: if there is no such file, or it is none of plants.
    """
    if not path.is_file():
        raise InputError(f"--plant {path}: there is no such file, nor a plant of that name")
    return text_files.load(path)


def physics_lungs() -> Plant:
    """The base model of the six lungs at their labels, stacked."""
    from ventbench import precision
    from ventbench.physics import physics

    with precision.float64():
        return alike.stacked([physics(item) for item in LUNGS])


def _sha256(path: Path) -> str:
    from ventbench import files

    return files.sha256(path)
