"""Draws of a score: rigs, and how the ventilator, the sensor and each breath deviate from nominal.

One draw puts each lung on a rig, and gives each PIP of it sensor noise and converter, pressure at
the start of the inspiration, control step, PIP and PEEP. All numbers follow from a seed of 32 bytes
by :func:`uniforms`. Training draws anew with JAX keys.

**Practice.** The development draws, from a published seed, are on all rigs of a lung. R, C and dead
time deviate.

**Rounds.** Of four draws two are on rigs that are drawn anew from the population of a lung's rigs,
one is on a rig that was held out of every training, and one on a rig of the training, to compare.
The first three are ranked: they are on rigs that nobody trained on. The gain of the valve scatters
from breath to breath.
"""

from __future__ import annotations

import hashlib
import hmac
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from statistics import NormalDist
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ventbench.base import compilation
from ventbench.base.arrays import Bools, Floats, Ints
from ventbench.base.errors import InputError
from ventbench.task import protocol
from ventbench.task.environment import Scenario, nominal_scenario
from ventbench.task.interfaces import Plant

#: How many draws a ranked score has.
COUNT = 20

#: Bytes of a seed: as many as the hash has, so that guessing is hopeless.
SEED_BYTES = 32

#: Seed of the development draws. It is published, so nobody can have chosen it: a hash of its name.
DEVELOPMENT_SEED = hashlib.sha256(b"ventbench development draws").digest()

#: Name of the draws of :data:`DEVELOPMENT_SEED`.
DEVELOPMENT = "development"

#: Step of the pressure sensor's converter, cmH2O (PVP).
QUANTUM = 0.0703

#: Standard deviation of the sensor's noise, cmH2O: uniform in this range for each run (recordings).
NOISE_SD = (0.20, 0.25)

#: Every other deviation is uniform in its range: shifts in cmH2O, scales as true over nominal, the
#: delay as a share of one step. A uniform range reaches sqrt(3) standard deviations to each side of
#: its middle. Those of R, C, delay and step were measured between the label-true rigs of one
#: lung: resistance at 0.5 L/s 11 %, compliance 8 %, control interval 3.7 %, dead time and lag of
#: the valve 4.6 ms. The fitted simulators have 5.3 %, 3.6 % and, for dead time and lag, 1.6 ms. A
#: fit shrinks rigs of few breaths towards their lung: the true spread is larger than that.
RANGES = {
    "pip_shift": (-1.0, 1.0),
    "peep_shift": (-0.5, 0.5),
    "start_shift": (-0.5, 0.5),
    "dt_scale": (0.936, 1.064),
    "r_scale": (0.81, 1.19),
    "c_scale": (0.86, 1.14),
    "delay": (0.0, 0.53),
}

#: Which of them rigs differ by. Rigs that are drawn from a population have no further ones.
OF_RIGS = ("r_scale", "c_scale", "delay")

#: Logarithm of the gain of the valve in a breath around its rig's, at every twentieth of the
#: probability from 0 to 1: quantiles of the measured breaths of the scored rigs, which the manifest
#: of the simulators holds too. Between neighbouring breaths no correlation was found.
GAIN_QUANTILES = (
    -0.41,
    -0.294,
    -0.152,
    -0.093,
    -0.081,
    -0.046,
    -0.033,
    -0.02,
    -0.011,
    -0.001,
    0.0,
    0.001,
    0.011,
    0.021,
    0.033,
    0.039,
    0.051,
    0.081,
    0.093,
    0.122,
    0.247,
)

#: What kind of rig a draw is on.
TRAINING, HELD_OUT, DRAWN = 0, 1, 2

#: Kinds of rigs of draws, in turn.
PATTERN = (DRAWN, HELD_OUT, DRAWN, TRAINING)

#: Number of the first rig that is drawn anew; sessions have lower ones.
FIRST_DRAWN = 1000

# They stand before what is hashed, so that no hash of one use is also one of another use.
_STREAM = b"ventbench uniforms 1\n"
_COMMITMENT = b"ventbench season 1\n"

# It is part of the labels of the streams and of what records say of draws.
_FORMAT = 2

PlantT = TypeVar("PlantT")


@dataclass(frozen=True, eq=False)
class Draws:
    """Cells of L lungs, n draws and P PIPs, and the plant of each."""

    name: str  #: ``"development"`` for the published draws.
    commitment: str  #: of the seed, 64 hexadecimal digits.
    cells: Scenario  #: batch shape ``(L, n, P)``, float64 numpy leaves.
    #: session of each lung in each draw, or :data:`FIRST_DRAWN` and more for a rig that is drawn
    #: anew, shape ``(L, n)``.
    rig: Ints
    member: Ints  #: member of the ensemble, 0 for a drawn rig, shape ``(L, n)``.
    ranked: Bools  #: whether a draw is meant for rigs that nobody trained on, shape ``(n,)``.
    #: rigs that are drawn anew, leaves ``(L, n, ...)``; None where there are none.
    sampled_rigs: Plant | None = None

    @property
    def count(self) -> int:
        """Number of draws."""
        return self.rig.shape[1]

    def first(self, n: int) -> Draws:
        """Return the first n draws.

        Raises:
            InputError: if there are not so many.
        """
        if not 1 <= n <= self.count:
            raise InputError(
                f"there are {self.count} {self.name} draws; {n} is outside 1..{self.count}"
            )
        return self.only(np.arange(n))

    def only(self, at: Ints) -> Draws:
        """Return some draws."""
        parts = (self.cells, self.rig, self.member, self.sampled_rigs)
        cells, rig, member, sampled_rigs = jax.tree.map(lambda x: x[:, at], parts)
        return Draws(self.name, self.commitment, cells, rig, member, self.ranked[at], sampled_rigs)

    def about(self) -> dict[str, Any]:
        """Commitment, number and name of the draws, with the keys that records have."""
        return {
            "version": _FORMAT,
            "sha256": self.commitment,
            "count": self.count,
            "season": self.name,
        }


def build(
    rigs: Sequence[Sequence[int]],
    members: int,
    *,
    held_out: Sequence[Sequence[int]] = (),
    sampled_rigs: Plant | None = None,
    seed: bytes = DEVELOPMENT_SEED,
    name: str = DEVELOPMENT,
    n: int = COUNT,
    pips: Sequence[float] = protocol.PIPS,
) -> Draws:
    """Make the draws of a seed; the result is the same everywhere.

    The rigs of a lung of one kind are drawn equally often, up to one, and so are the members. The
    rounding to 4 decimals removes what differs between mathematical libraries.

    Args:
        rigs: sessions of each lung that may be drawn; L of them.
        members: number of members of the ensemble.
        held_out: those of them on which nothing was trained; L of them, or nothing.
        sampled_rigs: a rig of each lung and draw from the population, leaves ``(L, n, ...)``. If
            there are none, the rigs themselves deviate (:data:`OF_RIGS`), and no gain does.
        seed: 32 bytes.
        name: of the draws.
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

    def uniform(label: str, shape: tuple[int, ...]) -> Floats:
        return uniforms(seed, f"draws {_FORMAT}, {label}", shape)

    values = {
        name: low + (high - low) * uniform(name, cells) for name, (low, high) in RANGES.items()
    }
    gain = np.ones((*cells, protocol.BREATHS))
    if sampled_rigs is not None:
        values |= {name: np.full(cells, _nominal(name)) for name in OF_RIGS}
        gain = np.exp(_log_gain(uniform("gain", gain.shape), np))
    low, high = NOISE_SD
    sd = low + (high - low) * uniform("noise_sd", cells)
    normal = np.vectorize(NormalDist().inv_cdf, otypes=[float])
    steps = (protocol.BREATHS, protocol.INSPIRATION_STEPS)
    values["noise"] = sd[..., None, None] * normal(uniform("noise", (*cells, *steps)))
    values["gain"] = gain
    columns = [protocol.PIPS.index(pip) for pip in pips]
    values = {name: np.round(array[:, :, columns], 4) for name, array in values.items()}
    pip = np.broadcast_to(np.asarray(pips, float), values["pip_shift"].shape)
    noise = values.pop("noise")
    quantum = np.full(pip.shape, QUANTUM)
    held_out_rigs = held_out or [()] * len(rigs)
    rig_of_draw = [
        _places(scored, out, sampled_rigs is not None, partial(uniform, f"rig {k}"), n)
        for k, (scored, out) in enumerate(zip(rigs, held_out_rigs, strict=True))
    ]
    rig = np.array(rig_of_draw)
    balanced_members = [
        _balanced(uniform(f"member {k}", (n + 1,)), members) for k in range(len(rigs))
    ]
    return Draws(
        name=name,
        commitment=commitment(seed),
        cells=deviate(pip, values, quantum, noise),
        rig=rig,
        member=np.where(rig >= FIRST_DRAWN, 0, balanced_members),
        ranked=ranked(rig),
        sampled_rigs=sampled_rigs,
    )


def ranked(rig: Ints) -> Bools:
    """Whether each draw is ranked, ``(n,)``, by its rig of each lung, ``(L, n)``.

    In a round those are ranked that are on rigs that nobody trained on; in practice all are shown.
    """
    count = rig.shape[1]
    if not np.any(rig >= FIRST_DRAWN):
        return np.ones(count, bool)
    return np.resize(np.array(PATTERN), count) != TRAINING


def _places(
    rigs: Sequence[int],
    held_out: Sequence[int],
    from_population: bool,
    uniform: Callable[[tuple[int, ...]], Floats],
    n: int,
) -> Ints:
    """Rig of each draw of one lung."""
    kind = np.resize(np.array(PATTERN), n)
    kind[(kind == DRAWN) & (not from_population)] = HELD_OUT
    kind[(kind == HELD_OUT) & (not held_out)] = DRAWN if from_population else TRAINING
    numbers = uniform((n + 1,))
    rig = FIRST_DRAWN + np.arange(n)
    training = [session for session in rigs if session not in held_out]
    for value, choices in ((TRAINING, training), (HELD_OUT, held_out)):
        at = np.flatnonzero(kind == value)
        if len(at):
            dealt = _balanced(numbers[np.append(0, 1 + at)], len(choices))
            rig[at] = np.array(choices)[dealt]
    return rig


def _log_gain(numbers: Any, xp: Any) -> Any:
    """Logarithms of gains for uniform numbers."""
    return xp.interp(numbers, np.linspace(0.0, 1.0, len(GAIN_QUANTILES)), np.array(GAIN_QUANTILES))


def _balanced(numbers: Floats, choices: int) -> Ints:
    """Deal ``0..choices - 1`` to draws equally often, up to one, in random order.

    The numbers are uniform; the first says which choice is dealt first, and each other is a draw.
    """
    order = np.argsort(np.argsort(numbers[1:], kind="stable"), kind="stable")
    return (order + int(numbers[0] * choices)) % choices


def with_nominal(
    draws: Draws | None, reference: Sequence[int], pips: Sequence[float]
) -> tuple[Scenario, Ints, Ints]:
    """Nominal cells, at P PIPs, cmH2O, of the reference rigs in front of n draws of L lungs.

    Returns:
        Cells of batch shape ``(L, 1 + n, P)`` with numpy leaves, and the session and the member of
        each lung, both of shape ``(L, 1 + n)``; the member of a reference rig is 0.
    """
    count = len(reference)
    with compilation.float64():
        cells = jax.tree.map(np.asarray, nominal_scenario(np.asarray(pips, float)))
    nominal = jax.tree.map(lambda x: np.broadcast_to(x, (count, 1, *x.shape)), cells)
    rig, member = np.asarray(reference)[:, None], np.zeros((count, 1), np.int64)
    if draws is None:
        return nominal, rig, member
    cells = jax.tree.map(lambda *x: np.concatenate(x, axis=1), nominal, draws.cells)
    return cells, np.hstack([rig, draws.rig]), np.hstack([member, draws.member])


def plants_of(
    plants: PlantT, rig: Ints, member: Ints, sampled_rigs: PlantT | None = None
) -> PlantT:
    """Plants of cells.

    Args:
        plants: of every member and session, leaves ``(members, sessions, ...)``.
        rig: sessions, or :data:`FIRST_DRAWN` and more, shape ``(L, n)``.
        member: members, shape ``(L, n)``.
        sampled_rigs: of the last draws, leaves ``(L, k, ...)`` with k <= n.

    Returns:
        Leaves ``(L, n, 1, ...)``, float64: the axis of length 1 stands for the PIPs.
    """
    from_population = rig >= FIRST_DRAWN
    session = np.where(from_population, 0, rig)
    chosen = jax.tree.map(lambda leaf: np.asarray(leaf, float)[member, session], plants)
    if sampled_rigs is not None:
        replaced_cells = np.nonzero(from_population)
        before = rig.shape[1] - jax.tree.leaves(sampled_rigs)[0].shape[1]

        def replaced(leaf: Floats, new: Floats) -> Floats:
            leaf[replaced_cells] = new[replaced_cells[0], replaced_cells[1] - before]
            return leaf

        chosen = jax.tree.map(replaced, chosen, sampled_rigs)
    return jax.tree.map(lambda leaf: leaf[:, :, None], chosen)


def uniforms(seed: bytes, label: str, shape: int | tuple[int, ...]) -> Floats:
    r"""Uniform numbers that follow from a seed and a label, the same on every machine.

    Block ``k = 0, 1, ...`` of the stream is HMAC-SHA256, with the seed as its key, of
    ``b"ventbench uniforms 1\n"``, the label in UTF-8, and ``k`` in 8 bytes, most significant first.
    A block gives four numbers of 8 bytes, most significant first. The upper 52 bits ``n`` of one
    give ``(n + 1/2) / 2**52``, which float64 represents exactly. Numbers of different labels tell
    nothing about each other, and none of them about the seed.

    Args:
        seed: 32 bytes.
        label: what the numbers are for.
        shape: of the result; a longer shape begins with the same numbers.

    Returns:
        Numbers greater than 0 and less than 1 in row-major order, all multiples of 2**-53.

    Raises:
        InputError: if the seed does not have 32 bytes.
    """
    _check_length(seed)
    lengths = (shape,) if isinstance(shape, int) else tuple(shape)
    size = int(np.prod(lengths, dtype=np.int64))
    prefix = _STREAM + label.encode()
    blocks = b"".join(
        hmac.digest(seed, prefix + k.to_bytes(8, "big"), "sha256") for k in range(-(-size // 4))
    )
    words = np.frombuffer(blocks, ">u8", count=size).astype(np.uint64)
    return ((words >> np.uint64(12)).astype(np.float64) + 0.5).reshape(lengths) * 2.0**-52


def commitment(seed: bytes) -> str:
    r"""Hash that binds whoever publishes it to a seed without telling the seed.

    It is SHA-256 of ``b"ventbench season 1\n"`` and the seed, as 64 hexadecimal digits.

    Raises:
        InputError: if the seed does not have 32 bytes.
    """
    _check_length(seed)
    return hashlib.sha256(_COMMITMENT + seed).hexdigest()


def random_scenarios(
    key: Array, pip: Array, *, spread: Array | float | None = None, smooth: bool = False
) -> Scenario:
    """Draw new cells from the distributions of the development draws, for training.

    The development draws themselves are never among them. Pure, so that it can be compiled.

    Args:
        key: JAX key of all random numbers.
        pip: nominal PIP of each of n cells, cmH2O, shape ``(n,)``.
        spread: reach of the deviations, as a multiple of the draws' ranges, ``(n,)`` or ``()``; 0
            for nominal cells, None for the ranges themselves. The delay stays below one step.
        smooth: represent the converter by noise of one step's width, since rounding has no
            derivative; else the cells round.
    """
    n = pip.shape[0]
    keys = jax.random.split(key, len(RANGES) + 3)
    deviations = {}
    for deviation_key, (name, (low, high)) in zip(keys, RANGES.items(), strict=False):
        if spread is None:
            deviations[name] = jax.random.uniform(deviation_key, (n,), minval=low, maxval=high)
        else:
            middle = _nominal(name)
            low, high = low - middle, high - middle
            value = jax.random.uniform(deviation_key, (n,), minval=low, maxval=high)
            deviations[name] = middle + spread * value
    # The order of these two keys is that with which the published weights were trained.
    sd_key, noise_key = (keys[-3], keys[-2]) if smooth else (keys[-2], keys[-3])
    sd = jax.random.uniform(sd_key, (n, 1, 1), minval=NOISE_SD[0], maxval=NOISE_SD[1])
    shape = (n, protocol.BREATHS, protocol.INSPIRATION_STEPS)
    noise = sd * jax.random.normal(noise_key, shape)
    if smooth:
        noise += QUANTUM * jax.random.uniform(keys[-1], shape, minval=-0.5, maxval=0.5)
    quantum = jnp.full(n, 0.0 if smooth else QUANTUM)
    gain = _log_gain(jax.random.uniform(jax.random.fold_in(key, 1), shape[:2]), jnp)
    if spread is not None:
        scale = jnp.broadcast_to(spread, (n,))
        noise = scale[:, None, None] * noise
        quantum = jnp.where(scale > 0, quantum, 0.0)
        deviations["delay"] = jnp.minimum(deviations["delay"], 0.99)
        gain = scale[:, None] * gain
    deviations["gain"] = jnp.exp(gain)
    return deviate(pip, deviations, quantum, noise)


def _nominal(name: str) -> float:
    """Value of a deviation that changes nothing."""
    return 1.0 if name.endswith("scale") else 0.0


def deviate(pip: Any, deviations: Mapping[str, Any], quantum: Any, noise: Any) -> Scenario:
    """Cells of nominal PIPs, cmH2O, ``(...)``, with quantum and noise as of :class:`Scenario`.

    Deviations are by the keys of :data:`RANGES`, ``(...)``, and ``gain``, ``(..., BREATHS)``.
    """
    peep, start = protocol.PEEP + deviations["peep_shift"], deviations["start_shift"]
    of_cell = {name: deviations[name] for name in ("r_scale", "c_scale", "delay", "gain")}
    dt = protocol.DT * deviations["dt_scale"]
    return Scenario(
        pip + deviations["pip_shift"],
        peep,
        peep + start,
        dt,
        quantum=quantum,
        noise=noise,
        **of_cell,
    )


def _check_length(seed: bytes) -> None:
    if len(seed) != SEED_BYTES:
        raise InputError(f"a seed has {SEED_BYTES} bytes; this one has {len(seed)}")
