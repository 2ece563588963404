"""Several recordings as one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ventbench.errors import InputError
from ventbench.recordings.breaths import Breaths

#: Arrays that every recording has.
_ALWAYS = (
    "breath_id", "R", "C", "time", "dt", "u_in", "u_out", "pressure", "valid", "time_inferred",
)  # fmt: skip


def join(parts: Sequence[Breaths]) -> Breaths:
    """Put recordings one after the other; flow and volume are left out.

    Args:
        parts: at least one; breaths of equally many samples.

    Returns:
        All breaths; no ``source`` and no ``sha256``. Ids may now be there twice.

    Raises:
        InputError: there is nothing to join, or the numbers of samples differ.
    """
    if not parts:
        raise InputError("there are no recordings to join")
    lengths = sorted({part.pressure.shape[1] for part in parts})
    if len(lengths) > 1:
        raise InputError(
            f"recordings with breaths of {lengths} samples cannot be joined; cut them to "
            f"{lengths[0]} samples, or use one at a time"
        )
    arrays = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _ALWAYS}
    notes = tuple(note for part in parts for note in part.notes)
    return replace(
        parts[0], **arrays, flow=None, volume=None, source=None, sha256=None, notes=notes
    )
