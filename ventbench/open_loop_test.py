"""What ``ventbench open-loop`` finds: one kind of simulator on every lung of a recording."""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ventbench import evaluation
from ventbench.evaluation import PlantsFor
from ventbench.lungs import RECORDED_LUNGS
from ventbench.plants import frozen
from ventbench.plants.labelled import single_compartments
from ventbench.recordings import Breaths

#: Kinds that were trained on recordings.
LEARNED_KINDS = ("frozen", "hybrid", "learned")


def run(breaths: Breaths, kind: str = "frozen") -> dict[str, Any]:
    """Test simulators against a recording.

    Args:
        breaths: the recording.
        kind: ``"frozen"`` (the official simulators) or their kind by name, ``"hybrid"``;
            ``"learned"`` for the paper's networks; ``"physics"`` for R-C lungs at their labels.

    Returns:
        JSON values: ``plant``; ``lungs``; ``misfits``; ``not_judged``, the ids of breaths without a
        first or another inspiratory pressure; ``notes``. For each lung the figures of
        :func:`ventbench.evaluation.summary`, cmH2O: without prefix of the simulators that make the
        scores, over all breaths; ``held_out_...`` of each breath by a member of the ensemble that
        has not seen it; ``official_held_out_...`` of the simulators that make the scores, on what
        they have not seen. In ``fitting_label`` the same without the misfits.

    Raises:
        InputError: if there is no simulator for a lung of the recording.
    """
    simulators = frozen.load()
    official, cross_fitted = _kinds(simulators, kind)
    error = evaluation.errors(official, breaths)
    crossed = evaluation.errors(cross_fitted, breaths)
    if kind in LEARNED_KINDS:
        held_out, unseen = simulators.held_out(breaths), simulators.unseen(breaths)
    else:
        held_out = unseen = np.ones(len(breaths), bool)  # nothing of it is learned
    misfits = evaluation.misfits(
        simulators.cross_fitted,
        lambda plants, gain: replace(plants, slopes=plants.slopes * gain),
        breaths,
        evaluation.errors(simulators.cross_fitted, breaths),
        tuple((lung.R, lung.C) for lung in RECORDED_LUNGS),
    )
    apart = np.isin(breaths.breath_id, [found.breath_id for found in misfits])

    def figures(index: NDArray[np.int64]) -> dict[str, Any]:
        return {
            **evaluation.summary("", error[index]),
            **evaluation.summary("held_out_", crossed[index][held_out[index]]),
            **evaluation.summary("official_held_out_", error[index][unseen[index]]),
        }

    lungs = {}
    for lung, index in breaths.by_lung_index.items():
        lungs[lung] = figures(index) | {"fitting_label": figures(index[~apart[index]])}
    return {
        "plant": kind,
        "simulators": simulators.about(),
        "unit": "cmH2O",
        "lungs": lungs,
        "misfits": [asdict(found) for found in misfits],
        "not_judged": breaths.breath_id[np.isnan(error)].tolist(),
        "notes": list(breaths.notes),
    }


def _kinds(simulators: frozen.Frozen, kind: str) -> tuple[PlantsFor, PlantsFor]:
    """Official and cross-fitted plants of a kind."""
    if kind == "physics":
        return single_compartments, single_compartments
    if kind == "learned":
        learned = frozen.load_learned()
        return learned.for_breaths, learned.cross_fitted
    return simulators.for_breaths, simulators.cross_fitted


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
