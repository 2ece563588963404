"""The proof on real recordings: what physics models of a ventilator lack on the real rig.

Each part is a diagnosis in a folder of its own. Finished parts are not run again.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import ventbench
from proofs import code_version
from proofs.real.parts import PARTS, Part, Setting, by_names_alone
from ventbench import recordings
from ventbench.base import files
from ventbench.base.errors import InputError
from ventbench.diagnosis.corrected import open_loop_error
from ventbench.diagnosis.diagnose import diagnose
from ventbench.diagnosis.result import Diagnosis
from ventbench.plants.catalog import load_simulators
from ventbench.recordings.breaths import Breaths

FORMAT = "ventbench-proof-1"

#: File of recordings on which the proof rests.
RECORDING = "pvp_quicklung.csv"

#: File whose presence marks a part as finished.
DONE = "part.json"

#: Least cut of the error by named physics alone, %.
CUT = 70.0

#: Called with the part, its current step, and the finished share of the part.
Progress = Callable[[str, str, float], None]


@dataclass(frozen=True)
class Claim:
    """One claim of the proof."""

    part: str  #: part whose figures the claim is about.
    what: str  #: the claim.
    value: str  #: the outcome, in words.
    met: bool  #: whether the claim holds.


@dataclass(frozen=True, eq=False)
class Proof:
    """The finished parts of the proof."""

    sha256: str  #: SHA-256 of the recording.
    parts: dict[str, dict[str, Any]]  #: figures by name.
    impossible: dict[str, str]  #: why a part could not be set up, by name.
    claims: tuple[Claim, ...]  #: about the finished parts.

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
    folder: Path, out: Path, only: Collection[str] = (), progress: Progress = lambda *_: None
) -> Proof:
    """Run the parts that are not finished, and write ``proof.json`` of all that are.

    A part runs again if the recording, its setting or the part that it starts from has changed, but
    not if the diagnosis has: remove the part's folder then.

    Args:
        folder: folder of the public recordings.
        out: folder to write to, a folder for each part.
        only: names of parts; all parts if empty.
        progress: see :data:`Progress`.

    Raises:
        InputError: if there is no such recording or part, or the part that another one starts from
            is missing.
    """
    if unknown := sorted(set(only) - set(PARTS)):
        raise InputError(f"no part {unknown[0]!r} in the proof; choose of {', '.join(PARTS)}")
    breaths = recordings.load(folder / RECORDING)
    sha256 = breaths.sha256 or ""
    parts: dict[str, dict[str, Any]] = {}
    impossible: dict[str, str] = {}
    for part in PARTS.values():
        selected = not only or part.name in only
        if part.needs is not None and part.needs not in parts:
            if selected:
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
        if selected and _finished(out / part.name, key) is None:
            _run(part, setting, key, out / part.name, progress)
        if summary := _finished(out / part.name, key):
            diagnosis = json.loads((out / part.name / "diagnosis.json").read_text("utf-8"))
            parts[part.name] = figures(diagnosis, summary)
    proof = Proof(sha256, parts, impossible, tuple(claims(parts, impossible)))
    files.write_json(out / "proof.json", proof.as_dict())
    return proof


def _run(part: Part, setting: Setting, key: dict[str, Any], out: Path, progress: Progress) -> None:
    diagnosis = diagnose(
        setting.breaths,
        simulator=setting.plant,
        progress=partial(progress, part.name),
        patient=False,  # the ventilator was connected to a test lung
    )
    diagnosis = dataclasses.replace(diagnosis, simulator=setting.plant_name)
    out.mkdir(parents=True, exist_ok=True)
    (out / DONE).unlink(missing_ok=True)
    written = diagnosis.save(out)
    files.write_json(
        out / DONE,
        {
            "key": key,
            "wanted": setting.wanted,
            "code": code_version(),
            "mae_by_names_alone": _mae_by_names_alone(diagnosis),
            "files": [path.name for path in written],
        },
    )


def _finished(folder: Path, key: dict[str, Any]) -> dict[str, Any] | None:
    """Content of ``part.json`` if the part has this setting and all its files; else None."""
    try:
        summary = json.loads((folder / DONE).read_text("utf-8"))
    except (OSError, ValueError):
        return None
    complete = all((folder / name).is_file() for name in summary["files"])
    return summary if summary.get("key") == key and complete else None


def _mae_by_names_alone(diagnosis: Diagnosis) -> float | None:
    """Held-out MAE of the corrected simulator without nonparametric components, cmH2O."""
    plants = {lung: by_names_alone(plant) for lung, plant in diagnosis.plants.items()}
    if all(plants[lung] is plant for lung, plant in diagnosis.plants.items()):
        error = diagnosis.open_loop.after.mae
    else:
        held_out: Breaths = diagnosis.traces.breaths.select(diagnosis.traces.held_out)
        inspiration = held_out.inspiratory & (held_out.time > 0)
        simulated = load_simulators(plants).pressures(held_out)
        error = open_loop_error(held_out.pressure, simulated, inspiration).mae
    return float(error) if np.isfinite(error) else None


def figures(diagnosis: Mapping[str, Any], summary: Mapping[str, Any]) -> dict[str, Any]:
    """JSON values of a finished part; errors in cmH2O, on breaths that no fit has seen.

    The part's ``diagnosis.json`` has everything else.

    Args:
        diagnosis: content of its ``diagnosis.json``.
        summary: content of its ``part.json``.
    """
    loop = diagnosis["open_loop"]
    mechanisms = diagnosis["mechanisms"]
    named_alone = summary["mae_by_names_alone"] if mechanisms else None
    return {
        "held_out": len(loop["held_out_breaths"]),
        "mae": {name: loop[name]["mae"] for name in ("before", "refit", "after")},
        "mae_by_names_alone": summary["mae_by_names_alone"],
        "cut_percent": cut(loop["before"]["mae"], named_alone),
        "groups": loop["groups"],
        "mechanisms": mechanisms,
        "slot": diagnosis["slot"],
        "wanted": summary["wanted"],
        "about": summary["key"]["about"],
        "code": summary.get("code"),
    }


def cut(before: float | None, after: float | None) -> float | None:
    """Relative decrease of an error, %; None if one of the errors is unknown."""
    return None if not before or after is None else 100.0 * (1.0 - after / before)


def named(mechanisms: list[dict[str, Any]], name: str) -> dict[str, Any] | None:
    """The mechanism of this name among the named ones, or None."""
    return next((mechanism for mechanism in mechanisms if mechanism["name"] == name), None)


def claims(parts: Mapping[str, Mapping[str, Any]], impossible: Mapping[str, str]) -> list[Claim]:
    """Judge the claims about the parts that are finished or impossible.

    Args:
        parts: figures by name.
        impossible: why a part could not be set up, by name.
    """
    judged = []
    if "rc" in parts:
        percent = parts["rc"]["cut_percent"]
        value = "not known" if percent is None else f"{percent:.0f} %"
        what = f"held-out error cut by at least {CUT:g} % by named physics alone"
        judged.append(Claim("rc", what, value, percent is not None and percent >= CUT))
        by_lung = {
            name: error
            for name, error in parts["rc"].get("groups", {}).items()
            if name.startswith("lung ")
        }
        if by_lung:
            worse = [n for n, e in by_lung.items() if e["after"]["mae"] > e["refit"]["mae"]]
            value = f"worse: {', '.join(worse)}" if worse else f"{len(by_lung)} lungs"
            judged.append(Claim("rc", "no lung is worse than refitted", value, not worse))
    for name in ("removed", "injected"):
        if name in parts:
            judged.append(_wanted_is_named(name, parts))
        elif name in impossible:
            judged.append(Claim(name, "what was removed is named again", impossible[name], False))
    return judged


def _wanted_is_named(name: str, parts: Mapping[str, Mapping[str, Any]]) -> Claim:
    part = parts[name]
    wanted = part["wanted"]
    mechanism = named(part["mechanisms"], wanted)
    missed = f"not named; named: {_names(part['mechanisms'])}"
    value = _in_words(mechanism) if mechanism else missed
    if name == "injected" and "frozen" in parts:
        # What the same simulators lack on the same breaths before anything was injected.
        control = named(parts["frozen"]["mechanisms"], wanted)
        value += f"; without injection {_in_words(control) if control else 'not named'}"
    return Claim(name, f"{wanted} is named", value, mechanism is not None)


def _in_words(mechanism: Mapping[str, Any]) -> str:
    estimates = []
    for name, estimate in mechanism["parameters"].items():
        unit = "" if estimate["unit"] == "1" else f" {estimate['unit']}"
        low, high = estimate["ci95"]
        estimates.append(f"{name} {estimate['value']:.3g}{unit} [{low:.3g}, {high:.3g}]")
    return (", ".join(estimates) or "named") + _alternatives(mechanism)


def _names(mechanisms: list[dict[str, Any]]) -> str:
    return ", ".join(f"{m['name']}{_alternatives(m)}" for m in mechanisms) or "nothing"


def _alternatives(mechanism: Mapping[str, Any]) -> str:
    """Names that the recording cannot tell from this one."""
    return f" (or {', '.join(mechanism['alternatives'])})" if mechanism["alternatives"] else ""
