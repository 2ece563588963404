"""Error rates of the self-test on three families of lungs.

- ``generator``: the second rig generator, which shares nothing with the simulators. Every lung has
  R, C, PEEP, valves and dead time of its own about one of the nine settings of a test lung; half of
  the resistors of 5 and 20 are parabolic.
- ``population``: rigs drawn from the population that real sessions span, of the six scored lungs.
- ``frozen``: the rigs of the frozen simulators, each member of the ensemble.

Sensor noise of 0.1 to 0.3 cmH2O and the converter's step lie on the pressure. The self-test's
programs breathe on all lungs of a label side by side, in virtual time, watched by the checks; then
each is judged as at a bench.

    python benchmarks/hardware_selftests.py [--lungs 200] [--family FAMILY] [--label R5C20 ...]

Prints the table of ``hardware_eval/README.md``: lungs that are refused, by label, and 95 %
intervals (Clopper-Pearson). The folder keeps what is finished; the same command continues.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
import typer
from scipy import stats

from hardware_eval.bench import safety, selftest
from hardware_eval.bench.drive import Driven
from hardware_eval.bench.identity import Baseline, KnownLung, measured_lung, white_noise
from hardware_eval.bench.safety import VALVE_GAIN
from hardware_eval.emulation.cases import NOMINAL_GAIN, Base, Effect
from hardware_eval.emulation.simulated import breath_begun
from proofs.challenge.stranger.rig import Rig
from ventbench.base.arrays import Floats, Ints
from ventbench.base.resume import WorkFolder
from ventbench.plants.rigs import load_rigs
from ventbench.task import protocol
from ventbench.task.lungs import LUNGS, RECORDED_LUNGS
from ventbench.task.lungs import lung as parse_lung

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
PARTS_OF = {
    CREEPS: ("sensor", "leak"),
    LEAKS: ("sensor", "leak"),
    STUCK: ("sensor", "sweep"),
}


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
        import jax
        import jax.numpy as jnp

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
    if family == "generator":
        base, effects, dead = generated(settings, fault, rng)
        begin, gain = partial(Generated, base, effects, dead), np.asarray(base.gain)
    else:
        begin = partial(Plants, _rigs(family, settings, seed), fault == STUCK)
        gain = np.full(n, VALVE_GAIN)
    sensor, flow = np.full(n, SENSORS.get(fault, 1.0)), 1.0 + FLOW_GAIN * rng.standard_normal(n)
    return Mounted(begin, gain, sensor, flow, rng.uniform(0.1, 0.3, n))


def _rigs(family: str, settings: Sequence[str], seed: int) -> Any:
    """A plant of each setting, leaves ``(n, ...)``: one of its rigs after the other, or drawn."""
    import jax

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
    mounted: Mounted, label: str, rng: np.random.Generator, only: Sequence[str]
) -> list[dict[str, list[Driven]]]:
    """Run programs of the self-test on lungs that are mounted under a label; one result a lung."""
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
    return done


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


def session(
    mounted: Mounted, label: str, rng: np.random.Generator, blind: bool, only: Sequence[str]
) -> list[dict[str, list[Driven]]]:
    """Run programs on mounted lungs, with a flow sensor or without."""
    made = driven(mounted, label, rng, only)
    return [blinded(each) for each in made] if blind else made


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
        first = session(sound, label, rng, blind, ("sensor", "lung"))
        known = [calibrated(each, label) for each in first]
    results = []
    for k, own in enumerate(session(mounted, label, rng, blind, PARTS_OF.get(kind, ALL))):
        gain = float(mounted.gain[k]) if blind else None
        results.append({"lung": settings[k], **judged(own, label, gain, known[k])})
    return results


def labels_of(family: str) -> list[str]:
    """Settings of which a family has lungs."""
    return [x.id for x in (RECORDED_LUNGS if family == "generator" else LUNGS)]


def interval(count: int, of: int) -> tuple[float, float]:
    """Clopper-Pearson interval of a share, 95 %."""
    found = stats.binomtest(count, of).proportion_ci(0.95, "exact")
    return found.low, found.high


def main(
    lungs: int = 200,
    family: Literal["generator", "population", "frozen"] = "generator",
    label: list[str] | None = None,
    kind: list[str] | None = None,
    blind: bool = False,
    seed: int = 0,
    out: Path = Path("runs/selftests"),
) -> None:
    """Error rates of the self-test on three families of lungs.

    --lungs: of each label and kind.
    --label: one of the nine; repeatable; all if not.
    --kind: repeatable; all if not.
    --blind: no flow sensor, a calibrated valve.
    --out: kept here.
    """
    possible = KINDS if family == "generator" else PLANTS
    kinds, labels = kind or list(possible), label or labels_of(family)
    if unfit := sorted(set(kinds) - set(possible)):
        raise typer.BadParameter(f"{family} has no lungs of the kind {unfit[0]!r}")
    about: dict[str, Any] = {"family": family, "lungs": lungs, "blind": blind, "seed": seed}
    work, began = WorkFolder(out / family, about), time.process_time()
    table = {
        name: {
            each: work.get(f"{name}-{KINDS.index(each)}", partial(of_label, name, each, **about))
            for each in kinds
        }
        for name in labels
    }
    print(f"| of {lungs} refused | {' | '.join(kinds)} |\n|---{len(kinds) * '|---'}|")
    for name, of in table.items():
        print(f"| {name} | {' | '.join(str(_refused(of[each])) for each in kinds)} |")
    cells, parts = [], []
    for each in kinds:
        every = [x for of in table.values() for x in of[each]]
        low, high = interval(_refused(every), len(every))
        share = 100.0 * _refused(every) / len(every)
        cells.append(f"{share:.1f} ({100.0 * low:.1f} to {100.0 * high:.1f})")
        by = {name: sum(name in x["bad"] for x in every) for x in every for name in x["bad"]}
        parts.append(f"{each}: {by}")
    print(f"| all, % (95 %) | {' | '.join(cells)} |")
    wrong = [x for of in table.values() for x in of.get("another lung", ()) if x["bad"]]
    print(f"of {len(wrong)} other lungs that were refused {sum(map(_named, wrong))} were named")
    print("refused by part:", *parts, sep="\n")
    print(f"{time.process_time() - began:.0f} s of this process")


def _refused(lungs: Sequence[dict[str, Any]]) -> int:
    return sum(bool(x["bad"]) for x in lungs)


def _named(lung: dict[str, Any]) -> bool:
    return lung["lung"] in lung["told"]


if __name__ == "__main__":
    typer.run(main)
