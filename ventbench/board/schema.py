"""What a record must look like before anything of it is used or shown.

A record may come from anybody: every value is checked for its type and range here, so that ranking
and pages need not; text is escaped where it is shown.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ventbench import protocol
from ventbench.board import actions, forms
from ventbench.errors import InputError
from ventbench.lungs import LUNG_IDS
from ventbench.submissions.manifest import FAMILIES, NAME, TRACKS

#: Version of the record's form, and its two kinds.
FORMAT = 1
KINDS = ("score", "withdrawal")

#: Largest record, bytes.
MOST_BYTES = 2 * 2**20

_HASH = forms.pattern(forms.SHA256)

_MANIFEST: dict[str, forms.Check] = {
    "name": forms.pattern(NAME),
    "authors": forms.listed(forms.text, None),
    "licence": forms.text,
    "api_version": forms.count,
    "family": forms.one_of(*FAMILIES),
    "tracks": forms.listed(forms.one_of(*TRACKS), None),
    "description": forms.text,
    "training": forms.object_,
}

_FAILURE = forms.table(
    lung=forms.one_of(*LUNG_IDS),
    pip=forms.number,
    draw=forms.or_none(forms.count),
    kind=forms.text,
    what=forms.text,
    detail=forms.text,
    breath=forms.or_none(forms.count),
    step=forms.or_none(forms.count),
    message=forms.text,
)


def _score_checks(lungs: int, pips: int, draws: int) -> dict[str, forms.Check]:
    """Checks of a score's keys; errors and spread are null where a controller failed."""
    steps = protocol.INSPIRATION_STEPS
    return {
        "format": forms.one_of(FORMAT),
        "kind": forms.one_of("score"),
        "protocol": forms.count,
        "created": forms.pattern(forms.TIME),
        "official": forms.flag,
        "supersedes": forms.or_none(_HASH),
        "reason": forms.text,
        "provenance": forms.object_,
        "track": forms.one_of(*TRACKS),
        "submission": forms.table(
            sha256=_HASH, files=forms.object_, manifest=forms.table(**_MANIFEST)
        ),
        "simulators": forms.object_,
        "draws": forms.table(version=forms.count, sha256=_HASH, count=forms.count),
        "lungs": forms.listed(forms.pattern(forms.LUNG), lungs),
        "pips": forms.listed(forms.number, pips),
        "errors": forms.table(
            nominal=forms.grid(forms.number_row, lungs, pips),
            drawn=forms.grid(forms.number_row, draws, lungs, pips),
        ),
        "safe": forms.listed(forms.flag, lungs),
        "peak_pressure_cmH2O": forms.listed(forms.number, lungs),
        "safety": forms.table(
            peak_centi_cmH2O=forms.grid(forms.whole_row, 1 + draws, lungs, pips),
            steps_above=forms.grid(forms.count_row, 1 + draws, lungs, pips),
        ),
        "clipped": forms.table(
            below=forms.listed(forms.count, lungs),
            above=forms.listed(forms.count, lungs),
            commands=forms.count,
        ),
        "spread": forms.grid(forms.number_row, lungs, pips),
        "failures": forms.listed(_FAILURE, None),
        "failed_cells": forms.count,
        "trace": forms.table(
            breath=forms.count,
            pressure_centi_cmH2O=forms.grid(forms.whole_row, lungs, pips, steps),
            u_in_tenths_percent=forms.grid(forms.whole_row, lungs, pips, steps),
        ),
        "actions": forms.table(
            sha256=_HASH,
            bytes=forms.count,
            encoding=forms.one_of(actions.ENCODING),
            shape=forms.listed(forms.count, 5),
        ),
        "sandbox": forms.or_none(forms.object_),
        "versions": forms.object_,
        "machine": forms.object_,
        "timing": forms.object_,
    }


_WITHDRAWAL: dict[str, forms.Check] = {
    "format": forms.one_of(FORMAT),
    "kind": forms.one_of("withdrawal"),
    "created": forms.pattern(forms.TIME),
    "withdraws": _HASH,
    "reason": lambda value: forms.text(value) and bool(value.strip()),
}


def check(content: Any, label: str) -> None:
    """Check the content of a record.

    Args:
        content: JSON values.
        label: names the file in messages.

    Raises:
        InputError: naming the first key that is wrong.
    """
    if not isinstance(content, dict) or content.get("kind") not in KINDS:
        raise InputError(f"{label}, key kind: is not one of {', '.join(KINDS)}")
    if content["kind"] == "withdrawal":
        _keys(content, _WITHDRAWAL, label)
        return
    sizes = [content.get(key) for key in ("lungs", "pips")]
    lungs, pips = (len(size) if isinstance(size, list) else -1 for size in sizes)
    draws = content.get("draws")
    count = draws.get("count") if isinstance(draws, dict) else None
    count = count if isinstance(count, int) and forms.count(count) else -2
    _keys(content, _score_checks(lungs, pips, count), label)
    _consistent(content, label)


def _keys(content: Mapping[str, Any], checks: Mapping[str, forms.Check], label: str) -> None:
    for key in checks:
        if key not in content:
            raise InputError(f"{label}, key {key}: is missing")
    for key, value in content.items():
        if key not in checks:
            raise InputError(f"{label}, key {key[:40]!r}: is not known")
        if not checks[key](value):
            raise InputError(f"{label}, key {key}: does not have the form of a record's")


def _consistent(content: Mapping[str, Any], label: str) -> None:
    lungs, pips, count = content["lungs"], content["pips"], content["draws"]["count"]
    if content["protocol"] == protocol.VERSION and (
        tuple(lungs) != LUNG_IDS or tuple(pips) != protocol.PIPS
    ):
        raise InputError(f"{label}: does not cover all lungs and PIPs of the protocol")
    if content["actions"]["shape"] != list(actions.shape(len(lungs), count, len(pips))):
        raise InputError(f"{label}, key actions.shape: does not fit lungs, draws and PIPs")
    if content["track"] not in content["submission"]["manifest"]["tracks"]:
        raise InputError(f"{label}, key track: the submission does not enter it")
    sandbox = content["sandbox"]
    if content["official"] and not (sandbox and sandbox.get("official") is True):
        raise InputError(f"{label}, key official: its sandbox was not official")
    errors = content["errors"]
    tables = [errors["nominal"], *errors["drawn"]]
    cells = [cell for table in tables for row in table for cell in row]
    if cells.count(None) != content["failed_cells"]:
        raise InputError(f"{label}, key failed_cells: does not fit the errors")
    if any(cell is not None and cell < 0 for cell in cells):
        raise InputError(f"{label}, key errors: one is negative")
    _failures_fit(content, label)


def _failures_fit(content: Mapping[str, Any], label: str) -> None:
    """Every failed cell has no error and one failure, and no other cell has either."""
    lungs, pips, errors = content["lungs"], content["pips"], content["errors"]
    runs = [(None, errors["nominal"]), *enumerate(errors["drawn"], 1)]
    failed = {
        (lung, pip, draw)
        for draw, table in runs
        for lung, row in zip(lungs, table, strict=True)
        for pip, error in zip(pips, row, strict=True)
        if error is None
    }
    listed = [(f["lung"], f["pip"], f["draw"]) for f in content["failures"]]
    if len(listed) != len(failed) or set(listed) != failed:
        raise InputError(f"{label}, key failures: do not fit the errors")
