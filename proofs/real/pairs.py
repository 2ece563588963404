"""Real against real: what the tool says of pairs whose difference is known and concealed from it.

Each pair has a first recording, which stands for the simulator, and a second one that differs in a
known way: another lung, another source of gas, a leak or a lag that was added to the signals. The
tool gets both and says what differs.

The recordings are those with flow (RespiraWorks), the tool is :mod:`ventbench.mechanics`. An added
leak and an added lag are exact: a leak behind the flow sensor adds its flow to the measured one at
the measured pressure, and a lag of the pressure sensor is applied to the measured pressure.

Half of the pairs, chosen by the hash of their names, are for development; the others are sealed
and opened once. The answers are kept one by one; the report has rates of right answers and
detection curves.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
import pandas as pd

import ventbench
from proofs.challenge.figures import wilson
from proofs.real.parts import slower_sensor
from ventbench.base import files
from ventbench.base.errors import InputError
from ventbench.base.resume import WorkFolder
from ventbench.mechanics.identify import Mechanics, Term, identify
from ventbench.mechanics.labels import TOLERANCE_C, TOLERANCE_R, Estimate
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


#: Names that are right for what is added, and rivals that act alike where flow is measured before
#: the circuit: the tubing delays flow as the sensor delays pressure.
_NAMES = {"leak": "leak", "lag": "sensor_lag"}
_RIVALS = {"leak": (), "lag": ("circuit_compliance",)}

#: Names that are true of every run: the QuickLung's resistors are parabolic.
_TRUE = {"turbulent_resistance"}


@dataclass(frozen=True)
class Answered:
    """A pair with the answer of the tool."""

    pair: Pair  #: the pair.
    answer: str  #: the answer in words.
    right: bool  #: whether it is right.
    #: names of effects in the answer that are not what was added, beyond those that the tool also
    #: names without the concealed difference.
    new_names: tuple[str, ...] = ()
    value: float | None = None  #: estimated strength of what was added, or None.
    interval: tuple[float, float] | None = None  #: its 95 % interval, or None.
    #: whether it is named, or a rival that acts alike has appeared or grown.
    in_class: bool = False


def answer(pair: Pair, material: Material) -> Answered:
    """Let the tool answer a pair; it sees no name and no true label."""
    return _TOOLS[pair.kind](pair, material)


def _label(pair: Pair, material: Material) -> Answered:
    settings = material.mechanics(pair.second).match.settings
    shown = settings[0] if settings else "none known"
    return Answered(pair, shown, shown == pair.truth)


def _lung(pair: Pair, material: Material) -> Answered:
    matches = [material.mechanics(run).match for run in (pair.first, pair.second)]
    truth = {part[0] for part in pair.truth.split(", ")} & {"R", "C"}
    parts = {}
    for name, tolerance in (("R", TOLERANCE_R), ("C", TOLERANCE_C)):  # R at the flow of the labels
        x, y = (
            Estimate(getattr(match, f"fitted_{name}"), "", getattr(match, f"ci95_{name}"))
            for match in matches
        )
        if _apart(x, y, tolerance):
            parts[name] = f"{name} {x.value:.3g} -> {y.value:.3g}"
    return Answered(pair, ", ".join(parts.values()) or "nothing of the lung", set(parts) == truth)


def _apart(x: Estimate, y: Estimate, tolerance: float) -> bool:
    """Whether two values differ by more than their intervals and a calibration's tolerance."""
    low, high = (x, y) if x.value < y.value else (y, x)
    return low.ci95[1] * tolerance < high.ci95[0]


def _added(pair: Pair, material: Material) -> Answered:
    """An added leak or lag: is it named, and which strength does it have?"""
    breaths = material.runs[pair.second]
    given = breaths
    if pair.strength:
        given = (with_leak if pair.kind == "leak" else slower_sensor)(breaths, pair.strength)
    lung = identify(given)[0]
    wanted = _NAMES[pair.kind]
    before = {term.name: term for term in material.mechanics(pair.first).terms}
    terms = {term.name: term for term in lung.terms}
    value, interval = None, None
    if wanted in terms:
        estimate = next(iter(terms[wanted].parameters.values()))
        value, interval = estimate.value, estimate.ci95
    rivals = _RIVALS[pair.kind]
    grown = any(_has_grown(terms.get(name), before.get(name)) for name in rivals)
    right = (wanted in terms) == (pair.strength > 0)
    new = tuple(sorted(set(terms) - set(before) - {wanted, *rivals}))
    words = ", ".join(terms) or "nothing"
    in_class = wanted in terms or (pair.strength > 0 and grown)
    return Answered(pair, words, right, new, value, interval, in_class)


def _has_grown(now: Term | None, before: Term | None) -> bool:
    """Whether a term is new, or its strength above the interval that it had."""
    if now is None:
        return False
    if before is None:
        return True
    x, y = (next(iter(term.parameters.values())) for term in (now, before))
    return x.ci95[0] > y.ci95[1]


def with_leak(breaths: Breaths, slope: float) -> Breaths:
    """Add a linear leak between flow sensor and lung to a recording.

    The measured pressure stays; the sensor of flow sees the leak's flow as well.

    Args:
        breaths: recorded ones with flow or volume.
        slope: mL/s per cmH2O.
    """
    leak = slope * np.nan_to_num(breaths.pressure)
    dt = np.diff(breaths.time, axis=1)
    lost = np.concatenate(
        [np.zeros((len(breaths), 1)), np.cumsum(0.5 * (leak[:, 1:] + leak[:, :-1]) * dt, axis=1)],
        axis=1,
    )
    return replace(
        breaths,
        flow=None if breaths.flow is None else breaths.flow + leak,
        volume=None if breaths.volume is None else breaths.volume + lost,
        sha256=None,
    )


_TOOLS: dict[str, Callable[[Pair, Material], Answered]] = {
    "label": _label,
    "lung": _lung,
    "drive": _lung,
    "leak": _added,
    "lag": _added,
}


def run(
    folder: Path,
    out: Path,
    *,
    sealed: bool = False,
    kinds: Iterable[str] = (),
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Answered]:
    """Answer the pairs that have no answer yet, and write each answer at once.

    Args:
        folder: folder of the public recordings.
        out: folder of the answers; the same call continues.
        sealed: True to open the sealed pairs, once.
        kinds: kinds of pairs; all if empty.
        progress: called with the numbers of answered and of all pairs.

    Raises:
        InputError: if a kind or a file is unknown, or the sealed pairs were opened by another
            version.
    """
    chosen = tuple(kinds) or tuple(KINDS)
    if unknown := sorted(set(chosen) - set(KINDS)):
        raise InputError(f"no kind {unknown[0]!r} of pairs; choose of {', '.join(KINDS)}")
    material = load(folder)
    split: Split = "sealed" if sealed else "development"
    asked = [pair for pair in pairs(material) if pair.kind in chosen and pair.split == split]
    if sealed:
        _open(out / "opened.json", chosen)
    work, answers = WorkFolder(out / split, {"leaks": LEAKS, "lags": LAGS}), []
    for done, pair in enumerate(asked):
        progress(done, len(asked))
        name = hashlib.sha256(pair.name.encode()).hexdigest()[:16]
        stored = work.get(name, lambda pair=pair: asdict(answer(pair, material)))
        answers.append(msgspec.convert(stored, Answered))
    progress(len(asked), len(asked))
    return answers


def _open(path: Path, kinds: tuple[str, ...]) -> None:
    """Note when, and by which version, sealed pairs of each kind were opened for the first time."""
    opened = json.loads(path.read_text("utf-8")) if path.is_file() else {}
    now = datetime.now(UTC).isoformat(timespec="seconds")
    for kind in kinds:
        if opened.get(kind, {"version": ventbench.__version__})["version"] != ventbench.__version__:
            raise InputError(
                f"{path}: the sealed pairs of kind {kind} were opened by version "
                f"{opened[kind]['version']}; they can be opened once"
            )
        opened.setdefault(kind, {"opened": now, "version": ventbench.__version__})
    files.write_json(path, opened)


def report(answers: list[Answered]) -> str:
    """Markdown: rates of right answers by kind, and detection curves."""
    lines = [
        "| kind | question | right (95 %) |",
        "|---|---|---|",
    ]
    counted = [a for a in answers if a.pair.kind not in ("leak", "lag")]
    for kind, question in KINDS.items():
        own = [a.right for a in counted if a.pair.kind == kind]
        if own:
            lines.append(f"| `{kind}` | {question} | {_share(sum(own), len(own))} |")
    for kind, unit, scale in (("leak", "mL/s per cmH2O", 1.0), ("lag", "ms", 1e3)):
        own = [a for a in answers if a.pair.kind == kind]
        if own:
            lines += ["", *_curve(kind, unit, scale, own)]
    return "\n".join(lines)


def _curve(kind: str, unit: str, scale: float, answers: list[Answered]) -> list[str]:
    """Detection curve: share of the recordings in which what was added is named."""
    lines = [
        f"| added {kind}, {unit} | named (95 %) | or a rival that acts alike | estimate, median | "
        "a new name | a new wrong name |",
        "|---|---|---|---|---|---|",
    ]
    for strength in sorted({a.pair.strength for a in answers}):
        own = [a for a in answers if a.pair.strength == strength]
        named = [a.value for a in own if a.value is not None]
        middle = f"{scale * float(np.median(named)):.3g}" if named else "-"
        alike = sum(a.in_class for a in own)
        new = sum(bool(a.new_names) for a in own)
        wrong = sum(bool(set(a.new_names) - _TRUE) for a in own)
        lines.append(
            f"| {scale * strength:g} | {_share(len(named), len(own))} | {alike} | {middle} | "
            f"{new} | {wrong} |"
        )
    return lines


def _share(count: int, of: int) -> str:
    """A count of several with its 95 % interval."""
    low, high = wilson(count, of)
    return f"{count} of {of} ({100 * low:.0f}–{100 * high:.0f})"


def as_dict(answers: list[Answered]) -> dict[str, Any]:
    """JSON values."""
    return {
        "answers": [asdict(entry) for entry in answers],
        "ventbench": ventbench.__version__,
    }
