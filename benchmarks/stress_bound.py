"""What stress costs a controller that knows all: least error, and runs survived, by stressor.

In each breath of a stressed run the physics of that breath is known, and its commands are the best
that :mod:`ventbench.task.attainable` finds. So nobody has a lower stress score on these cells, but
by what the search has missed: rounding of commands has no derivative. ``--draws`` of the
development draws, one PIP of each lung and draw.

Usage:

    python benchmarks/stress_bound.py [--draws 1]
"""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
import typer

from ventbench.base import compilation
from ventbench.base.arrays import Bools, Floats
from ventbench.entries.cells import Cells, protocol_of
from ventbench.entries.runs import PLATEAU_SHARE, PLATEAU_TOLERANCE
from ventbench.plants.rigs import load_rigs
from ventbench.task import attainable, protocol
from ventbench.task.metrics.score import passes_safety_gate, steady_error
from ventbench.task.stressors import WEIGHTS

#: Steps that the starts of the search open the valve for: of six, two.
STARTS = (1, 8)


def best(cells: Cells, draw: int) -> tuple[Floats, Bools]:
    """Least error of each condition and lung of a draw, cmH2O, ``(S, L)``, and runs survived."""
    plants, scenario = cells.stressed(draw)
    errors, survived = [], np.ones(np.shape(scenario.pip), bool)
    for breath in range(protocol.BREATHS):
        own = jax.tree.map(lambda leaf, k=breath: np.asarray(leaf)[:, k], plants)
        some: Any = jax.tree.map(np.asarray, scenario)
        some = some.replace(gain=np.repeat(some.gain[:, [breath]], protocol.BREATHS, axis=1))
        found = attainable.attainable(own, some, starts=STARTS)
        later = attainable.pressures(own, some, found.commands)
        pressure = np.column_stack([some.start, later])
        if breath in protocol.SCORED_BREATHS:
            errors.append(np.abs(pressure - some.pip[:, None]).mean(axis=1))
        survived &= passes_safety_gate(pressure, some.pip, some.dt)
    held = steady_error(pressure, some.pip) <= PLATEAU_TOLERANCE + PLATEAU_SHARE * some.pip
    shape = (len(cells.conditions), len(cells.lungs))
    return np.mean(errors, axis=0).reshape(shape), (survived & held).reshape(shape)


def main(draws: int = 1) -> None:
    """What stress costs a controller that knows all: least error, and survival."""
    compilation.keep()
    cells = protocol_of(load_rigs(), draws=draws, stress=draws).stressed
    assert cells is not None
    with compilation.float64():
        errors, survived = zip(*(best(cells, k) for k in range(draws)), strict=True)
    error, share = np.mean(errors, axis=(0, 2)), np.mean(survived, axis=(0, 2))
    names = [condition.id for condition in cells.conditions]
    for k in np.argsort(-error):
        print(f"{names[k]:40}{error[k]:7.2f} cmH2O{100 * share[k]:6.0f} %")
    weights = [WEIGHTS.get(name, 1.0) for name in names[1:]]
    score = float(np.average(error[1:], weights=weights))
    print(
        f"nobody below {score:.2f} cmH2O, {100 * share[1:].mean():.1f} % of runs survived; without "
        f"a stressor {error[0]:.2f} cmH2O"
    )


if __name__ == "__main__":
    typer.run(main)
