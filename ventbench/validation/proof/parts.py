"""The parts of the proof: which recordings, which simulator, and what must be found."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import numpy as np

from ventbench import files, precision
from ventbench.diagnosis.simulators import Given
from ventbench.lungs import LUNG_IDS, LUNGS
from ventbench.physics.model import Physics
from ventbench.plants import text_files
from ventbench.plants.two_balloon import two_balloon
from ventbench.recordings.breaths import Breaths
from ventbench.validation.proof import inject, remove

#: Lungs of the parts whose simulator must be asked too, which takes as long again: each C once, and
#: both R. Chosen by that rule, not by what comes out.
FEW = ("R20C10", "R5C20", "R20C50")

#: Lag that is injected, s.
LAG = 0.080


@dataclass(frozen=True, eq=False)
class Setting:
    """What a diagnosis is made of.

    Attributes:
        breaths: recorded ones, perhaps with an injected effect.
        plant: simulator to diagnose.
        called: what reports call it.
        wanted: mechanism that must be named, or None.
        about: JSON values: what was injected or removed.
    """

    breaths: Breaths
    plant: Given
    called: str
    wanted: str | None = None
    about: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Part:
    """One diagnosis of the proof.

    Attributes:
        name: of its folder.
        title: in words.
        lungs: that it is about.
        set_up: makes its setting, from the breaths of its lungs and the folder of the proof; or
            says why there is none.
        needs: part that must be finished before.
    """

    name: str
    title: str
    lungs: tuple[str, ...]
    set_up: Callable[[Breaths, Path], Setting | str]
    needs: str | None = None


def _rc(breaths: Breaths, out: Path) -> Setting:
    return Setting(breaths, "physics", "physics")


def _two_balloon(breaths: Breaths, out: Path) -> Setting:
    with precision.float64():
        plants = {item.id: jax.tree.map(np.asarray, two_balloon(item)) for item in LUNGS}
    return Setting(breaths, plants, "two-balloon")


def _removed(breaths: Breaths, out: Path) -> Setting | str:
    corrected = out / "rc" / "corrected.json"
    found = json.loads((out / "rc" / "diagnosis.json").read_text("utf-8"))
    name = remove.most_important(found["mechanisms"])
    if name is None:
        return "rc names nothing that all breaths share, so that there is nothing to remove"
    plants = {
        key: remove.without(plant, (name,)) if isinstance(plant, Physics) else plant
        for key, plant in text_files.load(corrected).items()
    }
    about = {"removed": name, "corrected_sha256": files.sha256(corrected)}
    return Setting(breaths, plants, f"corrected R-C without {name}", name, about)


def _frozen(breaths: Breaths, out: Path) -> Setting:
    return Setting(breaths, "frozen", "frozen")


def _injected(breaths: Breaths, out: Path) -> Setting:
    slower = inject.slower_sensor(breaths, LAG)
    return Setting(slower, "frozen", "frozen", "sensor_lag", {"injected_tau_s": LAG})


#: By name, in the order in which they run.
PARTS: dict[str, Part] = {
    part.name: part
    for part in (
        Part("rc", "R-C lungs at their labels", LUNG_IDS, _rc),
        Part("two_balloon", "the paper's two-balloon lungs at their labels", LUNG_IDS,
             _two_balloon),
        Part("removed", "the corrected R-C lungs, a mechanism removed", FEW, _removed, "rc"),
        Part("injected", "the frozen simulators, recordings with a sensor lag", FEW, _injected),
        Part("frozen", "the frozen simulators, recordings as they are", FEW, _frozen),
    )
}  # fmt: skip
