"""A record: the immutable result of one scored run, named by the SHA-256 of its bytes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ventbench.board import canonical, schema
from ventbench.errors import InputError

Floats = NDArray[np.float64]

#: End of a record's file name, after its SHA-256.
SUFFIX = ".json"


@dataclass(frozen=True)
class Record:
    """A record's content, checked; L lungs, P PIPs, K draws.

    Attributes:
        sha256: of its bytes: its name.
        content: JSON values, without those that are arrays here.
        nominal: error of the nominal runs, cmH2O, shape ``(L, P)``; NaN where it failed.
        drawn: error of the drawn runs, cmH2O, shape ``(K, L, P)``, likewise.
        spread: disagreement of the ensemble, cmH2O, shape ``(L, P)``, likewise.
        breath: that is shown, counted from 1.
        pressure: its nominal inspirations, cmH2O, to 0.01, shape ``(L, P, S)``.
        u_in: likewise, as applied, %, to 0.1.
        peak: highest pressure of each run, nominal ones first, cmH2O, to 0.01, shape
            ``(1 + K, L, P)``.
        steps_above: longest time above the safety limit of each run, steps, likewise.
    """

    sha256: str
    content: Mapping[str, Any]
    nominal: Floats
    drawn: Floats
    spread: Floats
    breath: int
    pressure: Floats
    u_in: Floats
    peak: Floats
    steps_above: NDArray[np.int64]

    @property
    def name(self) -> str:
        """Of the submission."""
        return self.manifest["name"]

    @property
    def manifest(self) -> Mapping[str, Any]:
        """Of the submission."""
        return self.content["submission"]["manifest"]

    @property
    def track(self) -> str:
        """``"performance"`` or ``"robustness"``."""
        return self.content["track"]

    @property
    def official(self) -> bool:
        """Whether it was scored in a sandbox that deserves the word."""
        return self.content["official"]

    @property
    def version(self) -> int:
        """Of the protocol, and so of the board."""
        return self.content["protocol"]

    @property
    def lungs(self) -> list[str]:
        """Lung ids."""
        return self.content["lungs"]

    @property
    def pips(self) -> list[float]:
        """Nominal PIPs, cmH2O."""
        return self.content["pips"]

    @cached_property
    def by_draw(self) -> Floats:
        """Score of each draw, cmH2O, shape ``(K,)``; NaN if any of its cells failed."""
        return self.drawn.mean(axis=(1, 2))

    @cached_property
    def exploitation(self) -> float:
        """Exploitation index, cmH2O: mean of the ensemble's spread over all cells; or NaN."""
        return float(self.spread.mean())

    @cached_property
    def clipped_share(self) -> float:
        """Share of all commands that were outside 0 to 100 %."""
        clipped = self.content["clipped"]
        return float(sum(clipped["below"]) + sum(clipped["above"])) / max(1, clipped["commands"])

    @property
    def basis(self) -> tuple[str, str]:
        """What its errors depend on besides commands: canonical text of simulators and draws."""
        simulators, draws = self.content["simulators"], self.content["draws"]
        return canonical.canonical(simulators).decode(), canonical.canonical(draws).decode()


@dataclass(frozen=True)
class Withdrawal:
    """Takes a record back; its entry is not ranked until a newer one arrives.

    Attributes:
        sha256: of its bytes: its name.
        withdraws: SHA-256 of the record.
        reason: for the page.
        created: UTC.
    """

    sha256: str
    withdraws: str
    reason: str
    created: str


def from_bytes(content: bytes, label: str, *, strict: bool = True) -> Record | Withdrawal:
    """Read and check a record.

    Args:
        content: of the file.
        label: names the file in messages.
        strict: also check the canonical form; not needed where the hash is known to be right.

    Raises:
        InputError: if it is not a record.
    """
    read = canonical.parse if strict else canonical.parse_any
    values = read(content, label)
    schema.check(values, label)
    sha256 = canonical.digest(content)
    if values["kind"] == "withdrawal":
        return Withdrawal(sha256, values["withdraws"], values["reason"], values["created"])
    errors, trace, safety = (values.pop(key) for key in ("errors", "trace", "safety"))
    return Record(
        sha256,
        values,
        nominal=np.array(errors["nominal"], float),
        drawn=np.array(errors["drawn"], float).reshape(
            values["draws"]["count"], len(values["lungs"]), len(values["pips"])
        ),
        spread=np.array(values.pop("spread"), float),
        breath=trace["breath"],
        pressure=np.array(trace["pressure_centi_cmH2O"]) / 100.0,
        u_in=np.array(trace["u_in_tenths_percent"]) / 10.0,
        peak=np.array(safety["peak_centi_cmH2O"]) / 100.0,
        steps_above=np.array(safety["steps_above"]),
    )


def load(path: Path, *, strict: bool = True) -> Record | Withdrawal:
    """Read a record's file, whatever it is called; see :func:`from_bytes`.

    Raises:
        InputError: if it is not a record.
        OSError: if it cannot be read.
    """
    if path.is_symlink():
        raise InputError(f"{path} is a symbolic link; give the record itself")
    if path.stat().st_size > schema.MOST_BYTES:
        raise InputError(f"{path} is larger than a record may be, {schema.MOST_BYTES / 1e6:.1f} MB")
    return from_bytes(path.read_bytes(), str(path), strict=strict)


def withdrawal(withdraws: str, reason: str, now: datetime | None = None) -> bytes:
    """Return the bytes of a record that takes another one back.

    Args:
        withdraws: SHA-256 of the other one.
        reason: for the page.
        now: time of the record; the clock's if not given.
    """
    return canonical.canonical(
        {
            "format": schema.FORMAT,
            "kind": "withdrawal",
            "created": timestamp(now),
            "withdraws": withdraws,
            "reason": reason,
        }
    )


def timestamp(now: datetime | None = None) -> str:
    """A time as records write it; the clock's if none is given."""
    return f"{now or datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ}"
