"""Breaths in memory: a frozen record of numpy arrays, n breaths of T samples."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np

from ventbench.lungs import Lung


@dataclass(frozen=True, eq=False)
class Breaths:
    """n breaths of T samples; the arrays cannot be written to.

    Padding (`valid` False) stands after a short breath: u_in 0, u_out 1, pressure, flow and volume
    NaN, time going on at the last interval.

    Attributes:
        breath_id: int64, (n,).
        R: resistance, cmH2O/(L/s), float64, (n,).
        C: compliance, mL/cmH2O, float64, (n,).
        time: s from each breath's first sample, float64, (n, T).
        dt: s, `dt[:, i] = time[:, i+1] - time[:, i]`, the last repeated, float64, (n, T).
        u_in: opening of the inspiratory valve, %, float64, (n, T).
        u_out: 1 while the expiratory valve is open, int8, (n, T).
        pressure: cmH2O, NaN where blank, float64, (n, T).
        valid: True for a sample, False for padding, bool, (n, T).
        time_inferred: True if a breath's times were blank and are an estimate, bool, (n,).
        flow: mL/s, NaN where blank, float64, (n, T), or None.
        volume: mL, NaN where blank, float64, (n, T), or None.
        source: path of the file, or None.
        sha256: of the file, hex, or None (not from a file, or from a part of one).
        notes: what a reader of the file should know, a sentence each.
    """

    breath_id: np.ndarray
    R: np.ndarray
    C: np.ndarray
    time: np.ndarray
    dt: np.ndarray
    u_in: np.ndarray
    u_out: np.ndarray
    pressure: np.ndarray
    valid: np.ndarray
    time_inferred: np.ndarray
    flow: np.ndarray | None = None
    volume: np.ndarray | None = None
    source: str | None = None
    sha256: str | None = None
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Make the arrays read-only."""
        for array in self._arrays().values():
            array.setflags(write=False)

    def __len__(self) -> int:
        """Number of breaths n."""
        return len(self.breath_id)

    def __repr__(self) -> str:
        """Sizes and origin."""
        n, samples = self.pressure.shape
        lungs = len(self.by_lung_index)
        return f"Breaths({n} breaths x {samples} samples, {lungs} lungs, source={self.source!r})"

    @cached_property
    def lung_ids(self) -> np.ndarray:
        """The lung of each breath, such as `R5C10`, str, (n,)."""
        pairs = zip(self.R.tolist(), self.C.tolist(), strict=True)
        return np.array([Lung(r, c).id for r, c in pairs], dtype=str)

    @cached_property
    def by_lung_index(self) -> dict[str, np.ndarray]:
        """Which breaths each lung has, int64, by R then C."""
        order = np.lexsort((self.C, self.R))
        names = dict.fromkeys(self.lung_ids[order].tolist())
        return {name: np.flatnonzero(self.lung_ids == name) for name in names}

    @cached_property
    def inspiratory(self) -> np.ndarray:
        """Samples of inspiration: u_out is 0 and no padding, bool, (n, T)."""
        mask = (self.u_out == 0) & self.valid
        mask.setflags(write=False)
        return mask

    def select(self, which: np.ndarray | slice | list[int]) -> Breaths:
        """Some of the breaths, as copies.

        Args:
            which: a mask (n,), indices (k,) in the order wanted, or a slice.

        Returns:
            The breaths; `source` and `sha256` still name the file they come from.

        Raises:
            IndexError: an index or the length of the mask does not fit.
        """
        index = which if isinstance(which, slice) else np.asarray(which)
        if isinstance(index, np.ndarray) and index.size == 0 and index.dtype != bool:
            index = index.astype(np.int64)
        chosen = {name: array[index].copy() for name, array in self._arrays().items()}
        return replace(self, **chosen)

    def by_lung(self) -> dict[str, Breaths]:
        """The breaths of each lung, by R then C."""
        return {name: self.select(index) for name, index in self.by_lung_index.items()}

    def _arrays(self) -> dict[str, np.ndarray]:
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: value for name, value in values.items() if isinstance(value, np.ndarray)}
