"""Why simulators err on breaths of their own rigs: a table of docs/simulators.md.

Every measured breath of a scored rig is simulated by the member that has not seen it. Then one
quantity of that breath alone is fitted to its pressure, which no prediction can do: what remains
says what the error is made of. ``--fits`` fits the rigs anew in other ways and holds out the same
folds; ``--unseen`` does the first for breaths of rigs that a fit has not seen.

Usage:

    python benchmarks/own_rig_error.py [--recordings DIR] [--fits | --unseen]
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import typer
from scipy.special import ndtri

from proofs.paper.published import OPEN_LOOP
from ventbench.base import compilation
from ventbench.base.arrays import Bools, Floats, Ints
from ventbench.plants import frozen
from ventbench.plants.hybrid import Hybrid
from ventbench.recordings import Breaths, recordings_dir
from ventbench.task.lungs import LUNG_IDS
from ventbench.task.metrics.open_loop import WIDE_OPEN
from ventbench.train.rigs.data import (
    InspirationData,
    RigRecordings,
    groups_of,
    inspirations,
    load_rig_recordings,
)
from ventbench.train.rigs.fit import FitConfig, Noise, Scales, centre, fit, plants, simulate
from ventbench.train.rigs.train import UNRECORDED_SLOPE

#: What is fitted to single breaths, and the deviations tried: logarithms; s; cmH2O.
GRIDS = {
    "gain": np.linspace(-0.4, 0.4, 41),
    "R": np.linspace(-0.6, 0.6, 41),
    "C": np.linspace(-0.4, 0.4, 41),
    "delay": np.linspace(-0.02, 0.03, 26),
    "start": np.linspace(-1.5, 1.5, 31),
}

#: Rounds over all grids in which all quantities are fitted together.
ROUNDS = 3

#: Breaths with a larger error are listed, cmH2O.
LISTED = 1.5

#: Commands of two breaths are the same if they differ by less on average, %.
SAME_COMMANDS = 1.0

#: Samples that two breaths must have in common to be compared.
LEAST = 10

#: Weights of reconstructed breaths and of breaths of lungs that are not scored, as in the fit.
RECONSTRUCTED, UNLISTED = 0.4, 0.2

#: Other fits: what they change.
VARIANTS: dict[str, dict[str, Any]] = {
    "as frozen": {},
    "breath's gain 0.06 wide, not 0.02": {"noise": Noise(gain=0.06)},
    "plain absolute error": {"noise": Noise(saturation=1e3)},
    "rigs twice as free": {
        "scales": Scales(
            rig_gain=0.1, rig_resistance=0.2, rig_quadratic=0.3, rig_elastance=0.12, rig_offset=0.6
        )
    },
    "rigs half as free": {
        "scales": Scales(
            rig_gain=0.025,
            rig_resistance=0.05,
            rig_quadratic=0.075,
            rig_elastance=0.03,
            rig_offset=0.15,
        )
    },
    "half of the measured breaths": {"share": 0.5},
    "measured breaths only": {"reconstructed": 0.0},
}


@dataclasses.dataclass(frozen=True)
class Judged:
    """Measured breaths of the scored rigs, n of them, and the errors of the frozen simulators."""

    data: InspirationData
    lung: Ints
    session: Ints
    breath: Ints
    member: Ints


def breath_error(plant: Hybrid, data: InspirationData, deviation: dict[str, Any]) -> Floats:
    """Mean absolute error of each breath with deviations of its own, cmH2O, ``(n,)``."""
    zero = np.zeros(data.start.shape)
    return np.asarray(_error(plant, data, {name: deviation.get(name, zero) for name in GRIDS}))


@jax.jit
def _error(plant: Any, data: InspirationData, deviation: dict[str, Any]) -> Any:
    gain = jnp.exp(deviation["gain"])
    resistance = jnp.exp(deviation["R"])
    plant = plant.replace(
        slopes=plant.slopes * gain[:, None],
        R=plant.R * resistance,
        K2=plant.K2 * resistance,
        E=plant.E / jnp.exp(deviation["C"]),
        valve_delay=jnp.maximum(plant.valve_delay + deviation["delay"], 0.0),
    )
    simulated = simulate(plant, data.start + deviation["start"], data)
    return jnp.sum(data.share * jnp.abs(simulated - data.pressure), axis=1)


def best(
    plant: Hybrid, data: InspirationData, names: tuple[str, ...], group: Ints
) -> tuple[Floats, dict[str, Floats]]:
    """Fit some quantities to every group of breaths by itself; returns errors and deviations."""
    at = {name: np.zeros(len(group)) for name in names}
    error = breath_error(plant, data, at)
    for _ in range(ROUNDS if len(names) > 1 else 1):
        for name in names:
            before = at
            for value in GRIDS[name]:
                tried = breath_error(plant, data, before | {name: np.full(len(group), value)})
                gained = np.bincount(group, error - tried)[group] > 0
                error = np.where(gained, tried, error)
                at = at | {name: np.where(gained, value, at[name])}
    return error, at


def without_spread(plant: Hybrid, chosen: Judged, simulators: frozen.Frozen) -> Hybrid:
    """Plants as they were fitted, before the members were spread where the valve is wide open."""
    folds = simulators.manifest["split"]["folds"]
    rank = np.maximum(chosen.member - 1, 0)
    shift = np.where(chosen.member > 0, UNRECORDED_SLOPE * ndtri((rank + 0.5) / folds), 0.0)
    last = jnp.asarray(plant.slopes)[:, -1] * jnp.exp(-shift)
    return plant.replace(slopes=jnp.asarray(plant.slopes).at[:, -1].set(last))  # type: ignore[attr-defined]


def judged(recordings: RigRecordings, simulators: frozen.Frozen) -> Judged:
    """Choose the measured breaths of scored rigs."""
    breaths = recordings.measured_breaths
    session = simulators.sessions.assign(breaths)
    lung = np.full(len(breaths), -1)
    for number, own in enumerate(simulators.rigs):
        lung[np.isin(session, own)] = number
    chosen = np.flatnonzero(lung >= 0)
    breaths = breaths.select(chosen)
    data = inspirations(breaths, simulators.sessions, recordings.labels)
    member = np.maximum(simulators.training_breaths.folds(breaths), 0)
    return Judged(data, lung[chosen], session[chosen], chosen, member)


def row(name: str, error: Floats, lung: Ints) -> str:
    """One row of a Markdown table: mean / median by lung, and over all breaths."""
    cells = [f"{error[lung == k].mean():.2f} / {np.median(error[lung == k]):.2f}" for k in range(6)]
    return f"| {name} | {' | '.join(cells)} | {error.mean():.2f} / {np.median(error):.2f} |"


def goals(error: Floats, lung: Ints) -> str:
    """On how many lungs the median and the mean are at or below the paper's figure."""
    at = [error[lung == k] for k in range(6)]
    pairs = list(zip(at, OPEN_LOOP.values(), strict=True))
    median = sum(np.median(own) <= paper for own, paper in pairs)
    mean = sum(own.mean() <= paper for own, paper in pairs)
    return f"median {median} of 6, mean {mean} of 6"


def rows(plant: Hybrid, chosen: Judged, write: Callable[..., None]) -> None:
    """Rows of what is left when rigs, or breaths, have quantities of their own."""
    for what, group in (("rig", chosen.session), ("breath", np.arange(len(chosen.lung)))):
        for names in (*((name,) for name in GRIDS), tuple(GRIDS)):
            error, _ = best(plant, chosen.data, names, group)
            name = names[0] if len(names) == 1 else "all five"
            write(row(f"own {name} a {what}", error, chosen.lung))


def same_commands(recordings: RigRecordings, simulators: frozen.Frozen) -> Floats:
    """Breaths of one scored rig with the same commands: how far are their pressures apart?

    What the remaining differences of commands, times and known first pressures do, by the scored
    simulators, is taken off; a first pressure that is unknown may be any. No simulator that knows
    the commands and the rig can err by less than half of it on average over the two breaths.

    Returns:
        Mean absolute difference of each pair, cmH2O.
    """
    breaths = recordings.breaths
    session = simulators.sessions.assign(breaths)
    data = inspirations(breaths, simulators.sessions, recordings.labels)
    known = np.asarray(data.start_measured) > 0
    data = data.replace(start=jnp.where(known, data.start, Noise().unknown_start))  # type: ignore[attr-defined]
    at = (np.zeros_like(session), session)
    plant = jax.tree.map(lambda leaf: jnp.asarray(leaf[at], float), simulators.members)
    run = jax.jit(simulate)
    # Simulated minus recorded, by deviation of the start: the middle one is none.
    error = np.array([np.asarray(run(plant, data.start + d, data)) for d in GRIDS["start"]])
    error = error - np.asarray(data.pressure)
    counted, u_in = np.asarray(data.share) > 0, np.asarray(data.u_in)
    none, apart = len(GRIDS["start"]) // 2, []
    for own in (rig for rigs in simulators.rigs for rig in rigs):
        index = np.flatnonzero(session == own)
        for place, i in enumerate(index):
            for j in index[place + 1 :]:
                both = counted[i] & counted[j]
                if np.sum(both) < LEAST or np.mean(np.abs(u_in[i] - u_in[j])) > SAME_COMMANDS:
                    continue
                starts = slice(none, none + 1) if known[i] and known[j] else slice(None)
                difference = np.abs(error[starts, i] - error[none, j])[:, both].mean(axis=1)
                apart.append(difference.min())
    return np.array(apart)


def variant_errors(
    recordings: RigRecordings, simulators: frozen.Frozen, chosen: Judged, change: dict[str, Any]
) -> Floats:
    """Errors of the chosen breaths by fits of another kind that have not seen them."""
    table = simulators.sessions
    noise, scales = change.get("noise", Noise()), change.get("scales", Scales())
    measured = recordings.measured
    whole = inspirations(recordings.breaths, table, recordings.labels)
    around = centre(recordings.labels, len(table))
    weight = np.where(
        np.arange(len(recordings.breaths)) < measured,
        1.0,
        change.get("reconstructed", RECONSTRUCTED),
    )
    listed = np.isin(recordings.breaths.lung_ids, LUNG_IDS)
    weight = weight * np.where(listed, 1.0, UNLISTED)
    error = np.zeros(len(chosen.lung))
    rng = np.random.default_rng(0)
    for fold in range(5):
        own = weight.copy()
        own[:measured][recordings.fold == fold] = 0.0
        if "share" in change:
            own[:measured] *= rng.uniform(size=measured) < change["share"]
        fitted, _ = fit(whole, jnp.asarray(own, jnp.float32), around, scales, noise, FitConfig())
        groups = groups_of(_breaths(recordings, chosen), table, recordings.labels)
        plant = plants(fitted.pooled, groups)
        now = recordings.fold[chosen.breath] == fold
        error[now] = breath_error(plant, chosen.data, {})[now]
    return error


def unseen_plants(recordings: RigRecordings, simulators: frozen.Frozen, chosen: Judged) -> Hybrid:
    """Plants of the chosen breaths by fits that have not seen their rigs, nor those that failed."""
    table, labels = simulators.sessions, recordings.labels
    by_lung = {
        label.id: [k for k, about in enumerate(table.table) if about.lung == label.id]
        for label in labels
    }
    turns = max(len(by_lung[name]) for name in LUNG_IDS)
    whole = inspirations(recordings.breaths, table, labels)
    session = np.asarray(whole.groups.session)
    listed = np.isin(recordings.breaths.lung_ids, LUNG_IDS)
    weight = np.where(np.arange(len(session)) < recordings.measured, 1.0, RECONSTRUCTED)
    weight = weight * np.where(listed, 1.0, UNLISTED)
    around, out = centre(labels, len(table)), None
    for turn in range(turns):
        left = [k for own in by_lung.values() if len(own) > 1 for k in own[turn::turns]]
        own = np.where(np.isin(session, [*left, *simulators.rejected]), 0.0, weight)
        fitted, _ = fit(whole, jnp.asarray(own, jnp.float32), around, Scales(), Noise())
        plant = plants(fitted.pooled, groups_of(_breaths(recordings, chosen), table, labels))
        now = np.isin(chosen.session, left)
        out = plant if out is None else _chosen(now, plant, out)
    assert out is not None
    return out


def _chosen(now: Bools, plant: Hybrid, other: Hybrid) -> Hybrid:
    def choose(a: Any, b: Any) -> Any:
        return np.where(now.reshape(-1, *(1,) * (np.ndim(a) - 1)), a, b)

    return jax.tree.map(choose, plant, other)


def _breaths(recordings: RigRecordings, chosen: Judged) -> Breaths:
    return recordings.breaths.select(chosen.breath)


def report(recordings: RigRecordings, write: Callable[..., None] = print) -> None:
    """Print what the errors of the frozen simulators are made of."""
    simulators = frozen.load()
    chosen = judged(recordings, simulators)
    data, lung = chosen.data, chosen.lung

    def of_member(member: Any) -> Hybrid:
        at = (member, chosen.session)
        return jax.tree.map(lambda leaf: jnp.asarray(leaf[at], float), simulators.members)

    plant = of_member(chosen.member)
    held_out = breath_error(plant, data, {})
    write(f"| | {' | '.join(LUNG_IDS)} | all |")
    write("|---" * 8 + "|")
    write(f"| paper | {' | '.join(f'{value:.2f}' for value in OPEN_LOOP.values())} | |")
    write(row("held out", held_out, lung))
    narrow = breath_error(without_spread(plant, chosen, simulators), data, {})
    write(row(f"held out, without the spread above {WIDE_OPEN:g} %", narrow, lung))
    write(row("seen by the fit", breath_error(of_member(np.zeros_like(lung)), data, {}), lung))
    rows(plant, chosen, write)
    corrected, at = best(plant, data, ("gain",), np.arange(len(lung)))
    together, _ = best(plant, data, tuple(GRIDS), np.arange(len(lung)))
    gain = at["gain"]
    write(f"\nheld out: {goals(held_out, lung)}; own gain a breath: {goals(corrected, lung)}")
    rig = np.array([np.mean(gain[chosen.session == k]) for k in chosen.session])
    free = len(gain) - len(np.unique(chosen.session))
    spread = np.sqrt(np.sum((gain - rig) ** 2) / free)
    write(f"gain of a breath around the mean of its rig: standard deviation {spread:.3f};")
    tenth = breath_error(plant, data, {"gain": gain + 0.1}) - corrected
    each = (f"{LUNG_IDS[k]} {tenth[lung == k].mean():.2f}" for k in range(6))
    write(f"a gain that is wrong by 10 % costs, cmH2O: {', '.join(each)}")
    high = np.asarray((data.share > 0) * (data.u_in >= WIDE_OPEN)).sum(axis=1)
    write(f"\nbreaths above {LISTED} cmH2O: breath, lung, session, error, own gain, error with it,")
    write(f"largest command, samples at {WIDE_OPEN:g} % and above, all five fitted")
    for k in np.flatnonzero(held_out > LISTED):
        largest = float(np.max(np.asarray(data.u_in)[k]))
        write(
            f"  {chosen.breath[k] + 1} {LUNG_IDS[lung[k]]} {chosen.session[k]} {held_out[k]:.2f} "
            f"x {np.exp(gain[k]):.2f} {corrected[k]:.2f} {largest:.0f} {high[k]} {together[k]:.2f}"
        )
    kept = held_out <= LISTED
    write(row(f"held out, breaths up to {LISTED}", held_out[kept], lung[kept]))
    write(f"  {goals(held_out[kept], lung[kept])}; {np.sum(~kept)} breaths left out")
    pairs = same_commands(recordings, simulators)
    write(f"\n{len(pairs)} pairs of breaths of one rig with commands within {SAME_COMMANDS:g} %:")
    write(f"  pressures differ by {np.median(pairs):.2f} (median), {pairs.mean():.2f} (mean)")


def main(recordings: Path | None = None, fits: bool = False, unseen: bool = False) -> None:
    """Why simulators err on breaths of their own rigs: a table of docs/simulators.md.

    --fits: by fits of other kinds that have not seen the breath.
    --unseen: by fits that have not seen the rig.
    """
    folder = recordings or recordings_dir()
    if folder is None:
        print("no recordings: give --recordings DIR or set VENTBENCH_RECORDINGS")
        return
    compilation.keep()
    measured = load_rig_recordings(folder, folds=5, seed=0)
    simulators = frozen.load()
    if not fits and not unseen:
        with compilation.float64():
            report(measured)
        return
    with compilation.float32():
        chosen = judged(measured, simulators)
        if unseen:
            plant = unseen_plants(measured, simulators, chosen)
            error = breath_error(plant, chosen.data, {})
            print(row("unseen rig", error, chosen.lung))
            rows(plant, chosen, print)
            return
        for name, variant in VARIANTS.items():
            error = variant_errors(measured, simulators, chosen, variant)
            print(row(name, error, chosen.lung), goals(error, chosen.lung), flush=True)


if __name__ == "__main__":
    typer.run(main)
