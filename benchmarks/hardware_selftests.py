"""Error rates of the self-test on lungs that are not the simulators: the second rig generator.

Every lung has R, C, PEEP, valves and dead time of its own about one of the nine settings of a test
lung, half of the resistors of 5 and 20 are parabolic, and sensor noise of 0.1 to 0.3 cmH2O and the
converter's step lie on the pressure. The self-test's programs breathe on all lungs of a label side
by side, in virtual time, watched by the checks; then each is judged as at a bench.

    python benchmarks/hardware_selftests.py [--lungs 200] [--label R5C20 ...] [--json FILE]

Prints the table of ``hardware_eval/README.md``: counts and 95 % intervals (Clopper-Pearson).
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from hardware_eval.bench import safety, selftest
from hardware_eval.bench.drive import Driven
from hardware_eval.bench.identity import KnownLung, measured_lung
from hardware_eval.emulation.cases import NOMINAL_GAIN, Base, Effect
from proofs.challenge.stranger.rig import Rig
from ventbench.task import protocol
from ventbench.task.lungs import LUNGS, RECORDED_LUNGS
from ventbench.task.lungs import lung as parse_lung

Floats = NDArray[np.float64]

#: Step of the integration, s; steps of it in a control step.
STEP = 1e-3
FINE = round(protocol.DT / STEP)

#: Converter's step, cmH2O; noise of the flow, mL/s, and relative error of its gain.
QUANTUM, FLOW_NOISE, FLOW_GAIN = 0.0703, 5.0, 0.01

#: A leak of so much at 20 cmH2O, mL/s.
LEAK = 5.0

#: What is wrong with a lung of the right label.
SENSORS = {"sensor 5 % high": 1.05, "sensor 5 % low": 0.95}
KINDS = ("right", "another lung", *SENSORS, "leak of 5 mL/s", "valve stuck")

#: Parts of the self-test that could find it; all if not here.
ALL = selftest.PARTS
PARTS_OF = {"leak of 5 mL/s": ("sensor", "leak"), "valve stuck": ("sensor", "sweep")}


@dataclass(frozen=True, eq=False)
class Mounted:
    """Lungs side by side; arrays of shape ``(n,)``.

    Attributes:
        base: the rigs, each value an array.
        quadratic: parabolic part of the resistance, cmH2O/(L/s)^2.
        leak: conductance, mL/s per sqrt(cmH2O).
        sensor: gain of the pressure sensor.
        flow: gain of the flow sensor.
        noise: standard deviation, cmH2O.
        dead: dead time of the valve, steps of the integration.
    """

    base: Base
    quadratic: Floats
    leak: Floats
    sensor: Floats
    flow: Floats
    noise: Floats
    dead: NDArray[np.int64]


def draw(settings: Sequence[str], fault: str, rng: np.random.Generator) -> Mounted:
    """Draw a lung about each setting; the ranges of the base are those of the generator."""
    n, lungs = len(settings), [parse_lung(setting) for setting in settings]
    R = np.array([x.R for x in lungs]) * rng.uniform(0.85, 1.15, n)
    C = np.array([x.C for x in lungs]) * rng.uniform(0.93, 1.07, n)
    # A parabolic 50 would be told from flows far below 1 L/s; no scored lung has it.
    parabolic = (rng.uniform(size=n) < 0.5) & np.array([x.R < 50.0 for x in lungs])
    gain = NOMINAL_GAIN * rng.uniform(0.9, 1.1, n) * (fault != "valve stuck")
    values: dict[str, Any] = {
        "R": np.where(parabolic, 0.5, R), "C": C, "R_ex": rng.uniform(4.0, 7.0, n),
        "peep": rng.uniform(4.5, 5.5, n), "gain": gain,
    }  # fmt: skip
    sensor = SENSORS.get(fault, 1.0)
    leak = LEAK / np.sqrt(20.0) if fault == "leak of 5 mL/s" else 0.0
    return Mounted(
        Base(**values), np.where(parabolic, R, 0.0), np.full(n, leak), np.full(n, sensor),
        1.0 + FLOW_GAIN * rng.standard_normal(n), rng.uniform(0.1, 0.3, n),
        rng.integers(0, FINE, n),
    )  # fmt: skip


def driven(
    mounted: Mounted, label: str, rng: np.random.Generator, only: Sequence[str]
) -> list[dict[str, list[Driven]]]:
    """Run programs of the self-test on lungs that are mounted under a label; one result a lung."""
    n = len(mounted.noise)
    quadratic: dict[str, Any] = {"quadratic": mounted.quadratic}
    conductance: dict[str, Any] = {"conductance": mounted.leak}
    effects = {
        "turbulent_resistance": Effect("turbulent_resistance", "mild", "quadratic", quadratic),
        "leak": Effect("leak", "mild", "orifice", conductance),
    }
    rig = Rig(mounted.base, effects, np.zeros(n), 0.03, np.zeros(n), np.zeros((2, n)))
    rig.start(np.asarray(mounted.base.peep))
    done: list[dict[str, list[Driven]]] = [{} for _ in range(n)]
    for part, programs in selftest.programs().items():
        for make, steps, pip in programs if part in only else ():
            for _ in range(round(selftest.rest_before(label) / STEP)):
                rig.advance(np.zeros(n), np.ones(n), 0.0, STEP)
            columns, trips = _program(rig, mounted, make, steps, pip, label, rng)
            for i in range(n):
                own = Driven(*columns[:, :, i], trips[i], False, 0)  # type: ignore[arg-type]
                done[i].setdefault(part, []).append(own)
    return done


def _program(
    rig: Rig, mounted: Mounted, make: Any, steps: int, pip: float, label: str,
    rng: np.random.Generator,
) -> tuple[Floats, list[tuple[str, ...]]]:  # fmt: skip
    """Columns of :class:`Driven`, ``(7, T, n)``, and the trips of each lung."""
    n, zeros = len(mounted.noise), np.zeros(len(mounted.noise))
    commands = [make() for _ in range(n)]
    watched = [safety.init(parse_lung(label)) for _ in range(n)]
    u_in, u_out, before = zeros.copy(), np.ones(n), zeros.copy()
    rows = []
    for step in range(steps):
        read = mounted.sensor * rig.shown() + mounted.noise * rng.standard_normal(n)
        read = np.round(read / QUANTUM) * QUANTUM
        flow = 1e3 * mounted.flow * rig.q + FLOW_NOISE * rng.standard_normal(n)
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
        for fine in range(FINE):
            rig.advance(np.where(fine >= mounted.dead, u_in, before), u_out, 0.0, STEP)
    trips = [tuple(trip.message for trip in state.trips) for state in watched]
    return np.moveaxis(np.array(rows), 0, 1), trips


def judged(
    done: dict[str, list[Driven]], label: str, gain: float | None, known: KnownLung | None
) -> dict[str, Any]:
    """Judge a lung; a valve of known ``gain``, mL/s per %, stands for a flow that is not there."""
    valve = None if gain is None else (gain, 0.98 * gain, 1.02 * gain)
    judge = partial(selftest.judge, label, done, valve=valve, known=known)
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
    noise = float(np.std(np.diff(done["sensor"][0].pressure))) / np.sqrt(2.0)
    return measured_lung(done["lung"], label, noise)[0]


def of_label(
    label: str, kinds: Sequence[str], lungs: int, blind: bool, seed: int
) -> list[dict[str, Any]]:
    """Right, wrong and faulty lungs of a label, judged."""
    rng = np.random.default_rng([seed, RECORDED_LUNGS.index(parse_lung(label))])
    others = [x.id for x in RECORDED_LUNGS if x.id != label]
    results = []
    for kind in kinds:
        settings = [label] * lungs
        if kind == "another lung":
            settings = [others[k % len(others)] for k in range(lungs)]
        mounted = draw(settings, kind, rng)
        known: Sequence[KnownLung | None] = [None] * lungs
        if kind in ("right", *SENSORS):  # its calibration, when the sensor was right
            sound = replace(mounted, sensor=np.ones(lungs))
            first = session(sound, label, rng, blind, ("sensor", "lung"))
            known = [calibrated(each, label) for each in first]
        for k, own in enumerate(session(mounted, label, rng, blind, PARTS_OF.get(kind, ALL))):
            gain = float(np.asarray(mounted.base.gain)[k]) if blind else None
            told = judged(own, label, gain, known[k])
            results.append({"label": label, "kind": kind, "lung": settings[k], **told})
    return results


def interval(count: int, of: int) -> tuple[float, float]:
    """Clopper-Pearson interval of a share, 95 %."""
    found = stats.binomtest(count, of).proportion_ci(0.95, "exact")
    return found.low, found.high


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--lungs", type=int, default=200, help="of each label and kind")
    parser.add_argument("--label", action="append", help="one of the nine; repeatable; all if not")
    parser.add_argument("--kind", action="append", choices=KINDS, help="repeatable; all if not")
    parser.add_argument("--blind", action="store_true", help="no flow sensor, a calibrated valve")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    kinds = given.kind or KINDS
    labels = given.label or [x.id for x in RECORDED_LUNGS]
    began = time.process_time()
    work = partial(of_label, kinds=kinds, lungs=given.lungs, blind=given.blind, seed=given.seed)
    if given.workers > 1:
        with ProcessPoolExecutor(given.workers) as pool:
            parts = list(pool.map(work, labels))
    else:
        parts = [work(label) for label in labels]
    everything = [one for part in parts for one in part]
    if given.json:
        given.json.write_text(json.dumps(everything))
    print(
        "| label | kind | NO-GO | %, 95 % interval | uncalibrated | named | by |\n"
        + 7 * "|---"
        + "|"
    )
    for label, part in zip([*labels, "all"], [*parts, everything], strict=True):
        for kind in kinds:
            own = [x for x in part if x["kind"] == kind]
            if not own:
                continue
            refused = [x for x in own if x["bad"]]
            low, high = interval(len(refused), len(own))
            named = sum(x["lung"] in x["told"] for x in refused)
            by = {name: sum(name in x["bad"] for x in own) for x in own for name in x["bad"]}
            uncalibrated = sum(x["bad"] != ["sensor_span"] for x in refused)
            print(
                f"| {label} | {kind} | {len(refused)}/{len(own)} | "
                f"{100 * len(refused) / len(own):.1f} ({100 * low:.1f} to {100 * high:.1f}) | "
                f"{uncalibrated} | {named if kind == 'another lung' else ''} | {by} |",
                flush=True,
            )
    print(f"{time.process_time() - began:.0f} s of this process")


if __name__ == "__main__":
    main()
