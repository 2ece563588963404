"""Rigs of lungs: the plants that draws are on, and where each cell of a score runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import jax
import numpy as np

from ventbench.plants import frozen
from ventbench.plants.catalog import SimulatorLike, load_simulators
from ventbench.plants.hybrid import RigPopulation
from ventbench.task import draws as draw_tables
from ventbench.task import protocol
from ventbench.task.draws import Draws
from ventbench.task.environment import Scenario
from ventbench.task.interfaces import Plant
from ventbench.task.lungs import LUNGS, Lung


@dataclass(frozen=True, eq=False)
class Rigs:
    """Plants of L lungs, each on one or several rigs; make one with a function of this module."""

    lungs: tuple[Lung, ...]  #: L of them.
    #: leaves ``(members, sessions, ...)`` where :attr:`sessions` says which are scored; leaves
    #: ``(L, ...)`` where each lung has one rig only.
    plants: Plant
    #: scored sessions of each lung, the reference rig first; None for one rig each.
    sessions: tuple[tuple[int, ...], ...] | None = None
    about: Mapping[str, Any] = field(default_factory=dict)  #: version and hashes, for the result.
    sha256: str | None = None  #: of the manifest of the frozen simulators; None for others.
    #: for each lung the scored sessions that no entry may be trained on.
    held_out: tuple[tuple[int, ...], ...] = ()
    population: RigPopulation | None = None  #: that further rigs are drawn from; None for none.

    @property
    def members(self) -> int:
        """Number of members of the ensemble."""
        return 1 if self.sessions is None else jax.tree.leaves(self.plants)[0].shape[0]

    def draws(
        self,
        n: int,
        pips: Sequence[float] = protocol.PIPS,
        *,
        seed: bytes = draw_tables.DEVELOPMENT_SEED,
        name: str = draw_tables.DEVELOPMENT,
    ) -> Draws:
        """Return the first n draws of a seed on these rigs at some of the protocol's PIPs.

        Raises:
            InputError: if there are not so many, a PIP is not one of the protocol's, or the seed
                does not have 32 bytes.
        """
        sessions = self.sessions or tuple((0,) for _ in self.lungs)
        of_round: dict[str, Any] = {}
        if seed != draw_tables.DEVELOPMENT_SEED and self.population is not None:
            by_lung = [
                self.population.rigs(seed, lung, draw_tables.COUNT) for lung in range(len(sessions))
            ]
            sampled_rigs = jax.tree.map(lambda *leaves: np.stack(leaves), *by_lung)
            of_round = {"held_out": self.held_out, "sampled_rigs": sampled_rigs}
        return draw_tables.build(
            sessions, self.members, seed=seed, name=name, pips=pips, **of_round
        ).first(n)

    @property
    def of_training(self) -> Rigs:
        """The same without what is held out: what a controller may be tuned on."""
        if self.sessions is None or not self.held_out:
            return self
        pairs = zip(self.sessions, self.held_out, strict=True)
        sessions = tuple(
            tuple(rig for rig in scored if rig not in apart) for scored, apart in pairs
        )
        return replace(self, sessions=sessions, held_out=(), population=None)

    def plants_of(self, draws: Draws) -> Plant:
        """Plants of draws, leaves ``(L, n, 1, ...)``, or ``(L, ...)`` with one rig a lung."""
        if self.sessions is None:
            return self.plants
        return draw_tables.plants_of(self.plants, draws.rig, draws.member, draws.sampled_rigs)

    def cells(self, draws: Draws | None, pips: Sequence[float]) -> tuple[Plant, Scenario]:
        """Nominal cells in front of K draws, and their plants, at P PIPs, cmH2O.

        Plants have leaves ``(L, 1 + K, 1, ...)``, or ``(L, ...)`` where each lung has one rig;
        cells the batch shape ``(L, 1 + K, P)``.
        """
        reference = (
            [scored[0] for scored in self.sessions] if self.sessions else [0] * len(self.lungs)
        )
        cells, rig, member = draw_tables.with_nominal(draws, reference, pips)
        if self.sessions is None:
            return self.plants, cells
        sampled_rigs = None if draws is None else draws.sampled_rigs
        return draw_tables.plants_of(self.plants, rig, member, sampled_rigs), cells


def load_rigs(simulator: SimulatorLike = "frozen") -> Rigs:
    """Load the official rigs, or of other simulators one rig a lung.

    Raises:
        InputError: if there are no such simulators, or they have no plants.
    """
    if isinstance(simulator, str) and simulator == "frozen":
        return rigs_of(frozen.load())
    simulators = load_simulators(simulator)
    return Rigs(simulators.lungs, simulators.stacked, about=simulators.about)


def rigs_of(official: Any) -> Rigs:
    """Rigs of a set of simulators, such as :func:`ventbench.plants.frozen.load` returns."""
    return Rigs(
        LUNGS,
        official.sessions_plants,
        official.rigs,
        official.about(),
        official.manifest_sha256,
        official.held_out_rigs,
        official.population,
    )
