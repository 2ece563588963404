"""Figures of a part of the proof, from its ``diagnosis.json``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def figures(diagnosis: Mapping[str, Any], made: Mapping[str, Any]) -> dict[str, Any]:
    """JSON values of a finished part; errors in cmH2O, on breaths that no fit has seen.

    Args:
        diagnosis: its ``diagnosis.json``.
        made: its ``part.json``.
    """
    loop = diagnosis["open_loop"]
    stages = {name: loop[name] for name in ("before", "refit", "after")}
    mechanisms = diagnosis["mechanisms"]
    wanted = made["wanted"]
    return {
        "title": made["title"],
        "lungs": made["key"]["lungs"],
        "breaths": made["breaths"],
        "held_out": len(loop["held_out_breaths"]),
        "mae": {name: stage["mae"] for name, stage in stages.items()},
        "rmse": {name: stage["rmse"] for name, stage in stages.items()},
        "mae_by_names_alone": made["mae_by_names_alone"],
        "cut_percent": cut(loop["before"]["mae"], made["mae_by_names_alone"]),
        "noise_floor": loop["noise_floor"],
        "groups": loop["groups"],
        "verdict": diagnosis["verdict"],
        "mechanisms": mechanisms,
        "slot": diagnosis["slot"],
        "misfitting_labels": [item for item in diagnosis["lungs"] if not item["label_matches"]],
        "wanted": wanted,
        "found": None if wanted is None else named(mechanisms, wanted) is not None,
        "about": made["key"]["about"],
        "seconds": diagnosis["seconds"],
    }


def cut(before: float | None, after: float | None) -> float | None:
    """By how many per cent an error became smaller; None if one of them is not known."""
    return None if not before or after is None else 100.0 * (1.0 - after / before)


def named(mechanisms: list[dict[str, Any]], name: str) -> dict[str, Any] | None:
    """The mechanism of this name among those that were named, or None."""
    return next((item for item in mechanisms if item["name"] == name), None)
