"""How often the fallback and the host's checks are wrong, on three families of right lungs.

The frozen rigs, rigs of the population, and lungs of an independent generator breathe side by side,
in virtual time. First every bundled entry runs on each at each PIP without a fallback: a run is
harmless if it passes the safety gate and never reaches the device's limit. Then it runs with one.
What the fallback takes of a harmless run, and a check that trips in one, is a false alarm. Entries
that run away, of which most runs fail the gate, say what the fallback misses: runs that fail the
gate although it may take over. What reaches the limit is vented by the device and counted apart.

    python benchmarks/hardware_guards.py [--rigs 4] [--entry pid_best ...]

Prints both tables, and what the population's rigs do, on which the
bounds of the fallback rest.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np
import typer
from hardware_selftests import QUANTUM, Generated, Lungs, Plants, generated, interval

from hardware_eval.bench import fallback, safety
from hardware_eval.bench.controllers import PIDController
from hardware_eval.bench.loop import LATE_SHARE
from hardware_eval.bench.plan import CONTROL_GAINS
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
    """PIDs that go wrong at a random moment: the valve is open, opens on, or the gain tenfold."""

    def __init__(self, labels: Ints) -> None:
        random = np.random.default_rng(list(SEED))
        self._pids = [PIDController((*CONTROL_GAINS[LUNGS[k].id], 0.0)) for k in labels]
        self._moment = random.integers(
            0, protocol.BREATHS * protocol.INSPIRATION_STEPS, len(labels)
        )
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
    """A share with its interval of 95 %."""
    low, high = (100.0 * x for x in interval(count, of))
    return f"{100.0 * count / of:.2f} ({low:.2f} to {high:.2f})"


def main(rigs: int = 4, entry: list[str] | None = None) -> None:
    """How often the fallback and the host's checks are wrong, on three families of right lungs.

    --rigs: of each lung and family.
    --entry: bundled; repeatable; all if not.
    """
    names = entry or bundled()
    asked = protocol.BREATHS * protocol.INSPIRATION_STEPS
    print("| lungs | entry | harmless runs | steps taken, % | runs failed, % | checks tripped |")
    print("|---|---|---|---|---|---|")
    missed = []
    for family, (rig_labels, make) in families(rigs).items():
        rig, place = (x.ravel() for x in np.indices((len(rig_labels), len(protocol.PIPS))))
        labels, pips = rig_labels[rig], np.array(protocol.PIPS)[place]
        for name in names:
            free = breathe(make(rig), labels, pips, controllers(name, labels), False)
            harmless = ~(free.unsafe | free.vented)
            held = breathe(make(rig), labels, pips, controllers(name, labels), True)
            count = int(harmless.sum())
            failed = harmless & (held.outside > LATE_SHARE * asked)
            print(
                f"| {family} | {name} | {count} of {len(rig)} | "
                f"{percent(int(held.taken[harmless].sum()), count * asked)} | "
                f"{percent(int(failed.sum()), count)} | {int(free.tripped[harmless].sum())} |",
                flush=True,
            )
        free = breathe(make(rig), labels, pips, Runaways(labels), False)
        held = breathe(make(rig), labels, pips, Runaways(labels), True)
        missed.append(
            f"| {family} | {len(rig)} | {free.unsafe.sum()} | {free.vented.sum()} | "
            f"{percent(int(held.unsafe.sum()), int(free.unsafe.sum()))} | {held.vented.sum()} |"
        )
    print("\n| lungs | runaways | unsafe alone | vented alone | missed, % | vented by the device |")
    print("|---|---|---|---|---|---|", *missed, sep="\n")
    labels, make = families(64)["population"]
    resistive = np.flatnonzero([LUNGS[k].R >= 20.0 for k in labels])  # others show little of it
    shares = responses(make(resistive), len(resistive))
    print(f"\ndrop that readings after a flow still show, {len(resistive)} rigs of the population:")
    for step, own in enumerate(shares, 1):
        low, middle, high = np.quantile(own, (0.01, 0.5, 0.99))
        print(f"  {step}: {middle:.2f} ({low:.2f} to {high:.2f}: 98 % of them)")


if __name__ == "__main__":
    typer.run(main)
