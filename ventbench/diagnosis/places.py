"""Slots as candidates: what any shape at each place of the physics could explain."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ventbench.diagnosis.candidates import Candidate
from ventbench.diagnosis.hypothesis import Hypothesis
from ventbench.diagnosis.linear import Local, local
from ventbench.diagnosis.solved import Solved
from ventbench.physics.catalogue import library, mechanism, parameter, paths, slots
from ventbench.physics.nonparametric import SLOTS
from ventbench.system_id.data import Floats

#: Directions whose derivatives are taken at once.
_TOGETHER = 16


def all_paths() -> tuple[str, ...]:
    """Parameters of the library and of all slots."""
    return paths((*library(), *slots()))


def public(element: str) -> str:
    """Public name of the slot that an element belongs to."""
    return next(slot.name for slot in SLOTS.values() if element in slot.elements)


def holds(element: str) -> tuple[str, ...]:
    """Mechanisms of the library that an element holds as special cases, or nearly."""
    own = {
        "sensor_memory": ("sensor_lag",), "drift_shape": ("sensor_drift",), "sensor_shape": (),
        "outlet_shape": (),
    }  # fmt: skip
    return own.get(element, SLOTS[public(element)].holds)


def scan(solved: Solved) -> list[Candidate]:
    """Every element that a hypothesis lacks, by what it gains to first order, the best first.

    Args:
        solved: fitted with a simulator of all slots' parameters.
    """
    missing = [name for name in slots() if name not in solved.hypothesis.names]
    columns = [f"{n}.{p.name}" for n in missing for p in mechanism(n).description.parameters]
    slopes = _slopes(solved, columns)
    problem, x = solved.problem, solved.minimum.x
    white = replace(problem, noise=replace(problem.noise, ar=(0.0, 0.0)))
    places = [local(problem, x), local(white, x)]
    projected = [_projected(place, slopes) for place in places]
    found = []
    for name in missing:
        own = [k for k, path in enumerate(columns) if path.startswith(f"{name}.")]
        spread = np.array([parameter(columns[k]).prior()[1] for k in own])
        gains = [
            _gain(place, rows[:, own], spread)
            for place, rows in zip(places, projected, strict=True)
        ]
        found.append(Candidate(name, Hypothesis((name,)), {}, *gains))
    return sorted(found, key=lambda one: -max(one.nats, one.white))


def _slopes(solved: Solved, columns: list[str]) -> Floats:
    """Derivatives of the prediction by coefficients, ``(n, q, c, T)``."""
    simulator = solved.problem.simulator
    index = [simulator.names.index(path) for path in columns]
    parts = []
    for first in range(0, len(index), _TOGETHER):
        some = index[first : first + _TOGETHER]
        # Always as many, so that one compiled function serves.
        filled = tuple(some + some[:1] * (_TOGETHER - len(some)))
        parts.append(simulator.derivatives(solved.values, filled)[1][:, : len(some)])
    return np.concatenate(parts, axis=1)


def _projected(place: Local, slopes: Floats) -> Floats:
    return place.without_shared(place.without_own(place.whitened(slopes)))


def _gain(place: Local, rows: Floats, spread: Floats) -> float:
    """Nats that the best coefficients gain, with their prior."""
    flat = rows.swapaxes(0, 1).reshape(rows.shape[1], -1)
    force = flat @ place.residual.ravel()
    curvature = flat @ flat.T + np.diag(spread**-2.0)
    return 0.5 * float(force @ np.linalg.solve(curvature, force))
