"""Real against real: known differences between real recordings, hidden from the tool.

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
import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

import numpy as np

import ventbench
from ventbench import files, recordings
from ventbench.errors import InputError
from ventbench.lungs import Lung
from ventbench.mechanics.identify import Mechanics, Term, identify
from ventbench.mechanics.labels import TOLERANCE_C, TOLERANCE_R, Estimate
from ventbench.mechanics.respiraworks import breaths_of
from ventbench.physics.model import Physics
from ventbench.recordings.breaths import Breaths
from ventbench.recordings.respiraworks import RespiraWorksRun, load_respiraworks
from ventbench.validation.challenge.figures import wilson
from ventbench.validation.real_rig_parts import slower_sensor

Split = Literal["development", "sealed"]

#: Files of the public recordings.
FLOW_FILE, PRESSURE_FILE = "respiraworks_quicklung.parquet", "pvp_quicklung.csv"

#: Strengths of added leaks, mL/s per cmH2O, and of added lags, s; 0 shows what is named without.
LEAKS = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0)
LAGS = (0.0, 0.005, 0.01, 0.02, 0.04, 0.08)

#: Names that are right for what is added, and rivals that act alike where flow is measured before
#: the circuit: the tubing delays flow as the sensor delays pressure.
_NAMES = {"leak": "leak", "lag": "sensor_lag"}
_RIVALS = {"leak": (), "lag": ("circuit_compliance",)}

#: Factor by which the gain of a valve is changed.
_GAIN = 1.12

#: Lags and lungs of pairs from pressure alone.
_PRESSURE_LAGS = (0.04, 0.08)
_PRESSURE_LUNGS = ("R5C10", "R5C20", "R5C50", "R20C10", "R20C20", "R20C50")

#: What the PVP rigs have beyond R-C lungs (``ventbench proof``, part ``rc``): the simulator of a
#: first recording is fitted with these.
_KNOWN = ("exhalation_valve_delay", "circuit_compliance", "valve_curve", "sensor_lag")

#: Kinds of pairs, with what they ask.
KINDS: dict[str, str] = {
    "label": "which lung a run was recorded with (flow)",
    "lung": "another run of the day: what of R and C differs (flow)",
    "drive": "blower against proportional valve, same lung: nothing of the lung differs (flow)",
    "leak": "a leak was added to the recording (flow)",
    "lag": "a lag of the pressure sensor was added to the recording (flow)",
    "leak_driven": "the same leaks, diagnosed from flow",
    "lag_driven": "the same lags, diagnosed from flow",
    "lung_pressure": "a simulator fitted to one lung, a recording of another (pressure)",
    "gain_pressure": "the gain of the valve was changed by 12 % (pressure)",
    "lag_pressure": "a lag of the pressure sensor was added to the recording (pressure)",
}

#: Kinds that need minutes a pair.
SLOW = ("leak_driven", "lag_driven", "lung_pressure", "gain_pressure", "lag_pressure")

#: Runs and strengths that are diagnosed from flow: clean ones in which flow itself was logged.
_DRIVEN_RUNS = ("1", "3", "4", "5")
_DRIVEN_DAY = "2020-07-31-UFlow-Performance"
_DRIVEN = {"leak": (0.5, 1.0, 4.0), "lag": (0.01, 0.02, 0.08)}


@dataclass(frozen=True)
class Pair:
    """A pair and its truth.

    Attributes:
        name: unique name.
        kind: one of :data:`KINDS`.
        truth: what differs, in words.
        first: name of the first recording.
        second: name of the second recording.
        strength: strength of what was added; 0 if nothing was.
    """

    name: str
    kind: str
    truth: str
    first: str
    second: str
    strength: float = 0.0

    @property
    def split(self) -> Split:
        """Half to which the pair belongs, by the hash of its name."""
        first = hashlib.sha256(f"real pair {self.name}".encode()).digest()[0]
        return "development" if first < 128 else "sealed"


@dataclass(frozen=True)
class Answered:
    """A pair with the answer of the tool.

    Attributes:
        pair: the pair.
        answer: the answer in words.
        right: whether it is right.
        wrong_names: names of effects in the answer that are not in the truth, beyond those that the
            tool also names without the concealed difference.
        value: estimated strength of what was added, or None.
        interval: its 95 % interval, or None.
        in_class: whether it is named, or a rival that acts alike has appeared or grown.
    """

    pair: Pair
    answer: str
    right: bool
    wrong_names: tuple[str, ...] = ()
    value: float | None = None
    interval: tuple[float, float] | None = None
    in_class: bool = False


@dataclass(frozen=True, eq=False)
class Material:
    """Recordings of the pairs, by name.

    Attributes:
        runs: runs with flow or volume as breaths; padded, u_in 0.
        drives: source of gas of each run.
        lungs: recordings from pressure alone, by lung.
    """

    runs: Mapping[str, Breaths]
    drives: Mapping[str, str]
    lungs: Mapping[str, Breaths]
    _mechanics: dict[str, Mechanics] = field(default_factory=dict, repr=False)
    _driven: dict[str, frozenset[str]] = field(default_factory=dict, repr=False)

    def mechanics(self, run: str) -> Mechanics:
        """Mechanics of a run, computed once."""
        if run not in self._mechanics:
            self._mechanics[run] = identify(self.runs[run])[0]
        return self._mechanics[run]

    def driven(self, run: str) -> frozenset[str]:
        """Names that a diagnosis of a run from its flow gives, computed once."""
        if run not in self._driven:
            from ventbench.diagnosis.diagnose import diagnose

            diagnosis = diagnose(self.runs[run], patient=False, drive="flow")
            self._driven[run] = frozenset(m.name for m in diagnosis.mechanisms)
        return self._driven[run]


def load(folder: Path) -> Material:
    """Read the recordings.

    Raises:
        InputError: if a file is missing.
    """
    for name in (FLOW_FILE, PRESSURE_FILE):
        if not (folder / name).is_file():
            raise InputError(f"{folder / name} is missing; the real pairs need it")
    runs, drives = {}, {}
    for run in load_respiraworks(folder / FLOW_FILE):
        breaths = breaths_of(run)
        if breaths.flow is not None or breaths.volume is not None:
            runs[_run_name(run)] = breaths
            drives[_run_name(run)] = "blower" if "blower" in run.drive else "proportional valve"
    whole = recordings.load(folder / PRESSURE_FILE)
    return Material(runs, drives, whole.by_lung())


def _run_name(run: RespiraWorksRun) -> str:
    return f"{run.name}#{run.test}"


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

    for kind, strengths in _DRIVEN.items():
        for test in _DRIVEN_RUNS:
            name = f"{_DRIVEN_DAY}#{test}"
            for strength in strengths if name in label else ():
                own = f"{kind}_driven"
                yield Pair(f"{own} {strength:g} {name}", own, kind, name, name, strength)


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
    from ventbench.lungs import lung

    a, b = lung(first), lung(second)
    parts = [
        f"{name} {x:g} -> {y:g}" for name, x, y in (("R", a.R, b.R), ("C", a.C, b.C)) if x != y
    ]
    return ", ".join(parts) or "nothing of the lung"


def answer(pair: Pair, material: Material) -> Answered:
    """Let the tool answer a pair; it sees no name and no true label."""
    return _TOOLS[pair.kind](pair, material)


def _label(pair: Pair, material: Material) -> Answered:
    lung = material.mechanics(pair.second)
    settings = [setting.id for setting in lung.settings]
    shown = settings[0] if settings else "none known"
    return Answered(pair, shown, shown == pair.truth)


def _lung(pair: Pair, material: Material) -> Answered:
    a, b = material.mechanics(pair.first), material.mechanics(pair.second)
    truth = {part[0] for part in pair.truth.split(", ")} & {"R", "C"}
    differs = {
        name
        for name, tolerance, x, y in (
            ("R", TOLERANCE_R, _at_label(a, "R"), _at_label(b, "R")),
            ("C", TOLERANCE_C, _at_label(a, "C"), _at_label(b, "C")),
        )
        if _apart(x, y, tolerance)
    }
    parts = [
        f"{name} {_at_label(a, name).value:.3g} -> {_at_label(b, name).value:.3g}"
        for name in sorted(differs, reverse=True)
    ]
    return Answered(pair, ", ".join(parts) or "nothing of the lung", differs == truth)


def _at_label(lung: Mechanics, name: str) -> Estimate:
    """R at the flow of the labels, or C."""
    match = lung.match
    return Estimate(getattr(match, f"fitted_{name}"), "", getattr(match, f"ci95_{name}"))


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
    wrong = tuple(sorted(set(terms) - set(before) - {wanted, *rivals}))
    words = ", ".join(terms) or "nothing"
    in_class = wanted in terms or (pair.strength > 0 and grown)
    return Answered(pair, words, right, wrong, value, interval, in_class)


def _has_grown(now: Term | None, before: Term | None) -> bool:
    """Whether a term is new, or its strength above the interval that it had."""
    if now is None:
        return False
    if before is None:
        return True
    x, y = (next(iter(term.parameters.values())) for term in (now, before))
    return x.ci95[0] > y.ci95[1]


def _driven(pair: Pair, material: Material) -> Answered:
    """An added leak or lag by two diagnoses from flow: what is named with it and not without."""
    from ventbench.diagnosis.diagnose import diagnose

    kind = pair.kind.removesuffix("_driven")
    add = with_leak if kind == "leak" else slower_sensor
    diagnosis = diagnose(
        add(material.runs[pair.second], pair.strength), patient=False, drive="flow"
    )
    wanted = _NAMES[kind]
    named = {mechanism.name: mechanism for mechanism in diagnosis.mechanisms}
    before = material.driven(pair.first)
    value, interval = None, None
    if wanted in named:
        estimate = next(iter(named[wanted].parameters.values()))
        value, interval = estimate.value, estimate.ci95
    wrong = tuple(sorted(set(named) - before - {wanted, *_RIVALS[kind]}))
    in_class = wanted in named or bool(set(_RIVALS[kind]) & (set(named) - before))
    words = ", ".join(named) or "nothing"
    return Answered(pair, words, wanted in named, wrong, value, interval, in_class)


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


def _diagnosed(pair: Pair, material: Material) -> Answered:
    """Diagnose a simulator fitted to the first recording against the second one."""
    from ventbench.diagnosis.diagnose import diagnose

    first, second = material.lungs[pair.first], material.lungs[pair.second]
    label = _lung_of(first)
    simulator = {label.id: fitted_plant(first)}
    given = replace(
        second, R=np.full(len(second), label.R), C=np.full(len(second), label.C), sha256=None
    )
    if pair.kind == "gain_pressure":
        given = replace(given, u_in=given.u_in / pair.strength)
    if pair.kind == "lag_pressure":
        given = slower_sensor(given, pair.strength)
    diagnosis = diagnose(given, simulator=simulator, patient=False)
    names = tuple(mechanism.name for mechanism in diagnosis.mechanisms)
    match = diagnosis.lungs[0]
    own = simulator[label.id]
    ratio_R = match.fitted_R / float(own.get("R"))
    ratio_C = match.fitted_C / float(own.get("C"))
    words = f"{', '.join(names) or 'no effect'}; R x {ratio_R:.2f}, C x {ratio_C:.2f}"
    if pair.kind == "lag_pressure":
        lag = next((m for m in diagnosis.mechanisms if m.name == "sensor_lag"), None)
        estimate = lag.parameters.get("tau") if lag is not None else None
        return Answered(
            pair, words, names == ("sensor_lag",), tuple(n for n in names if n != "sensor_lag"),
            estimate.value if estimate else None, estimate.ci95 if estimate else None,
        )  # fmt: skip
    if pair.kind == "gain_pressure":
        return Answered(pair, words, not names, names)
    truth = _lung_of(second)
    right = not names and truth.id in match.settings
    return Answered(pair, words, right, names)


def fitted_plant(breaths: Breaths) -> Physics:
    """The plant of one lung, fitted with what the PVP rigs are known to have."""
    from ventbench.physics.catalogue import paths
    from ventbench.system_id import fit, make_data

    fitted = fit(make_data(breaths), list(_KNOWN))
    names = [path for path in paths(_KNOWN) if path != "position"]
    return fitted.problem.predictor.plant({name: float(fitted.column(name)[0]) for name in names})


def _lung_of(breaths: Breaths) -> Lung:
    return Lung(float(breaths.R[0]), float(breaths.C[0]))


_TOOLS: dict[str, Callable[[Pair, Material], Answered]] = {
    "label": _label, "lung": _lung, "drive": _lung, "leak": _added, "lag": _added,
    "leak_driven": _driven, "lag_driven": _driven,
    "lung_pressure": _diagnosed, "gain_pressure": _diagnosed, "lag_pressure": _diagnosed,
}  # fmt: skip


def run(
    folder: Path, out: Path, *, sealed: bool = False, kinds: Iterable[str] = (),
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Answered]:  # fmt: skip
    """Answer the pairs that have no answer yet, and write each answer at once.

    Args:
        folder: folder of the public recordings.
        out: folder of the answers; the same call continues.
        sealed: True to open the sealed pairs, once.
        kinds: kinds of pairs; those with flow if empty.
        progress: called with the numbers of answered and of all pairs.

    Raises:
        InputError: if a kind or a file is unknown, or the sealed pairs were opened by another
            version.
    """
    chosen = tuple(kinds) or tuple(kind for kind in KINDS if kind not in SLOW)
    if unknown := sorted(set(chosen) - set(KINDS)):
        raise InputError(f"no kind {unknown[0]!r} of pairs; choose of {', '.join(KINDS)}")
    material = load(folder)
    split: Split = "sealed" if sealed else "development"
    asked = [pair for pair in pairs(material) if pair.kind in chosen and pair.split == split]
    if sealed:
        _open(out / "opened.json", chosen)
    answers = []
    for done, pair in enumerate(asked):
        progress(done, len(asked))
        path = out / split / f"{hashlib.sha256(pair.name.encode()).hexdigest()[:16]}.json"
        stored = _stored(path, pair)
        if stored is None:
            stored = answer(pair, material)
            files.write_json(path, asdict(stored))
        answers.append(stored)
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


def _stored(path: Path, pair: Pair) -> Answered | None:
    try:
        plain = json.loads(path.read_text("utf-8"))
        value = Answered(
            Pair(**plain.pop("pair")),
            **plain
            | {
                "wrong_names": tuple(plain["wrong_names"]),
                "interval": tuple(plain["interval"]) if plain["interval"] else None,
            },
        )
    except (OSError, ValueError, TypeError, KeyError):
        return None
    return value if value.pair == pair else None


def report(answers: list[Answered]) -> str:
    """Markdown: rates of right answers by kind, and detection curves."""
    lines = [
        "| kind | question | right | 95 % | pairs |",
        "| --- | --- | --- | --- | --- |",
    ]
    counted = [a for a in answers if a.pair.kind not in ("leak", "lag")]
    for kind, question in KINDS.items():
        own = [a.right for a in counted if a.pair.kind == kind]
        if own:
            low, high = wilson(sum(own), len(own))
            lines.append(
                f"| `{kind}` | {question} | {sum(own)} ({sum(own) / len(own):.0%}) | "
                f"{low:.0%} to {high:.0%} | {len(own)} |"
            )
    for kind, unit, scale in (("leak", "mL/s per cmH2O", 1.0), ("lag", "ms", 1e3)):
        own = [a for a in answers if a.pair.kind == kind]
        if own:
            lines += ["", *_curve(kind, unit, scale, own)]
    return "\n".join(lines)


def _curve(kind: str, unit: str, scale: float, answers: list[Answered]) -> list[str]:
    """Detection curve: share of the recordings in which what was added is named."""
    lines = [
        f"| added {kind}, {unit} | named | 95 % | or a rival that acts alike | recordings | "
        "estimate, median | a new wrong name |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for strength in sorted({a.pair.strength for a in answers}):
        own = [a for a in answers if a.pair.strength == strength]
        named = [a.value for a in own if a.value is not None]
        low, high = wilson(len(named), len(own))
        middle = f"{scale * float(np.median(named)):.3g}" if named else "-"
        alike = sum(a.in_class for a in own)
        wrong = sum(bool(a.wrong_names) for a in own)
        lines.append(
            f"| {scale * strength:g} | {len(named)} ({len(named) / len(own):.0%}) | "
            f"{low:.0%} to {high:.0%} | {alike} ({alike / len(own):.0%}) | {len(own)} | {middle} | "
            f"{wrong} |"
        )
    return lines


def as_dict(answers: list[Answered]) -> dict[str, Any]:
    """JSON values."""
    return {
        "answers": [asdict(entry) for entry in answers],
        "report": report(answers),
        "ventbench": ventbench.__version__,
    }
