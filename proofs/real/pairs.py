"""Pairs of real recordings whose difference is known; :mod:`.comparisons` hides it from the tool.

Each pair has a first recording, which stands for the simulator, and a second one whose difference
is known and concealed: another lung, another source of gas, a leak or a lag that was added to the
signals. The tool gets both and says what differs.

The recordings are those with flow (RespiraWorks), the tool is :mod:`ventbench.mechanics`. An added
leak and an added lag are exact: a leak behind the flow sensor adds its flow to the measured one at
the measured pressure, and a lag of the pressure sensor is applied to the measured pressure.

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

from ventbench.base.errors import InputError
from ventbench.mechanics.identify import Mechanics, identify
from ventbench.recordings.breaths import Breaths
from ventbench.recordings.foreign import import_runs
from ventbench.task.lungs import lung

Split = Literal["development", "sealed"]

#: File of the public recordings.
FLOW_FILE = "respiraworks_quicklung.parquet"

#: Strengths of added leaks, mL/s per cmH2O, and of added lags, s; 0 shows what is named without.
LEAKS = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0)
LAGS = (0.0, 0.005, 0.01, 0.02, 0.04, 0.08)

#: Kinds of pairs, with what they ask.
KINDS: dict[str, str] = {
    "label": "which lung a run was recorded with (flow)",
    "lung": "another run of the day: what of R and C differs (flow)",
    "drive": "blower against proportional valve, same lung: nothing of the lung differs (flow)",
    "leak": "a leak was added to the recording (flow)",
    "lag": "a lag of the pressure sensor was added to the recording (flow)",
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
    _mechanics: dict[str, Mechanics] = field(default_factory=dict, repr=False)

    def mechanics(self, run: str) -> Mechanics:
        """Mechanics of a run, computed once."""
        if run not in self._mechanics:
            self._mechanics[run] = identify(self.runs[run])[0]
        return self._mechanics[run]


def load(folder: Path) -> Material:
    """Read the recordings.

    Raises:
        InputError: if their file is missing.
    """
    if not (folder / FLOW_FILE).is_file():
        raise InputError(f"{folder / FLOW_FILE} is missing; the real pairs need it")
    runs, drives = {}, {}
    read = import_runs(folder / FLOW_FILE)
    columns = pd.read_parquet(folder / FLOW_FILE, columns=["run", "test", "drive"])
    for day, test, drive in columns.drop_duplicates().itertuples(index=False):
        breaths = read[f"{day} {test}"]
        if breaths.flow is not None or breaths.volume is not None:
            runs[f"{day}#{test}"] = breaths
            drives[f"{day}#{test}"] = "blower" if "blower" in drive else "proportional valve"
    return Material(runs, drives)


def pairs(material: Material) -> Iterator[Pair]:
    """All pairs, in a fixed order."""
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


def changed(first: str, second: str) -> str:
    """What of R and C differs between two labels, in words."""
    a, b = lung(first), lung(second)
    parts = [
        f"{name} {x:g} -> {y:g}" for name, x, y in (("R", a.R, b.R), ("C", a.C, b.C)) if x != y
    ]
    return ", ".join(parts) or "nothing of the lung"
