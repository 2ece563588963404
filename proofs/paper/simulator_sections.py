"""Sections of the paper's page on simulators: errors, horizon, networks, exploration."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from proofs.paper import published
from proofs.paper.report import Cell, Chart, Section, Table, Verdict, bars, below, every
from ventbench.base import compilation, files
from ventbench.base.arrays import Floats
from ventbench.plants import frozen
from ventbench.plants.single_compartment import single_compartment
from ventbench.plants.stacking import nominal_plants, open_loop_breaths, take
from ventbench.plants.two_balloon import two_balloon
from ventbench.recordings import load
from ventbench.task.lungs import LUNG_IDS
from ventbench.task.metrics import open_loop
from ventbench.train.exploration import RANGES, SimulatedVentilator, explore

AnyFloats = NDArray[np.floating]

#: Kinds of simulators whose error is measured.
KINDS = ("hybrid", "network", "single_compartment", "two_balloon")

#: The lung of the paper's figure of exploration.
SHOWN = "R5C50"

#: Steps after the start at which errors by horizon are tabulated.
HORIZONS = (1, 3, 5, 10, 15, 20, 25, 28)

#: Error at the end of the horizon over its mean, up to which it is said not to grow.
GROWTH = 1.5

#: Breaths of the exploration, and how often they are resampled.
BREATHS, RESAMPLES = 64, 400

_MEANS = ("mae", "median_mae")


def measure_horizon(recording: Path, stored: Mapping[str, Any]) -> dict[str, Any]:
    """Open-loop errors of every kind of simulator on measured breaths, by horizon, as JSON values.

    Hybrids are judged by the member of their ensemble that has not seen the breath; the physics
    knows no more than the label.

    Args:
        recording: file of measured breaths in the public schema.
        stored: an earlier result, whose errors of the paper's networks stay: they are not among the
            simulators.

    Raises:
        InputError: if it is missing or malformed.
    """
    breaths = load(recording)
    breaths = breaths.select(np.flatnonzero(np.isin(breaths.lung_ids, LUNG_IDS)))
    official = frozen.load()
    judged = {
        "hybrid": official.cross_fitted,
        "single_compartment": partial(nominal_plants, single_compartment),
        "two_balloon": partial(nominal_plants, two_balloon),
    }
    lungs: dict[str, Any] = {
        name: {"breaths": len(index), "network": stored["lungs"][name]["network"]}
        for name, index in breaths.by_lung_index.items()
    }
    for kind, plants_for in judged.items():
        simulated = np.nan_to_num(open_loop_breaths(plants_for, breaths))
        for name, index in breaths.by_lung_index.items():
            pair = (breaths.pressure[index], simulated[index], breaths.inspiratory[index])
            curve = open_loop.by_horizon(*pair)
            lungs[name][kind] = {
                "mae": round(float(np.nanmean(open_loop.mae(*pair))), 4),
                "median_mae": round(float(np.nanmedian(open_loop.mae(*pair))), 4),
                "distance": round(float(np.nanmean(open_loop.distance(*pair))), 3),
                "by_step": [round(x, 4) for x in curve[np.isfinite(curve)].tolist()],
            }
    return {
        "about": {
            "recording": files.sha256(recording),
            "simulators": official.manifest_sha256,
            "command": "python -m proofs paper --recordings DIR",
        },
        "step_s": round(float(np.median(breaths.dt[breaths.valid])), 4),
        "lungs": {name: lungs[name] for name in LUNG_IDS if name in lungs},
    }


def simulators(official: frozen.Frozen, horizon: Mapping[str, Any]) -> Section:
    """Open-loop errors of the simulators beside the paper's (its table 3)."""
    rows: list[tuple[Cell, ...]] = []
    below = 0
    for name, about in official.lungs().items():
        own = "own_rig" if "own_rig_mae" in about else "held_out"
        here = [about.get(f"{kind}_{x}") for kind in (own, "unseen_rig") for x in _MEANS]
        others = [horizon["lungs"][name][kind]["mae"] for kind in KINDS if kind != "hybrid"]
        rows.append((name, published.OPEN_LOOP[name], *here, *others))
        below += about[f"{own}_median_mae"] <= published.OPEN_LOOP[name]
    numbers = np.array([row[1:] for row in rows], float)
    paper, hybrid, network, rc, balloons = numbers.mean(axis=0)[[0, 1, 5, 6, 7]].tolist()
    physics = min(rc, balloons)
    finding = (
        f"By median {below} of 6 lungs are at or below the paper's error; the mean over lungs is "
        f"{hybrid:.2f} (paper {paper:.2f}) cmH2O for the hybrid and {network:.2f} for a network of "
        f"the paper's kind. Physics from labels alone has {physics:.2f}: {physics / network:.1f} "
        f"times the network's, {physics / hybrid:.1f} times the hybrid's, not an order of "
        "magnitude; and the hybrid, physics with learned curves, beats the pure network."
    )
    columns = (
        "lung",
        "paper, mean",
        "hybrid, own rig, mean",
        "median",
        "unseen rig, mean",
        "median",
        "network",
        "R-C lung",
        "two balloons",
    )
    table = Table(
        "Open-loop mean absolute error on held-out breaths, cmH2O", columns, tuple(rows), 2
    )
    return Section(
        "simulators",
        "Errors of the simulators",
        "table 3, conclusion 1",
        "Networks model ventilator and lung far better than physics-based models.",
        "in part" if network < physics else "differs",
        finding,
        "held-out errors of the official simulators; the others from recordings, stored",
        (table,),
        (bars(table, "error, cmH2O", (columns[1], columns[2], *columns[6:])),),
    )


def by_horizon(horizon: Mapping[str, Any]) -> Section:
    """Error after so many steps without feedback (the paper's figure 5 and table 5)."""
    lungs = horizon["lungs"]
    rows: list[tuple[Cell, ...]] = []
    for name, about in lungs.items():
        curve = about["hybrid"]["by_step"]
        at = [curve[k - 1] if k <= len(curve) else None for k in HORIZONS]
        rows.append((name, about["hybrid"]["distance"], *at))
    steps = {
        name: (list(range(1, len(about["hybrid"]["by_step"]) + 1)), about["hybrid"]["by_step"])
        for name, about in lungs.items()
    }
    growth = {
        name: about["hybrid"]["by_step"][HORIZONS[-1] - 1] / np.mean(about["hybrid"]["by_step"])
        for name, about in lungs.items()
    }
    flat = [name for name, value in growth.items() if value <= GROWTH]
    verdict: Verdict = "agrees" if len(flat) == len(lungs) else "in part" if flat else "differs"
    return Section(
        "horizon",
        "Error by horizon",
        "figure 5, table 5",
        "The error stays low as more steps are projected.",
        verdict,
        f"At step {HORIZONS[-1]} the error is at most {GROWTH:g} times its mean over the horizon "
        f"on {len(flat)} of {len(lungs)} lungs (largest ratio {max(growth.values()):.2f}).",
        "held-out measured breaths, stored; `--recordings DIR` measures again",
        (
            Table(
                "Hybrid: open-loop distance (sum over steps) and error after n steps, cmH2O",
                ("lung", "distance", *(f"step {k}" for k in HORIZONS)),
                tuple(rows),
                2,
            ),
        ),
        (Chart("Hybrid, held-out breaths", "steps without feedback", "error, cmH2O", steps),),
    )


def architectures(networks: Mapping[str, Any]) -> Section:
    """The paper's search over network shapes (its table 4)."""
    base, rows = networks["base"], []
    variants = {row["variant"]: row for row in networks["variants"]}
    clear = [
        name
        for name, row in variants.items()
        if row.get("low95") is not None and (row["low95"] > 0 or row["high95"] < 0)
    ]
    larger = [
        name for name in variants if name != "base" and int(name.split()[1]) > base[name.split()[0]]
    ]
    gained = [name for name in larger if name in clear and variants[name]["high95"] < 0]
    for setting, values in published.ARCHITECTURES.items():
        ours = {int(base[setting]): variants["base"]}
        ours |= {
            int(name.split()[1]): row
            for name, row in variants.items()
            if name.split()[0] == setting
        }
        for value in sorted({*values, *ours}):
            row = ours.get(value)
            figures = [row[key] if row else None for key in ("R5C10", "mean", "low95", "high95")]
            rows.append((f"{setting} {value}", values.get(value), *figures))
    table = Table(
        "Open-loop error on held-out breaths, cmH2O",
        (
            "setting",
            "paper, R5C10",
            "here, R5C10",
            "mean of six lungs",
            "change of it, 95 % from",
            "to",
        ),
        tuple(rows),
        2,
    )
    return Section(
        "architectures",
        "Shapes of the networks",
        "table 4",
        "More expressive networks gain a little, and the gains plateau quickly.",
        "agrees" if len(gained) > len(larger) / 2 else "in part" if gained else "differs",
        f"{len(gained)} of {len(larger)} larger shapes gain, by a paired 95 % interval without "
        f"zero: {', '.join(gained) or 'none'}. Of {len(variants) - 1} changes {len(clear)} have "
        f"one: {', '.join(clear) or 'none'}.",
        f"`{networks['about']['command']}`, stored; one setting changed at a time from "
        + ", ".join(f"{name} {value}" for name, value in base.items()),
        (table,),
        (bars(table, "error, cmH2O", table.columns[1:4]),),
    )


def boundary(networks: Mapping[str, Any]) -> Section:
    """Models of their own for the first steps of a breath (the paper's section 4.2)."""
    row = next(row for row in networks["variants"] if row["variant"] == "N_B 0")
    return Section(
        "boundary",
        "Boundary models",
        "section 4.2",
        "Models of their own for the beginning of a breath are very helpful.",
        "agrees" if row["low95"] > 0 else "in part" if row["change"] > 0 else "differs",
        f"Without them the error changes by {row['change']:+.2f} cmH2O (95 % from "
        f"{row['low95']:+.2f} to {row['high95']:+.2f}).",
        f"`{networks['about']['command']}`, stored",
    )


def exploration(official: frozen.Frozen) -> Section:
    """Exploratory breaths on a simulator (the paper's figure 6 and table 1)."""
    index = LUNG_IDS.index(SHOWN)
    with compilation.float32():
        plant = jax.tree.map(
            lambda leaf: jnp.asarray(leaf, jnp.float32), take(official.plants, index)
        )
        breaths = explore(SimulatedVentilator(plant, BREATHS, noise=0.2), SHOWN, BREATHS, seed=0)
    inspired = np.where(breaths.inspiratory, 1.0, np.nan)
    u_in, pressure = breaths.u_in * inspired, breaths.pressure * inspired

    common = int(np.min(np.count_nonzero(breaths.inspiratory, axis=1)))

    def spread(values: Floats) -> float:
        low, high = np.quantile(values[:, 2:common], (0.05, 0.95), axis=0)
        return float(np.mean(high - low))

    wide, narrow, peak = spread(u_in), spread(pressure), float(np.nanmax(pressure))
    most = float(np.nanmax(u_in))
    # How much less of their range pressures take up than commands, over resampled breaths.
    random = np.random.default_rng(0)
    picked = random.integers(len(u_in), size=(RESAMPLES, len(u_in)))
    less = [spread(pressure[at]) / 60.0 - spread(u_in[at]) / 100.0 for at in picked]
    low, high = np.quantile(less, (0.025, 0.975)).tolist()
    ranges = RANGES[SHOWN]
    rows = (
        ("P, I, D", ", ".join(f"{gain:g}" for gain in ranges.gains)),
        ("boundary, added %", f"{ranges.boundary_u[0]:g} to {ranges.boundary_u[1]:g}"),
        ("triangle, added %", f"{ranges.triangular_u[0]:g} to {ranges.triangular_u[1]:g}"),
        ("share of boundary breaths", f"{ranges.boundary_share:g}"),
        ("command, spread between breaths (5 to 95 %), %", f"{wide:.1f}"),
        ("pressure, spread between breaths (5 to 95 %), cmH2O", f"{narrow:.1f}"),
        ("highest command, %; highest pressure, cmH2O", f"{most:.0f}; {peak:.1f}"),
    )
    safe: Verdict = "agrees" if peak <= 60.0 else "differs"
    return Section(
        "exploration",
        "Exploratory breaths",
        "figure 6, table 1",
        "Exploration covers a wide range of controls and stays in a limited, safe range of "
        "pressures.",
        every(safe, below((low, high))),
        f"Commands spread over {wide:.0f} of 100 % and pressures over {narrow:.1f} of 60 cmH2O "
        f"between breaths ({100 * low:+.0f} to {100 * high:+.0f} points of their ranges apart, "
        f"95 %); the highest pressure is {peak:.1f} cmH2O.",
        f"computed: {BREATHS} breaths of {SHOWN}, with the paper's ranges of that lung",
        (Table(f"Exploration of {SHOWN}", ("quantity", "value"), rows),),
        (
            Chart("Commands", "time, s", "inspiratory valve, %", _some(breaths.time, u_in)),
            Chart("Their pressures", "time, s", "pressure, cmH2O", _some(breaths.time, pressure)),
        ),
    )


def _some(time: Floats, values: Floats) -> dict[str, tuple[list[float], list[float | None]]]:
    """Curves of the first breaths; None outside of inspirations."""
    curves = {}
    for k in range(8):
        shown = np.isfinite(values[k])
        curves[f"breath {k + 1}"] = (time[k][shown].tolist(), values[k][shown].tolist())
    return curves
