"""A lung with concealed physics: drawn from any words, sealed before anybody measures.

The words determine one strong effect of the library, its strength and its lung. The
lung is the frozen simulator plus what that physics adds to it. The answer is published encrypted,
with its hash, when the lung is made; the words open it.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from hardware_eval.emulation.cases import (
    LIBRARY,
    Effect,
    commitment,
    draw_case,
    draw_effect,
    draw_grid,
    encrypt,
    random_generator,
    unseal,
)
from ventbench.base import files
from ventbench.base.errors import InputError
from ventbench.physics.model import physics
from ventbench.plants.catalog import load_simulators
from ventbench.plants.corrected import Corrected
from ventbench.task.interfaces import Plant
from ventbench.task.lungs import Lung, lung

_FORMAT = "ventbench-concealed-1"

#: Never concealed: a test lung has no patient, the drift of a sensor over a recording needs to know
#: how long that will be, and the other two hardly matter to a controller.
_LEFT_OUT = ("patient_effort", "sensor_drift", "command_rounding", "inertance")

#: Cases from which the words choose: each mechanism of the library about four times.
_CASES = 68


@dataclass(frozen=True, eq=False)
class ConcealedLung:
    """A lung whose physics nobody has been told."""

    lung: Lung  #: its label, which is public.
    plant: Plant  #: simulator with the concealed physics.
    seal: dict[str, str]  #: JSON values to publish: lung, commitment, and the encrypted answer.

    def write(self, path: Path) -> None:
        """Write the seal to a JSON file."""
        files.write_json(path, self.seal)


def conceal(words: str, simulator: Any = "frozen") -> ConcealedLung:
    """Make the lung that any words determine: the same words make the same lung.

    The physics is added to a simulator: whatever :func:`ventbench.load_simulators` takes.

    Raises:
        InputError: if there are no words.
    """
    if not words.strip():
        raise InputError("--conceal: give some words; they determine the lung and open the seal")
    effect, label = _draw(words)
    without = physics(label)
    named = {effect.name: effect.parameters}
    plant = Corrected(load_simulators(simulator).plant(label.id), physics(label, named), without)
    answer = {
        "format": _FORMAT,
        "lung": label.id,
        "effect": asdict(effect),
        "nonce": random_generator(words, "emulator", "nonce").bytes(32).hex(),
    }
    text = json.dumps(answer, indent=1).encode()
    public = label.id.encode()
    seal = {
        "format": _FORMAT,
        "lung": label.id,
        "commitment": commitment(text),
        "sealed": encrypt(text, words, public).hex(),
    }
    return ConcealedLung(label, plant, seal)


def reveal(path: Path, words: str) -> tuple[Lung, Effect]:
    """Open a seal that :meth:`ConcealedLung.write` wrote: the lung's label and what it concealed.

    Raises:
        InputError: if the file is no seal, or the words are others.
    """
    try:
        seal = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path} cannot be read: {error}") from error
    if not isinstance(seal, dict) or seal.get("format") != _FORMAT:
        raise InputError(f"{path} is no seal of a concealed lung")
    text = unseal(
        bytes.fromhex(seal["sealed"]), words, str(seal["lung"]).encode(), seal["commitment"]
    )
    answer = json.loads(text)
    return lung(answer["lung"]), Effect(**answer["effect"])


def _draw(words: str) -> tuple[Effect, Lung]:
    """One strong effect, and its lung."""
    rng = random_generator(words, "emulator")
    drawn = [
        draw_case(lung, (draw_effect(name, strength, rng, form),), rng)
        for name, strength, lung, form in draw_grid(LIBRARY, _CASES, rng, other=False)
    ]
    strong = [
        case
        for case in (drawn[i] for i in rng.permutation(_CASES))
        if case.effects[0].strength == "strong" and case.effects[0].name not in _LEFT_OUT
    ]
    case = strong[int(rng.integers(len(strong)))]
    return case.effects[0], Lung(case.lung_R, case.lung_C)
