"""From a score to a record: replayed first, so that no record can exist that does not replay.

A record also says where it was made.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import platform
import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from ventbench.base import files
from ventbench.base.arrays import Floats
from ventbench.base.errors import InputError
from ventbench.board import canonical, record, schema, store
from ventbench.board.replay import TRACE_BREATH, Replayed, ReplayPlants, differences, replay
from ventbench.entries.folder import combined_hash, file_hashes
from ventbench.entries.result import Score, package_versions
from ventbench.entries.runs import DRAWS, CellFailure, Runs
from ventbench.task import draws as draw_tables
from ventbench.task import stressors
from ventbench.task.draws import Draws

#: How many failures keep their whole text, and how much of it the others keep, characters.
_IN_FULL, _SHORT = 40, 240

#: Packages besides those of every score.
_PACKAGES = ("flax", "safetensors", "scipy")

#: Instruction sets that decide how matrix products round, as /proc/cpuinfo names them, widest last.
_ISA = ("asimd", "sve", "sve2", "sse4_2", "avx", "avx2", "fma", "avx512f")


@dataclass(frozen=True)
class Draft:
    """A new record and its commands as bytes of two files, not yet in any folder."""

    content: bytes
    commands: bytes

    def save(self, folder: Path) -> Path:
        """Write both files, each named by its hash; return the record's path."""
        commands = folder / f"{canonical.digest(self.commands)}{canonical.ACTIONS_SUFFIX}"
        path = folder / f"{canonical.digest(self.content)}{record.SUFFIX}"
        files.write_bytes(commands, self.commands)
        files.write_bytes(path, self.content)
        return path


def create(
    score: Score,
    simulators: ReplayPlants,
    *,
    source: Mapping[str, Any] | None = None,
    now: datetime | None = None,
) -> Draft:
    """Make the record of a score.

    Args:
        score: over all lungs, PIPs and published draws.
        simulators: that it was scored on.
        source: where the submission came from, such as commit and pull request.
        now: time of the record; the clock's if not given.

    Raises:
        InputError: if the score is not complete, the submission has changed since it was scored,
            or the score does not replay.
    """
    label, sandbox = score.submission.label, score.sandbox
    if not score.complete or score.rig_draws is None or score.rig_draws.count < draw_tables.COUNT:
        raise InputError(
            f"{label}: a record needs all lungs, all PIPs and all {draw_tables.COUNT} draws; "
            f"score it with --draws {draw_tables.COUNT}"
        )
    if score.submission.controller is not None:
        raise InputError(f"{label}: only a submission in a folder can have a record")
    hashes = file_hashes(score.submission.folder)
    if combined_hash(hashes) != score.submission.sha256:
        raise InputError(f"{label} was changed while it was scored; score it again")
    (replayed,) = replay(simulators, score.pips, [score.requested], score.rig_draws)
    commands = store.encode(score.requested)
    errors = np.concatenate([score.nominal[None], score.drawn])
    content: dict[str, Any] = {
        "format": schema.FORMAT,
        "kind": "score",
        "protocol": schema.PROTOCOL,
        "created": record.timestamp(now),
        "official": score.official,
        "supersedes": None,
        "reason": "",
        "provenance": dict(source or {}),
        "track": score.track,
        "submission": {
            "sha256": score.submission.sha256,
            "files": hashes,
            "manifest": dataclasses.asdict(score.submission.manifest),
        },
        "simulators": dict(simulators.about()),
        "draws": score.rig_draws.about(),
        **_headroom(score, score.rig_draws),
        **_stressed(score),
        "lungs": list(score.lungs),
        "pips": list(score.pips),
        "errors": {"nominal": _plain(score.nominal), "drawn": _plain(score.drawn)},
        "safe": score.safe.tolist(),
        "peak_pressure_cmH2O": score.peak.tolist(),
        "safety": {
            "peak_centi_cmH2O": np.round(100.0 * replayed.peak).astype(int).tolist(),
            "steps_above": replayed.steps_above.tolist(),
        },
        "clipped": {
            "below": replayed.below.tolist(),
            "above": replayed.above.tolist(),
            "commands": score.requested.size,
        },
        "spread": _plain(np.where(np.isnan(score.nominal), np.nan, replayed.spread)),
        "failures": [_failure(score, f, n < _IN_FULL) for n, f in enumerate(score.failures)],
        "failed_cells": int(np.isnan(errors).sum()),
        "trace": trace(replayed),
        "actions": {
            "sha256": canonical.digest(commands),
            "bytes": len(commands),
            "encoding": schema.ENCODING,
            "shape": list(score.requested.shape),
        },
        "sandbox": None if sandbox is None else dict(sandbox),
        "versions": versions(),
        "machine": machine(),
        "timing": dict(score.timing),
    }
    draft = Draft(canonical.canonical(content), commands)
    made = record.from_bytes(draft.content, f"the record of {label}")
    assert isinstance(made, record.Record)
    problems = differences(made, replayed)
    if problems:
        raise InputError(f"{label}: the score does not replay: {'; '.join(problems)}")
    return draft


def _headroom(score: Score, drawn: Draws) -> dict[str, Any]:
    """Rigs of the draws, and what the score is relative to."""
    reference = score.protocol.reference
    if reference is None:
        raise InputError(
            f"{score.submission.label}: there are no reference errors of these simulators and "
            "draws; make them with `ventbench board headroom`"
        )
    tables = {
        "error": score.controllable,
        "attainable": reference.attainable,
        "pid": reference.pid,
    }
    return {
        "rigs": {"session": drawn.rig.tolist(), "member": drawn.member.tolist()},
        "headroom": {key: _plain(np.moveaxis(table, 1, 0)) for key, table in tables.items()},
    }


def _stressed(score: Score) -> dict[str, Any]:
    """What missing physics adds to a record."""
    stress = score.stressed
    if stress is None:
        return {}
    if not stress.complete:
        raise InputError(
            f"{score.submission.label}: a record needs all stressors on {DRAWS} draws, or none"
        )
    return {
        "stress": {
            "stressors": stressors.VERSION,
            "conditions": [condition.id for condition in stress.conditions],
            "pips": stress.pips.tolist(),
            "errors": _plain(stress.error),
            "safe": stress.safe.tolist(),
            "survived": stress.survived.tolist(),
            "above_alarm_ms": np.round(1e3 * stress.alarm_s).astype(int).tolist(),
            "peak_centi_cmH2O": np.round(100.0 * stress.peak).astype(int).tolist(),
            "volume_mL": np.round(stress.volume).astype(int).tolist(),
            "commands_sha256": stress_digest(stress),
        }
    }


def stress_digest(stressed: Runs) -> str:
    """SHA-256 of the commands of stressed runs."""
    return canonical.digest(np.ascontiguousarray(stressed.requested, "<f8").tobytes())


def versions() -> dict[str, str]:
    """Versions of Python and packages, and the hash of the lock file where there is one."""
    known = package_versions()
    for name in _PACKAGES:
        with contextlib.suppress(metadata.PackageNotFoundError):
            known[name] = metadata.version(name)
    lock = Path(files.__file__).parent.resolve().parent.parent / "requirements.lock"
    if lock.is_file():
        known["requirements.lock"] = files.sha256(lock)
    return known


def machine() -> dict[str, Any]:
    """What the scorer ran on: system, kernel, processor and its instruction sets."""
    info = _cpuinfo()
    flags = set(info.get("flags", info.get("Features", "")).split())
    limit = re.search(r"--xla_cpu_max_isa=(\w+)", os.environ.get("XLA_FLAGS", ""))
    kernel = system = f"{platform.system()} {platform.release()}"
    with contextlib.suppress(OSError, KeyError):
        system = platform.freedesktop_os_release()["PRETTY_NAME"]
    return {
        "system": system,
        "kernel": kernel,
        "architecture": platform.machine(),
        "cpu": info.get("model name", platform.processor()),
        "isa": [name for name in _ISA if name in flags],
        "isa_limit": limit[1] if limit else None,
        "cores": os.cpu_count() or 0,
    }


def _cpuinfo() -> dict[str, str]:
    """First processor of /proc/cpuinfo; empty where there is none."""
    path = Path("/proc/cpuinfo")
    fields: dict[str, str] = {}
    if path.is_file():
        for line in path.read_text(errors="replace").splitlines():
            key, _, value = line.partition(":")
            fields.setdefault(key.strip(), value.strip())
    return fields


def trace(replayed: Replayed) -> dict[str, Any]:
    """What the page draws, in whole numbers."""
    return {
        "breath": TRACE_BREATH + 1,
        "pressure_centi_cmH2O": np.round(100.0 * replayed.pressure).astype(int).tolist(),
        "u_in_tenths_percent": np.round(10.0 * replayed.u_in).astype(int).tolist(),
    }


def _plain(values: Floats) -> Any:
    """Nested lists, null for NaN."""
    return files.json_values(values.tolist())


def _failure(score: Score, failure: CellFailure, in_full: bool) -> dict[str, Any]:
    cell = {"lung": failure.lung, "pip": failure.pip, "draw": failure.draw}
    # By its name, wherever its folder was.
    description = failure.message.removeprefix(score.submission.label)
    message = f"{score.submission.manifest.name}{description}"
    texts = {**failure.failure.to_json(), "message": message}
    length = schema.MAX_TEXT if in_full else _SHORT
    cut = {k: v[:length] if isinstance(v, str) else v for k, v in texts.items()}
    return {**cell, **cut}
