"""How often the guards of a bench are wrong: fallback, checks of the host, lateness, self-test.

Right lungs of three families breathe side by side, in virtual time: the frozen rigs, rigs of the
population, and lungs of an independent generator. First every bundled entry runs on each at each
PIP without a fallback: a run is harmless if it passes the safety gate and never reaches the
device's limit. Then it runs with one. What the fallback takes of a harmless run, and a check that
trips in one, is a false alarm.

Where the paper's PI does no harm, controllers that run away say what the fallback misses: runs that
fail the gate, or that the device vents at its limit, although it may take over. Hosts and entries
that are late by chance say how often a session blames the wrong one. Right and wrong lungs say how
often the self-test is wrong. Its programs breathe on all lungs of a label side by side, watched by
the checks; then each is judged as at a bench. Lungs of the generator have R, C, PEEP, valves and
dead time of their own about one of the nine settings of a test lung, and half of the resistors of 5
and 20 are parabolic; sensor noise of 0.1 to 0.3 cmH2O and the converter's step lie on the pressure.

    python benchmarks/hardware_guards.py [--lungs 4] [--entry pid_best ...] [--guard lateness ...]

Prints the tables of ``hardware_eval/README.md`` with intervals of 95 % (Clopper-Pearson), and what
the population's rigs do, on which the bounds of the fallback rest.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
import typer
from scipy import stats

from hardware_eval.bench import fallback, safety, selftest
from hardware_eval.bench.controllers import Count, Lateness, PIDController
from hardware_eval.bench.drive import Driven
from hardware_eval.bench.identity import Baseline, KnownLung, measured_lung, white_noise
from hardware_eval.bench.loop import LATE_SHARE
from hardware_eval.bench.plan import CONTROL_GAINS
from hardware_eval.bench.safety import VALVE_GAIN
from hardware_eval.bench.session import MAX_HELD_UP
from hardware_eval.emulation.cases import NOMINAL_GAIN, Base, Effect
from hardware_eval.emulation.simulated import breath_begun
from proofs.challenge.stranger.rig import Rig
from ventbench.base.arrays import Bools, Floats, Ints
from ventbench.base.resume import WorkFolder
from ventbench.entries.cells import InProcessRunner
from ventbench.entries.folder import bundled, open_submission
from ventbench.plants.rigs import load_rigs
from ventbench.task import protocol, waveform
from ventbench.task.interfaces import Task
from ventbench.task.lungs import LUNGS, RECORDED_LUNGS
from ventbench.task.lungs import lung as parse_lung
from ventbench.task.metrics import measured

#: Seed of the population's rigs, of the noise and of what runs away.
SEED = b"guards of a bench, right lungs 1"

#: Noise of the sensor, cmH2O.
NOISE = 0.1


#: Step of the integration, s; steps of it in a control step.
STEP = 1e-3
FINE = round(protocol.DT / STEP)

#: Converter's step, cmH2O; noise of the flow, mL/s, and relative error of its gain.
QUANTUM, FLOW_NOISE, FLOW_GAIN = 0.0703, 5.0, 0.01

#: A leak of so much at 20 cmH2O, mL/s.
LEAK = 5.0

#: What is wrong with a lung of the right label; one that creeps is as right as its twin.
SENSORS = {"sensor 5 % high": 1.05, "sensor 5 % low": 0.95}
CREEPS, LEAKS, STUCK = "right, creeping", "leak of 5 mL/s", "valve stuck"
KINDS = ("right", CREEPS, "another lung", *SENSORS, LEAKS, STUCK)

#: Those that a plant can be.
PLANTS = ("right", "another lung", *SENSORS, STUCK)

#: Share of the recoil that relaxes in lungs that creep or leak, rubber's and twice that, and the
#: times in which it does, s.
CREEP, CREEP_TIME = (0.04, 0.08), (0.5, 1.8)

#: Parts of the self-test that could find it; all if not here.
ALL = selftest.PARTS
PARTS_OF = {CREEPS: ("sensor", "leak"), LEAKS: ("sensor", "leak")}


class Lungs(Protocol):
    """Lungs side by side, at rest; arrays of shape ``(n,)``."""

    def hold(self, before: Floats, u_in: Floats, u_out: Floats, begins: bool = False) -> None:
        """Hold commands, % and 0/1, for a control step; before them others were in force.

        ``begins`` tells that an inspiration does.
        """
        ...

    def pressure(self) -> Floats:
        """Airway pressures, cmH2O."""
        ...

    def flow(self) -> Floats:
        """Flows into the lungs, mL/s."""
        ...


@dataclass(frozen=True, eq=False)
class Mounted:
    """What is mounted; arrays of shape ``(n,)``.

    Attributes:
        begin: puts the lungs at rest.
        gain: of the valve, mL/s per %.
        sensor: gain of the pressure sensor.
        flow: gain of the flow sensor.
        noise: standard deviation, cmH2O.
    """

    begin: Callable[[], Lungs]
    gain: Floats
    sensor: Floats
    flow: Floats
    noise: Floats


class Generated:
    """Lungs of the generator; ``dead`` is the dead time of each valve, steps of integration."""

    def __init__(self, base: Base, effects: dict[str, Effect], dead: Ints) -> None:
        n = len(dead)
        self._rig = Rig(base, effects, np.zeros(n), 0.03, np.zeros(n), np.zeros((2, n)))
        self._rig.start(np.asarray(base.peep))
        self._dead = dead

    def hold(self, before: Floats, u_in: Floats, u_out: Floats, begins: bool = False) -> None:
        """See :class:`Lungs`."""
        for fine in range(FINE):
            self._rig.advance(np.where(fine >= self._dead, u_in, before), u_out, 0.0, STEP)

    def pressure(self) -> Floats:
        """See :class:`Lungs`."""
        return self._rig.shown()

    def flow(self) -> Floats:
        """See :class:`Lungs`."""
        return 1e3 * self._rig.q


class Plants:
    """Plants with leaves ``(n, ...)``."""

    def __init__(self, plants: Any, stuck: bool = False) -> None:
        self._plants = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), plants)
        start = jnp.full(jax.tree.leaves(plants)[0].shape[0], protocol.PEEP, jnp.float32)
        self._state, self._signals = jax.vmap(lambda plant, x: plant.init(x, x))(plants, start)
        self._open = 0.0 if stuck else 1.0
        dt = jnp.float32(protocol.DT)

        def step(plant: Any, state: Any, u: Any, out: Any, begins: Any) -> Any:
            return plant.step(breath_begun(state, begins), u, out, dt)

        self._step = jax.jit(jax.vmap(step, in_axes=(0, 0, 0, 0, None)))

    def hold(self, before: Floats, u_in: Floats, u_out: Floats, begins: bool = False) -> None:
        """See :class:`Lungs`."""
        inputs = (np.float32(self._open * u_in), np.float32(u_out), np.float32(begins))
        self._state, self._signals = self._step(self._plants, self._state, *inputs)

    def pressure(self) -> Floats:
        """See :class:`Lungs`."""
        return np.asarray(self._signals.reading, float)

    def flow(self) -> Floats:
        """See :class:`Lungs`."""
        return np.asarray(self._signals.flow, float)


def draw(
    family: str, settings: Sequence[str], fault: str, seed: int, rng: np.random.Generator
) -> Mounted:
    """Draw a lung of a family about each setting."""
    n = len(settings)
    if family == "independent":
        base, effects, dead = generated(settings, fault, rng)
        begin, gain = partial(Generated, base, effects, dead), np.asarray(base.gain)
    else:
        begin = partial(Plants, _rigs(family, settings, seed), fault == STUCK)
        gain = np.full(n, VALVE_GAIN)
    sensor, flow = np.full(n, SENSORS.get(fault, 1.0)), 1.0 + FLOW_GAIN * rng.standard_normal(n)
    return Mounted(begin, gain, sensor, flow, rng.uniform(0.1, 0.3, n))


def _rigs(family: str, settings: Sequence[str], seed: int) -> Any:
    """A plant of each setting, leaves ``(n, ...)``: one of its rigs after the other, or drawn."""
    rigs, place = load_rigs(), [lung.id for lung in LUNGS]
    assert rigs.population is not None
    assert rigs.sessions is not None
    chosen = []
    for k, setting in enumerate(settings):
        lung = place.index(setting)
        if family == "population":
            drawn = rigs.population.rigs(seed.to_bytes(32, "big"), lung, len(settings))
            chosen.append(jax.tree.map(lambda leaf, k=k: np.asarray(leaf)[k], drawn))
            continue
        member, session = (
            k % rigs.members,
            rigs.sessions[lung][k // rigs.members % len(rigs.sessions[lung])],
        )
        at = (member, session)
        chosen.append(jax.tree.map(lambda leaf, at=at: np.asarray(leaf)[at], rigs.plants))
    return jax.tree.map(lambda *leaves: np.stack(leaves), *chosen)


def generated(
    settings: Sequence[str], fault: str, rng: np.random.Generator
) -> tuple[Base, dict[str, Effect], Ints]:
    """Draw what :class:`Generated` takes, in the ranges of the generator."""
    n, lungs = len(settings), [parse_lung(setting) for setting in settings]
    R = np.array([x.R for x in lungs]) * rng.uniform(0.85, 1.15, n)
    C = np.array([x.C for x in lungs]) * rng.uniform(0.93, 1.07, n)
    # A parabolic 50 would be told from flows far below 1 L/s; no scored lung has it.
    parabolic = (rng.uniform(size=n) < 0.5) & np.array([x.R < 50.0 for x in lungs])
    gain = NOMINAL_GAIN * rng.uniform(0.9, 1.1, n) * (fault != STUCK)
    values: dict[str, Any] = {
        "R": np.where(parabolic, 0.5, R),
        "C": C,
        "R_ex": rng.uniform(4.0, 7.0, n),
        "peep": rng.uniform(4.5, 5.5, n),
        "gain": gain,
    }
    leak = LEAK / np.sqrt(20.0) if fault == LEAKS else 0.0
    creep = rng.uniform(*CREEP, n) * (fault in (CREEPS, LEAKS))
    quadratic: dict[str, Any] = {"quadratic": np.where(parabolic, R, 0.0)}
    conductance: dict[str, Any] = {"conductance": np.full(n, leak)}
    relaxing: dict[str, Any] = {"ratio": creep, "time": rng.uniform(*CREEP_TIME, n)}
    effects = {
        "viscoelasticity": Effect("viscoelasticity", "mild", "library", relaxing),
        "turbulent_resistance": Effect("turbulent_resistance", "mild", "quadratic", quadratic),
        "leak": Effect("leak", "mild", "orifice", conductance),
    }
    return Base(**values), effects, rng.integers(0, FINE, n)


def driven(
    mounted: Mounted, label: str, rng: np.random.Generator, blind: bool, only: Sequence[str]
) -> list[dict[str, list[Driven]]]:
    """Run programs of the self-test on lungs that are mounted under a label; one result a lung.

    ``blind``: without a flow sensor.
    """
    n = len(mounted.noise)
    lungs = mounted.begin()
    done: list[dict[str, list[Driven]]] = [{part: [] for part in only} for _ in range(n)]
    noises = [0.0] * n
    for part in only:
        each = [selftest.programs(label, noise)[part] for noise in noises]
        for k, (make, _, pip) in enumerate(each[0]):
            lengths = [programs[k][1] for programs in each]
            for _ in range(round(selftest.rest_before(label) / protocol.DT)):
                lungs.hold(np.zeros(n), np.zeros(n), np.ones(n))
            columns, trips = _program(lungs, mounted, make, max(lengths), pip, label, rng)
            for i, steps in enumerate(lengths):
                own = Driven(*columns[:, :steps, i], trips[i], False, 0)  # type: ignore[arg-type]
                done[i][part].append(own)
        if part == "sensor":
            noises = [white_noise(x[part][0].pressure[17:]) for x in done]
    return [blinded(each) for each in done] if blind else done


def _program(
    lungs: Lungs,
    mounted: Mounted,
    make: Any,
    steps: int,
    pip: float,
    label: str,
    rng: np.random.Generator,
) -> tuple[Floats, list[tuple[str, ...]]]:
    """Columns of :class:`Driven`, ``(7, T, n)``, and the trips of each lung."""
    n, zeros = len(mounted.noise), np.zeros(len(mounted.noise))
    commands = [make() for _ in range(n)]
    watched = [safety.init(parse_lung(label)) for _ in range(n)]
    u_in, u_out, before = zeros.copy(), np.ones(n), zeros.copy()
    rows = []
    for step in range(steps):
        read = mounted.sensor * lungs.pressure() + mounted.noise * rng.standard_normal(n)
        read = np.round(read / QUANTUM) * QUANTUM
        flow = mounted.flow * lungs.flow() + FLOW_NOISE * rng.standard_normal(n)
        for i in range(n):
            now = step * protocol.DT
            sample = safety.SafetySample(
                now, read[i], flow[i], u_in[i], int(u_out[i]), pip, 0.0, u_in[i]
            )
            watched[i] = safety.step(safety.DEFAULT, watched[i], sample)
        before = u_in.copy()
        for i in range(n):
            wanted, u_out[i] = commands[i](step, float(read[i]))
            u_in[i], _ = safety.limit_command(safety.DEFAULT, before[i], wanted)
        rows.append(
            (zeros + step * protocol.DT, read, flow, u_in.copy(), u_out.copy(), zeros, zeros)
        )
        lungs.hold(before, u_in, u_out)
    trips = [tuple(trip.message for trip in state.trips) for state in watched]
    return np.moveaxis(np.array(rows), 0, 1), trips


def judged(
    done: dict[str, list[Driven]], label: str, gain: float | None, known: KnownLung | None
) -> dict[str, Any]:
    """Judge a lung; a valve of known ``gain``, mL/s per %, stands for a flow that is not there."""
    valve = None if gain is None else (gain, 0.98 * gain, 1.02 * gain)
    baseline = Baseline(valve, known)
    judge = partial(selftest.judge, label, done, baseline=baseline)
    sheet = judge(simulator=None)
    undecided = any(x.name == "lung" and not x.ok for x in sheet.findings)
    if undecided and parse_lung(label) in LUNGS:  # else the simulators have no say
        sheet = judge()
    trips = [text for each in done.values() for x in each for text in x.trips]
    bad = [x.name for x in sheet.findings if not x.ok] + ["safety"] * bool(trips)
    told = "; ".join(x.text for x in sheet.findings if x.name in ("identity", "lung"))
    return {"bad": bad, "told": told}


def blinded(done: dict[str, list[Driven]]) -> dict[str, list[Driven]]:
    """The same without a flow sensor."""
    return {
        part: [replace(x, flow=np.full_like(x.flow, np.nan)) for x in each]
        for part, each in done.items()
    }


def calibrated(done: dict[str, list[Driven]], label: str) -> KnownLung:
    """The lung by its calibration."""
    return measured_lung(done["lung"], label, white_noise(done["sensor"][0].pressure))[0]


def of_label(
    label: str, kind: str, family: str, lungs: int, blind: bool, seed: int
) -> list[dict[str, Any]]:
    """Lungs of a kind that are mounted under a label, judged."""
    place = RECORDED_LUNGS.index(parse_lung(label))
    rng = np.random.default_rng([seed, place, KINDS.index(kind)])
    settings = [label] * lungs
    if kind == "another lung":
        others = [x for x in labels_of(family) if x != label]
        settings = [others[k % len(others)] for k in range(lungs)]
    mounted = draw(family, settings, kind, seed, rng)
    known: Sequence[KnownLung | None] = [None] * lungs
    if kind in ("right", *SENSORS):  # its calibration, when the sensor was right
        sound = replace(mounted, sensor=np.ones(lungs))
        first = driven(sound, label, rng, blind, ("sensor", "lung"))
        known = [calibrated(each, label) for each in first]
    results = []
    for k, own in enumerate(driven(mounted, label, rng, blind, PARTS_OF.get(kind, ALL))):
        gain = float(mounted.gain[k]) if blind else None
        results.append({"lung": settings[k], **judged(own, label, gain, known[k])})
    return results


def labels_of(family: str) -> list[str]:
    """Settings of which a family has lungs."""
    return [x.id for x in (RECORDED_LUNGS if family == "independent" else LUNGS)]


class Guard(Enum):
    """What is measured; the host's checks with the fallback."""

    FALLBACK = "fallback"
    LATENESS = "lateness"
    SELFTEST = "selftest"


#: Answers of a run.
ASKED = protocol.BREATHS * protocol.INSPIRATION_STEPS

#: Shares of late answers of entry and host, and whether the entry is to blame.
LATE = (
    (0.002, 0.002, False),
    (0.01, 0.01, False),
    (0.03, 0.03, False),
    (0.2, 0.2, False),
    (0.02, 0.0, True),
    (0.05, 0.0, True),
    (0.2, 0.01, True),
    (1.0, 0.2, True),
)

#: Commands of the bias flow before an inspiration, %.
BIAS = float(waveform.expiratory_command(protocol.BREATH_STEPS - 1))


#: Asks the controllers of all cells for their commands, %, ``(n,)``, given their observations.
Act = Callable[[Floats], Floats]


@dataclass(frozen=True, eq=False)
class Outcome:
    """What became of n runs; arrays ``(n,)``."""

    unsafe: Bools  #: whether the safety gate failed.
    vented: Bools  #: whether the pressure reached the device's limit.
    tripped: Bools  #: whether a check of the host tripped before that.
    taken: Ints  #: steps that the fallback commanded.
    outside: Ints  #: answers that it refused.


def breathe(lungs: Lungs, labels: Ints, pips: Floats, act: Act, guarded: bool) -> Outcome:
    """Run three breaths; a lung that reaches the device's limit or trips a check is vented."""
    n, noise = len(labels), np.random.default_rng(list(SEED))
    states = [fallback.init(LUNGS[k]) for k in labels]
    watched = [safety.init(LUNGS[k]) for k in labels]
    ended, vented, tripped = np.zeros(n, bool), np.zeros(n, bool), np.zeros(n, bool)
    pressure = np.full((n, protocol.BREATHS, protocol.BREATH_STEPS), np.nan)
    u_in, acting = np.full(n, BIAS), np.zeros(n)
    ahead = [waveform.targets_ahead(k, 1.0) for k in range(34)]
    for index in range(protocol.BREATHS * protocol.BREATH_STEPS):
        breath, step = divmod(index, protocol.BREATH_STEPS)
        inspired, now = step < protocol.INSPIRATION_STEPS, index * protocol.DT
        read = np.round((lungs.pressure() + NOISE * noise.standard_normal(n)) / QUANTUM) * QUANTUM
        for i in np.flatnonzero(~ended):
            position = float(u_in[i]), int(0 < step <= protocol.INSPIRATION_STEPS) ^ 1
            sample = safety.SafetySample(now, read[i], np.nan, *position, pips[i], 0.0, u_in[i])
            watched[i] = safety.step(safety.DEFAULT, watched[i], sample)
            tripped[i] = bool(watched[i].trips)
        vented |= ~ended & (read >= protocol.SAFETY_PRESSURE)
        pressure[:, breath, step] = np.where(ended, pips, read)
        ended |= vented | tripped
        previous = np.full(n, BIAS) if step == 0 else u_in
        if inspired:
            head = [np.full(n, step * protocol.DT), np.full(n, protocol.DT), read, pips]
            rows = np.column_stack([*head, np.outer(pips, ahead[step]), previous])
            wanted = np.clip(act(rows), 0.0, protocol.U_MAX)
            for i in np.flatnonzero(~ended) if guarded else ():
                states[i], wanted[i] = fallback.step(
                    fallback.DEFAULT, states[i], step, read[i], pips[i], wanted[i], previous[i]
                )
        else:
            wanted = np.full(n, float(waveform.expiratory_command(step)))
        u_in = np.where(ended, 0.0, wanted)
        lungs.hold(acting, u_in, np.full(n, float(not inspired)), step == 0)
        acting = u_in
    runs = zip(pressure, pips.tolist(), strict=True)
    safe = np.array([measured.is_safe(run, pip, protocol.DT).all() for run, pip in runs])
    taken, outside = (np.array([getattr(x, name) for x in states]) for name in ("taken", "outside"))
    return Outcome(~safe, vented, tripped & ~vented, taken, outside)


class Runaways:
    """PIs that go wrong at a random moment: the valve is open, opens on, or the gain tenfold.

    Sound ones never do.
    """

    def __init__(self, labels: Ints, *, sound: bool = False) -> None:
        random = np.random.default_rng(list(SEED))
        self._pids = [PIDController((*CONTROL_GAINS[LUNGS[k].id], 0.0)) for k in labels]
        self._moment = random.integers(0, ASKED, len(labels)) + ASKED * sound
        self._kind, self._step = random.integers(0, 3, len(labels)), -1

    def __call__(self, rows: Floats) -> Floats:
        """Commands of all, %, ``(n,)``."""
        self._step += 1
        pairs = zip(self._pids, rows, strict=True)
        asked = np.array([pid.act(row[None], 0.0) for pid, row in pairs], float)
        wrong = np.choose(self._kind, [np.full(len(rows), 100.0), rows[:, -1] + 20.0, 10.0 * asked])
        return np.where(self._step >= self._moment, wrong, asked)


def controllers(name: str, labels: Ints) -> Act:
    """A bundled entry on each lung, in this process."""
    submission = open_submission(name)
    track = submission.manifest.tracks[0]
    tasks = [
        Task(track, LUNGS[k].id if track == "performance" else None, protocol.DT, 34)
        for k in labels
    ]
    return InProcessRunner().start(submission, tasks).act


def families(rigs: int) -> dict[str, tuple[Ints, Callable[[Ints], Lungs]]]:
    """Labels of the rigs of each family, ``(m,)``, and what makes lungs of some of them."""
    official = load_rigs("frozen")
    assert official.sessions is not None
    assert official.population is not None
    reference = [own[0] for own in official.sessions]
    frozen = jax.tree.map(lambda x: np.asarray(x)[0, reference], official.plants)
    each = [official.population.rigs(SEED, k, rigs) for k in range(len(LUNGS))]
    population = jax.tree.map(lambda *x: np.concatenate(x), *each)
    once, often = np.arange(len(LUNGS)), np.repeat(np.arange(len(LUNGS)), rigs)

    def taken(plants: Any) -> Callable[[Ints], Lungs]:
        return lambda at: Plants(jax.tree.map(lambda leaf: np.asarray(leaf)[at], plants))

    settings = [LUNGS[k].id for k in often]
    base, effects, dead = generated(settings, "right", np.random.default_rng(list(SEED)))

    def strangers(at: Ints) -> Lungs:
        chosen = {
            name: replace(
                effect, parameters={k: np.asarray(v)[at] for k, v in effect.parameters.items()}
            )
            for name, effect in effects.items()
        }
        values: Any = {name: np.asarray(value)[at] for name, value in vars(base).items()}
        return Generated(Base(**values), chosen, dead[at])

    return {
        "frozen": (once, taken(frozen)),
        "population": (often, taken(population)),
        "independent": (often, strangers),
    }


def responses(lungs: Lungs, n: int) -> Floats:
    """Shares of the drop of a step of 50 % that the three readings after its end show, ``(3, n)``.

    The pressure that remains is that of the fifth reading.
    """
    shown, before = [], np.zeros(n)
    for step in range(12):
        u_in = np.full(n, 50.0 if 4 <= step < 8 else 0.0)
        lungs.hold(before, u_in, np.zeros(n))
        before = u_in
        shown.append(lungs.pressure())
    held, *after = (x - shown[-1] for x in shown[7:11])
    return np.array(after) / held


def percent(count: int, of: int) -> str:
    """A share with its interval of 95 %, if there is one."""
    if not of:
        return "-"
    found = stats.binomtest(count, of).proportion_ci(0.95, "exact")
    return f"{100.0 * count / of:.2f} ({100.0 * found.low:.2f} to {100.0 * found.high:.2f})"


def false_alarms(
    family: str, name: str, labels: Ints, pips: Floats, make: Callable[[], Lungs]
) -> str:
    """Row of an entry on lungs of a family."""
    free = breathe(make(), labels, pips, controllers(name, labels), False)
    held = breathe(make(), labels, pips, controllers(name, labels), True)
    harmless = ~(free.unsafe | free.vented)
    count = int(harmless.sum())
    failed = int((harmless & (held.outside > LATE_SHARE * ASKED)).sum())
    taken, tripped = (int(x[harmless].sum()) for x in (held.taken, free.tripped))
    return (
        f"| {family} | {name} | {count} of {len(labels)} | {percent(taken, count * ASKED)} | "
        f"{percent(failed, count)} | {tripped} |"
    )


def misses(family: str, labels: Ints, pips: Floats, make: Callable[[], Lungs]) -> str:
    """Row of runaways on lungs of a family."""
    sound = breathe(make(), labels, pips, Runaways(labels, sound=True), False)
    free = breathe(make(), labels, pips, Runaways(labels), False)
    held = breathe(make(), labels, pips, Runaways(labels), True)
    harmful = ~(sound.unsafe | sound.vented) & (free.unsafe | free.vented)
    vented = int((harmful & held.vented).sum())
    missed = int((harmful & held.unsafe & ~held.vented).sum())
    count = int(harmful.sum())
    return f"| {family} | {count} of {len(labels)} | {vented} | {percent(missed, count)} |"


def is_blamed(entry: float, host: float, random: np.random.Generator, runs: int = 60) -> bool:
    """Whether a session of one lung fails an entry; both are late in such shares of answers."""
    lateness = Lateness()
    for _ in range(runs):
        for _ in range(MAX_HELD_UP):
            own, empty = (Count(int(random.binomial(ASKED, p)), ASKED) for p in (entry, host))
            of_host = lateness.is_of_host("entry", own, empty)
            if own.late <= LATE_SHARE * ASKED:
                break
            if not of_host:
                return True
        else:
            return False  # the session gives up, and says that the host is too busy
    return False


def of_fallback(lungs: int, entry: list[str] | None) -> None:
    """Print false alarms of the fallback and of the host's checks, and what the fallback misses."""
    mounted = []
    for family, (rig_labels, make) in families(lungs).items():
        rig, place = (x.ravel() for x in np.indices((len(rig_labels), len(protocol.PIPS))))
        pips = np.array(protocol.PIPS)[place]
        mounted.append((family, rig_labels[rig], pips, partial(make, rig)))
    print("| lungs | entry | harmless runs | steps taken, % | runs failed, % | checks tripped |")
    print("|---|---|---|---|---|---|")
    for family, labels, pips, make_all in mounted:
        for name in entry or bundled():
            print(false_alarms(family, name, labels, pips, make_all), flush=True)
    print("\n| lungs | runaways that do harm | vented by the device | missed, % |")
    print("|---|---|---|---|")
    for each in mounted:
        print(misses(*each), flush=True)
    labels, make = families(64)["population"]
    resistive = np.flatnonzero([LUNGS[k].R >= 20.0 for k in labels])  # others show little of it
    shares = responses(make(resistive), len(resistive))
    print(f"\ndrop that readings after a flow still show, {len(resistive)} rigs of the population:")
    for step, own in enumerate(shares, 1):
        low, middle, high = np.quantile(own, (0.01, 0.5, 0.99))
        print(f"  {step}: {middle:.2f} ({low:.2f} to {high:.2f}: 98 % of them)")


def of_lateness(sessions: int) -> None:
    """Print how often sessions of 60 runs blame the wrong one for late answers."""
    print("| entry late, % | host late, % | to blame | sessions that blame wrongly, % |")
    print("|---|---|---|---|")
    random = np.random.default_rng(list(SEED))
    for own, host, guilty in LATE:
        wrong = sum(is_blamed(own, host, random) is not guilty for _ in range(sessions))
        who = "entry" if guilty else "host"
        print(f"| {100 * own:g} | {100 * host:g} | {who} | {percent(wrong, sessions)} |")


def of_selftest(lungs: int, families: Sequence[str], label: list[str] | None, **about: Any) -> None:
    """Print how many lungs the self-test refuses: right ones, and wrong ones, which it must.

    The folder ``out`` keeps what is finished; the same command continues.
    """
    out, kept = about.pop("out"), {"lungs": lungs, **about}
    print("| lungs | mounted | refused | %, 95 % interval | by part |\n|---|---|---|---|---|")
    for family in families:
        work = WorkFolder(out / family, kept)
        for kind in KINDS if family == "independent" else PLANTS:
            every: list[dict[str, Any]] = []
            for name in label or labels_of(family):
                one = partial(of_label, name, kind, family, **kept)
                every += work.get(f"{name}-{KINDS.index(kind)}", one)
            bad = [x for x in every if x["bad"]]
            by = Counter(part for x in bad for part in x["bad"])
            named = sum(x["lung"] in x["told"] for x in bad)
            parts = ", ".join(f"{part} {count}" for part, count in by.items())
            if kind == "another lung":
                parts += f"; {named} named"
            refused = f"{len(bad)}/{len(every)} | {percent(len(bad), len(every))}"
            print(f"| {family} | {kind} | {refused} | {parts} |", flush=True)


def main(
    lungs: int = 4,
    entry: list[str] | None = None,
    guard: list[Guard] | None = None,
    sessions: int = 1000,
    family: list[str] | None = None,
    label: list[str] | None = None,
    blind: bool = False,
    seed: int = 0,
    out: Path = Path("runs/selftests"),
) -> None:
    """How often the guards of a bench are wrong: fallback, host's checks, lateness, self-test.

    --lungs: of each label and family; of each kind in self-tests.
    --entry: bundled; repeatable; all if not.
    --guard: repeatable; all if not.
    --sessions: with answers that are late.
    --family: of self-tests: frozen, population or independent; repeatable; all if not.
    --label: of self-tests; repeatable; all if not.
    --blind: self-tests without a flow sensor, with a calibrated valve.
    --seed: of the lungs of self-tests.
    --out: keeps self-tests.
    """
    guards = guard or list(Guard)
    if Guard.FALLBACK in guards:
        of_fallback(lungs, entry)
    if Guard.LATENESS in guards:
        of_lateness(sessions)
    if Guard.SELFTEST in guards:
        chosen = family or ["frozen", "population", "independent"]
        of_selftest(lungs, chosen, label, blind=blind, seed=seed, out=out)


if __name__ == "__main__":
    typer.run(main)
