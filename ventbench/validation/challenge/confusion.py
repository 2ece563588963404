"""What was answered to what: rows are truths, columns answers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

from ventbench.validation.challenge.judge import Judged

_NOTHING, _SEVERAL = "nothing missing", "several names"


def confusion(cases: Sequence[Judged]) -> dict[str, dict[str, int]]:
    """Counts by truth, then by answer; cases with one effect or none."""
    table: dict[str, Counter[str]] = {}
    for case in sorted(cases, key=lambda c: c.effects):
        if len(case.effects) <= 1:
            truth = case.effects[0] if case.effects else _NOTHING
            table.setdefault(truth, Counter())[_said(case)] += 1
    return {truth: dict(counts.most_common()) for truth, counts in table.items()}


def _said(case: Judged) -> str:
    if case.verdict == "nothing_missing":
        return _NOTHING
    if case.verdict == "unnamed":
        return f"unnamed: {case.slot}"
    name = next(iter(case.named)) if len(case.named) == 1 else _SEVERAL
    return name if case.slot is None else f"{name} + {case.slot}"


def by_effect(cases: Sequence[Judged]) -> dict[str, dict[str, Any]]:
    """Of each mechanism of the library: coverage and median error of its parameters."""
    found: dict[str, list[Any]] = {}
    for case in cases:
        for item in case.estimates:
            found.setdefault(item.path, []).append(item)
    return {
        path: {
            "count": len(items),
            "covered": sum(item.covered for item in items),
            "median_error": sorted(item.error for item in items)[len(items) // 2],
        }
        for path, items in sorted(found.items())
    }
