"""What is run on the bench, in which order: a plan that survives restarts.

A lung must be set by hand, so that lungs are the outer loop. Within a lung every run is in random
order, drawn from the plan's seed, so that a drift of the bench does not favour an entry; the PID of
the paper runs in between as a control and shows the drift. The order depends on nothing but the
plan, so that a restarted session continues it.
"""

from __future__ import annotations

import itertools
import tomllib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np

from ventbench.base import files
from ventbench.base.errors import InputError
from ventbench.task import protocol
from ventbench.task.lungs import LUNG_IDS, scored_lung
from ventbench.task.metrics import measured

#: Kinds of runs: PIP rises step by step before an entry is scored on a lung; scored; the PID
#: between them; with a leak or a pinched tube at an announced moment; exploring for recordings.
Kind = Literal["ramp", "scored", "control", "perturbed", "explore"]

#: Those with an error.
MEASURED = ("scored", "control")

#: Those whose lung is as its label says.
UNDISTURBED = ("ramp", "scored", "control")

#: A line of the log.
LogLine = dict[str, Any]

#: What happens to the tube in a perturbed run.
PERTURBATIONS = ("leak", "pinch")

#: Breath of a perturbed run, from 0, and step in it, from which on the tube is disturbed.
PERTURBED_BREATH, PERTURBED_STEP = 1, 10

#: Name of the control; no submission has it.
CONTROL = "control_pid"

#: The paper's best gains on the physical lung (P, I), %/cmH2O (table 2), with D = 0.
CONTROL_GAINS = {
    "R5C10": (10.0, 0.2),
    "R5C20": (10.0, 10.0),
    "R5C50": (10.0, 10.0),
    "R20C10": (8.0, 1.0),
    "R20C20": (5.0, 10.0),
    "R20C50": (5.0, 10.0),
}

#: PIP of the control, cmH2O: in the middle.
CONTROL_PIP = 20.0

#: A control run stands before each so many scored runs, and after the last.
CONTROL_EVERY = 10

#: Repetitions of each cell, as on the hardware boards of double pendulums.
REPEATS = 10


@dataclass(frozen=True)
class PlannedRun:
    """One run: a fresh controller, three breaths."""

    number: int  #: its place in the plan, from 0.
    kind: Kind  #: see :data:`Kind`.
    entry: str  #: name of the submission; :data:`CONTROL` for the control.
    lung: str  #: label of the lung that must be mounted.
    pip: float  #: cmH2O.
    repeat: int  #: repetition, from 1.
    perturbation: str = ""  #: what happens to the tube; empty for nothing.

    def line(self, kind: str, attempt: int, **more: Any) -> LogLine:
        """A line of the log about it; ``attempt`` is how often it was begun before."""
        about = {name: getattr(self, name) for name in _LOGGED}
        return {"type": kind, "run": self.number, "attempt": attempt, **about, **more}

    @classmethod
    def of_line(cls, line: LogLine) -> PlannedRun:
        """The run that a line is about."""
        return cls(line["run"], *(line[name] for name in _LOGGED))


#: What a line of the log tells of its run.
_LOGGED = ("kind", "entry", "lung", "pip", "repeat")


#: Kind, entry, PIP, repetition and perturbation of a run.
_Case = tuple[Kind, str, float, int, str]


@dataclass(frozen=True)
class Plan:
    """A plan of runs; see :func:`make_plan`."""

    entries: tuple[str, ...]  #: names of the submissions.
    lungs: tuple[str, ...]  #: labels, in the order in which they are mounted.
    pips: tuple[float, ...]  #: cmH2O.
    track: str = "performance"  #: what controllers are told: ``"performance"`` names the lung.
    repeats: int = REPEATS  #: repetitions of each cell.
    control_every: int = CONTROL_EVERY  #: see there; 0 for no control.
    perturbations: Sequence[str] = ()  #: see :data:`PERTURBATIONS`; each once at each PIP.
    seed: int = 0  #: of the order.

    @cached_property
    def runs(self) -> tuple[PlannedRun, ...]:
        """All runs in their order: of each lung the ramps, then all others shuffled."""
        order = np.random.default_rng(self.seed)
        order.permutation(len(self.lungs))  # theirs
        cells = list(itertools.product(self.entries, self.pips))
        ramps: list[_Case] = [("ramp", *cell, 1, "") for cell in cells]
        cases: list[_Case] = [
            ("scored", *cell, repeat + 1, "") for cell in cells for repeat in range(self.repeats)
        ]
        cases.extend(("perturbed", *cell, 1, tube) for cell in cells for tube in self.perturbations)
        runs: list[PlannedRun] = []
        for lung in self.lungs:
            shuffled = [cases[k] for k in order.permutation(len(cases))]
            every = _with_controls(shuffled, self.control_every)
            for kind, entry, pip, repeat, tube in [*ramps, *every]:
                runs.append(PlannedRun(len(runs), kind, entry, lung, pip, repeat, tube))
        return tuple(runs)

    def as_dict(self) -> dict[str, Any]:
        """JSON values without the runs, which follow from them."""
        return files.json_values(asdict(self))


#: A limit of the valve's commands, %.
_Percent = Annotated[float, msgspec.Meta(gt=0.0, le=protocol.U_MAX)]


class Procedure(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How a session runs its plan, as a file of TOML says; every key may be left out."""

    pips: tuple[float, ...] = protocol.PIPS  #: cmH2O.
    repeats: Annotated[int, msgspec.Meta(ge=1, le=100)] = REPEATS  #: runs of each lung and PIP.
    #: ``performance`` (the lung is told) or ``robustness``; the first entry's if not given.
    track: Literal["performance", "robustness"] | None = None
    perturb: tuple[str, ...] = ()  #: also run with a disturbed tube, see :data:`PERTURBATIONS`.
    control_every: Annotated[int, msgspec.Meta(ge=0)] = CONTROL_EVERY  #: see there; 0 for none.
    seed: Annotated[int, msgspec.Meta(ge=0)] | None = None  #: of the order; drawn if not given.
    blind: bool = False  #: call entries by numbers until the plan is done.
    notes: str = ""  #: for the record.
    largest_u_in: _Percent = protocol.U_MAX  #: commands are cut to this, %; the record says so.
    largest_rise: _Percent = protocol.U_MAX  #: of the command in one step, %.
    fallback: bool = True  #: a safe controller takes over when an entry is late or unsafe.
    dry_run: bool = True  #: run the plan on the frozen simulators first.
    selftest: bool = True  #: test the bench once each lung is set.
    skip: tuple[str, ...] = ()  #: parts that the self-test leaves out.
    rest: Annotated[float, msgspec.Meta(ge=0.5)] = 4.0  #: before each run, s.
    calibration: str | None = None  #: file of this device's calibration.
    rerun: str | None = None  #: also show breaths in rerun: a file, or ``live``.


def read_procedure(path: Path | None) -> Procedure:
    """Read how a session runs its plan; without a file, as usual.

    Raises:
        InputError: if the file cannot be read, is no TOML, or a key is unknown or wrong.
    """
    try:
        given = {} if path is None else tomllib.loads(path.read_text("utf-8"))
        return msgspec.convert(given, Procedure)
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise InputError(f"--plan {path}: {reason}; the manual shows a plan") from error


def make_plan(
    entries: Sequence[str],
    lungs: Sequence[str],
    *,
    pips: Sequence[float] = protocol.PIPS,
    seed: int = 0,
    **how: Any,
) -> Plan:
    """Plan the evaluation of entries.

    Each entry starts on each lung with a ramp: one unscored run at each PIP from the lowest to the
    highest. All other runs of a lung are shuffled together.

    Args:
        entries: names of the submissions.
        lungs: labels; mounted in random order.
        pips: cmH2O, of the protocol.
        seed: of the order.
        how: other fields of :class:`Plan`.

    Raises:
        InputError: if something occurs twice, is unknown, or there is nothing to run.
    """
    # In one order, whatever order they were given in: a log names them in that of mounting.
    named = sorted((scored_lung(lung).id for lung in lungs), key=LUNG_IDS.index)
    mounted = tuple(named[i] for i in np.random.default_rng(seed).permutation(len(named)))
    plan = Plan(tuple(entries), mounted, tuple(sorted(map(float, pips))), seed=seed, **how)
    _check(plan)
    return plan


def _with_controls(cases: Sequence[_Case], every: int) -> Iterator[_Case]:
    """Cases with a control before each so many of them and after the last; 0 for none."""
    for place, case in enumerate([*cases, None]):
        if every and (place % every == 0 or case is None):
            yield "control", CONTROL, CONTROL_PIP, -(-place // every) + 1, ""
        if case is not None:
            yield case


def _check(plan: Plan) -> None:
    """Refuse what is missing, stands twice or is unknown."""
    for name, values in (("entry", plan.entries), ("lung", plan.lungs), ("PIP", plan.pips)):
        if not values:
            raise InputError(f"the plan has no {name}; give one at least")
        if len(set(values)) != len(values):
            raise InputError(f"the plan names one {name} twice: {', '.join(map(str, values))}")
    if plan.repeats < 1:
        raise InputError(f"{plan.repeats} repetitions: run each cell once at least")
    for pip in plan.pips:
        if pip not in protocol.PIPS:
            raise InputError(
                f"PIP {pip:g} cmH2O is not one of {', '.join(f'{pip:g}' for pip in protocol.PIPS)}"
            )
    for name in plan.perturbations:
        if name not in PERTURBATIONS:
            raise InputError(f"perturbation {name!r} is not one of {', '.join(PERTURBATIONS)}")
    if CONTROL in plan.entries:
        raise InputError(f"no entry can be called {CONTROL}; that is the PID in between")


def progress(plan: Plan, lines: Iterable[LogLine]) -> tuple[list[PlannedRun], dict[int, int]]:
    """How far a plan has come by its log.

    A run is done when it is complete, or when a check tripped that blames its controller. A run
    that was cut off, that the bench spoilt or of which the log holds too few readings runs again
    from its first breath, as its controller is gone; its logged breaths stay in the log.

    Returns:
        Runs that are still to do, in the plan's order; and how often each run has been begun.

    Raises:
        InputError: if the log is of another plan.
    """
    logged, own = list(lines), plan.as_dict()
    done = {run for run, _ in complete_runs(logged)}
    attempts: dict[int, int] = {}
    for line in logged:
        if line["type"] == "plan" and line["plan"] != own:
            keys = [key for key, value in own.items() if line["plan"].get(key) != value]
            raise InputError(
                f"the log is of another plan ({', '.join(keys)} differ); give its options, or "
                "another --out"
            )
        if line["type"] == "run_begins":
            attempts[line["run"]] = line["attempt"] + 1
        if line["type"] == "run" and line["status"] == "failed":
            done.add(line["run"])
    return [run for run in plan.runs if run.number not in done], attempts


def complete_runs(lines: Iterable[LogLine]) -> set[tuple[int, int]]:
    """Number and attempt of the runs of a log that are complete, with enough readings to score.

    Nobody can say that a breath without any reading was safe, be it scored or not.
    """
    pressures: dict[Any, dict[int, list[float | None]]] = {}
    complete = set()
    for line in lines:
        key = line.get("run"), line.get("attempt")
        if line["type"] == "breath":
            pressures.setdefault(key, {})[line["breath"]] = line["pressure"]
        elif line["type"] == "run" and line["status"] == "complete":
            rows = [pressures.get(key, {}).get(k, []) for k in range(protocol.BREATHS)]
            unseen = any(all(x is None for x in row) for row in rows)
            if line["kind"] not in MEASURED or not (
                unseen or measured.too_few(measured.scored(rows))
            ):
                complete.add(key)
    return complete
