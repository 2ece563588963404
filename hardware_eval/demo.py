"""The loop closed: a lung that conceals physics, found, corrected for, and controlled better.

An emulated lung conceals physics that the simulators lack, drawn from the library by words. A
controller that was planned on a simulator runs on it and does worse than there. The comparison of a
recording with the simulator names what is missing; the controller is planned again on the corrected
simulator and runs on the same lung. Only then it is told what was concealed; nothing in between
reads it.

A simulator says which commands bring the pressure to its target and keep it there, and which
pressures they give. The controller sends these commands, and a PI controller answers the difference
between measured and planned pressure (two degrees of freedom: Horowitz, *Synthesis of Feedback
Systems*, 1963). It is as good as its simulator: commands planned without a leak are too small for a
lung that leaks, and feedback corrects that late. So it shows what a better simulator is worth. A
PID tuned on it hardly does, as its gains serve many lungs.

The commands are those of least error, by sequential linear programming
(:mod:`ventbench.task.attainable`). What is planned is the reading of the sensor, which is all
that a bench measures and scores. And it is planned for the second breath of a run and those after
it, which a bench scores: a slow lung has not emptied since the breath before.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from hardware_eval.bench.drive import collect
from hardware_eval.bench.loop import Bench, Operator
from hardware_eval.bench.plan import Procedure, make_plan
from hardware_eval.bench.raw_log import read_session
from hardware_eval.bench.safety import DEFAULT
from hardware_eval.emulation.emulator import LoopbackDevice
from hardware_eval.emulation.simulated import (
    PVP_SENSOR,
    SimulatedHal,
    breath_begun,
    conceal,
)
from hardware_eval.results import evaluate as ev
from hardware_eval.results.evaluate import Line
from hardware_eval.results.record import scored_plants
from hardware_eval.wire.client import Client
from ventbench.base import compilation, files
from ventbench.base.arrays import Floats
from ventbench.base.errors import InputError
from ventbench.controllers.pid import TIME_CONSTANT
from ventbench.diagnosis.diagnose import diagnose
from ventbench.entries.folder import CONTROLLER, open_submission
from ventbench.entries.scaffold import create
from ventbench.task import attainable as bound
from ventbench.task import environment as env
from ventbench.task import protocol, rollouts
from ventbench.task.environment import Scenario
from ventbench.task.interfaces import Plant, Signals

#: PIPs of the demo, cmH2O: few, so that it takes minutes.
PIPS = (10.0, 20.0, 30.0)

#: How the entries run.
_HOW = Procedure(fallback=False, dry_run=False, selftest=False, rest=2.0, notes="emulated lung")

#: Steps that the starts of the search for commands open the valve for: a short and a long rise.
STARTS = (2, 8)

#: Breaths before the one that is planned: by then the breaths of the slowest lung (R20C50, 1.25 s)
#: differ by less than a twentieth of what is left in it.
BEFORE = 2

#: P and I of the feedback, %/cmH2O. With more P a lung of 20 cmH2O/(L/s) rings when its valve is a
#: step late.
GAINS = (0.5, 10.0)

#: The controller of an entry, before its numbers.
_CONTROLLER = '''"""Commands planned on a simulator, and feedback where the lung departs from it."""

STEP = {step}  # s
TIME_CONSTANT = {time_constant}  # s, of the averaged difference
GAINS = {gains}  # P and I, %/cmH2O

# Each row: PIP, cmH2O; planned commands, %; pressures that they should give, cmH2O.
PLAN = (
{rows}
)


def between(pip, column, step):
    """Value of the plan at a PIP: linear between two rows, that of the nearest beyond."""
    below = max((row for row in PLAN if row[0] <= pip), default=PLAN[0])
    above = min((row for row in PLAN if row[0] >= pip), default=PLAN[-1])
    share = 0.0 if below is above else (pip - below[0]) / (above[0] - below[0])
    return (1.0 - share) * below[column][step] + share * above[column][step]


class Controller:
    """One for each run of three breaths."""

    def reset(self, task):
        """Nothing to prepare."""

    def act(self, observation):
        """Return u_in, %, for the next step."""
        if observation.time == 0:  # a new breath
            self.integral = 0.0
        step = min(round(observation.time / STEP), len(PLAN[0][1]) - 1)
        missing = between(observation.target, 2, step) - observation.pressure
        a = observation.dt / (observation.dt + TIME_CONSTANT)
        self.integral += a * (missing - self.integral)
        p, i = GAINS
        return between(observation.target, 1, step) + p * missing + i * self.integral
'''


@dataclass(frozen=True, eq=False)
class PlannedController:
    """Feedforward of N PIPs over the T steps of an inspiration."""

    pips: tuple[float, ...]  #: cmH2O, rising, N of them.
    commands: Floats  #: planned, %, shape ``(N, T)``.
    #: that the simulator gives under them, one before each command, cmH2O, shape ``(N, T)``.
    pressures: Floats

    @property
    def error(self) -> float:
        """Mean ``|pressure - PIP|`` on the simulator, cmH2O."""
        return float(np.mean(np.abs(self.pressures - np.array(self.pips)[:, None])))

    def write(self, folder: Path, name: str) -> Path:
        """Write it as a submission ``folder/name``; returns that folder."""
        rows = [
            f"    ({pip}, {_numbers(commands)},\n     {_numbers(pressures)}),"
            for pip, commands, pressures in zip(
                self.pips, self.commands, self.pressures, strict=True
            )
        ]
        controller = _CONTROLLER.format(
            step=protocol.DT, time_constant=TIME_CONSTANT, gains=GAINS, rows="\n".join(rows)
        )
        made = create(name, "other", folder)
        (made / CONTROLLER).write_text(controller)
        return made


def _numbers(values: Floats) -> str:
    return f"({', '.join(f'{value:.3f}' for value in values)})"


@flax.struct.dataclass
class _Breathing:
    """A plant at the end of an expiration, whose airway pressure is the reading of its sensor."""

    plant: Any  #: the plant.
    state: Any  #: of the plant when an inspiration begins, with the batch axes of the plant.

    def init(self, pressure: Array, peep: Array | None = None) -> tuple[Any, Signals]:
        return self.state, Signals(pressure)

    def step(self, state: Any, u_in: Array, u_out: Array, dt: Array) -> tuple[Any, Signals]:
        state, signals = self.plant.step(state, u_in, u_out, dt)
        return state, Signals(signals.reading)

    def vary(self, r_scale: Array, c_scale: Array, gain: Array | float = 1.0) -> _Breathing:
        return _Breathing(self.plant.vary(r_scale, c_scale, gain), self.state)

    def parameters(self) -> Any:
        return self.plant.parameters()


def plan_controller(plant: Plant, pips: tuple[float, ...]) -> PlannedController:
    """Plan a controller on a simulator.

    Args:
        plant: the simulator of a lung, without a batch shape.
        pips: cmH2O, rising; commands of a PIP between two are interpolated.
    """
    n = len(pips)
    with compilation.float64():
        cells = env.nominal_scenario(np.asarray(pips))
        cells = cells.replace(noise=np.zeros((n, 1, 1)))  # type: ignore[attr-defined]
        wide = jax.tree.map(lambda leaf: np.asarray(leaf, float), plant)
        stacked = jax.tree.map(lambda leaf: np.broadcast_to(leaf, (n, *np.shape(leaf))), wide)
        state, _ = jax.vmap(type(plant).init)(stacked, cells.start, cells.peep)
        for turn in range(1 + BEFORE):
            breathing = _Breathing(stacked, state)
            best = bound.attainable(breathing, cells, starts=STARTS)
            after = bound.pressures(breathing, cells, best.commands)
            # The last command of an inspiration acts on no scored pressure: it stays.
            commands = np.concatenate([best.commands, best.commands[:, -1:]], axis=1)
            pressures = np.concatenate([np.asarray(cells.start)[:, None], after], axis=1)
            if turn < BEFORE:
                state, start = _breath_after(breathing, cells, commands)
                cells = cells.replace(start=start)  # type: ignore[attr-defined]
    return PlannedController(pips, commands, pressures)


@jax.jit
@jax.vmap
def _breath_after(plant: _Breathing, cell: Scenario, commands: Array) -> tuple[Any, Array]:
    """State and reading after a breath, when the next inspiration begins."""
    loop, _, _ = rollouts.inspiration(plant, cell, rollouts.commanded, inputs=commands)
    loop, _ = rollouts.expiration(plant, cell, loop)
    return breath_begun(loop.plant, jnp.ones(())), loop.signals.reading


@dataclass(frozen=True, eq=False)
class Demo:
    """Figures of every step; errors in cmH2O."""

    words: str  #: what the lung was drawn from.
    lung: str  #: its label.
    #: error of the entry on the emulator of the plain simulator, by PIP.
    simulated: dict[float, float]
    measured: dict[float, float]  #: its error on the lung that conceals something, by PIP.
    verdict: str  #: of the diagnosis.
    named: dict[str, dict[str, float]]  #: mechanisms that it names, with their parameters.
    #: held-out open-loop error ``before``, ``refit`` and ``after`` the correction.
    open_loop_mae: dict[str, float]
    predicted: float  #: error of the replanned entry on the corrected simulator, mean over PIPs.
    retuned: dict[float, float]  #: error of the replanned entry on the lung, by PIP.
    truth: dict[str, Any]  #: what was concealed.
    steps: tuple[str, ...]  #: what was done, with its figures, a sentence each.
    seconds: float  #: duration.
    right: bool  #: whether the concealed mechanism was named.
    better: bool  #: whether the replanned entry does better on the lung than the first.


def _mechanism(name: str, parameters: Mapping[str, float]) -> str:
    """A mechanism and its parameters in words."""
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
    breaths: int,
    simulator: str,
    sandbox: bool,
    tell: Callable[[str], None],
) -> Demo:
    """Run the demo, in this process on a virtual clock.

    Args:
        words: any words; they determine lung and concealed physics.
        out: an empty folder for everything.
        breaths: breaths to collect for the diagnosis.
        simulator: name of the simulators, which the concealed physics is added to. It is all that
            the library's physics lacks; the frozen simulators differ from that physics by
            themselves, which hides what is concealed.
        sandbox: run entries as in scoring.
        tell: told every step and its figures as it ends.

    Raises:
        InputError: if the folder is not empty, or a plan does not finish.
    """
    began = time.perf_counter()
    files.claim_folder(out)
    if out.exists() and any(out.iterdir()):
        raise InputError(f"{out} is not empty; choose another --out")
    steps: list[str] = []

    def step(title: str, figures: str) -> None:
        steps.append(f"{title}: {figures}")
        tell(f"{len(steps)}. {steps[-1]}")

    # Its label is public; of the rest only the bench knows.
    hidden = conceal(words, simulator)
    lung, effect = hidden.lung.id, hidden.effect
    step("A lung conceals physics", lung)
    tested = scored_plants(simulator, [lung])
    plain = tested.plant(lung)
    planned = plan_controller(plain, PIPS)
    entry = planned.write(out / "entries", "first")

    evaluated = partial(errors_on, lung=lung, pips=PIPS, sandbox=sandbox)
    simulated = evaluated(emulated_line(plain, lung), entry, out=out / "simulated")
    step("A controller is planned on the simulator", f"{_mean(simulated):.2f} cmH2O there")
    line = emulated_line(hidden.plant, lung)
    measured = evaluated(line, entry, out=out / "first")
    against = _against(simulated, measured, "simulation")
    step("The same controller on the lung", f"{_said(measured)}{against}")
    bench = Bench(line.client, line.clock, DEFAULT, Operator(), rest=_HOW.rest)
    explored, _ = collect(bench, lung, breaths, out / "explored")
    step("The lung is explored", f"{len(explored)} breaths")
    diagnosis = diagnose(explored, simulator=tested, lung=lung)
    diagnosis.save(out / "diagnosis")
    named = {
        x.name: {key: estimate.value for key, estimate in x.parameters.items()}
        for x in diagnosis.mechanisms
    }
    said = "; ".join(_mechanism(name, values) for name, values in named.items())
    step("The diagnosis", f"{diagnosis.verdict}: {said or 'no mechanism is named'}")
    mae = {name: getattr(diagnosis.open_loop, name).mae for name in ("before", "refit", "after")}
    step(
        "The corrected simulator",
        "held-out open-loop error {before:.2f}, refitted {refit:.2f}, corrected {after:.2f}".format(
            **mae
        ),
    )
    replanned = plan_controller(diagnosis.plants.get(lung, plain), PIPS)
    second = replanned.write(out / "entries", "replanned")
    step("The controller is planned again on it", f"{replanned.error:.2f} cmH2O predicted")
    retuned = evaluated(line, second, out=out / "second")
    against = _against(measured, retuned, "the first")
    step("The replanned controller on the lung", f"{_said(retuned)}{against}")
    truth = _mechanism(effect.name, effect.parameters)
    found = "named" if effect.name in named else "not named"
    step("What it conceals", f"{truth}, {effect.strength}: {found}")
    done = Demo(
        words,
        lung,
        simulated,
        measured,
        diagnosis.verdict,
        named,
        mae,
        replanned.error,
        retuned,
        {"name": effect.name, "strength": effect.strength, "parameters": dict(effect.parameters)},
        tuple(steps),
        time.perf_counter() - began,
        effect.name in named,
        _mean(retuned) < _mean(measured),
    )
    files.write_json(out / "demo.json", files.json_values(vars(done)))
    return done


def emulated_line(plant: Plant, lung: str) -> Line:
    """A line to an emulated lung of a label, in this process on a virtual clock."""
    hal = SimulatedHal(plant, name=f"emulated {lung}", sensor=PVP_SENSOR)
    device = LoopbackDevice(hal)
    client = Client(device, device.clock)
    client.hello()
    return Line(client, device.clock)


def errors_on(
    line: Line, entry: Path, lung: str, pips: tuple[float, ...], out: Path, *, sandbox: bool
) -> dict[float, float]:
    """Evaluate an entry, one scored run at each PIP.

    Args:
        line: to the lung.
        entry: folder of the entry.
        lung: label of the lung, which the entry is told.
        pips: cmH2O.
        out: folder of the log.
        sandbox: run the entry as in scoring.

    Returns:
        Errors by PIP, cmH2O; infinite where a check stopped the run.

    Raises:
        InputError: if the plan does not finish.
    """
    plan = make_plan([entry.name], [lung], pips=pips, repeats=1, control_every=0)
    done = ev.evaluate(
        [open_submission(str(entry))],
        line,
        out,
        Operator(),
        plan=plan,
        how=_HOW,
        sandbox=sandbox,
        operator_name="ventbench-hardware demo",
    )
    if done.reason:
        raise InputError(f"{entry.name} did not finish its plan: {done.reason}")
    scored = read_session(done.log).of_type("run", kind="scored", status="complete")
    return dict.fromkeys(pips, float("inf")) | {line["pip"]: line["error"] for line in scored}
