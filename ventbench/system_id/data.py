"""Data of a fit: commands, sample times and measurements, as plain arrays."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from ventbench.base.arrays import Floats, Ints
from ventbench.base.errors import InputError
from ventbench.recordings.breaths import Breaths


@dataclass(frozen=True, eq=False)
class Data:
    """n breaths of T samples, c = 1 (pressure) or 2 (pressure and flow) channels."""

    u_in: Floats  #: inspiratory valve, %, ``(n, T)``.
    u_out: Floats  #: expiratory valve, 0/1, ``(n, T)``.
    dt: Floats  #: time to the next sample, s, ``(n, T)``.
    #: pressure, cmH2O, and flow, mL/s; zero where nothing was measured, ``(n, c, T)``.
    measured: Floats
    weight: Floats  #: 1 where measured, else 0, ``(n, c, T)``.
    R: Floats  #: label of the lung's resistance, cmH2O/(L/s), ``(n,)``.
    C: Floats  #: label of the lung's compliance, mL/cmH2O, ``(n,)``.
    position: Floats  #: place of each breath in its recording, 0 first, 1 last, ``(n,)``.

    def __len__(self) -> int:
        """Number of breaths n."""
        return len(self.u_in)

    @property
    def lung(self) -> Ints:
        """Index of each breath's lung label, from 0, ``(n,)``."""
        pairs = np.stack([self.R, self.C], axis=1)
        return np.unique(pairs, axis=0, return_inverse=True)[1].reshape(-1)

    def select(self, which: ArrayLike | slice) -> Data:
        """Select breaths by mask, index or slice; they keep their positions."""
        index = which if isinstance(which, slice) else np.asarray(which)
        return Data(**{name: array[index] for name, array in vars(self).items()})

    def with_pressure(self, pressure: ArrayLike) -> Data:
        """Replace the pressure, cmH2O, ``(n, T)``; blank samples keep their weight of zero.

        Raises:
            InputError: if the shape differs, or a pressure with weight is not finite.
        """
        pressure = np.asarray(pressure, float)
        if pressure.shape != self.u_in.shape:
            raise InputError(
                f"pressures of shape {pressure.shape} for commands of shape {self.u_in.shape}"
            )
        weight = self.weight[:, :1]
        if not np.all(np.isfinite(pressure[weight[:, 0] > 0])):
            raise InputError("a simulated pressure is not finite; use a stable simulator")
        measured = np.where(weight > 0, pressure[:, None], 0.0)
        return replace(self, measured=measured, weight=weight)


def make_data(breaths: Breaths, *, flow: bool = False, position: ArrayLike | None = None) -> Data:
    """Make the data of a fit from a recording, with its flow if that is asked for.

    Positions, the place of each breath in its recording, are evenly from 0 to 1 if not given.

    Raises:
        InputError: if there is no breath, no pressure or, when asked for, no flow.
    """
    if len(breaths) == 0:
        raise InputError("no breaths to fit; choose a recording with at least one")
    if flow and breaths.flow is None:
        raise InputError("the recording has no flow; fit its pressure alone")
    channels = [breaths.pressure] + ([breaths.flow] if flow and breaths.flow is not None else [])
    measured = np.stack(channels, axis=1)
    weight = (np.isfinite(measured) & breaths.valid[:, None]).astype(float)
    if flow:
        weight[:, 1, 0] = 0.0  # a breath starts at rest
    if not weight[:, 0].any():
        raise InputError("no pressure is measured in these breaths")
    if position is None:
        position = np.linspace(0.0, 1.0, len(breaths)) if len(breaths) > 1 else np.zeros(1)
    names = ("u_in", "u_out", "dt", "R", "C")
    plain = {name: getattr(breaths, name).astype(float) for name in names}
    known = np.where(weight > 0, measured, 0.0)
    return Data(measured=known, weight=weight, position=np.asarray(position, float), **plain)
