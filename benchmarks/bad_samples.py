"""Whether bad samples make physics: sound recordings with 0.1 to 3 % of six kinds of them.

A lung of one R and one C is ventilated by pressure control or by a constant flow, which rise within
20 to 50 ms. Where it empties slowly, gas is trapped. It is sampled with noise, and spoiled by marks
of missing values, zeros, spikes, held values, moments at an end of the sensor's range, or rows that
are there twice, with a clock or (repeated rows) without one. The recording is imported as another
laboratory's, and its mechanics are identified, or it is diagnosed. Prints by kind how many have a
false effect, and how often R and C are in their intervals of 95 %. Usage:

    python benchmarks/bad_samples.py [--draws 60] [--seed 0] [--first 0] [--sound] [--diagnose]
"""

from __future__ import annotations

import numpy as np
import pandas as pd
import typer

import ventbench
from ventbench.mechanics import identify
from ventbench.mechanics.labels import LungMatch
from ventbench.recordings.breaths import Breaths
from ventbench.recordings.foreign import import_recording
from ventbench.recordings.foreign.tables import Table

KINDS = ("marks", "zeros", "spikes", "held", "rails", "repeated")

#: Steps of the simulation within a sample.
_FINE = 20

#: Least share of the intervals that must hold the truth.
COVERED = 0.92


def recording(rng: np.random.Generator) -> tuple[dict[str, np.ndarray], float, float, float]:
    """Time, s, pressure, cmH2O, and flow, L/min, with R, C and the rate, Hz."""
    R, C = rng.uniform(8.0, 40.0), rng.uniform(15.0, 70.0)
    rate = float(rng.choice([50.0, 100.0, 125.0]))
    period, inside = rng.uniform(2.5, 4.0), rng.uniform(0.8, 1.2)
    peep, above, constant = rng.uniform(4.0, 9.0), rng.uniform(10.0, 20.0), rng.uniform() < 0.5
    rise = rng.uniform(0.02, 0.05)
    time = np.arange(0.0, 20.0 * period, 1.0 / rate / _FINE)
    phase, r, e, dt = time % period, R / 1000.0, 1.0 / C, time[1]
    flow, pressure = (np.zeros(len(time)) for _ in range(2))
    wanted = above * C / (inside * (1.0 + R * C / 1000.0 / inside))  # mL/s that reaches about above
    p, q, v = peep, 0.0, 0.0
    for k, now in enumerate(phase.tolist()):
        if now < inside and constant:
            q += (wanted - q) * dt / rise
            p = peep + r * q + e * v
        else:
            p += (peep + (above if now < inside else 0.0) - p) * dt / rise
            q = (p - peep - e * v) / r
        pressure[k], flow[k] = p, q
        v += q * dt
    at = slice(int(rng.integers(_FINE)), None, _FINE)
    noise = rng.normal(size=(2, len(time[at])))
    columns = {
        "time": np.round(time[at] - time[at][0], 4),
        "pressure": np.round(pressure[at] + rng.uniform(0.05, 0.15) * noise[0], 3),
        "flow": np.round(0.06 * (flow[at] + rng.uniform(2.0, 5.0) * noise[1]), 3),
    }
    return columns, R, C, rate


def spoiled(
    columns: dict[str, np.ndarray], kind: str, share: float, rng: np.random.Generator
) -> dict[str, np.ndarray]:
    """The recording with a share of bad samples; repeated rows have no clock."""
    columns = {name: values.copy() for name, values in columns.items()}
    rows = len(columns["time"])
    count = max(1, round(share * rows))
    name = str(rng.choice(["pressure", "flow"]))
    values = columns[name]
    at = rng.choice(np.arange(5, rows - 5), count, replace=False)
    if kind == "marks":
        values[at] = rng.choice([-99.0, 99.99, -1000.0, -1e30, 32767.0])
    elif kind == "zeros":
        values[at] = 0.0
    elif kind == "spikes":
        values[at] += rng.choice([-1.0, 1.0], count) * rng.uniform(0.2, 3.0, count) * np.ptp(values)
    elif kind == "held":
        length = int(rng.integers(3, 8))
        for start in rng.choice(np.arange(5, rows - 20), max(1, count // length), replace=False):
            for both in (columns["pressure"], columns["flow"]):
                both[start + 1 : start + 1 + length] = both[start]
    elif kind == "rails":
        ends = np.quantile(values, [0.0, 1.0]) + np.array([-0.3, 0.3]) * np.ptp(values)
        values[at] = rng.choice(ends)
    else:
        order = np.sort(np.concatenate([np.arange(rows), at]))
        columns = {name: values[order] for name, values in columns.items()}
        del columns["time"]
    return columns


def _lung(breaths: Breaths, whole: bool) -> tuple[LungMatch, tuple[str, ...]]:
    """The lung, and the effects that are told beside it."""
    if whole:
        answer = ventbench.diagnose(breaths)
        effects = [mechanism.name for mechanism in answer.mechanisms]
        wrong = answer.verdict != "nothing_missing" and not effects
        return answer.lungs[0], (*effects, *((answer.verdict,) if wrong else ()))
    (lung,) = identify(breaths)
    return lung.match, tuple(term.name for term in lung.terms)


def main(
    draws: int = 60, seed: int = 0, first: int = 0, sound: bool = False, diagnose: bool = False
) -> None:
    """Whether bad samples make physics: sound recordings with 0.1 to 3 % of six kinds of them.

    --sound: spoil nothing. --diagnose: diagnose, which takes about 15 processor seconds a draw.
    """
    rows = []
    for draw in range(first, first + draws):
        rng = np.random.default_rng([seed, draw])
        kind = KINDS[draw % len(KINDS)]
        columns, R, C, rate = recording(rng)
        share = float(np.exp(rng.uniform(np.log(0.001), np.log(0.03))))
        if not sound:
            columns = spoiled(columns, kind, share, rng)
        table = Table("the table", columns, {"flow": "L/min"})
        imported = import_recording(
            table, lung=f"R{R:.3g}C{C:.3g}", rate=None if "time" in columns else rate
        )
        lung, names = _lung(imported.breaths, diagnose)
        ends = ((R, lung.ci95_R), (C, lung.ci95_C))
        held = [low <= truth <= high for truth, (low, high) in ends]
        rows.append((kind, bool(names), np.mean(held)))
        if names or not all(held):
            found = [f"{low:.4g} to {high:.4g} for {truth:.4g}" for truth, (low, high) in ends]
            print(f"{draw:3d} {kind:9s} {100 * share:.2f} %:", *found, *names, flush=True)
    table = pd.DataFrame(rows, columns=["kind", "false effects", "intervals that hold"])
    by_kind = table.groupby("kind", sort=False)
    print(by_kind.agg({"false effects": "sum", "intervals that hold": "mean"}).round(3))
    false = sum(wrong for _, wrong, _ in rows)
    held = float(np.mean([share for _, _, share in rows]))
    good = held >= COVERED and not false
    print(
        f"{draws} recordings: {false} with a false effect, {held:.3f} of the "
        f"intervals hold (none, and {COVERED:g} at least: {'yes' if good else 'NO'})"
    )
    raise typer.Exit(not good)


if __name__ == "__main__":
    typer.run(main)
