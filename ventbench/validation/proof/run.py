"""Running the parts of the proof; what is finished is not done again."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import ventbench
from ventbench import files, recordings
from ventbench.diagnosis import simulators
from ventbench.diagnosis.diagnose import diagnose
from ventbench.diagnosis.residual_analysis import open_loop_error
from ventbench.diagnosis.result import Diagnosis
from ventbench.errors import InputError
from ventbench.recordings.breaths import Breaths
from ventbench.validation.proof import remove
from ventbench.validation.proof.claims import Claim, claims
from ventbench.validation.proof.figures import figures
from ventbench.validation.proof.parts import PARTS, Part, Setting

FORMAT = "ventbench-proof-1"

#: The recordings that it is made with, and what says that a part is finished.
RECORDING, DONE = "pvp_quicklung.csv", "part.json"

#: Writes the files of a diagnosis to a folder, and gives their paths.
Keep = Callable[[Path, Diagnosis], list[Path]]

#: Is told the part, what is done, and which share of the part is behind.
Progress = Callable[[str, str, float], None]


@dataclass(frozen=True, eq=False)
class Proof:
    """What is finished of the proof.

    Attributes:
        sha256: of the recording.
        parts: figures by name.
        impossible: why a part could not be set up, by name.
        claims: that could be judged.
    """

    sha256: str
    parts: dict[str, dict[str, Any]]
    impossible: dict[str, str]
    claims: tuple[Claim, ...]

    @property
    def met(self) -> bool:
        """Whether no claim fails."""
        return all(claim.met for claim in self.claims)

    def as_dict(self) -> dict[str, Any]:
        """JSON values of ``proof.json``."""
        return {
            "recording": {"file": RECORDING, "sha256": self.sha256},
            "unit": "cmH2O",
            "parts": self.parts,
            "impossible": self.impossible,
            "claims": [dataclasses.asdict(claim) for claim in self.claims],
            "met": self.met,
            "format": FORMAT,
            "ventbench": ventbench.__version__,
        }


def prove(
    folder: Path,
    out: Path,
    keep: Keep,
    only: Collection[str] = (),
    progress: Progress | None = None,
) -> Proof:
    """Run the parts that are not finished, and write ``proof.json`` of all that are.

    A part is done again if the recording, the code of its setting or the part that it starts from
    has changed; not if the diagnosis has: remove its folder then.

    Args:
        folder: of the public recordings.
        out: where to write, a folder a part.
        keep: see :data:`Keep`.
        only: names of parts; all if there is none.
        progress: see :data:`Progress`.

    Raises:
        InputError: if there is no such recording or part, or what a part starts from is missing.
    """
    if unknown := sorted(set(only) - set(PARTS)):
        raise InputError(f"no part {unknown[0]!r} in the proof; choose of {', '.join(PARTS)}")
    breaths = recordings.load(folder / RECORDING)
    sha256 = breaths.sha256 or ""
    parts: dict[str, dict[str, Any]] = {}
    impossible: dict[str, str] = {}
    for part in PARTS.values():
        asked = not only or part.name in only
        if part.needs is not None and part.needs not in parts:
            if asked:
                raise InputError(
                    f"{part.name} starts from the part {part.needs}, which is not in {out}; "
                    "leave --only out, or name both"
                )
            continue
        chosen = breaths.select(np.isin(breaths.lung_ids, part.lungs))
        setting = part.set_up(chosen, out)
        if isinstance(setting, str):
            impossible[part.name] = setting
            continue
        key = {"recording_sha256": sha256, "lungs": list(part.lungs), "about": setting.about}
        if asked and _finished(out / part.name, key) is None:
            _run(part, setting, key, out / part.name, keep, progress)
        if made := _finished(out / part.name, key):
            plain = json.loads((out / part.name / "diagnosis.json").read_text("utf-8"))
            parts[part.name] = figures(plain, made)
    found = Proof(sha256, parts, impossible, tuple(claims(parts, impossible)))
    files.write_json(out / "proof.json", found.as_dict())
    return found


def _run(
    part: Part, setting: Setting, key: dict[str, Any], out: Path, keep: Keep,
    progress: Progress | None,
) -> None:  # fmt: skip
    def tell(what: str, share: float) -> None:
        if progress is not None:
            progress(part.name, what, share)

    # The PVP breathed for a test lung.
    found = diagnose(setting.breaths, plant=setting.plant, passive=True, progress=tell)
    found = dataclasses.replace(found, simulator=setting.called)
    out.mkdir(parents=True, exist_ok=True)
    (out / DONE).unlink(missing_ok=True)
    written = keep(out, found)
    files.write_json(
        out / DONE,
        {
            "key": key,
            "title": part.title,
            "breaths": len(setting.breaths),
            "wanted": setting.wanted,
            "mae_by_names_alone": _by_names_alone(found),
            "files": [path.name for path in written],
        },
    )


def _finished(folder: Path, key: dict[str, Any]) -> dict[str, Any] | None:
    """What ``part.json`` says, if it is of this setting and all files are there."""
    try:
        made = json.loads((folder / DONE).read_text("utf-8"))
    except (OSError, ValueError):
        return None
    whole = made.get("key") == key and all((folder / name).is_file() for name in made["files"])
    return made if whole else None


def _by_names_alone(found: Diagnosis) -> float | None:
    """Held-out MAE of the corrected simulator without what has no name, cmH2O."""
    if not any(remove.has_unnamed(plant) for plant in found.plants.values()):
        error = found.open_loop.after.mae
    else:
        held: Breaths = found.traces.breaths.select(found.traces.held_out)
        plants = {name: remove.by_names_alone(plant) for name, plant in found.plants.items()}
        inspiration = held.inspiratory & (held.time > 0)
        error = open_loop_error(held.pressure, simulators.answers(plants, held), inspiration).mae
    return float(error) if np.isfinite(error) else None
