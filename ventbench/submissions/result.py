"""The result of scoring a submission, and its JSON."""

from __future__ import annotations

import dataclasses
import math
import platform
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

import numpy as np
from numpy.typing import NDArray

import ventbench
from ventbench import draws, protocol
from ventbench.lungs import LUNG_IDS
from ventbench.metrics import bootstrap
from ventbench.metrics.waveform import lung_score
from ventbench.submissions.errors import Failure
from ventbench.submissions.folder import Submission

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class CellFailure:
    """A failure and its cell.

    Attributes:
        lung: id; also where the submission did not know it.
        pip: nominal PIP, cmH2O.
        draw: counted from 1; None for the nominal cell.
        failure: what went wrong.
        message: the same for a person.
    """

    lung: str
    pip: float
    draw: int | None
    failure: Failure
    message: str


@dataclass(frozen=True)
class Score:
    """Scores of one submission on one track; L lungs, P PIPs, K draws, cmH2O.

    The JSON holds all but ``requested``, which is what a record is replayed from.

    Attributes:
        submission: that was scored.
        track: ``"performance"`` or ``"robustness"``.
        lungs: ids, length L.
        pips: nominal PIPs, cmH2O, length P.
        nominal: error of each nominal run, shape ``(L, P)``; NaN where the controller failed.
        drawn: error of each drawn run, shape ``(K, L, P)``, likewise.
        safe: whether all runs of a lung passed the safety gate, shape ``(L,)``.
        peak: highest pressure of a lung in any run, cmH2O, shape ``(L,)``.
        figures: secondary figures of the scored nominal inspirations by name, shape
            ``(L, P, scored breaths)``; NaN where one does not exist.
        below: nominal commands below 0 %, shape ``(L,)``.
        above: nominal commands above 100 %, likewise.
        commands: nominal commands on each lung.
        failures: of all cells.
        requested: all commands, nominal cells first, %, shape
            ``(L, 1 + K, P, BREATHS, INSPIRATION_STEPS)``; 0 once a cell has failed.
        sandbox: the runner's layers; None in this process.
        simulators: what the caller says about the plants (version, hashes); goes into the JSON.
        timing: seconds, by name; the only numbers that differ from run to run.
    """

    submission: Submission
    track: str
    lungs: tuple[str, ...]
    pips: tuple[float, ...]
    nominal: Floats
    drawn: Floats
    safe: NDArray[np.bool_]
    peak: Floats
    figures: Mapping[str, Floats]
    below: NDArray[np.int64]
    above: NDArray[np.int64]
    commands: int
    failures: tuple[CellFailure, ...]
    requested: Floats
    sandbox: Mapping[str, Any] | None
    simulators: Mapping[str, Any] | None
    timing: Mapping[str, float]

    @property
    def by_lung(self) -> Floats:
        """Nominal score of each lung, cmH2O, shape ``(L,)``; NaN where any cell failed."""
        failed = [lung in {f.lung for f in self.failures} for lung in self.lungs]
        return np.where(failed, np.nan, lung_score(self.nominal))

    @property
    def score(self) -> float:
        """Mean nominal score over lungs, cmH2O; NaN if any cell failed."""
        return float(np.mean(self.by_lung))

    @property
    def official(self) -> bool:
        """Whether its sandbox had every layer that the word needs."""
        return self.sandbox is not None and self.sandbox.get("official") is True

    @property
    def complete(self) -> bool:
        """Whether all lungs and PIPs of the protocol were run."""
        return self.lungs == LUNG_IDS and self.pips == protocol.PIPS

    def to_json(self) -> dict[str, Any]:
        """Return the score as JSON values, in the order in which a person reads it."""
        manifest = self.submission.manifest
        return {
            "protocol": protocol.VERSION,
            "score": _number(self.score),
            "name": manifest.name,
            "track": self.track,
            "official": self.official,
            "complete": self.complete,
            "safe": bool(np.all(self.safe)),
            "draws": self._draws(lung_score(self.drawn).mean(axis=1), published=True),
            "lungs": {lung: self._lung(i) for i, lung in enumerate(self.lungs)},
            **self._secondary(slice(None)),
            "clipped": self._clipped(slice(None)),
            "failures": [_failure(failure) for failure in self.failures],
            "sandbox": None if self.sandbox is None else dict(self.sandbox),
            "submission": {
                "sha256": self.submission.sha256,
                **dataclasses.asdict(manifest),
            },
            "simulators": None if self.simulators is None else dict(self.simulators),
            "versions": {
                "ventbench": ventbench.__version__,
                "python": platform.python_version(),
                **{name: version(name) for name in ("jax", "jaxlib", "numpy")},
            },
            "timing": dict(self.timing),
        }

    def _lung(self, i: int) -> dict[str, Any]:
        pips = zip(self.pips, self.nominal[i], strict=True)
        return {
            "score": _number(self.by_lung[i]),
            "pips": {f"{pip:g}": _number(error) for pip, error in pips},
            "safe": bool(self.safe[i]),
            "peak_pressure_cmH2O": _number(self.peak[i]),
            "draws": self._draws(lung_score(self.drawn[:, i])),
            **self._secondary(slice(i, i + 1)),
            "clipped": self._clipped(slice(i, i + 1)),
        }

    def _draws(self, values: Floats, *, published: bool = False) -> dict[str, Any] | None:
        if not len(values):
            return None
        # A draw that failed must not be left out of a mean.
        summary = bootstrap.summary(values if np.isfinite(values).all() else [])
        about = {"version": draws.VERSION, "sha256": draws.SHA256} if published else {}
        return {
            "score": _number(summary.mean),
            "ci95": [_number(limit) for limit in summary.ci95],
            "values": [_number(value) for value in values],
            **about,
        }

    def _secondary(self, lungs: slice) -> dict[str, Any]:
        means, missing = {}, {}
        for name, values in self.figures.items():
            there = values[lungs][~np.isnan(values[lungs])]
            means[name] = _number(np.mean(there)) if there.size else None
            missing[name] = int(values[lungs].size - there.size)
        missing = {name: count for name, count in missing.items() if count}
        return {"secondary": means, "secondary_missing": missing}

    def _clipped(self, lungs: slice) -> dict[str, Any]:
        below, above = int(self.below[lungs].sum()), int(self.above[lungs].sum())
        total = self.commands * len(self.below[lungs])
        return {
            "below": below,
            "above": above,
            "commands": total,
            "share": (below + above) / total,
        }


def _number(value: float | np.floating) -> float | None:
    return float(value) if math.isfinite(value) else None


def _failure(failure: CellFailure) -> dict[str, Any]:
    cell = {"lung": failure.lung, "pip": failure.pip, "draw": failure.draw}
    return {**cell, **failure.failure.to_json(), "message": failure.message}
