"""The errors of a record by numpy alone: nothing of ventbench is imported.

It reads the files of a board and of the simulators as their documentation says, makes the draws of
the round from the value of its beacon, and runs the commands through the rigs.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import tomllib
import zlib
from pathlib import Path
from statistics import NormalDist
from typing import Any

import numpy as np

PIPS, DRAWS, BREATHS, STEPS, BREATH_STEPS = np.arange(10.0, 36.0, 5.0), 20, 3, 34, 100
VALVE = np.array([0, 1, 2, 3.5, 5, 7, 10, 14, 19, 26, 36, 50, 70, np.inf])
ELASTIC, PLAYS = np.array([10.0, 16, 22, 28, 36]), np.array([0.7, 3, 10])
#: Of the logarithm of the gain of the valve, at every twentieth.
GAINS = [-0.41, -0.294, -0.152, -0.093, -0.081, -0.046, -0.033, -0.02, -0.011, -0.001, 0.0, 0.001]
GAINS += [0.011, 0.021, 0.033, 0.039, 0.051, 0.081, 0.093, 0.122, 0.247]
RANGES = {"pip": (-1, 1), "peep": (-0.5, 0.5), "start": (-0.5, 0.5), "dt": (0.936, 1.064)}
LABELS = {"pip": "pip_shift", "peep": "peep_shift", "start": "start_shift", "dt": "dt_scale"}
LOGARITHMS = "valve_delay valve_lag circuit_compliance sensor_lag rising falling conductance"
LOGARITHMS += " closing_conductance opening_delay closing_delay closing_lag rest"


def uniforms(seed: bytes, label: str, *shape: int) -> Any:
    """Uniform numbers of a seed and a label."""
    text, size = b"ventbench uniforms 1\n" + label.encode(), int(np.prod(shape))
    blocks = [
        hmac.digest(seed, text + k.to_bytes(8, "big"), "sha256") for k in range((size + 3) // 4)
    ]
    words = np.frombuffer(b"".join(blocks), ">u8")[:size] >> 12
    return ((words.astype(float) + 0.5) / 2**52).reshape(shape)


def dealt(numbers: Any, choices: int) -> Any:
    """Choices, equally often up to one, in random order."""
    order = np.argsort(np.argsort(numbers[1:], kind="stable"), kind="stable")
    return (order + int(numbers[0] * choices)) % choices


def population(seed: bytes, lung: int, mean: Any, factor: Any) -> dict[str, Any]:
    """Rigs of a lung that are drawn anew, leaves ``(DRAWS, ...)``."""
    numbers = uniforms(seed, f"population 1, lung {lung}", DRAWS, len(mean))
    normal = np.round(np.vectorize(NormalDist().inv_cdf)(numbers), 4)
    x = mean + (factor @ normal[..., None])[..., 0]
    slope = np.exp(np.cumsum(x[:, 4:9], axis=1))
    shape = np.exp(np.cumsum(np.column_stack([np.zeros(DRAWS), x[:, 10:22]]), axis=1))
    widths = np.clip(20.0 - VALVE[:-1], 0.0, np.diff(VALVE))
    odds, laminar = np.exp(x[:, 22:25]), np.exp(x[:, 0]) / (1.0 + np.exp(x[:, 1]))
    rig = {
        "R": laminar,
        "K2": laminar * np.exp(x[:, 1]) / 0.5,
        "E": np.exp(x[:, 2]),
        "stiffening": np.diff(slope, axis=1, prepend=1.0),
        "offset": x[:, 3],
        "slopes": shape * (np.exp(x[:, 9]) / (shape * widths).sum(axis=1))[:, None],
        "direction": -0.98 * odds / (1.0 + odds.sum(axis=1, keepdims=True)),
    }
    rig |= {name: np.exp(x[:, 25 + k]) for k, name in enumerate(LOGARITHMS.split())}
    return {name: np.vectorize(lambda v: float(f"{v:.6g}"))(value) for name, value in rig.items()}


def cells_of(simulators: Path, own: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Rigs, leaves ``(6, 1 + DRAWS, ...)``, and cells, ``(6, 1 + DRAWS, PIPs)``, of a round."""
    manifest, roles = (
        tomllib.loads((simulators / f"{name}.toml").read_text())
        for name in ("manifest", "population")
    )
    lungs = list(manifest["lungs"])
    members = dict(np.load(simulators / "hybrid.npz"))
    del members["structure"]
    randomness = bytes.fromhex(json.loads((own / "beacon.json").read_bytes())["randomness"])
    frozen = hashlib.sha256((own / "frozen.toml").read_bytes()).digest()
    seed = hmac.digest(randomness, b"ventbench round 1\n" + frozen, "sha256")
    drawn = np.load(simulators / "population.npz")
    shape = (len(lungs), DRAWS, len(PIPS))
    rigs: list[dict[str, Any]] = []
    for k, lung in enumerate(lungs):
        scored, held = manifest["lungs"][lung]["rigs"], roles["lungs"][lung]["held_out_rigs"]
        kind = np.resize(["drawn", "held", "drawn", "training"], DRAWS)
        numbers, turns = (
            uniforms(seed, f"draws 2, rig {k}", DRAWS + 1),
            dealt(uniforms(seed, f"draws 2, member {k}", DRAWS + 1), len(members["R"])),
        )
        session, member = np.full(DRAWS, scored[0]), np.where(kind == "drawn", 0, turns)
        for name, choices in (("held", held), ("training", [x for x in scored if x not in held])):
            at = np.flatnonzero(kind == name)
            session[at] = np.array(choices)[dealt(numbers[[0, *(1 + at)]], len(choices))]
        anew = population(seed, k, drawn["mean"][k], drawn["factor"][k])
        rig = {}
        for name, leaf in members.items():
            leaf_of = leaf[member, session]
            leaf_of[kind == "drawn"] = anew[name][kind == "drawn"]
            rig[name] = np.concatenate([leaf[:1, scored[0]], leaf_of])
        rigs.append(rig)
    cell = {
        name: np.round(low + (high - low) * uniforms(seed, f"draws 2, {LABELS[name]}", *shape), 4)
        for name, (low, high) in RANGES.items()
    }
    numbers = uniforms(seed, "draws 2, gain", *shape, BREATHS)
    cell["gain"] = np.round(np.exp(np.interp(numbers, np.linspace(0, 1, len(GAINS)), GAINS)), 4)
    nominal = {"pip": 0.0, "peep": 0.0, "start": 0.0, "dt": 1.0, "gain": 1.0}
    cell = {
        name: np.concatenate([np.full_like(x[:, :1], nominal[name]), x], axis=1)
        for name, x in cell.items()
    }
    cell["pip"] = PIPS + cell["pip"]
    cell["peep"] = 5.0 + cell["peep"]
    cell["start"] = cell["peep"] + cell["start"]
    cell["dt"] = 0.03 * cell["dt"]
    return {name: np.stack([rig[name] for rig in rigs]) for name in members}, cell


def commands_of(records: Path, about: dict[str, Any]) -> Any:
    """Commands of a file, %."""
    planes = np.frombuffer(
        zlib.decompress((records / f"{about['sha256']}.actions").read_bytes()), np.uint8
    )
    moves = planes.reshape(4, -1).T.copy().view("<i4").ravel()
    return np.cumsum(moves, dtype="i8").reshape(about["shape"]) / 1000


def errors(rig: dict[str, Any], cell: dict[str, Any], commands: Any) -> Any:
    """Mean |pressure - PIP| over inspirations of breaths 2 and 3, of flat cells ``(n, ...)``."""
    scored = [inspiration(rig, cell, commands[:, k], cell["gain"][:, k]) for k in range(BREATHS)]
    return np.mean([np.abs(x - cell["pip"][:, None]) for x in scored[1:]], axis=(0, 2))


def inspiration(rig: dict[str, Any], cell: dict[str, Any], commands: Any, gain: Any) -> Any:
    """Airway pressure at each step of an inspiration, cmH2O, ``(n, STEPS)``."""
    slopes = rig["slopes"] * gain[:, None]

    def valve(u: Any) -> Any:
        return (slopes * np.clip(u[:, None] - VALVE[:-1], 0.0, np.diff(VALVE))).sum(axis=1)

    def recoil(x: Any) -> Any:
        above = x[:, None] - ELASTIC
        return (
            x + (rig["stiffening"] * np.maximum(above, 0)).sum(axis=1),
            1 + (rig["stiffening"] * (above > 0)).sum(axis=1),
        )

    n, h = len(gain), cell["dt"] / 4
    rest = valve(rig["rest"])
    # Everything that was commanded before the breath, the expiratory valve open; the latest first.
    flows, opened, past = [rest] * 8, [np.ones(n)] * 8, [np.full(n, 0.03)] * 6
    plays = np.repeat(rig["rest"][:, None], 3, axis=1)
    elastic, drop, flow = cell["start"] + rig["offset"], -rig["offset"], rest
    behind = cell["peep"] - rest / rig["closing_conductance"]
    outlet, shown = np.ones(n), [cell["start"]]
    for u in commands.T[: STEPS - 1]:
        plays = np.clip(plays, (u[:, None] - PLAYS), (u[:, None] + PLAYS))
        effective = u + (rig["direction"] * (plays - u[:, None])).sum(axis=1)
        flows = [valve(np.maximum(effective, 0.0)), *flows[:7]]
        opened = [np.zeros(n), *opened[:7]]
        for k in range(4):
            wanted = delayed(flows, past, rig["valve_delay"], h, k)
            wide = delayed(opened, past, rig["closing_delay"], h, k)
            lag = np.exp(-h / rig["valve_lag"])
            inflow = wanted + (flow - wanted) * rig["valve_lag"] / h * (1 - lag)
            flow = wanted + (flow - wanted) * lag
            outlet = np.maximum(wide, outlet * np.exp(-h / rig["closing_lag"]))
            out = rig["closing_conductance"] * outlet
            held, slope = recoil(elastic)
            turbulent = 4 * rig["K2"] * (np.abs(drop) + 1e-6)
            resistance = 0.5 * (rig["R"] + np.sqrt(rig["R"] ** 2 + turbulent))
            soft = rig["circuit_compliance"]
            rate = (1 / soft + rig["E"] * slope) / resistance + out / soft
            goal = (inflow - out * (held - behind)) / soft / rate
            decay = np.exp(-rate * h)
            mean = goal + (drop - goal) * (1 - decay) / (rate * h)
            elastic = elastic + rig["E"] * mean / resistance * h
            pressure = recoil(elastic)[0] + goal + (drop - goal) * decay
            excess = np.maximum(pressure - 60.0, 0.0)
            pressure = pressure - excess + 10.0 * (1 - np.exp(-excess / 10.0))
            drop = pressure - recoil(elastic)[0]
        past = [cell["dt"], *past[:5]]
        shown.append(recoil(elastic)[0] + drop)
    return np.stack(shown, axis=1)


def delayed(held: list[Any], past: list[Any], delay: Any, h: Any, k: int) -> Any:
    """Mean of a delayed command over substep k of a sample."""
    mean, begin = held[0], delay
    for j in range(7):
        mean = mean + (held[j + 1] - held[j]) * np.clip(begin / h - k, 0, 1)
        begin = begin - past[j] if j < 6 else begin
    return mean
