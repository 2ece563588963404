"""Which parameters a fit may move, and which breaths share each of them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ventbench.errors import InputError
from ventbench.physics.catalogue import mechanism, parameter, strength_path
from ventbench.physics.parameters import REFITTED, Parameter
from ventbench.system_id.data import Data, Floats
from ventbench.system_id.derivatives import START

#: The start of a breath, as a parameter.
_START = Parameter(
    START, "cmH2O", "reading at the first sample", -50.0, 150.0, 5.0, 5.0, 5.0, scope="breath"
)


def described(path: str) -> Parameter:
    """Parameter of a path, the start of a breath among them."""
    return _START if path == START else parameter(path)


def freed(mechanisms: Iterable[str]) -> tuple[str, ...]:
    """Paths that a hypothesis frees: R, C, R_ex, PEEP, its mechanisms' parameters, the starts."""
    own = [
        f"{name}.{item.name}"
        for name in dict.fromkeys(mechanisms)
        for item in mechanism(name).description.parameters
        if not item.shape
    ]
    return (*REFITTED, *own, START)


@dataclass(frozen=True, eq=False)
class Unknowns:
    """The vector of a fit: U numbers in the coordinates of their parameters.

    Attributes:
        paths: k free parameters.
        index: which unknown each breath takes for each of them, ``(n, k)``.
        path_of: of each unknown, as an index into ``paths``, ``(U,)``.
    """

    paths: tuple[str, ...]
    index: NDArray[np.int64]
    path_of: NDArray[np.int64]

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Parameters of the paths."""
        return tuple(described(path) for path in self.paths)

    @property
    def shared(self) -> NDArray[np.bool_]:
        """Unknowns that are not one breath's own, ``(U,)``."""
        own = np.array([item.scope == "breath" for item in self.parameters])
        return ~own[self.path_of]

    def of(self, path: str) -> NDArray[np.int64]:
        """Unknowns of a parameter, in the order of their groups."""
        return np.flatnonzero(self.path_of == self.paths.index(path))

    def bounds(self) -> tuple[Floats, Floats]:
        """Lowest and highest coordinates, ``(U,)``."""
        pairs = [(p.coordinate(p.low), p.coordinate(p.high)) for p in self.parameters]
        low, high = np.array(pairs, float).reshape(-1, 2)[self.path_of].T.copy()
        return low, high

    def prior(self, given: Mapping[str, tuple[float, float]]) -> tuple[Floats, Floats]:
        """Means and precisions (1 / variance) in coordinates, ``(U,)``; precision 0 if none.

        What shapes an effect has its own prior, as no data bear on it while the effect is off, and
        so has a strength with a ``spread``.
        """
        mean, precision = np.zeros(len(self.path_of)), np.zeros(len(self.path_of))
        for path in self.paths:
            owner = path.rpartition(".")[0]
            if path in given:
                centre, width = given[path]
            elif owner and (path != strength_path(owner) or parameter(path).spread is not None):
                centre, width = parameter(path).prior()
            else:
                continue
            mean[self.of(path)], precision[self.of(path)] = centre, width**-2.0
        return mean, precision

    def pack(self, values: Mapping[str, ArrayLike]) -> Floats:
        """Coordinates of physical values: one of a parameter, or one for each breath."""
        x = np.zeros(len(self.path_of))
        for column, (path, item) in enumerate(zip(self.paths, self.parameters, strict=True)):
            value = np.broadcast_to(np.asarray(values[path], float), self.index.shape[:1])
            x[self.index[:, column]] = item.coordinate(np.clip(value, item.low, item.high))
        return x

    def unpack(self, x: Floats) -> Floats:
        """Physical values of each breath, ``(n, k)``."""
        columns = x[self.index].T
        pairs = zip(self.parameters, columns, strict=True)
        return np.stack([item.physical(column) for item, column in pairs], axis=1)

    def slopes(self, physical: Floats) -> Floats:
        """Derivatives of physical values by coordinates, ``(n, k)``."""
        pairs = zip(self.parameters, physical.T, strict=True)
        return np.stack([item.slope(column) for item, column in pairs], axis=1)


def unknowns(
    data: Data, paths: Iterable[str], groups: Mapping[str, ArrayLike] | None = None
) -> Unknowns:
    """Lay out the unknowns.

    Args:
        data: its breaths.
        paths: free parameters.
        groups: for a parameter, which breaths share it, ``(n,)`` whole numbers. Without: R and C
            belong to the lung, what is a breath's own to the breath, all else to everything.

    Raises:
        InputError: if a group does not fit the data, or a parameter appears twice.
    """
    paths, groups = tuple(paths), dict(groups or {})
    if len(set(paths)) < len(paths):
        raise InputError(f"a parameter is freed twice among {', '.join(paths)}")
    index, path_of = [], []
    for column, path in enumerate(paths):
        item = described(path)
        default = np.arange(len(data)) if item.scope == "breath" else np.zeros(len(data), int)
        if path in ("R", "C"):
            default = data.lung
        group = np.asarray(groups.get(path, default))
        if group.shape != (len(data),):
            raise InputError(f"groups of {path}: {group.shape} for {len(data)} breaths")
        kinds, place = np.unique(group, return_inverse=True)
        index.append(len(path_of) + place.reshape(-1))
        path_of += [column] * len(kinds)
    return Unknowns(paths, np.stack(index, axis=1), np.asarray(path_of))
