"""From a score to a record: replayed first, so that no record can exist that does not replay."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ventbench import draws, files, protocol
from ventbench.board import actions, canonical, compare, forms, provenance, record, schema
from ventbench.board.replay import TRACE_BREATH, replay
from ventbench.board.replayed import Replayed, Simulators
from ventbench.errors import InputError
from ventbench.submissions.folder import combined_hash, file_hashes
from ventbench.submissions.result import CellFailure, Score

#: How many failures keep their whole text, and how much of it the others keep, characters.
_IN_FULL, _SHORT = 40, 240


@dataclass(frozen=True)
class Draft:
    """A new record and its commands, not yet in any folder.

    Attributes:
        content: bytes of the record.
        commands: bytes of its action file.
    """

    content: bytes
    commands: bytes

    def save(self, folder: Path) -> Path:
        """Write both files, each named by its hash.

        Returns:
            The record's path, for ``ventbench board add``.
        """
        commands = folder / f"{canonical.digest(self.commands)}{actions.SUFFIX}"
        path = folder / f"{canonical.digest(self.content)}{record.SUFFIX}"
        files.write_atomically(commands, lambda file: file.write(self.commands))
        files.write_atomically(path, lambda file: file.write(self.content))
        return path


def create(
    score: Score,
    simulators: Simulators,
    *,
    official: bool = True,
    source: Mapping[str, Any] | None = None,
    supersedes: str | None = None,
    reason: str = "",
    now: datetime | None = None,
) -> Draft:
    """Make the record of a score.

    Args:
        score: over all lungs, PIPs and published draws.
        simulators: that it was scored on.
        official: whether to call it so if its sandbox allows that.
        source: where the submission came from, such as commit and pull request.
        supersedes: SHA-256 of the record that this one corrects.
        reason: why, for the page.
        now: time of the record; the clock's if not given.

    Raises:
        InputError: if the score is not complete, the submission has changed since it was scored,
            or the score does not replay.
    """
    label, sandbox = score.submission.label, score.sandbox
    if not score.complete or len(score.drawn) != draws.COUNT:
        raise InputError(
            f"{label}: a record needs all lungs, all PIPs and all {draws.COUNT} draws; "
            f"score it with --draws {draws.COUNT}"
        )
    if score.submission.controller is not None:
        raise InputError(f"{label}: only a submission in a folder can have a record")
    hashes = file_hashes(score.submission.folder)
    if combined_hash(hashes) != score.submission.sha256:
        raise InputError(f"{label} was changed while it was scored; score it again")
    (found,) = replay(simulators, score.pips, [score.requested])
    commands = actions.encode(score.requested)
    errors = np.concatenate([score.nominal[None], score.drawn])
    content: dict[str, Any] = {
        "format": schema.FORMAT,
        "kind": "score",
        "protocol": protocol.VERSION,
        "created": record.timestamp(now),
        "official": official and score.official,
        "supersedes": supersedes,
        "reason": reason,
        "provenance": dict(source or {}),
        "track": score.track,
        "submission": {
            "sha256": score.submission.sha256,
            "files": hashes,
            "manifest": dataclasses.asdict(score.submission.manifest),
        },
        "simulators": dict(simulators.about()),
        "draws": draws.about(),
        "lungs": list(score.lungs),
        "pips": list(score.pips),
        "errors": {"nominal": _plain(score.nominal), "drawn": _plain(score.drawn)},
        "safe": score.safe.tolist(),
        "peak_pressure_cmH2O": score.peak.tolist(),
        "safety": {
            "peak_centi_cmH2O": np.round(100.0 * found.peak).astype(int).tolist(),
            "steps_above": found.steps_above.tolist(),
        },
        "clipped": {
            "below": found.below.tolist(),
            "above": found.above.tolist(),
            "commands": score.requested.size,
        },
        "spread": _plain(np.where(np.isnan(score.nominal), np.nan, found.spread)),
        "failures": [_failure(score, f, n < _IN_FULL) for n, f in enumerate(score.failures)],
        "failed_cells": int(np.isnan(errors).sum()),
        "trace": trace(found),
        "actions": {
            "sha256": canonical.digest(commands),
            "bytes": len(commands),
            "encoding": actions.ENCODING,
            "shape": list(score.requested.shape),
        },
        "sandbox": None if sandbox is None else dict(sandbox),
        "versions": provenance.versions(),
        "machine": provenance.machine(),
        "timing": dict(score.timing),
    }
    draft = Draft(canonical.canonical(content), commands)
    made = record.from_bytes(draft.content, f"the record of {label}")
    assert isinstance(made, record.Record)
    problems = compare.differences(made, found)
    if problems:
        raise InputError(f"{label}: the score does not replay: {'; '.join(problems)}")
    return draft


def keep(folder: Path, scores: Sequence[Score], simulators: Simulators) -> list[Path]:
    """Write the records of some scores.

    Args:
        folder: for records and commands.
        scores: over all lungs, PIPs and published draws.
        simulators: that they were scored on.

    Returns:
        Paths of the records, for ``ventbench board add``.

    Raises:
        InputError: as of :func:`create`; nothing has then been written.
    """
    drafts = [create(score, simulators) for score in scores]
    return [draft.save(folder) for draft in drafts]


def trace(found: Replayed) -> dict[str, Any]:
    """What the page draws, in whole numbers."""
    return {
        "breath": TRACE_BREATH + 1,
        "pressure_centi_cmH2O": np.round(100.0 * found.pressure).astype(int).tolist(),
        "u_in_tenths_percent": np.round(10.0 * found.u_in).astype(int).tolist(),
    }


def _plain(values: NDArray[np.float64]) -> Any:
    """Nested lists, null for NaN."""
    if values.ndim:
        return [_plain(row) for row in values]
    return float(values) if math.isfinite(values) else None


def _failure(score: Score, failure: CellFailure, in_full: bool) -> dict[str, Any]:
    cell = {"lung": failure.lung, "pip": failure.pip, "draw": failure.draw}
    # By its name, wherever its folder was.
    said = failure.message.removeprefix(score.submission.label)
    message = f"{score.submission.manifest.name}{said}"
    texts = {**failure.failure.to_json(), "message": message}
    most = forms.MOST_TEXT if in_full else _SHORT
    cut = {k: v[:most] if isinstance(v, str) else v for k, v in texts.items()}
    return {**cell, **cut}
