"""Write the example recordings and their manifest; the same code gives the same bytes.

Usage: ``python data/examples/make.py [DIR]``

All breaths are simulated; none is from a real rig. The simulated rigs share no code with the
diagnosis.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from hardware_eval.emulation.cases import Base, Case, Effect
from proofs.challenge.first.rig import record
from ventbench.base import files
from ventbench.recordings import Breaths, make_breaths, write

#: Version of the examples; it changes with any byte of a recording.
VERSION = 1

#: Seeds of times, commands and noise.
SEEDS = {"concealed": 101, "sound": 102, "flow": 103}

#: Rig of the first two recordings: a valve that gives 4 % less than nominal, PEEP 5.2 cmH2O.
CONCEALED = Case(
    "concealed", 20.0, 50.0,
    (Effect("turbulent_resistance", "strong", "library", {"quadratic": 10.0}),),
    base=Base(R=21.0, C=48.0, R_ex=5.5, peep=5.2, gain=21.9),
    breaths=24, samples=80,
)  # fmt: skip
SOUND = Case(
    "sound", 5.0, 20.0, base=Base(R=5.2, C=19.4, R_ex=5.5, peep=5.2, gain=21.9), breaths=24,
    samples=80,
)  # fmt: skip

#: Lung of the recording with flow: its label is R20C20, but C is higher.
FLOW_R, FLOW_C, FLOW_PEEP = 20.0, 27.0, 5.0

#: Noise of the pressure and of the flow sensor, cmH2O and mL/s.
PRESSURE_NOISE, FLOW_NOISE = 0.1, 3.0


def with_flow(seed: int, breaths: int = 12, samples: int = 100) -> Breaths:
    """Simulate an R-C lung exactly: constant inflow, then outflow through 6 cmH2O/(L/s).

    Args:
        seed: seed of flows and noise.
        breaths: number of breaths.
        samples: samples of each breath, 30 ms apart.
    """
    rng = np.random.default_rng(seed)
    dt, inspiratory = 0.03, samples // 3
    time = np.tile(dt * np.arange(samples), (breaths, 1))
    u_in = np.round(rng.uniform(8.0, 20.0, (breaths, 1)), 2) * np.ones((breaths, samples))
    opened = np.arange(samples) >= inspiratory
    u_in[:, opened] = 0.0
    elastic = np.full(breaths, FLOW_PEEP)
    pressure, flow = np.empty((breaths, samples)), np.empty((breaths, samples))
    decay = np.exp(-dt / ((FLOW_R + 6.0) * FLOW_C / 1000.0))
    for k in range(samples):
        q = -(elastic - FLOW_PEEP) / (FLOW_R + 6.0) if opened[k] else 22.8 * u_in[:, k] / 1000.0
        pressure[:, k], flow[:, k] = elastic + FLOW_R * q, 1000.0 * q
        if opened[k]:
            elastic = FLOW_PEEP + (elastic - FLOW_PEEP) * decay
        else:
            elastic = elastic + q * dt / (FLOW_C / 1000.0)
    pressure += PRESSURE_NOISE * rng.standard_normal(pressure.shape)
    flow += FLOW_NOISE * rng.standard_normal(flow.shape)
    return make_breaths(
        np.arange(breaths) + 1, np.full(breaths, 20.0), np.full(breaths, 20.0), time, u_in,
        np.broadcast_to(opened, time.shape) * 1.0, np.round(pressure, 3), flow=np.round(flow, 1),
    )  # fmt: skip


def _case(case: Case) -> tuple[Breaths, dict[str, Any]]:
    assert case.base is not None
    base = case.base
    rig = {"R": base.R, "C": base.C, "R_ex": base.R_ex, "PEEP": base.peep, "gain": base.gain}
    effects = {effect.name: dict(effect.parameters) for effect in case.effects}
    seed = SEEDS[case.name]
    about = {"seed": seed, "label": case.lung, "noise": case.noise, "rig": rig, "effects": effects}
    return record(case, np.random.default_rng(seed)), about


def make(folder: Path) -> list[Path]:
    """Write the recordings and ``manifest.toml``.

    Args:
        folder: target folder.

    Returns:
        Paths of the files written.
    """
    concealed, about_concealed = _case(CONCEALED)
    sound, about_sound = _case(SOUND)
    seed = SEEDS["flow"]
    rig = {"R": FLOW_R, "C": FLOW_C, "R_ex": 6.0, "PEEP": FLOW_PEEP, "gain": 22.8}
    about_flow = {
        "seed": seed, "label": "R20C20", "noise": PRESSURE_NOISE, "flow_noise": FLOW_NOISE,
        "rig": rig, "effects": {},
    }  # fmt: skip
    examples = {
        "concealed.csv": (
            concealed,
            {"about": "An airway whose resistance rises with flow, which R-C lungs lack."}
            | about_concealed,
        ),
        "sound.csv": (sound, {"about": "An R-C lung: no physics is missing."} | about_sound),
        "flow.csv": (
            with_flow(seed),
            {"about": "Pressure and flow of a lung whose C is not that of its label."} | about_flow,
        ),
    }
    entries, written = {}, []
    for name, (breaths, about) in examples.items():
        write(breaths, folder / name)
        written.append(folder / name)
        entries[name] = about | {"breaths": len(breaths), "sha256": files.sha256(folder / name)}
    manifest = {
        "format": "ventbench-examples-1",
        "version": VERSION,
        "made_by": "data/examples/make.py",
        "units": "R, R_ex cmH2O/(L/s); C mL/cmH2O; PEEP, noise cmH2O; gain mL/s per %; flow mL/s",
        "recordings": entries,
    }
    files.write_text(folder / "manifest.toml", tomli_w.dumps(manifest))
    return [*written, folder / "manifest.toml"]


if __name__ == "__main__":
    target = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent
    for path in make(target):
        print(f"wrote {path}")
