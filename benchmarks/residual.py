"""The residual submissions compared with the best PIDs of the grid and with lower bounds.

On the six frozen simulators, in float64. Prints two bounds of the error: *rise*, with the valve
fully open until PIP is reached (a lower bound if a higher command never lowers the pressure), and
*reached*, the lowest error that a gradient search finds for the commands of each cell with the
simulator known. Then prints differences of the error, paired over the six PIPs (nominal) and over
the 20 published draws, with 95 % bootstrap intervals; below zero the residual network is better.
Usage:

    python benchmarks/residual.py [--json FILE]
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from proofs.studies.controllers import score_controllers
from ventbench import precision
from ventbench.controllers.pid import PID
from ventbench.controllers.residual import load_weights
from ventbench.files import write_json
from ventbench.lungs import LUNG_IDS
from ventbench.metrics import bootstrap
from ventbench.plants import frozen
from ventbench.submissions.folder import open_submission
from ventbench.training import pid_grid
from ventbench.training.residual import bound
from ventbench.training.trained import ALL


def row(name: str, one: np.ndarray, other: np.ndarray) -> dict[str, Any]:
    """Print and return paired differences of errors of shape ``(1 + draws, P)``."""
    nominal = bootstrap.summary(one[0] - other[0])
    drawn = bootstrap.summary((one[1:] - other[1:]).mean(axis=1))
    print(f"{name:8} {one[0].mean():7.3f} {other[0].mean():7.3f}", end="")
    for found in (nominal, drawn):
        print(f" {found.mean:8.3f} [{found.ci95[0]:.3f}, {found.ci95[1]:.3f}]", end="")
    print()
    return {
        "error": float(one[0].mean()),
        "pid": float(other[0].mean()),
        "nominal": [nominal.mean, *nominal.ci95],
        "draws": [drawn.mean, *drawn.ci95],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    simulators, gains = frozen.load(), pid_grid.paper_gains()
    error = pid_grid.errors(simulators.plants, gains).mean(axis=-1)
    best = [PID(*map(float, gains[k])) for k in error.argmin(axis=1)]
    single = [PID(*map(float, gains[int(error.mean(axis=0).argmin())]))] * len(LUNG_IDS)
    with precision.float64():
        each = load_weights(open_submission("v1/residual_mlp").folder / "weights.npz")
        for_all = load_weights(open_submission("v1/residual_mlp_all").folder / "weights.npz")[ALL]
    result: dict[str, Any] = {}

    print(f"{'lung':8} {'rise':>7} {'reached':>7}   cmH2O")
    columns = [
        x.mean(axis=-1) for x in (bound.rise(simulators.plants), bound.reached(simulators.plants))
    ]
    for name, *values in zip((*LUNG_IDS, "mean"), *([*x, x.mean()] for x in columns), strict=True):
        print(f"{name:8} {values[0]:7.3f} {values[1]:7.3f}")
        result[name] = {"rise": float(values[0]), "reached": float(values[1])}

    pairs = {
        "residual_mlp, best PID of each lung": ([each[name] for name in LUNG_IDS], best),
        "residual_mlp_all, best single PID": ([for_all] * len(LUNG_IDS), single),
    }
    for title, (residuals, pids) in pairs.items():
        (one, index, safe), (other, pid_index, _) = (
            score_controllers(simulators, controllers) for controllers in (residuals, pids)
        )
        print(f"\n{title}: nominal error, PID's, differences over PIPs and over draws")
        rows = {name: row(name, one[k], other[k]) for k, name in enumerate(LUNG_IDS)}
        rows["mean"] = row("mean", one.mean(axis=0), other.mean(axis=0))
        less = [1.0 - one[:, part].mean() / other[:, part].mean() for part in (0, slice(1, None))]
        print(
            f"{100 * less[0]:.1f} % less nominal, {100 * less[1]:.1f} % on draws; exploitation "
            f"{index:.3f}, PID's {pid_index:.3f}; {'safe' if safe else 'UNSAFE'}"
        )
        result[title] = {
            "lungs": rows, "less": less, "exploitation": index, "pid_exploitation": pid_index,
            "safe": safe,
        }  # fmt: skip
    if options.json:
        write_json(options.json, result)


if __name__ == "__main__":
    main()
