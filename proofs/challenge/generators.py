"""The generators of concealed recordings, by name."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from hardware_eval.emulation.cases import Case
from proofs.challenge.faults import effects as faults
from proofs.challenge.faults import laboratory as bedside
from proofs.challenge.first import plan, rig
from proofs.challenge.questions import DrawnCase, Kind
from proofs.challenge.stranger import effects as stranger
from proofs.challenge.stranger import laboratory
from ventbench.base.arrays import Bools, Floats
from ventbench.base.errors import InputError
from ventbench.recordings.breaths import Breaths


@dataclass(frozen=True)
class Generator:
    """A generator of recordings."""

    name: str  #: name on the command line.
    #: share of each kind of its cases, that of single effects among them.
    shares: Mapping[Kind, float]
    #: draws cases of a kind; see :func:`~proofs.challenge.first.plan.of_kind`.
    of_kind: Callable[[Any, int, np.random.Generator], Iterator[Case]]
    #: records a case; see :func:`~proofs.challenge.first.rig.record`.
    record: Callable[..., Breaths]
    #: responds without noise; see :func:`~proofs.challenge.first.rig.replay`.
    replay: Callable[..., Floats]
    #: where in a recording the effects of a case act, ``(n, T)``, or None if everywhere.
    active: Callable[[Case, Breaths], Bools | None] = lambda case, breaths: None
    case: type[Case] = Case  #: class of its cases.
    compared: int = 8  #: most breaths by which it is measured how far an effect can be detected.

    def draw(
        self, kind: Kind | Literal["all"], count: int, rng: np.random.Generator
    ) -> list[DrawnCase]:
        """Draw cases of one kind or of all kinds, in random order.

        Raises:
            InputError: if the generator has no such kind, or there are fewer cases than kinds.
        """
        if kind != "all" and kind not in self.shares:
            raise InputError(f"this generator has no kind {kind}; choose {', '.join(self.shares)}")
        if count < (len(self.shares) if kind == "all" else 1):
            raise InputError(f"{count} cases are too few; ask for at least {len(self.shares)}")
        sizes: dict[Any, int] = {kind: count}
        if kind == "all":
            sizes = {each: max(1, int(share * count)) for each, share in self.shares.items()}
            sizes["single"] += count - sum(sizes.values())
        cases = [
            DrawnCase(each, case)
            for each, size in sizes.items()
            for case in self.of_kind(each, size, rng)
        ]
        return [cases[i] for i in rng.permutation(len(cases))]


FIRST = Generator("first", plan.SHARES, plan.of_kind, rig.record, rig.replay)
STRANGER = Generator(
    "stranger",
    stranger.SHARES,
    stranger.of_kind,
    laboratory.record,
    laboratory.replay,
    case=stranger.StrangerCase,
)
FAULTS = Generator(
    "faults",
    faults.SHARES,
    faults.of_kind,
    bedside.record,
    bedside.replay,
    bedside.active,
    faults.FaultsCase,
    1000,
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
    return GENERATORS[getattr(case, "generator", "first")]
