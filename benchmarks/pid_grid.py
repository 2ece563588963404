"""The paper's PID grid on the six frozen simulators: best gains and speed.

Simulates 8,000 sets of gains at six PIPs on each lung, 288,000 trajectories. Prints the best gains
of each lung and those that the paper found on the physical lung, the best single set
(``submissions/pid_robust``), and the steps/s relative to the R-C lung, the cheapest plant, in the
same run. Usage:

    python benchmarks/pid_grid.py [--json FILE]
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

from ventbench.base.files import write_json
from ventbench.plants import frozen
from ventbench.plants.single_compartment import single_compartment
from ventbench.plants.stacking import stack
from ventbench.task import protocol
from ventbench.task.lungs import LUNG_IDS, LUNGS
from ventbench.train import pid_search

#: Best gains P, I on the physical lung (paper, appendix); D is 0.
PAPER = {
    "R5C10": (10.0, 0.2),
    "R5C20": (10.0, 10.0),
    "R5C50": (10.0, 10.0),
    "R20C10": (8.0, 1.0),
    "R20C20": (5.0, 10.0),
    "R20C50": (5.0, 10.0),
}


def timed(plants: Any, gains: np.ndarray) -> tuple[np.ndarray, float]:
    """Return errors, cmH2O, and steps/s without compilation."""
    pid_search.errors(jax.tree.map(lambda x: x[:1], plants), gains[: pid_search.BATCH])
    started = time.perf_counter()
    error = pid_search.errors(plants, gains)
    return error, error.size * protocol.INSPIRATION_STEPS / (time.perf_counter() - started)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    gains = pid_search.paper_gains()
    error, rate = timed(frozen.load().plants, gains)
    _, textbook = timed(stack([single_compartment(lung) for lung in LUNGS]), gains)

    result: dict[str, Any] = {"lungs": {}}
    print(f"{'lung':8} {'best P, I, D':>20} {'error':>7}   {'paper P, I':>12} {'error':>7}  cmH2O")
    for index, name in enumerate(LUNG_IDS):
        mean = error[index].mean(axis=-1)
        best = int(np.argmin(mean))
        P, I = PAPER[name]  # noqa: E741
        published = int(np.flatnonzero(np.all(gains == (P, I, 0.0), axis=1))[0])
        shown = ", ".join(f"{gain:g}" for gain in gains[best])
        print(
            f"{name:8} {shown:>20} {mean[best]:7.3f}   {f'{P:g}, {I:g}':>12} {mean[published]:7.3f}"
        )
        result["lungs"][name] = {
            "gains": gains[best].tolist(),
            "error": float(mean[best]),
            "paper_gains": [P, I, 0.0],
            "paper_error": float(mean[published]),
        }
    one = int(np.argmin(error.mean(axis=(0, 2))))
    shown = ", ".join(f"{gain:g}" for gain in gains[one])
    print(f"{'all six':8} {shown:>20} {error[:, one].mean():7.3f}")
    print(f"\n{error.size} trajectories, {rate:.3g} steps/s")
    print(f"R-C lungs {textbook:.3g} steps/s, ratio {rate / textbook:.3f}")
    result |= {"robust": gains[one].tolist(), "robust_error": float(error[:, one].mean())}
    result |= {"steps_per_s": rate, "textbook_steps_per_s": textbook}
    if options.json:
        write_json(options.json, result)


if __name__ == "__main__":
    main()
