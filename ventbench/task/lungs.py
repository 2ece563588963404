"""The lung settings: which (R, C) pairs exist and how they are named."""

from __future__ import annotations

import re
from dataclasses import dataclass

from ventbench.base.errors import InputError

_ID = re.compile(r"R(\d+(?:\.\d+)?)C(\d+(?:\.\d+)?)")


@dataclass(frozen=True, order=True)
class Lung:
    """One setting of a test lung."""

    R: float  #: airway resistance, cmH2O/(L/s).
    C: float  #: compliance, mL/cmH2O.

    @property
    def id(self) -> str:
        """Name used everywhere, such as ``R20C50``."""
        return f"R{self.R:g}C{self.C:g}"

    def __str__(self) -> str:
        """Return :attr:`id`."""
        return self.id


def lung(lung_id: str) -> Lung:
    """Parse a lung id.

    Args:
        lung_id: id of the lung, such as ``"R20C50"``.

    Raises:
        InputError: if the text is not a lung id, or R or C is 0.
    """
    match = _ID.fullmatch(lung_id)
    if match is None or not all(map(float, match.groups())):
        raise InputError(
            f"{lung_id!r} is not a lung id; write R<cmH2O/(L/s)>C<mL/cmH2O>, such as R20C50"
        )
    return Lung(float(match[1]), float(match[2]))


#: The six ISO lungs that are scored, in the order of every table.
LUNGS: tuple[Lung, ...] = tuple(Lung(r, c) for r in (5.0, 20.0) for c in (10.0, 20.0, 50.0))

#: All settings of the recordings; the R50 ones help to learn what the lungs share.
RECORDED_LUNGS: tuple[Lung, ...] = (*LUNGS, *(Lung(50.0, c) for c in (10.0, 20.0, 50.0)))

#: Ids of :data:`LUNGS`.
LUNG_IDS: tuple[str, ...] = tuple(lung.id for lung in LUNGS)


def scored_lung(lung_id: str) -> Lung:
    """Return one of the six scored lung settings by its id.

    Raises:
        InputError: if the text is not the id of a scored lung.
    """
    named = lung(lung_id)
    if named not in LUNGS:
        raise InputError(f"{lung_id} is not a scored lung; choose one of {', '.join(LUNG_IDS)}")
    return named
