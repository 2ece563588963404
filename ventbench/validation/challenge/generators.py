"""The generators of concealed recordings, by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from ventbench.errors import InputError
from ventbench.recordings.breaths import Breaths
from ventbench.validation.challenge import plan, rig
from ventbench.validation.challenge.cases import EFFECTS, Case, DrawnCase
from ventbench.validation.challenge.stranger import effects as stranger
from ventbench.validation.challenge.stranger import laboratory


@dataclass(frozen=True)
class Generator:
    """A generator of recordings.

    Attributes:
        name: name on the command line.
        draw: draws cases; see :func:`~ventbench.validation.challenge.plan.draw`.
        record: records a case; see :func:`~ventbench.validation.challenge.rig.record`.
        record_commands: records requested breaths; see
            :func:`~ventbench.validation.challenge.rig.record_commands`.
        replay: responds without noise; see :func:`~ventbench.validation.challenge.rig.replay`.
    """

    name: str
    draw: Callable[..., list[DrawnCase]]
    record: Callable[..., Breaths]
    record_commands: Callable[..., Breaths]
    replay: Callable[..., rig.Floats]


FIRST = Generator("first", plan.draw, rig.record, rig.record_commands, rig.replay)
STRANGER = Generator(
    "stranger", stranger.draw, laboratory.record, laboratory.record_commands, laboratory.replay
)
GENERATORS: dict[str, Generator] = {entry.name: entry for entry in (FIRST, STRANGER)}


def generator(name: str) -> Generator:
    """Return a generator by name.

    Raises:
        InputError: if there is none of that name.
    """
    if name not in GENERATORS:
        raise InputError(f"there is no generator {name!r}; choose {' or '.join(GENERATORS)}")
    return GENERATORS[name]


def generator_of(case: Case) -> Generator:
    """Return the generator of a case."""
    return STRANGER if isinstance(case, stranger.StrangerCase) else FIRST


def in_library(case: Case, name: str) -> bool:
    """Whether the library has a mechanism of the name of an effect."""
    if isinstance(case, stranger.StrangerCase):
        return stranger.EFFECTS[name].inside
    return EFFECTS[name].inside
