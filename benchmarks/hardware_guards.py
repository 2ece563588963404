"""How often the guards of a bench are wrong: fallback, checks of the host, lateness, self-test.

Right lungs of three families breathe side by side, in virtual time: the frozen rigs, rigs of the
population, and lungs of an independent generator. First every bundled entry runs on each at each
PIP without a fallback: a run is harmless if it passes the safety gate and never reaches the
device's limit. Then it runs with one. What the fallback takes of a harmless run, and a check that
trips in one, is a false alarm.

Where the paper's PI does no harm, controllers that run away say what the fallback misses: runs that
fail the gate, or that the device vents at its limit, although it may take over. Hosts and entries
that are late by chance say how often a session blames the wrong one. Right and wrong lungs say how
often the self-test is wrong (``hardware_selftests.py`` has the other faults).

    python benchmarks/hardware_guards.py [--lungs 4] [--entry pid_best ...] [--guard lateness ...]

Prints the tables of ``hardware_eval/README.md``, and what the population's rigs do, on which
the bounds of the fallback rest.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum
from functools import partial
from typing import Any

import jax
import numpy as np
import typer
from hardware_selftests import QUANTUM, Generated, Lungs, Plants, generated, interval, of_label

from hardware_eval.bench import fallback, safety
from hardware_eval.bench.controllers import Count, Lateness, PIDController
from hardware_eval.bench.loop import LATE_SHARE
from hardware_eval.bench.plan import CONTROL_GAINS
from hardware_eval.bench.session import MAX_HELD_UP
from hardware_eval.emulation.cases import Base
from ventbench.base.arrays import Bools, Floats, Ints
from ventbench.entries.cells import InProcessRunner
from ventbench.entries.folder import bundled, open_submission
from ventbench.plants.rigs import load_rigs
from ventbench.task import protocol, waveform
from ventbench.task.interfaces import Task
from ventbench.task.lungs import LUNGS
from ventbench.task.metrics import measured

#: Seed of the population's rigs, of the noise and of what runs away.
SEED = b"guards of a bench, right lungs 1"

#: Noise of the sensor, cmH2O.
NOISE = 0.1


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
    low, high = (100.0 * x for x in interval(count, of))
    return f"{100.0 * count / of:.2f} ({low:.2f} to {high:.2f})"


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


def refused(family: str, kind: str, lungs: int) -> tuple[int, int]:
    """Lungs of a kind that the self-test refuses, and how many there were."""
    sheets = [x for lung in LUNGS for x in of_label(lung.id, kind, family, lungs, False, 0)]
    return sum(bool(x["bad"]) for x in sheets), len(sheets)


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


def of_selftest(lungs: int) -> None:
    """Print right lungs that the self-test refuses, and wrong ones that it does not."""
    print("| lungs | right lungs refused, % | wrong lungs missed, % |\n|---|---|---|")
    for family in ("frozen", "population", "generator"):
        right, of = refused(family, "right", lungs)
        wrong, others = refused(family, "another lung", lungs)
        print(
            f"| {family} | {percent(right, of)} | {percent(others - wrong, others)} |", flush=True
        )


def main(
    lungs: int = 4,
    entry: list[str] | None = None,
    guard: list[Guard] | None = None,
    sessions: int = 1000,
) -> None:
    """How often the guards of a bench are wrong: fallback, host's checks, lateness, self-test.

    --lungs: of each label and family.
    --entry: bundled; repeatable; all if not.
    --guard: repeatable; all if not.
    --sessions: with answers that are late.
    """
    guards = guard or list(Guard)
    if Guard.FALLBACK in guards:
        of_fallback(lungs, entry)
    if Guard.LATENESS in guards:
        of_lateness(sessions)
    if Guard.SELFTEST in guards:
        of_selftest(lungs)


if __name__ == "__main__":
    typer.run(main)
