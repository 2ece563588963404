"""The loop closed: a lung that conceals physics, found, corrected for, and controlled better.

An emulated lung conceals physics that the simulators lack, drawn from the library and sealed. A
controller that was planned on a simulator runs on it and does worse than there. The comparison of a
recording with the simulator names what is missing; the controller is planned again on the corrected
simulator and runs on the same lung. Only then the seal is opened. Nothing in between reads it.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hardware_eval.bench.drive import collect
from hardware_eval.bench.loop import Bench, Operator, SilentOperator
from hardware_eval.bench.plan import Plan, make_plan
from hardware_eval.bench.raw_log import lines
from hardware_eval.bench.safety import DEFAULT
from hardware_eval.bench.session import dry_run
from hardware_eval.emulation.loopback import LoopbackDevice
from hardware_eval.emulation.simulated import SimulatedHal, conceal, reveal
from hardware_eval.planned import PlannedController, plan_controller
from hardware_eval.results import evaluate as ev
from hardware_eval.results.evaluate import Evaluation, Line
from hardware_eval.results.replay import scored_plants
from hardware_eval.wire.client import Client
from ventbench.base import files
from ventbench.base.errors import InputError
from ventbench.diagnosis.diagnose import diagnose
from ventbench.entries.folder import open_submission
from ventbench.task.interfaces import Plant

#: PIPs of the demo, cmH2O: few, so that it takes minutes.
PIPS = (10.0, 20.0, 30.0)

#: Breaths that are collected for the comparison.
BREATHS = 36

#: Simulators of the demo. The concealed physics is all that the library's physics lacks; the
#: frozen simulators differ from that physics by themselves, which hides what is concealed.
SIMULATOR = "physics"

#: Noise of the emulated sensor, cmH2O, and the step of its converter (PVP's).
NOISE, QUANTUM = 0.1, 0.0703

#: Patience with an emulator that starts, s.
_STARTS_S = 90.0

#: Rest before a run, s.
_REST = 2.0


@dataclass(frozen=True, eq=False)
class Demo:
    """Figures of every step; errors in cmH2O."""

    words: str  #: what the lung was drawn from.
    lung: str  #: its label.
    commitment: str  #: hash of the sealed answer, published first.
    #: P and I of the feedback before and after the correction, %/cmH2O.
    gains: tuple[tuple[float, ...], tuple[float, ...]]
    #: error of the entry on the emulator of the plain simulator, by PIP.
    simulated: dict[float, float]
    measured: dict[float, float]  #: its error on the lung that conceals something, by PIP.
    verdict: str  #: of the diagnosis.
    named: dict[str, dict[str, float]]  #: mechanisms that it names, with their parameters.
    #: held-out open-loop error before, refitted and after the correction.
    open_loop: tuple[float, float, float]
    predicted: float  #: error of the replanned entry on the corrected simulator, mean over PIPs.
    retuned: dict[float, float]  #: error of the replanned entry on the lung, by PIP.
    truth: dict[str, Any]  #: what the seal held.
    steps: tuple[str, ...]  #: what was done, with its figures, a sentence each.
    seconds: float  #: duration.

    @property
    def right(self) -> bool:
        """Whether the concealed mechanism was named."""
        return self.truth["name"] in self.named

    @property
    def better(self) -> bool:
        """Whether the replanned entry does better on the lung than the first."""
        return _mean(self.retuned) < _mean(self.measured)

    def as_dict(self) -> dict[str, Any]:
        """JSON values."""
        return files.json_values(
            {
                "words": self.words,
                "lung": self.lung,
                "commitment": self.commitment,
                "gains": {"entry": self.gains[0], "retuned": self.gains[1]},
                "errors": {
                    "simulated": self.simulated,
                    "measured": self.measured,
                    "retuned": self.retuned,
                    "predicted_mean": self.predicted,
                },
                "verdict": self.verdict,
                "named": self.named,
                "open_loop_mae": dict(
                    zip(("before", "refit", "after"), self.open_loop, strict=True)
                ),
                "truth": self.truth,
                "right": self.right,
                "better": self.better,
                "steps": self.steps,
                "seconds": self.seconds,
            }
        )


def _mechanism(name: str, parameters: Mapping[str, float]) -> str:
    """A mechanism and its parameters in words."""
    values = ", ".join(f"{key} {value:.3g}" for key, value in parameters.items())
    return f"{name.replace('_', ' ')} ({values})"


def _gains(planned: PlannedController) -> str:
    return " ".join(f"{gain:g}" for gain in planned.gains)


def _mean(errors: Mapping[float, float]) -> float:
    return float(np.mean(list(errors.values())))


def _against(before: Mapping[float, float], after: Mapping[float, float], what: str) -> str:
    """Change of the mean error in words; nothing if a check ended a run."""
    if not np.isfinite(_mean(before)) or not np.isfinite(_mean(after)):
        return ""
    return f", {100.0 * (_mean(after) / _mean(before) - 1.0):+.0f} % against {what}"


def _said(errors: Mapping[float, float]) -> str:
    """Mean error in words; of a run that a check ended there is none."""
    stopped = [pip for pip, error in errors.items() if not np.isfinite(error)]
    if not stopped:
        return f"{_mean(errors):.2f} cmH2O"
    return f"stopped by a safety check at PIP {', '.join(f'{pip:g}' for pip in stopped)} cmH2O"


def demo(
    words: str,
    out: Path,
    *,
    pips: tuple[float, ...] = PIPS,
    breaths: int = BREATHS,
    simulator: str = SIMULATOR,
    real_time: bool = True,
    sandbox: bool = True,
    tell: Callable[[str], None] = lambda text: None,
) -> Demo:
    """Run the demo.

    Args:
        words: any words; they determine lung and concealed physics, and open the seal.
        out: an empty folder for everything.
        pips: cmH2O.
        breaths: breaths to collect for the diagnosis.
        simulator: name of the simulators, which the concealed physics is added to.
        real_time: over a pseudo-terminal in real time; else in this process on a virtual clock.
        sandbox: run entries as in scoring.
        tell: told every step and its figures as it ends.

    Raises:
        InputError: if the folder is not empty, or a plan does not finish.
        LinkError: if the emulator is lost.
    """
    began = time.perf_counter()
    if out.exists() and any(out.iterdir()):
        raise InputError(f"{out} is not empty; choose another --out")
    out.mkdir(parents=True, exist_ok=True)
    steps: list[str] = []

    def step(title: str, figures: str) -> None:
        steps.append(f"{title}: {figures}")
        tell(f"{len(steps)}. {steps[-1]}")

    # The public half of the concealed lung: its label and the seal. The plant stays in there.
    hidden = conceal(words, simulator)
    lung, seal = hidden.lung.id, out / "seal.json"
    hidden.write(seal)
    commitment = str(hidden.seal["commitment"])
    step("A lung is sealed", f"{lung}; commitment {commitment[:16]}...")
    tested = scored_plants(simulator, [lung])
    plain = tested.plant(lung)
    planned = plan_controller(plain, pips)
    entry = planned.write(out / "entries", "first")
    plan = _plan("first", lung, pips)
    simulated = error_on(SimulatedHal(plain, noise=NOISE, quantum=QUANTUM), entry, lung, pips)
    step(
        "A controller is planned on the simulator",
        f"{_mean(simulated):.2f} cmH2O there; feedback P I = {_gains(planned)}",
    )
    with _line(hidden.plant, words, simulator, lung, out, real_time) as line:
        measured = _errors(_evaluate(plan, entry, line, out / "first", sandbox))
        against = _against(simulated, measured, "simulation")
        step("The same controller on the lung", f"{_said(measured)}{against}")
        bench = Bench(line.client, line.clock, DEFAULT, SilentOperator(), rest=_REST)
        explored = collect(bench, lung, breaths, out / "explored").breaths
        step("The lung is explored", f"{len(explored)} breaths")
    diagnosis = diagnose(explored, simulator=tested, lung=lung)
    diagnosis.save(out / "diagnosis")
    named = {
        x.name: {key: estimate.value for key, estimate in x.parameters.items()}
        for x in diagnosis.mechanisms
    }
    said = "; ".join(_mechanism(name, values) for name, values in named.items())
    step("The diagnosis", f"{diagnosis.verdict}: {said or 'no mechanism is named'}")
    errors = diagnosis.open_loop
    open_loop = errors.before.mae, errors.refit.mae, errors.after.mae
    step(
        "The corrected simulator",
        "held-out open-loop error {:.2f}, refitted {:.2f}, corrected {:.2f}".format(*open_loop),
    )
    replanned = plan_controller(diagnosis.plants.get(lung, plain), pips)
    second = replanned.write(out / "entries", "replanned")
    step(
        "The controller is planned again on it",
        f"{replanned.error:.2f} cmH2O predicted; feedback P I = {_gains(replanned)}",
    )
    with _line(hidden.plant, words, simulator, lung, out, real_time) as line:
        again = _plan("replanned", lung, pips)
        retuned = _errors(_evaluate(again, second, line, out / "second", sandbox))
    against = _against(measured, retuned, "the first")
    step("The replanned controller on the lung", f"{_said(retuned)}{against}")
    _, effect = reveal(seal, words)
    truth = _mechanism(effect.name, effect.parameters)
    found = "named" if effect.name in named else "not named"
    step("The seal is opened", f"{truth}, {effect.strength}: {found}")
    done = Demo(
        words, lung, commitment, (planned.gains, replanned.gains), simulated, measured,
        diagnosis.verdict, named, open_loop, replanned.error, retuned,
        {"name": effect.name, "strength": effect.strength, "parameters": dict(effect.parameters)},
        tuple(steps), time.perf_counter() - began,
    )  # fmt: skip
    files.write_json(out / "demo.json", done.as_dict())
    return done


def _plan(name: str, lung: str, pips: tuple[float, ...]) -> Plan:
    return make_plan([name], [lung], pips=pips, repeats=1, control_every=0)


def error_on(
    hal: SimulatedHal, entry: Path, lung: str, pips: tuple[float, ...]
) -> dict[float, float]:
    """Errors of an entry on an emulator in this process, cmH2O, by PIP; infinite if it stopped.

    Args:
        hal: the emulated lung.
        entry: folder of the entry, which runs in this process.
        lung: its label, which the entry is told.
        pips: cmH2O.
    """
    plan = _plan(entry.name, lung, pips)
    make = ev.controllers([open_submission(str(entry))], plan.track, ev.make_runner(False),
                          real_time=False)  # fmt: skip
    _, errors = dry_run(plan, make, DEFAULT, _REST, lung=lambda label: hal)
    by_pip = {pip: error for *_, pip, error in errors}
    return {pip: by_pip.get(pip, float("inf")) for pip in pips}


def _evaluate(plan: Plan, entry: Path, line: Line, out: Path, sandbox: bool) -> Evaluation:
    operator: Operator = SilentOperator()
    submission = open_submission(str(entry))
    done = ev.evaluate(
        [submission], line, out, operator, plan=plan, sandbox=sandbox, dry=False,
        operator_name="ventbench-hardware demo", notes="emulated lung", rest=_REST,
    )  # fmt: skip
    if not done.complete:
        raise InputError(f"{entry.name} did not finish its plan: {done.reason}")
    return done


def _errors(done: Evaluation) -> dict[float, float]:
    """Errors of the scored runs by PIP; a stopped run counts as infinite."""
    errors: dict[float, float] = {}
    for line in lines(done.log):
        if line["type"] == "run" and line["kind"] == "scored" and line["status"] != "aborted":
            error = line.get("error")
            errors[line["pip"]] = float("inf") if error is None else error
    return dict(sorted(errors.items()))


@contextmanager
def _line(
    plant: Plant, words: str, simulator: str, lung: str, out: Path, real_time: bool
) -> Iterator[Line]:
    """A line to the emulated lung: in its own process, or in this one on a virtual clock."""
    if not real_time:
        hal = SimulatedHal(plant, name=f"emulated {lung}", noise=NOISE, quantum=QUANTUM)
        device = LoopbackDevice(hal)
        client = Client(device, device.clock)
        client.hello()
        yield Line(client, device.clock)
        return
    command = [sys.executable, "-m", "hardware_eval", "emulate", "--conceal", words]
    command += ["--plant", simulator, "--noise", str(NOISE), "--quantum", str(QUANTUM)]
    with open(out / "emulator.log", "a") as log:
        emulator = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, text=True)
    try:
        assert emulator.stdout is not None
        port = emulator.stdout.readline().strip()
        if not port:
            raise InputError(f"the emulator did not start; see {out / 'emulator.log'}")
        line = ev.connect(port)
        try:
            yield line
        finally:
            line.client.close()
    finally:
        emulator.terminate()
        emulator.wait(_STARTS_S)
        if emulator.stdout is not None:
            emulator.stdout.close()
