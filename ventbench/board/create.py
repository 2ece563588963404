"""From a score to a record: replayed first, so that no record can exist that does not replay.

A record also says where it was made.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import platform
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from ventbench.base import files
from ventbench.base.errors import InputError
from ventbench.board import canonical, record, schema, store
from ventbench.board.replay import TOLERANCE, ReplayPlants, figures_of
from ventbench.entries.folder import combined_hash, file_hashes
from ventbench.entries.result import Score, package_versions
from ventbench.entries.runs import DRAWS, CellFailure
from ventbench.task import draws as draw_tables
from ventbench.task import stressors

#: How many failures keep their whole text, and how much of it the others keep, characters.
_IN_FULL, _SHORT = 40, 240

#: Packages besides those of every score.
_PACKAGES = ("flax", "safetensors", "scipy")

#: Instruction sets that decide how matrix products round, as /proc/cpuinfo names them, widest last.
_ISA = ("asimd", "sve", "sve2", "sse4_2", "avx", "avx2", "fma", "avx512f")


@dataclass(frozen=True)
class Draft:
    """A new record and its commands as bytes of files, not yet in any folder."""

    content: bytes
    commands: tuple[bytes, ...]  #: those under missing physics last.

    def save(self, folder: Path) -> Path:
        """Write all files, each named by its hash; return the record's path."""
        for commands in self.commands:
            name = f"{canonical.digest(commands)}{canonical.ACTIONS_SUFFIX}"
            files.write_bytes(folder / name, commands)
        path = folder / f"{canonical.digest(self.content)}{record.SUFFIX}"
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
    stressed = score.stressed
    if stressed is not None and not stressed.complete:
        raise InputError(f"{label}: a record needs all stressors on {DRAWS} draws, or none")
    of_runs = [score.requested] + ([] if stressed is None else [stressed.requested])
    requested = [np.asarray(x) for x in of_runs]
    commands = tuple(map(store.encode, requested))
    described = [store.described(x, y.shape) for x, y in zip(commands, requested, strict=True)]
    stress = None
    if stressed is not None:
        stress = {
            "stressors": stressors.VERSION,
            "commands": described[1],
            "failures": _failures(score, stressed.failures),
        }
    content: dict[str, Any] = {
        "format": schema.FORMAT,
        "kind": "score",
        "protocol": schema.PROTOCOL,
        "created": record.timestamp(now),
        "official": score.official,
        "provenance": dict(source or {}),
        "track": score.track,
        "submission": {
            "sha256": score.submission.sha256,
            "files": hashes,
            "manifest": dataclasses.asdict(score.submission.manifest),
        },
        "simulators": dict(simulators.about()),
        "draws": score.rig_draws.about(),
        "commands": described[0],
        "failures": _failures(score, score.failures),
        "stress": stress,
        "sandbox": None if sandbox is None else dict(sandbox),
        "versions": versions(),
        "machine": machine(),
        "timing": dict(score.timing),
    }
    draft = Draft(canonical.canonical(msgspec.to_builtins(content)), commands)
    parsed = record.from_bytes(draft.content, f"the record of {label}")
    assert isinstance(parsed, record.Record)
    _require_replay(parsed, draft, score, simulators)
    return draft


def _require_replay(
    parsed: record.Record, draft: Draft, score: Score, simulators: ReplayPlants
) -> None:
    """Refuse a record whose commands do not give the errors of the score again."""
    label, header = score.submission.label, parsed.header
    decoded = [
        store.decode(content, commands.shape, label)
        for content, commands in zip(draft.commands, parsed.commands, strict=True)
    ]
    under_stress = decoded[1] if len(decoded) > 1 else None
    figures = figures_of(header, decoded[0], under_stress, score.protocol, simulators)
    if parsed.track == "robustness" and figures.leak:
        raise InputError(f"{label}, key commands: {figures.leak}")
    pairs = [("errors", np.concatenate([score.nominal[None], score.drawn]), figures.error)]
    if score.stressed is not None and figures.stressed is not None:
        pairs.append(("errors under stress", score.stressed.error, figures.stressed.error))
    for quantity, scored, replayed in pairs:
        off = np.abs(scored - replayed)
        if np.any(np.isnan(scored) != np.isnan(replayed)) or np.nanmax(off, initial=0) > TOLERANCE:
            raise InputError(
                f"{label}: the score does not replay: its {quantity} differ by up to "
                f"{np.nanmax(off, initial=0):.1e} cmH2O from those of its commands"
            )


def versions() -> dict[str, str]:
    """Versions of Python and packages, and the hash of the lock file where there is one."""
    installed = package_versions()
    for name in _PACKAGES:
        with contextlib.suppress(metadata.PackageNotFoundError):
            installed[name] = metadata.version(name)
    lock = Path(files.__file__).parent.resolve().parent.parent / "requirements.lock"
    if lock.is_file():
        installed["requirements.lock"] = files.sha256(lock)
    return installed


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


def _failures(score: Score, failures: Sequence[CellFailure]) -> list[dict[str, Any]]:
    """Failures for a record; the first ones with their whole text."""
    recorded = []
    for n, failure in enumerate(failures):
        length = schema.MAX_TEXT if n < _IN_FULL else _SHORT
        # By its name, wherever its folder was.
        description = failure.message.removeprefix(score.submission.label)
        texts = failure.to_json() | {"message": f"{score.submission.manifest.name}{description}"}
        recorded.append({k: v[:length] if isinstance(v, str) else v for k, v in texts.items()})
    return recorded
