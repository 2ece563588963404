"""Deviations of the ventilator and the lung in protocol version 2: every draw is on some rig.

One draw gives each lung one of its rigs and one member of the ensemble, and each PIP of it the
deviations of version 1 (:mod:`ventbench.draws`), drawn anew for every lung. All numbers follow from
a seed of 32 bytes by :func:`ventbench.seasons.uniforms`: the development draws from a published
one, the draws of a season from its secret one.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import Any, TypeVar

import jax
import numpy as np
from numpy.typing import NDArray

from ventbench import draws, precision, protocol
from ventbench.environment import Scenario, nominal_scenario
from ventbench.errors import InputError
from ventbench.seasons import DEVELOPMENT_SEED, commitment, uniforms

#: Version of these draws, and how many a score has.
VERSION = 2
COUNT = 20

#: Name of the season of the development draws.
DEVELOPMENT = "development"

#: Ranges of the deviations, uniform. A uniform range reaches sqrt(3) standard deviations to each
#: side of its middle. They were measured between the label-true rigs of one lung on the first set
#: of simulators of version 2: resistance at 0.5 L/s 11 %, compliance 8 %, control interval 3.7 %,
#: dead time and lag of the valve 4.6 ms. The fitted simulators have 5.3 %, 3.6 % and, for dead time
#: and lag, 1.6 ms. A fit shrinks rigs of few breaths towards their lung, so the true spread is
#: larger than that; the wider ranges stay. The others are those of version 1.
RANGES = draws.RANGES | {
    "dt_scale": (0.936, 1.064),
    "r_scale": (0.81, 1.19),
    "c_scale": (0.86, 1.14),
    "delay": (0.0, 0.53),
}

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
PlantT = TypeVar("PlantT")


@dataclass(frozen=True, eq=False)
class RigDraws:
    """Cells of L lungs, n draws and P PIPs, and the plant of each.

    Attributes:
        season: id of the season, ``"development"`` for the published draws.
        commitment: of the seed, 64 hexadecimal digits.
        cells: batch shape ``(L, n, P)``, float64 numpy leaves.
        rig: session of each lung in each draw, shape ``(L, n)``.
        member: member of the ensemble, shape ``(L, n)``.
    """

    season: str
    commitment: str
    cells: Scenario
    rig: Ints
    member: Ints

    @property
    def count(self) -> int:
        """Number of draws."""
        return self.rig.shape[1]

    def first(self, n: int) -> RigDraws:
        """Return the first n draws.

        Raises:
            InputError: if there are not so many.
        """
        if not 1 <= n <= self.count:
            raise InputError(
                f"season {self.season} has {self.count} draws; {n} is outside 1..{self.count}"
            )
        cells = jax.tree.map(lambda x: x[:, :n], self.cells)
        return dataclasses.replace(
            self, cells=cells, rig=self.rig[:, :n], member=self.member[:, :n]
        )

    def about(self) -> dict[str, Any]:
        """Version, season, commitment and number of the draws, for records."""
        return {
            "version": VERSION,
            "sha256": self.commitment,
            "count": self.count,
            "season": self.season,
        }


def build(
    rigs: Sequence[Sequence[int]],
    members: int,
    *,
    seed: bytes = DEVELOPMENT_SEED,
    season: str = DEVELOPMENT,
    n: int = COUNT,
    pips: Sequence[float] = protocol.PIPS,
) -> RigDraws:
    """Make the draws of a seed; the result is the same everywhere.

    The rigs of a lung are drawn equally often, up to one, and so are the members. The rounding to 4
    decimals removes what differs between mathematical libraries.

    Args:
        rigs: sessions of each lung that may be drawn; L of them.
        members: number of members of the ensemble.
        seed: 32 bytes.
        season: id of the season that the seed belongs to.
        n: number of draws.
        pips: nominal PIPs, cmH2O, each one of the protocol's; length P.

    Raises:
        InputError: if ``n`` is not positive, a PIP is not one of the protocol's, a lung has no rig,
            or the seed does not have 32 bytes.
    """
    if n < 1:
        raise InputError(f"{n} draws: there must be at least one")
    unknown = [pip for pip in pips if pip not in protocol.PIPS]
    if unknown:
        raise InputError(
            f"no draws for PIP {unknown[0]:g} cmH2O; they exist for "
            f"{', '.join(f'{pip:g}' for pip in protocol.PIPS)}"
        )
    if not all(rigs):
        raise InputError("a lung has no rig to draw; every lung needs at least one")
    cells = (len(rigs), n, len(protocol.PIPS))

    def uniform(name: str, shape: tuple[int, ...]) -> Floats:
        return uniforms(seed, f"draws {VERSION}, {name}", shape)

    drawn = {
        name: low + (high - low) * uniform(name, cells) for name, (low, high) in RANGES.items()
    }
    low, high = draws.NOISE_SD
    sd = low + (high - low) * uniform("noise_sd", cells)
    normal = np.vectorize(NormalDist().inv_cdf, otypes=[float])
    steps = (protocol.BREATHS, protocol.INSPIRATION_STEPS)
    drawn["noise"] = sd[..., None, None] * normal(uniform("noise", (*cells, *steps)))
    columns = [protocol.PIPS.index(pip) for pip in pips]
    drawn = {name: np.round(values[:, :, columns], 4) for name, values in drawn.items()}
    pip = np.broadcast_to(np.asarray(pips, float), drawn["pip_shift"].shape)
    noise = drawn.pop("noise")
    quantum = np.full(pip.shape, draws.QUANTUM)
    places = [_balanced(uniform(f"rig {k}", (n + 1,)), len(own)) for k, own in enumerate(rigs)]
    turns = [_balanced(uniform(f"member {k}", (n + 1,)), members) for k in range(len(rigs))]
    return RigDraws(
        season=season,
        commitment=commitment(seed),
        cells=draws.deviate(pip, drawn, quantum, noise),
        rig=np.array([np.array(own)[at] for own, at in zip(rigs, places, strict=True)]),
        member=np.array(turns),
    )


def _balanced(numbers: Floats, choices: int) -> Ints:
    """Deal choices to draws equally often, up to one, in random order.

    Args:
        numbers: uniform; the first says which choice is dealt first.
        choices: how many there are.

    Returns:
        ``0..choices - 1``, shape of ``numbers`` but for the first.
    """
    order = np.argsort(np.argsort(numbers[1:], kind="stable"), kind="stable")
    return (order + int(numbers[0] * choices)) % choices


def with_nominal(
    drawn: RigDraws | None, reference: Sequence[int], pips: Sequence[float]
) -> tuple[Scenario, Ints, Ints]:
    """Nominal cells of the reference rigs in front of the draws.

    Args:
        drawn: n draws of L lungs; None for none.
        reference: session of each lung's reference rig, length L; its member is 0.
        pips: cmH2O, length P.

    Returns:
        Cells of batch shape ``(L, 1 + n, P)`` with numpy leaves, and the session and the member of
        each lung, both of shape ``(L, 1 + n)``.
    """
    count = len(reference)
    with precision.float64():
        cells = jax.tree.map(np.asarray, nominal_scenario(np.asarray(pips, float)))
    nominal = jax.tree.map(lambda x: np.broadcast_to(x, (count, 1, *x.shape)), cells)
    rig, member = np.asarray(reference)[:, None], np.zeros((count, 1), np.int64)
    if drawn is None:
        return nominal, rig, member
    cells = jax.tree.map(lambda *x: np.concatenate(x, axis=1), nominal, drawn.cells)
    return cells, np.hstack([rig, drawn.rig]), np.hstack([member, drawn.member])


def plants_of(plants: PlantT, rig: Ints, member: Ints) -> PlantT:
    """Plants of cells.

    Args:
        plants: of every member and session, leaves ``(members, sessions, ...)``.
        rig: sessions, shape ``(L, n)``.
        member: members, shape ``(L, n)``.

    Returns:
        Leaves ``(L, n, 1, ...)``, float64: the axis of length 1 stands for the PIPs.
    """
    return jax.tree.map(
        lambda leaf: np.asarray(leaf)[member, rig][:, :, None].astype(np.float64), plants
    )
