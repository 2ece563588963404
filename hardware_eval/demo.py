"""The loop closed: a lung that conceals physics, found, corrected for, and controlled better.

An emulated lung conceals physics that the simulators lack, drawn from the library and sealed. A
controller that was planned on a simulator runs on it and does worse than there. The comparison of a
recording with the simulator names what is missing; the controller is planned again on the corrected
simulator and runs on the same lung. Only then the seal is opened. Nothing in between reads it.
"""

from __future__ import annotations

import html
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hardware_eval.bench.collect import collect
from hardware_eval.bench.loop import Bench, Operator, SilentOperator, run_once
from hardware_eval.bench.plan import Plan, make_plan
from hardware_eval.bench.raw_log import lines
from hardware_eval.bench.safety import DEFAULT
from hardware_eval.emulation.loopback import LoopbackDevice
from hardware_eval.emulation.simulated import SimulatedHal, conceal, reveal
from hardware_eval.planned import plan_controller
from hardware_eval.results import evaluate as ev
from hardware_eval.results.compare import Comparison, compare, scored_plants
from hardware_eval.results.evaluate import Evaluation, Line
from hardware_eval.wire.client import Client
from ventbench.base import files
from ventbench.base.errors import InputError
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
    #: P, I, D of the feedback before and after the correction, %/cmH2O.
    gains: tuple[tuple[float, ...], tuple[float, ...]]
    #: error of the entry on the emulator of the plain simulator, by PIP.
    simulated: dict[float, float]
    measured: dict[float, float]  #: its error on the lung that conceals something, by PIP.
    comparison: Comparison  #: simulators against the collected recording.
    verdict: str  #: of the diagnosis.
    named: dict[str, dict[str, float]]  #: mechanisms that it names, with their parameters.
    #: held-out open-loop error before, refitted and after the correction.
    open_loop: tuple[float, float, float]
    predicted: float  #: error of the replanned entry on the corrected simulator, mean over PIPs.
    retuned: dict[float, float]  #: error of the replanned entry on the lung, by PIP.
    truth: dict[str, Any]  #: what the seal held.
    folder: Path  #: where everything lies.
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
                "seconds": self.seconds,
            }
        )

    def steps(self) -> list[tuple[str, str]]:
        """Title and figures of every step."""
        named = "; ".join(_mechanism(name, values) for name, values in self.named.items())
        truth = _mechanism(self.truth["name"], self.truth["parameters"])
        before, refit, after = self.open_loop
        first, second = (" ".join(f"{gain:g}" for gain in gains) for gains in self.gains)
        return [
            ("A lung is sealed", f"{self.lung}; commitment {self.commitment[:16]}..."),
            (
                "A controller is planned on the simulator",
                f"{_mean(self.simulated):.2f} cmH2O there; feedback P I D = {first}",
            ),
            (
                "The same controller on the lung",
                f"{_said(self.measured)}{_against(self.simulated, self.measured, 'simulation')}",
            ),
            (
                "The comparison",
                f"{len(self.comparison.breaths)} breaths explored; open-loop error "
                f"{self.comparison.lungs[self.lung].mae:.2f} cmH2O a step",
            ),
            ("The diagnosis", f"{self.verdict}: {named or 'no mechanism is named'}"),
            (
                "The corrected simulator",
                f"held-out open-loop error {before:.2f}, refitted {refit:.2f}, corrected "
                f"{after:.2f}",
            ),
            (
                "The controller is planned again on it",
                f"{self.predicted:.2f} cmH2O predicted; feedback P I D = {second}",
            ),
            (
                "The replanned controller on the lung",
                f"{_said(self.retuned)}{_against(self.measured, self.retuned, 'the first')}",
            ),
            (
                "The seal is opened",
                f"{truth}, {self.truth['strength']}: {'named' if self.right else 'not named'}",
            ),
        ]

    def __str__(self) -> str:
        rows = [f"{k}. {title}: {text}" for k, (title, text) in enumerate(self.steps(), start=1)]
        return "\n".join([*rows, f"{self.seconds:.0f} s; report: {self.folder / 'report.html'}"])


def _mechanism(name: str, parameters: Mapping[str, float]) -> str:
    values = ", ".join(f"{key} {value:.3g}" for key, value in parameters.items())
    return f"{name.replace('_', ' ')} ({values})"


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
        tell: told every step as it begins.

    Raises:
        InputError: if the folder is not empty, or a plan does not finish.
        LinkError: if the emulator is lost.
    """
    began = time.perf_counter()
    if out.exists() and any(out.iterdir()):
        raise InputError(f"{out} is not empty; choose another --out")
    out.mkdir(parents=True, exist_ok=True)
    # The public half of the concealed lung: its label and the seal. The plant stays in there.
    hidden = conceal(words, simulator)
    lung, seal = hidden.lung.id, out / "seal.json"
    hidden.write(seal)
    commitment = str(hidden.seal["commitment"])
    tell(f"1. a lung {lung} is sealed: {commitment[:16]}...")
    plain = scored_plants(simulator, [lung]).plant(lung)
    planned = plan_controller(plain, pips)
    entry = planned.write(out / "entries", "first")
    plan = _plan("first", lung, pips)
    tell(f"2. a controller is planned on the simulator: {planned.error:.2f} cmH2O predicted")
    simulated = error_on(SimulatedHal(plain, noise=NOISE, quantum=QUANTUM), entry, lung, pips)
    with _line(hidden.plant, words, simulator, lung, out, real_time) as line:
        tell("3. it runs on the lung")
        measured = _errors(_evaluate(plan, entry, line, out / "first", sandbox))
        tell(f"   {_said(measured)}; {_mean(simulated):.2f} cmH2O in simulation")
        tell(f"4. {breaths} breaths are explored")
        bench = Bench(line.client, line.clock, DEFAULT, SilentOperator(), rest=_REST)
        explored = collect(bench, lung, breaths, out / "explored")
    tell("5. simulator and lung are compared")
    compared = compare(explored.breaths, simulator=simulator)
    diagnosis = compared.diagnoses[lung]
    diagnosis.save(out / "diagnosis")
    corrected: Plant = diagnosis.plants.get(lung, plain)
    tell(f"6. {str(diagnosis).splitlines()[0]}")
    replanned = plan_controller(corrected, pips)
    second = replanned.write(out / "entries", "replanned")
    tell(f"7. it is planned again on the corrected one: {replanned.error:.2f} cmH2O predicted")
    with _line(hidden.plant, words, simulator, lung, out, real_time) as line:
        again = _plan("replanned", lung, pips)
        tell("8. it runs on the lung")
        retuned = _errors(_evaluate(again, second, line, out / "second", sandbox))
    _, effect = reveal(seal, words)
    errors = diagnosis.open_loop
    gains = ((*planned.gains, 0.0), (*replanned.gains, 0.0))
    done = Demo(
        words, lung, commitment, gains, simulated, measured, compared,
        diagnosis.verdict,
        {
            x.name: {key: estimate.value for key, estimate in x.parameters.items()}
            for x in diagnosis.mechanisms
        },
        (errors.before.mae, errors.refit.mae, errors.after.mae), replanned.error, retuned,
        {"name": effect.name, "strength": effect.strength, "parameters": dict(effect.parameters)},
        out, time.perf_counter() - began,
    )  # fmt: skip
    tell(f"9. the seal is opened: {effect.name}")
    files.write_json(out / "demo.json", done.as_dict())
    files.write_text(out / "report.html", _report(done))
    return done


def _plan(name: str, lung: str, pips: tuple[float, ...]) -> Plan:
    return make_plan([name], [lung], pips=pips, repeats=1, control_every=0)


def error_on(
    hal: SimulatedHal, entry: Path, lung: str, pips: tuple[float, ...]
) -> dict[float, float]:
    """Errors of an entry on an emulator in this process, cmH2O, by PIP.

    Args:
        hal: the emulated lung.
        entry: folder of the entry, which runs in this process.
        lung: its label, which the entry is told.
        pips: cmH2O.
    """
    device = LoopbackDevice(hal)
    client = Client(device, device.clock)
    client.hello()
    bench = Bench(client, device.clock, DEFAULT, SilentOperator(), rest=_REST)
    plan = _plan(entry.name, lung, pips)
    make = ev.controllers([open_submission(str(entry))], plan.track, ev.make_runner(False),
                          real_time=False)  # fmt: skip
    errors = {}
    for run in plan.runs:
        if run.kind == "scored":
            controller = make(run)
            errors[run.pip] = run_once(bench, run, controller).error
            controller.close()
    return dict(sorted(errors.items()))


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


_STYLE = """
body{font:16px/1.5 system-ui,sans-serif;margin:2rem auto;max-width:60rem;padding:0 1rem;
color:#1b1f24;background:#fff}h1{font-size:1.6rem}ol{padding-left:1.4rem}li{margin:.4rem 0}
table{border-collapse:collapse;margin:1rem 0}
th,td{padding:.3rem .8rem;text-align:right;border-bottom:1px solid #d7dce2}
th:first-child,td:first-child{text-align:left}.note{color:#57606a}
@media(prefers-color-scheme:dark){body{background:#14181d;color:#e6e9ed}td,th{border-color:#39414b}}
"""


def _report(done: Demo) -> str:
    """One page: the steps, the errors by PIP, the distance, and what was named."""
    steps = "".join(
        f"<li><b>{html.escape(title)}.</b> {html.escape(text)}</li>" for title, text in done.steps()
    )
    rows = "".join(
        f"<tr><td>{pip:g}</td>"
        + "".join(
            f"<td>{errors[pip]:.2f}</td>" if np.isfinite(errors[pip]) else "<td>stopped</td>"
            for errors in (done.simulated, done.measured, done.retuned)
        )
        + "</tr>"
        for pip in done.simulated
    )
    heads = "".join(f"<th>{name}</th>" for name in ("in simulation", "on the lung", "replanned"))
    waves = "".join(
        f"<tr><td>{html.escape(name)}</td><td>{x.breaths}</td><td>{x.mae:.2f}</td>"
        f"<td>{x.bias:+.2f}</td></tr>"
        for name, x in done.comparison.waveforms[done.lung].items()
    )
    sentences = "".join(
        f"<p>{html.escape(line)}</p>"
        for line in str(done.comparison.diagnoses[done.lung]).splitlines()
    )
    return (
        "<!doctype html><html lang=en><meta charset=utf-8><meta name=viewport "
        f'content="width=device-width"><title>The loop closed: {html.escape(done.lung)}</title>'
        f"<style>{_STYLE}</style><h1>The loop closed on an emulated {html.escape(done.lung)}</h1>"
        "<p class=note>Mean |pressure - target| over the scored inspirations, cmH2O: lower is "
        "better. The lung is emulated in software behind the real wire protocol.</p>"
        f"<ol>{steps}</ol><table><tr><th>PIP, cmH2O</th>{heads}</tr>{rows}</table>"
        "<h2>Open-loop distance by waveform</h2><table><tr><th>plateau, "
        f"cmH2O</th><th>breaths</th><th>error a step</th><th>bias</th></tr>{waves}</table>"
        f"<h2>The diagnosis in its own words</h2>{sentences}"
        '<p><a href="diagnosis/report.html">its report</a>, <a href="demo.json">all figures</a>, '
        f'<a href="seal.json">the seal</a>; the words were "{html.escape(done.words)}".</p>'
        "</html>\n"
    )
