"""Pairs of real recordings whose difference is known; :mod:`.comparisons` hides it from the tool.

Each pair has a first recording, which stands for the simulator, and a second one whose difference
is known and concealed: another lung, another source of gas, a leak or a lag that was added to the
signals, a valve whose gain was changed. The tool gets both and says what differs.

With flow (RespiraWorks) the tool is :mod:`ventbench.mechanics`. There an added leak and an added
lag are exact: a leak behind the flow sensor adds its flow to the measured one at the measured
pressure, and a lag of the pressure sensor is applied to the measured pressure. From pressure alone
(PVP) the tool is the diagnosis of a simulator that was fitted to the first recording.

Half of the pairs, chosen by the hash of their names, are for development; the others are sealed
and opened once.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import pandas as pd

from ventbench import recordings
from ventbench.base.errors import InputError
from ventbench.mechanics.identify import Mechanics, identify
from ventbench.recordings.breaths import Breaths
from ventbench.recordings.foreign import import_runs

Split = Literal["development", "sealed"]

#: Files of the public recordings.
FLOW_FILE, PRESSURE_FILE = "respiraworks_quicklung.parquet", "pvp_quicklung.csv"

#: Strengths of added leaks, mL/s per cmH2O, and of added lags, s; 0 shows what is named without.
LEAKS = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0)
LAGS = (0.0, 0.005, 0.01, 0.02, 0.04, 0.08)

#: Factor by which the gain of a valve is changed.
_GAIN = 1.12

#: Lags and lungs of pairs from pressure alone.
_PRESSURE_LAGS = (0.04, 0.08)
_PRESSURE_LUNGS = ("R5C10", "R5C20", "R5C50", "R20C10", "R20C20", "R20C50")

#: Kinds of pairs, with what they ask.
KINDS: dict[str, str] = {
    "label": "which lung a run was recorded with (flow)",
    "lung": "another run of the day: what of R and C differs (flow)",
    "drive": "blower against proportional valve, same lung: nothing of the lung differs (flow)",
    "leak": "a leak was added to the recording (flow)",
    "lag": "a lag of the pressure sensor was added to the recording (flow)",
    "lung_pressure": "a simulator fitted to one lung, a recording of another (pressure)",
    "gain_pressure": "the gain of the valve was changed by 12 % (pressure)",
    "lag_pressure": "a lag of the pressure sensor was added to the recording (pressure)",
}


@dataclass(frozen=True)
class Pair:
    """A pair and its truth."""

    name: str  #: unique name.
    kind: str  #: one of :data:`KINDS`.
    truth: str  #: what differs, in words.
    first: str  #: name of the first recording.
    second: str  #: name of the second recording.
    strength: float = 0.0  #: strength of what was added; 0 if nothing was.

    @property
    def split(self) -> Split:
        """Half to which the pair belongs, by the hash of its name."""
        first = hashlib.sha256(f"real pair {self.name}".encode()).digest()[0]
        return "development" if first < 128 else "sealed"


@dataclass(frozen=True, eq=False)
class Material:
    """Recordings of the pairs, by name."""

    runs: Mapping[str, Breaths]  #: runs with flow or volume as breaths; padded, u_in 0.
    drives: Mapping[str, str]  #: source of gas of each run.
    lungs: Mapping[str, Breaths]  #: recordings from pressure alone, by lung.
    _mechanics: dict[str, Mechanics] = field(default_factory=dict, repr=False)

    def mechanics(self, run: str) -> Mechanics:
        """Mechanics of a run, computed once."""
        if run not in self._mechanics:
            self._mechanics[run] = identify(self.runs[run])[0]
        return self._mechanics[run]


def load(folder: Path) -> Material:
    """Read the recordings.

    Raises:
        InputError: if a file is missing.
    """
    for name in (FLOW_FILE, PRESSURE_FILE):
        if not (folder / name).is_file():
            raise InputError(f"{folder / name} is missing; the real pairs need it")
    runs, drives = {}, {}
    read = import_runs(folder / FLOW_FILE)
    columns = pd.read_parquet(folder / FLOW_FILE, columns=["run", "test", "drive"])
    for day, test, drive in columns.drop_duplicates().itertuples(index=False):
        breaths = read[f"{day} {test}"]
        if breaths.flow is not None or breaths.volume is not None:
            runs[f"{day}#{test}"] = breaths
            drives[f"{day}#{test}"] = "blower" if "blower" in drive else "proportional valve"
    whole = recordings.load(folder / PRESSURE_FILE)
    return Material(runs, drives, whole.by_lung())


def pairs(material: Material) -> list[Pair]:
    """All pairs, in a fixed order."""
    return [*_flow_pairs(material), *_pressure_pairs(material)]


def _flow_pairs(material: Material) -> Iterator[Pair]:
    names = list(material.runs)
    label = {name: material.runs[name].lung_ids[0] for name in names}
    for name in names:
        yield Pair(f"label {name}", "label", str(label[name]), name, name)
    for first in names:
        day, test = first.split("#")
        for step in (1, 3):
            second = f"{day}#{(int(test) - 1 + step) % 8 + 1}"
            if second in label:
                truth = changed(label[first], label[second])
                yield Pair(f"lung {first} {second}", "lung", truth, first, second)
    for first in names:
        for second in names:
            same_test = first.split("#")[1] == second.split("#")[1]
            drives = material.drives[first], material.drives[second]
            if same_test and drives == ("blower", "proportional valve"):
                yield Pair(f"drive {first} {second}", "drive", "nothing of the lung", first, second)
    for kind, strengths in (("leak", LEAKS), ("lag", LAGS)):
        for name in names:
            for strength in strengths:
                truth = kind if strength else "nothing added"
                yield Pair(f"{kind} {strength:g} {name}", kind, truth, name, name, strength)


def _pressure_pairs(material: Material) -> Iterator[Pair]:
    lungs = [name for name in _PRESSURE_LUNGS if name in material.lungs]
    for k, first in enumerate(lungs):
        for step in (1, 2):
            second = lungs[(k + step) % len(lungs)]
            truth = changed(first, second)
            yield Pair(f"lung_pressure {first} {second}", "lung_pressure", truth, first, second)
    for name in lungs:
        yield Pair(f"gain_pressure {name}", "gain_pressure", "gain of the valve", name, name, _GAIN)
        for tau in _PRESSURE_LAGS:
            yield Pair(f"lag_pressure {tau:g} {name}", "lag_pressure", "lag", name, name, tau)


def changed(first: str, second: str) -> str:
    """What of R and C differs between two labels, in words."""
    from ventbench.task.lungs import lung

    a, b = lung(first), lung(second)
    parts = [
        f"{name} {x:g} -> {y:g}" for name, x, y in (("R", a.R, b.R), ("C", a.C, b.C)) if x != y
    ]
    return ", ".join(parts) or "nothing of the lung"
