"""How far simulators stray from recorded breaths: the open-loop test of ``ventbench open-loop``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ventbench.interfaces import Plant
from ventbench.lungs import RECORDED_LUNGS
from ventbench.metrics import bootstrap, open_loop
from ventbench.plants import frozen
from ventbench.plants.catalog import Given, load_simulators, names
from ventbench.recordings import Breaths
from ventbench.rollouts import PlantsFor, open_loop_breaths

Floats = NDArray[np.float64]

#: A breath is looked at more closely if its error exceeds this, cmH2O ...
SUSPECT = 1.0

#: ... and does not fit its label if another explanation leaves less than this share of its error.
FAR_BETTER = 0.4

#: Factors on the flow of the valve that are tried as explanations.
GAINS = (0.6, 0.7, 0.8, 0.9, 1.1, 1.25, 1.4, 1.6)


def run(breaths: Breaths, plant: Given = "frozen") -> dict[str, Any]:
    """Test simulators against a recording.

    Args:
        breaths: the recording.
        plant: the simulators; see :func:`ventbench.plants.catalog.load_simulators`.

    Returns:
        JSON values: ``plant``; ``simulators``, the official ones, by which misfits are judged;
        ``about``, what is known of others if they are from a file, a function or the caller;
        ``lungs``; ``misfits``; ``not_judged``, the ids of breaths without a first or another
        inspiratory pressure; ``notes``. For each lung the figures of :func:`summary`, cmH2O:
        without prefix of the simulators that make the scores, over all breaths; ``held_out_...``
        of each breath by a member of the ensemble that has not seen it; ``official_held_out_...``
        of the simulators that make the scores, on what they have not seen. In ``fitting_label``
        the figures without the misfits.

    Raises:
        InputError: if there is no simulator for a lung of the recording.
    """
    official = frozen.load()
    tested = load_simulators(plant, breaths=breaths)
    error = mean_errors(tested.pressures(breaths), breaths)
    crossed = mean_errors(tested.pressures(breaths, cross_fitted=True), breaths)
    held_out, unseen = tested.held_out(breaths), tested.unseen(breaths)
    doubtful = misfits(
        official.cross_fitted,
        lambda plants, gain: replace(plants, slopes=plants.slopes * gain),
        breaths,
        errors(official.cross_fitted, breaths),
        tuple((lung.R, lung.C) for lung in RECORDED_LUNGS),
    )
    apart = np.isin(breaths.breath_id, [misfit.breath_id for misfit in doubtful])

    def figures(index: NDArray[np.int64]) -> dict[str, Any]:
        return {
            **summary("", error[index]),
            **summary("held_out_", crossed[index][held_out[index]]),
            **summary("official_held_out_", error[index][unseen[index]]),
        }

    lungs = {}
    for lung, index in breaths.by_lung_index.items():
        lungs[lung] = figures(index) | {"fitting_label": figures(index[~apart[index]])}
    return {
        "plant": plant if isinstance(plant, str) and plant in names() else tested.name,
        "simulators": official.about(),
        **({} if tested.kind in names() else {"about": dict(tested.about)}),
        "unit": "cmH2O",
        "lungs": lungs,
        "misfits": [asdict(misfit) for misfit in doubtful],
        "not_judged": breaths.breath_id[np.isnan(error)].tolist(),
        "notes": list(breaths.notes),
    }


def misfit_lines(result: dict[str, Any]) -> list[str]:
    """Say in words which breaths do not fit their label."""
    misfits = result["misfits"]
    lines = []
    if misfits:
        lines.append(
            f"{len(misfits)} breaths are explained far better by something else than their label:"
        )
        lines += [
            f"  breath {one['breath_id']} ({one['lung']}): {one['mae']:.2f} cmH2O, "
            f"{one['mae_explained']:.2f} as {one['explanation']}"
            for one in misfits[:20]
        ]
        if len(misfits) > 20:
            lines.append(f"  ... and {len(misfits) - 20} more; --json lists all")
    if result["not_judged"]:
        lines.append(
            f"{len(result['not_judged'])} breaths have no first pressure or no other inspiratory "
            "one and were not judged."
        )
    return lines


def errors(plants_for: PlantsFor, breaths: Breaths) -> Floats:
    """Open-loop MAE of each breath by some plants; see :func:`mean_errors`."""
    return mean_errors(open_loop_breaths(plants_for, breaths), breaths)


def mean_errors(simulated: Floats, breaths: Breaths) -> Floats:
    """Mean |simulated - recorded| of each breath over its inspiratory samples, cmH2O, ``(n,)``.

    NaN where a breath has no first pressure or no other inspiratory one.

    Args:
        simulated: open-loop answers, cmH2O, shape ``(n, T)``.
        breaths: n recorded breaths.
    """
    blank = np.isnan(breaths.pressure[:, 0])
    found = open_loop.mae(breaths.pressure, np.nan_to_num(simulated), breaths.inspiratory)
    return np.where(blank, np.nan, found)


@dataclass(frozen=True)
class Misfit:
    """A breath that something else than its label explains far better.

    Attributes:
        breath_id: of the recording.
        lung: its label.
        mae: under its label, cmH2O.
        explanation: such as ``"lung R20C20"`` or ``"valve gain x 0.8"``.
        mae_explained: under the explanation, cmH2O.
    """

    breath_id: int
    lung: str
    mae: float
    explanation: str
    mae_explained: float


def misfits(
    plants_for: PlantsFor,
    with_gain: Callable[[Any, float], Plant],
    breaths: Breaths,
    error: Floats,
    settings: tuple[tuple[float, float], ...],
) -> list[Misfit]:
    """Find breaths that do not fit their label.

    Each suspect breath is simulated once more as every other lung setting and with each of
    :data:`GAINS`; nothing is fitted to it.

    Args:
        plants_for: see :data:`PlantsFor`.
        with_gain: returns plants whose valve gives a multiple of its flow.
        breaths: n breaths.
        error: of each under its label, cmH2O, shape ``(n,)``.
        settings: the (R, C) that are tried.
    """
    index = np.flatnonzero(error > SUSPECT)
    if index.size == 0:
        return []
    suspects = breaths.select(index)
    names, found = [], []
    for r, c in settings:
        other = replace(suspects, R=np.full(index.size, r), C=np.full(index.size, c))
        names.append(f"lung R{r:g}C{c:g}")
        found.append(errors(plants_for, other))
    for gain in GAINS:
        names.append(f"valve gain x {gain:g}")
        found.append(errors(lambda part, gain=gain: with_gain(plants_for(part), gain), suspects))
    best = np.argmin(found, axis=0)
    least = np.min(found, axis=0)
    return [
        Misfit(
            int(suspects.breath_id[i]),
            str(suspects.lung_ids[i]),
            float(error[index[i]]),
            names[best[i]],
            float(least[i]),
        )
        for i in np.flatnonzero(least < FAR_BETTER * error[index])
    ]


def summary(prefix: str, error: Floats) -> dict[str, Any]:
    """Figures of some breaths.

    Args:
        prefix: of the keys, such as ``"held_out_"``.
        error: of each breath, cmH2O, shape ``(n,)``; NaN for one that could not be judged.

    Returns:
        JSON values: ``mae``, ``median_mae``, ``ci95`` (bootstrap interval of the mean) and
        ``breaths``, with the prefix; null where there is no breath.
    """
    found = bootstrap.summary(error)
    return {
        f"{prefix}mae": _number(found.mean),
        f"{prefix}median_mae": _number(found.median),
        f"{prefix}ci95": [_number(limit) for limit in found.ci95],
        f"{prefix}breaths": found.count,
    }


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
