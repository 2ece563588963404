"""Deviations of the ventilator from nominal: the published paired draws, and new random ones.

One published draw is one deviation for each PIP, common to all lungs and entries: sensor noise and
converter, pressure at the start of the inspiration, R, C, dead time, control step, PIP and PEEP.
They are frozen in ``data/draws-v1.npz``; ``python -m ventbench.draws FILE`` makes that file again.
"""

from __future__ import annotations

import functools
import hashlib
import io
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import NormalDist
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from ventbench import files, protocol
from ventbench.environment import Scenario
from ventbench.errors import InputError

#: Version of the draws, how many there are, their file and its SHA-256.
VERSION = 1
COUNT = 20
FILE = "draws-v1.npz"
SHA256 = "114cb9c7e553cb7de26159760e25af60a59f331c25129134b81bfe41c63e3d92"

_SEED = 20210215  # the paper's date

#: Step of the pressure sensor's converter, cmH2O (PVP).
QUANTUM = 0.0703

#: Standard deviation of the sensor's noise, cmH2O: uniform in this range for each run (recordings).
NOISE_SD = (0.20, 0.25)

#: Every other deviation is uniform in its range: shifts in cmH2O, scales as true over nominal, the
#: delay as a share of one step.
RANGES = {
    "pip_shift": (-1.0, 1.0),
    "peep_shift": (-0.5, 0.5),
    "start_shift": (-0.5, 0.5),
    "dt_scale": (0.97, 1.03),
    "r_scale": (0.95, 1.05),
    "c_scale": (0.95, 1.05),
    "delay": (0.0, 0.5),
}

Floats = NDArray[np.float64]


def build() -> dict[str, Floats]:
    """Draw all deviations anew; the result is the same everywhere.

    Uniform numbers come from the raw stream of PCG64, which no numpy version changes; the rounding
    to 4 decimals removes what differs between mathematical libraries.

    Returns:
        For each key of :data:`RANGES` an array of shape ``(COUNT, P)`` with P nominal PIPs, and
        ``noise``, cmH2O, shape ``(COUNT, P, BREATHS, INSPIRATION_STEPS)``.
    """
    bits = np.random.PCG64(_SEED)

    def uniform(*shape: int) -> Floats:
        # The upper 53 bits, centred so that neither 0 nor 1 occurs.
        return ((bits.random_raw(shape) >> np.uint64(11)).astype(float) + 0.5) * 2.0**-53

    cells = (COUNT, len(protocol.PIPS))
    drawn = {name: low + (high - low) * uniform(*cells) for name, (low, high) in RANGES.items()}
    sd = NOISE_SD[0] + (NOISE_SD[1] - NOISE_SD[0]) * uniform(*cells)
    normal = np.vectorize(NormalDist().inv_cdf, otypes=[float])
    noise = normal(uniform(*cells, protocol.BREATHS, protocol.INSPIRATION_STEPS))
    drawn["noise"] = sd[..., None, None] * noise
    return {name: np.round(values, 4) for name, values in drawn.items()}


def write(path: Path) -> str:
    """Write the file of :func:`build` and return its SHA-256.

    It is :data:`SHA256` from Python 3.11.4 on. Older versions write the same arrays, with other
    headers of the archive around them.

    Raises:
        OSError: if it cannot be written.
    """
    # Not compressed: the bytes then depend on no version of zlib.
    arrays: dict[str, Any] = dict(build())
    files.write_atomically(path, lambda file: np.savez(file, **arrays))
    return files.sha256(path)


def about() -> dict[str, Any]:
    """Version, hash and number of the draws, for records."""
    return {"version": VERSION, "sha256": SHA256, "count": COUNT}


@functools.cache
def _frozen() -> dict[str, Floats]:
    path = files.data_path(FILE)
    content = path.read_bytes()
    sha256 = hashlib.sha256(content).hexdigest()
    if sha256 != SHA256:
        raise InputError(
            f"{path} is not the published draws version {VERSION}: its SHA-256 is {sha256}, "
            f"expected {SHA256}; restore the file"
        )
    with np.load(io.BytesIO(content), allow_pickle=False) as npz:
        return {name: npz[name] for name in npz.files}


def scenarios(pips: Sequence[float] = protocol.PIPS, n: int = COUNT) -> Scenario:
    """Return the first draws as cells.

    Args:
        pips: nominal PIPs, cmH2O, each one of the protocol's; length P.
        n: number of draws, 1..20.

    Returns:
        Cells with batch shape ``(n, P)``.

    Raises:
        InputError: if ``n`` or a PIP has no draws, or the file is missing or not the published one.
    """
    if not 1 <= n <= COUNT:
        raise InputError(f"there are {COUNT} published draws; {n} is outside 1..{COUNT}")
    unknown = [pip for pip in pips if pip not in protocol.PIPS]
    if unknown:
        raise InputError(
            f"no draws for PIP {unknown[0]:g} cmH2O; they exist for "
            f"{', '.join(f'{pip:g}' for pip in protocol.PIPS)}"
        )
    columns = [protocol.PIPS.index(pip) for pip in pips]
    drawn = {name: values[:n, columns] for name, values in _frozen().items()}
    pip = np.asarray(pips, float)
    noise = drawn.pop("noise")
    cells = deviate(pip, drawn, np.full((n, len(pips)), QUANTUM), noise)
    return jax.tree.map(jnp.asarray, cells)


def random_scenarios(
    key: Array,
    pip: Array,
    *,
    spread: Array | float | None = None,
    breaths: int = protocol.BREATHS,
    smooth: bool = False,
    ranges: Mapping[str, tuple[float, float]] = RANGES,
) -> Scenario:
    """Draw new cells from the distributions of the published draws, for training.

    The published draws themselves are never among them. Pure, so that it can be compiled.

    Args:
        key: JAX key of all random numbers.
        pip: nominal PIP of each cell, cmH2O, shape ``(n,)``.
        spread: reach of the deviations of each cell, as a multiple of the draws' ranges, shape
            ``(n,)`` or ``()``; 0 for nominal cells. The delay stays below one step. If not given,
            the ranges themselves.
        breaths: number of breaths with noise.
        smooth: represent the converter by noise of one step's width, since rounding has no
            derivative; else the cells round.
        ranges: of the deviations, those of this version of the draws or of another.

    Returns:
        Cells of batch shape ``(n,)``.
    """
    n = pip.shape[0]
    keys = jax.random.split(key, len(ranges) + 3)
    drawn = {}
    for deviation_key, (name, (low, high)) in zip(keys, ranges.items(), strict=False):
        if spread is None:
            drawn[name] = jax.random.uniform(deviation_key, (n,), minval=low, maxval=high)
        else:
            middle = _nominal(name)
            low, high = low - middle, high - middle
            value = jax.random.uniform(deviation_key, (n,), minval=low, maxval=high)
            drawn[name] = middle + spread * value
    # The order of these two keys is that with which the published weights were trained.
    sd_key, noise_key = (keys[-3], keys[-2]) if smooth else (keys[-2], keys[-3])
    sd = jax.random.uniform(sd_key, (n, 1, 1), minval=NOISE_SD[0], maxval=NOISE_SD[1])
    shape = (n, breaths, protocol.INSPIRATION_STEPS)
    noise = sd * jax.random.normal(noise_key, shape)
    if smooth:
        noise += QUANTUM * jax.random.uniform(keys[-1], shape, minval=-0.5, maxval=0.5)
    quantum = jnp.full(n, 0.0 if smooth else QUANTUM)
    if spread is not None:
        scale = jnp.broadcast_to(spread, (n,))
        noise = scale[:, None, None] * noise
        quantum = jnp.where(scale > 0, quantum, 0.0)
        drawn["delay"] = jnp.minimum(drawn["delay"], 0.99)
    return deviate(pip, drawn, quantum, noise)


def _nominal(name: str) -> float:
    """Value of a deviation that changes nothing."""
    return 1.0 if name.endswith("scale") else 0.0


def deviate(pip: Any, deviations: Mapping[str, Any], quantum: Any, noise: Any) -> Scenario:
    """Cells of nominal PIPs with deviations.

    Args:
        pip: nominal, cmH2O, shape ``(...)``.
        deviations: by the keys of :data:`RANGES`, shapes ``(...)``.
        quantum: step of the converter, cmH2O, shape ``(...)``.
        noise: cmH2O, shape ``(..., BREATHS, INSPIRATION_STEPS)``.
    """
    peep = protocol.PEEP + deviations["peep_shift"]
    return Scenario(
        pip=pip + deviations["pip_shift"],
        peep=peep,
        start=peep + deviations["start_shift"],
        dt=protocol.DT * deviations["dt_scale"],
        r_scale=deviations["r_scale"],
        c_scale=deviations["c_scale"],
        delay=deviations["delay"],
        quantum=quantum,
        noise=noise,
    )


if __name__ == "__main__":
    print(write(Path(sys.argv[1])))
