"""The parts of the proof on the real rig: recordings, simulator, and what must be named.

A part may add an effect to the recordings (a slower sensor) or take a mechanism out of a simulator.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import jax
import numpy as np

from ventbench.base import compilation, files
from ventbench.base.arrays import Floats
from ventbench.physics.catalogue import basis_terms, library, mechanism, parameter
from ventbench.physics.model import Physics
from ventbench.plants.catalog import SimulatorLike
from ventbench.plants.corrected import Corrected
from ventbench.plants.plant_files import load_plants
from ventbench.plants.two_balloon import two_balloon
from ventbench.recordings.breaths import Breaths
from ventbench.task.interfaces import Plant
from ventbench.task.lungs import LUNG_IDS, LUNGS

#: Lungs of the parts that must also simulate a learned plant, which takes as long again: each C
#: once, and both R. This rule chose them before anything was computed.
FEW = ("R20C10", "R5C20", "R20C50")

#: Time constant of the lag that is injected, s.
LAG = 0.080


@dataclass(frozen=True, eq=False)
class Setting:
    """Input of a diagnosis."""

    breaths: Breaths  #: recorded breaths, perhaps with an injected effect.
    plant: SimulatorLike  #: simulator to diagnose.
    plant_name: str  #: name of the simulator in reports.
    wanted: str | None = None  #: mechanism that must be named, or None.
    #: JSON values: what was injected or removed.
    about: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Part:
    """One diagnosis of the proof."""

    name: str  #: name of its folder.
    lungs: tuple[str, ...]  #: lungs whose breaths it uses.
    #: returns the setting, given the breaths of the lungs and the folder of the proof; or the
    #: reason why there is none.
    set_up: Callable[[Breaths, Path], Setting | str]
    needs: str | None = None  #: name of a part that must be finished before.


def _rc(breaths: Breaths, out: Path) -> Setting:
    return Setting(breaths, "physics", "physics")


def _two_balloon(breaths: Breaths, out: Path) -> Setting:
    with compilation.float64():
        plants = {lung.id: jax.tree.map(np.asarray, two_balloon(lung)) for lung in LUNGS}
    return Setting(breaths, plants, "two-balloon")


def _removed(breaths: Breaths, out: Path) -> Setting | str:
    corrected = out / "rc" / "corrected.json"
    diagnosis = json.loads((out / "rc" / "diagnosis.json").read_text("utf-8"))
    name = most_important(diagnosis["mechanisms"])
    if name is None:
        return "rc names nothing that all breaths share, so that there is nothing to remove"
    plants = {
        lung: without(plant, (name,)) if isinstance(plant, Physics) else plant
        for lung, plant in load_plants(corrected)[0].items()
    }
    about = {"removed": name, "corrected_sha256": files.sha256(corrected)}
    return Setting(breaths, plants, f"corrected R-C without {name}", name, about)


def _frozen(breaths: Breaths, out: Path) -> Setting:
    return Setting(breaths, "frozen", "frozen")


def _injected(breaths: Breaths, out: Path) -> Setting:
    slower = slower_sensor(breaths, LAG)
    return Setting(slower, "frozen", "frozen", "sensor_lag", {"injected_tau_s": LAG})


#: By name, in the order in which they run.
PARTS: dict[str, Part] = {
    part.name: part
    for part in (
        Part("rc", LUNG_IDS, _rc),
        Part("two_balloon", LUNG_IDS, _two_balloon),
        Part("removed", FEW, _removed, "rc"),
        Part("injected", FEW, _injected),
        Part("frozen", FEW, _frozen),
    )
}


def slower_sensor(breaths: Breaths, tau: float) -> Breaths:
    """Pass the recorded pressures of each breath through ``tau dy/dt = p - y``.

    The lag also smooths the noise of the recording. It shares no code with the physics library.

    Args:
        breaths: n recorded breaths.
        tau: time constant, s, positive.

    Returns:
        The breaths with other pressures and without the hash of a file.
    """
    pressure = np.stack(
        [lagged(t, p, tau) for t, p in zip(breaths.time, breaths.pressure, strict=True)]
    )
    return dataclasses.replace(breaths, pressure=pressure, sha256=None)


def lagged(time: Floats, pressure: Floats, tau: float) -> Floats:
    """Response of a first-order lag that is at rest before the first sample, ``(T,)``.

    Exact for a pressure that is linear between its samples, however they are spaced.

    Args:
        time: s, increasing, ``(T,)``.
        pressure: cmH2O, ``(T,)``; NaN where it is unknown, which stays NaN and is bridged.
        tau: time constant, s, positive.
    """
    known = np.flatnonzero(np.isfinite(pressure))
    response = np.full(len(pressure), np.nan)
    if known.size == 0:
        return response
    y = pressure[known[0]]
    response[known[0]] = y
    for before, now in pairwise(known):
        h = time[now] - time[before]
        behind = tau * (pressure[now] - pressure[before]) / h  # distance behind a ramp
        y = pressure[now] - behind + (y - pressure[before] + behind) * np.exp(-h / tau)
        response[now] = y
    return response


def most_important(mechanisms: Sequence[Mapping[str, Any]]) -> str | None:
    """Name of the first mechanism that all breaths share; None if there is none.

    Args:
        mechanisms: mechanisms of a ``diagnosis.json``, the most important first.
    """
    for named in mechanisms:
        scopes = [p.scope for p in mechanism(named["name"]).description.parameters]
        if named["name"] in library() and "breath" not in scopes:
            return str(named["name"])
    return None


def without(plant: Physics, names: Collection[str]) -> Physics:
    """Return the plant with the parameters of these mechanisms at their neutral values."""
    with compilation.float64():
        return plant.having(
            **{path: parameter(path).neutral for path in plant.names if _owner(path) in names}
        )


def by_names_alone(plant: Plant) -> Plant:
    """Return a corrected plant without the correction by nonparametric components, if it has any.

    Components that the given simulator has itself keep its values.
    """
    physics = plant.with_mechanisms if isinstance(plant, Corrected) else plant
    if not isinstance(physics, Physics) or not any(
        _owner(path) in basis_terms() for path in physics.names
    ):
        return plant
    if not isinstance(plant, Corrected):
        return without(physics, basis_terms())
    wanted, own = plant.with_mechanisms, plant.without_mechanisms
    coefficients = [path for path in (*wanted.names, *own.names) if _owner(path) in basis_terms()]
    with compilation.float64():
        named_only = wanted.having(**{path: own.get(path) for path in coefficients})
    return dataclasses.replace(plant, with_mechanisms=named_only)


def _owner(path: str) -> str:
    return path.rpartition(".")[0]
