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

Prints the tables of ``hardware_eval/README.md`` with intervals of 95 % (Clopper-Pearson).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
import typer
from scipy import stats

from hardware_eval.bench import calibrate, fallback, safety, selftest
from hardware_eval.bench.controllers import Count, Lateness, PIController
from hardware_eval.bench.drive import Commands, Driven
from hardware_eval.bench.identity import Baseline, KnownLung, Valve, measured_lung, white_noise
from hardware_eval.bench.loop import LATE_SHARE
from hardware_eval.bench.plan import CONTROL_GAINS
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

#: Relative error of a meter; steps until a flow is steady.
METER, STEADY = 0.02, 6

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

#: Forms of what a lung of the generator has, by effect.
FORMS = {"viscoelasticity": "library", "turbulent_resistance": "quadratic", "leak": "orifice"}

#: Parts of the self-test that could find it; all if not here.
PARTS_OF = {CREEPS: ("sensor", "leak"), LEAKS: ("sensor", "leak")}

#: Families of lungs.
FAMILIES = ("frozen", "population", "independent")


class Lungs(Protocol):
    """Lungs side by side, at rest; arrays of shape ``(n,)``."""

    def hold(self, u_in: Floats, u_out: Floats) -> None:
        """Hold commands, % and 0/1, for a control step."""
        ...

    def pressure(self) -> Floats:
        """Airway pressures, cmH2O."""
        ...

    def flow(self) -> Floats:
        """Flows into the lungs, mL/s."""
        ...


class Generated:
    """Lungs of the generator, as :func:`generated` draws them."""

    def __init__(self, drawn: dict[str, Any]) -> None:
        self._dead, zeros = drawn["dead"], np.zeros(len(drawn["dead"]))
        base = Base(**drawn["base"])
        effects = {name: Effect(name, "mild", form, drawn[name]) for name, form in FORMS.items()}
        self._rig = Rig(base, effects, zeros, 0.03, zeros, np.zeros((2, len(zeros))))
        self._rig.start(np.asarray(base.peep))
        self._u_in = zeros

    def hold(self, u_in: Floats, u_out: Floats) -> None:
        """See :class:`Lungs`; a valve stays where it was for its dead time."""
        for fine in range(FINE):
            self._rig.advance(np.where(fine >= self._dead, u_in, self._u_in), u_out, 0.0, STEP)
        self._u_in = u_in

    def pressure(self) -> Floats:
        """See :class:`Lungs`."""
        return self._rig.shown()

    def flow(self) -> Floats:
        """See :class:`Lungs`."""
        return 1e3 * self._rig.q


class Plants:
    """Plants with leaves ``(n, ...)``."""

    def __init__(self, plants: Any) -> None:
        self._plants = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), plants)
        start = jnp.full(jax.tree.leaves(plants)[0].shape[0], protocol.PEEP, jnp.float32)
        self._state, self._signals = jax.vmap(lambda plant, x: plant.init(x, x))(plants, start)
        self._u_out = np.ones(len(start))

    def hold(self, u_in: Floats, u_out: Floats) -> None:
        """See :class:`Lungs`; a breath begins where the expiratory valve closes."""
        inputs = (x.astype(np.float32) for x in (u_in, u_out, self._u_out > u_out))
        self._state, self._signals = _held(self._plants, self._state, *inputs)
        self._u_out = u_out

    def pressure(self) -> Floats:
        """See :class:`Lungs`."""
        return np.asarray(self._signals.reading, float)

    def flow(self) -> Floats:
        """See :class:`Lungs`."""
        return np.asarray(self._signals.flow, float)


@jax.jit
@jax.vmap
def _held(plant: Any, state: Any, u_in: Any, u_out: Any, begins: Any) -> Any:
    return plant.step(breath_begun(state, begins), u_in, u_out, jnp.float32(protocol.DT))


def drawn(
    family: str, settings: Sequence[str], seed: bytes, rng: np.random.Generator, kind: str = "right"
) -> tuple[Callable[[Any], Lungs], Any]:
    """A lung of a family about each setting: what makes them of arrays ``(n, ...)``, and these."""
    if family == "independent":
        return Generated, generated(settings, kind, rng)
    rigs, place = load_rigs(), [lung.id for lung in LUNGS]
    assert rigs.population is not None
    assert rigs.sessions is not None
    chosen = []
    for k, setting in enumerate(settings):
        lung, number = place.index(setting), settings[:k].count(setting)
        plants: Any = rigs.plants
        at: Any = number % rigs.members
        if family == "population":
            plants, at = rigs.population.rigs(seed, lung, number + 1), number
        else:
            sessions = rigs.sessions[lung]
            at = at, sessions[number // rigs.members % len(sessions)]
        chosen.append(jax.tree.map(lambda leaf, at=at: np.asarray(leaf)[at], plants))
    return Plants, jax.tree.map(lambda *leaves: np.stack(leaves), *chosen)


def generated(settings: Sequence[str], kind: str, rng: np.random.Generator) -> dict[str, Any]:
    """Draw what :class:`Generated` takes, in the ranges of the generator."""
    n, lungs = len(settings), [parse_lung(setting) for setting in settings]
    R = np.array([x.R for x in lungs]) * rng.uniform(0.85, 1.15, n)
    C = np.array([x.C for x in lungs]) * rng.uniform(0.93, 1.07, n)
    # A parabolic 50 would be told from flows far below 1 L/s; no scored lung has it.
    parabolic = (rng.uniform(size=n) < 0.5) & np.array([x.R < 50.0 for x in lungs])
    gain = NOMINAL_GAIN * rng.uniform(0.9, 1.1, n)
    outlet, peep = rng.uniform(4.0, 7.0, n), rng.uniform(4.5, 5.5, n)
    base = Base(np.where(parabolic, 0.5, R), C, outlet, peep, gain)  # type: ignore[arg-type]
    leak = LEAK / np.sqrt(20.0) if kind == LEAKS else 0.0
    creep = rng.uniform(*CREEP, n) * (kind in (CREEPS, LEAKS))
    return {
        "base": vars(base),
        "viscoelasticity": {"ratio": creep, "time": rng.uniform(*CREEP_TIME, n)},
        "turbulent_resistance": {"quadratic": np.where(parabolic, R, 0.0)},
        "leak": {"conductance": np.full(n, leak)},
        "dead": rng.integers(0, FINE, n),
    }


@dataclass(frozen=True, eq=False)
class Mounted:
    """What is mounted, and its sensors; arrays of shape ``(n,)``."""

    begin: Callable[[], Lungs]  #: puts the lungs at rest.
    noise: Floats  #: of the pressure, standard deviation, cmH2O.
    sensor: Floats | float = 1.0  #: gain of the pressure sensor.
    flow: Floats | None = None  #: gain of the flow sensor; None where there is none.
    opens: float = 1.0  #: share of a command to which the valve opens.


def mount(
    family: str,
    settings: Sequence[str],
    kind: str,
    seed: int,
    rng: np.random.Generator,
    blind: bool,
) -> Mounted:
    """Draw a lung of a family about each setting, and sensors, without one of flow if blind."""
    n = len(settings)
    make, arrays = drawn(family, settings, seed.to_bytes(32, "big"), rng, kind)
    flow, noise = 1.0 + FLOW_GAIN * rng.standard_normal(n), rng.uniform(0.1, 0.3, n)
    sensor, opens = SENSORS.get(kind, 1.0), float(kind != STUCK)
    return Mounted(partial(make, arrays), noise, sensor, None if blind else flow, opens)


class Watched:
    """Mounted lungs under the checks of a session; arrays of shape ``(n,)``.

    Args:
        mounted: what is mounted.
        lungs: of it, where they are.
        labels: under which they are mounted.
        pips: highest pressures that are meant, cmH2O.
        random: draws the noise.
    """

    def __init__(
        self,
        mounted: Mounted,
        lungs: Lungs,
        labels: Sequence[str],
        pips: Floats,
        random: np.random.Generator,
    ) -> None:
        self._mounted, self._lungs, self._pips, self._random = mounted, lungs, pips, random
        self.checks = [safety.SafetyState(parse_lung(label)) for label in labels]
        self.u_in, self._u_out, self._steps = np.zeros(len(pips)), np.ones(len(pips)), 0

    def look(self) -> tuple[Floats, Floats]:
        """Readings of pressure, cmH2O, and flow, mL/s."""
        mounted, n, now = self._mounted, len(self.checks), self._steps * protocol.DT
        noise = mounted.noise * self._random.standard_normal(n)
        read = mounted.sensor * self._lungs.pressure() + noise
        read = np.round(read / QUANTUM) * QUANTUM
        flow = np.full(n, np.nan)
        if mounted.flow is not None:
            flow = mounted.flow * self._lungs.flow() + FLOW_NOISE * self._random.standard_normal(n)
        for i, state in enumerate(self.checks):
            u_in = float(self.u_in[i])
            seen = read[i], flow[i], u_in, int(self._u_out[i]), self._pips[i]
            sample = safety.SafetySample(now, *seen, late=0.0, applied=u_in)
            self.checks[i] = safety.step(safety.DEFAULT, state, sample)
        return read, flow

    def hold(self, u_in: Floats, u_out: Floats) -> None:
        """Hold commands, % and 0/1, for a control step."""
        self._lungs.hold(self._mounted.opens * u_in, u_out)
        self.u_in, self._u_out, self._steps = u_in, u_out, self._steps + 1


def rest(lungs: Lungs, label: str, n: int) -> None:
    """Vent n lungs as long as the self-test does before a program."""
    for _ in range(round(selftest.rest_before(label) / protocol.DT)):
        lungs.hold(np.zeros(n), np.ones(n))


#: What the programs of each part brought.
Parts = dict[str, list[Driven]]


def driven(
    mounted: Mounted, label: str, rng: np.random.Generator, only: Sequence[str]
) -> list[Parts]:
    """Run programs of the self-test on lungs that are mounted under a label; one result a lung."""
    n = len(mounted.noise)
    lungs = mounted.begin()
    done: list[Parts] = [{part: [] for part in only} for _ in range(n)]
    noises = [0.0] * n
    for part in only:
        each = [selftest.programs(label, noise)[part] for noise in noises]
        for k in range(len(each[0])):
            own_programs = [programs[k] for programs in each]
            lengths = [program.steps for program in own_programs]
            rest(lungs, label, n)
            watched = Watched(mounted, lungs, [label] * n, np.full(n, own_programs[0].pip), rng)
            commands = [program.commands for program in own_programs]
            columns = _program(watched, commands, max(lengths))
            for i, steps in enumerate(lengths):
                trips = tuple(trip.message for trip in watched.checks[i].trips)
                own = Driven(*columns[:, :steps, i], trips, False, 0)  # type: ignore[arg-type]
                done[i][part].append(own)
        if part == "sensor":
            noises = [white_noise(x[part][0].pressure[17:]) for x in done]
    return done


def _program(watched: Watched, programs: Sequence[Commands], steps: int) -> Floats:
    """Columns of :class:`Driven`, ``(7, T, n)``, of a program on each lung."""
    zeros, rows = np.zeros(len(programs)), []
    for step in range(steps):
        read, flow = watched.look()
        asked = np.array([own(step, float(x)) for own, x in zip(programs, read, strict=True)])
        pairs = zip(watched.u_in, asked[:, 0], strict=True)
        u_in = np.array([safety.limit_command(safety.DEFAULT, *pair)[0] for pair in pairs])
        time, u_out = zeros + step * protocol.DT, asked[:, 1]
        rows.append((time, read, flow, u_in, u_out, zeros, zeros))
        watched.hold(u_in, u_out)
    return np.moveaxis(np.array(rows), 0, 1)


def metered(mounted: Mounted, label: str, rng: np.random.Generator) -> list[Valve | None]:
    """Curves of valves as a person calibrates them, who reads a meter; one result a lung."""
    lungs, n, reads = mounted.begin(), len(mounted.noise), []
    meter = 1.0 + METER * rng.standard_normal(n)
    for first, opening in product((1.0, 1.5), calibrate.OPENINGS):  # as it is, and from above
        rest(lungs, label, n)
        for larger in (first, first, *[1.0] * STEADY):
            lungs.hold(np.full(n, larger * opening), np.zeros(n))
        reads.append(meter * lungs.flow())
    about = "valve", "", calibrate.OPENINGS * 2
    parts = [calibrate.Part(*about, tuple(x), tuple(METER * x), True) for x in np.array(reads).T]
    return [calibrate.Calibration({}, {"valve": part}).valve for part in parts]


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
    mounted = mount(family, settings, kind, seed, rng, blind)
    known: list[KnownLung | None] = [None] * lungs
    if kind in ("right", *SENSORS):  # its calibration, when the sensor was right
        known = [
            measured_lung(own["lung"], label, white_noise(own["sensor"][0].pressure))[0]
            for own in driven(replace(mounted, sensor=1.0), label, rng, ("sensor", "lung"))
        ]
    results, valves = [], metered(mounted, label, rng) if blind else [None] * lungs
    done = driven(mounted, label, rng, PARTS_OF.get(kind, selftest.PARTS))
    for setting, own, *told in zip(settings, done, valves, known, strict=True):
        baseline = Baseline(*told)  # type: ignore[arg-type]
        sheet = selftest.judge(label, own, simulator=None, baseline=baseline)
        tripped = any(x.trips for each in own.values() for x in each)
        bad = [x.name for x in sheet.findings if not x.ok] + ["safety"] * tripped
        text = "; ".join(x.text for x in sheet.findings if x.name == "identity")
        results.append({"lung": setting, "bad": bad, "told": text})
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


def breathe(
    mounted: Mounted, labels: Sequence[str], pips: Floats, act: Act, guarded: bool
) -> Outcome:
    """Run three breaths; a lung that reaches the device's limit or trips a check is vented."""
    n, lungs = len(labels), mounted.begin()
    watched = Watched(mounted, lungs, labels, pips, np.random.default_rng(list(SEED)))
    watched.u_in = np.full(n, BIAS)
    states = [fallback.FallbackState(parse_lung(label)) for label in labels]
    ended, vented, tripped = np.zeros(n, bool), np.zeros(n, bool), np.zeros(n, bool)
    pressure = np.full((n, protocol.BREATHS, protocol.BREATH_STEPS), np.nan)
    for breath, step in np.ndindex(pressure.shape[1:]):
        read, _ = watched.look()
        vented |= ~ended & (read >= protocol.SAFETY_PRESSURE)
        tripped |= ~ended & np.array([bool(state.trips) for state in watched.checks])
        pressure[:, breath, step] = np.where(ended, pips, read)
        ended |= vented | tripped
        inspired = step < protocol.INSPIRATION_STEPS
        wanted = np.full(n, float(waveform.expiratory_command(step)))
        if inspired:
            previous = np.full(n, BIAS) if step == 0 else watched.u_in
            head = [np.full(n, step * protocol.DT), np.full(n, protocol.DT), read, pips]
            ahead = np.outer(pips, waveform.targets_ahead(step, 1.0))
            rows = np.column_stack([*head, ahead, previous])
            wanted = np.clip(act(rows), 0.0, protocol.U_MAX)
            for i in np.flatnonzero(~ended) if guarded else ():
                states[i], wanted[i] = fallback.step(
                    states[i], step, read[i], pips[i], wanted[i], previous[i]
                )
        watched.hold(np.where(ended, 0.0, wanted), np.full(n, float(not inspired)))
    runs = zip(pressure, pips.tolist(), strict=True)
    safe = np.array([measured.is_safe(run, pip, protocol.DT).all() for run, pip in runs])
    taken, outside = (np.array([getattr(x, name) for x in states]) for name in ("taken", "outside"))
    return Outcome(~safe, vented, tripped & ~vented, taken, outside)


class Runaways:
    """PIs that go wrong at a random moment: the valve is open, opens on, or the gain tenfold.

    Sound ones never do.
    """

    def __init__(self, labels: Sequence[str], *, sound: bool = False) -> None:
        random = np.random.default_rng(list(SEED))
        self._pids = [PIController(CONTROL_GAINS[label]) for label in labels]
        self._moment = random.integers(0, ASKED, len(labels)) + ASKED * sound
        self._kind, self._step = random.integers(0, 3, len(labels)), -1

    def __call__(self, rows: Floats) -> Floats:
        """Commands of all, %, ``(n,)``."""
        self._step += 1
        pairs = zip(self._pids, rows, strict=True)
        asked = np.array([pid.act(row[None], 0.0) for pid, row in pairs], float)
        wrong = np.choose(self._kind, [np.full(len(rows), 100.0), rows[:, -1] + 20.0, 10.0 * asked])
        return np.where(self._step >= self._moment, wrong, asked)


def controllers(name: str, labels: Sequence[str]) -> Act:
    """A bundled entry on each lung, in this process."""
    submission = open_submission(name)
    track = submission.manifest.tracks[0]
    told = labels if track == "performance" else [None] * len(labels)
    tasks = [Task(track, lung, protocol.DT, protocol.INSPIRATION_STEPS) for lung in told]
    return InProcessRunner().start(submission, tasks).act


def percent(count: int, of: int) -> str:
    """A share with its interval of 95 %, if there is one."""
    if not of:
        return "-"
    found = stats.binomtest(count, of).proportion_ci(0.95, "exact")
    return f"{100.0 * count / of:.2f} ({100.0 * found.low:.2f} to {100.0 * found.high:.2f})"


def false_alarms(name: str, mounted: Mounted, labels: Sequence[str], pips: Floats) -> str:
    """What an entry's row says of lungs of a family."""
    free = breathe(mounted, labels, pips, controllers(name, labels), False)
    held = breathe(mounted, labels, pips, controllers(name, labels), True)
    harmless = ~(free.unsafe | free.vented)
    count = int(harmless.sum())
    failed = int((harmless & (held.outside > LATE_SHARE * ASKED)).sum())
    taken, tripped = (int(x[harmless].sum()) for x in (held.taken, free.tripped))
    return (
        f"{count} of {len(labels)} | {percent(taken, count * ASKED)} | {percent(failed, count)} | "
        f"{tripped} |"
    )


def misses(mounted: Mounted, labels: Sequence[str], pips: Floats) -> str:
    """What the row of runaways says of lungs of a family."""
    sound = breathe(mounted, labels, pips, Runaways(labels, sound=True), False)
    free = breathe(mounted, labels, pips, Runaways(labels), False)
    held = breathe(mounted, labels, pips, Runaways(labels), True)
    harmful = ~(sound.unsafe | sound.vented) & (free.unsafe | free.vented)
    vented = int((harmful & held.vented).sum())
    missed = int((harmful & held.unsafe & ~held.vented).sum())
    count = int(harmful.sum())
    return f"{count} of {len(labels)} | {vented} | {percent(missed, count)} |"


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
    families = {}
    for family in FAMILIES:
        settings = [x.id for x in LUNGS for _ in range(1 if family == "frozen" else lungs)]
        make, arrays = drawn(family, settings, SEED, np.random.default_rng(list(SEED)))
        at, place = (x.ravel() for x in np.indices((len(settings), len(protocol.PIPS))))
        each = jax.tree.map(lambda leaf, at=at: leaf[at], arrays)
        mounted = Mounted(partial(make, each), np.full(len(at), NOISE))
        families[family] = mounted, [settings[k] for k in at], np.array(protocol.PIPS)[place]
    print("| lungs | entry | harmless runs | steps taken, % | runs failed, % | checks tripped |")
    print("|---|---|---|---|---|---|")
    for family, cells in families.items():
        for name in entry or bundled():
            print(f"| {family} | {name} | {false_alarms(name, *cells)}", flush=True)
    print("\n| lungs | runaways that do harm | vented by the device | missed, % |")
    print("|---|---|---|---|")
    for family, cells in families.items():
        print(f"| {family} | {misses(*cells)}", flush=True)


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
        of_selftest(lungs, family or FAMILIES, label, blind=blind, seed=seed, out=out)


if __name__ == "__main__":
    typer.run(main)
