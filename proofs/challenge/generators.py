"""The generators of concealed recordings, by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hardware_eval.emulation.cases import EFFECTS, Case
from proofs.challenge.faults import effects as faults
from proofs.challenge.faults import laboratory as bedside
from proofs.challenge.first import plan, rig
from proofs.challenge.questions import DrawnCase
from proofs.challenge.stranger import effects as stranger
from proofs.challenge.stranger import laboratory
from ventbench.base.errors import InputError
from ventbench.recordings.breaths import Breaths


@dataclass(frozen=True)
class Generator:
    """A generator of recordings."""

    name: str  #: name on the command line.
    #: draws cases; see :func:`~proofs.challenge.first.plan.draw`.
    draw: Callable[..., list[DrawnCase]]
    #: records a case; see :func:`~proofs.challenge.first.rig.record`.
    record: Callable[..., Breaths]
    #: responds without noise; see :func:`~proofs.challenge.first.rig.replay`.
    replay: Callable[..., rig.Floats]
    #: where in a recording the effects of a case act, ``(n, T)``, or None if everywhere.
    active: Callable[[Case, Breaths], NDArray[np.bool_] | None] = lambda case, breaths: None
    compared: int = 8  #: most breaths by which it is measured how far an effect can be detected.


FIRST = Generator("first", plan.draw, rig.record, rig.replay)
STRANGER = Generator("stranger", stranger.draw, laboratory.record, laboratory.replay)
FAULTS = Generator(
    "faults", faults.draw, bedside.record, bedside.replay, bedside.active, compared=1000
)
GENERATORS: dict[str, Generator] = {entry.name: entry for entry in (FIRST, STRANGER, FAULTS)}


def generator(name: str) -> Generator:
    """Return a generator by name.

    Raises:
        InputError: if there is none of that name.
    """
    if name not in GENERATORS:
        raise InputError(f"there is no generator {name!r}; choose {', '.join(GENERATORS)}")
    return GENERATORS[name]


def generator_of(case: Case) -> Generator:
    """Return the generator of a case."""
    if isinstance(case, faults.FaultsCase):
        return FAULTS
    return STRANGER if isinstance(case, stranger.StrangerCase) else FIRST


def in_library(case: Case, name: str) -> bool:
    """Whether the library has a mechanism of the name of an effect."""
    if isinstance(case, stranger.StrangerCase):
        return stranger.EFFECTS[name].inside
    return EFFECTS[name].inside
