"""The result of scoring a submission: its JSON, its tables, and whether it is official."""

from __future__ import annotations

import dataclasses
import html
import math
import platform
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

import ventbench
from ventbench.base import files
from ventbench.entries.errors import Failure
from ventbench.entries.folder import Submission
from ventbench.headroom.reference import Reference
from ventbench.plants import frozen
from ventbench.task import protocol
from ventbench.task.draws import DEVELOPMENT_SEED, Draws, commitment
from ventbench.task.lungs import LUNG_IDS
from ventbench.task.metrics import bootstrap
from ventbench.task.metrics.score import lung_score
from ventbench.trajectories import Trajectories

if TYPE_CHECKING:
    import pandas as pd

Floats = NDArray[np.float64]

#: Commitment of the published draws.
PUBLISHED = commitment(DEVELOPMENT_SEED)

#: Failures that a printed score names; the JSON has all.
_FAILURES_SHOWN = 3


@dataclass(frozen=True)
class CellFailure:
    """A failure and its cell.

    Attributes:
        lung: id; also where the submission did not know it.
        pip: nominal PIP, cmH2O.
        draw: counted from 1; None for the nominal cell.
        failure: what went wrong.
        message: the failure in one sentence for a person.
    """

    lung: str
    pip: float
    draw: int | None
    failure: Failure
    message: str


@dataclass(frozen=True, eq=False, repr=False)
class Score:
    """Scores of one submission on one track; L lungs, P PIPs, K draws, cmH2O.

    ``print(score)`` and a notebook show one row a lung. The JSON holds all but ``requested``, which
    is what a record is replayed from, and ``trajectories``.

    Attributes:
        submission: what was scored.
        track: ``"performance"`` or ``"robustness"``.
        lungs: ids, length L.
        pips: nominal PIPs, cmH2O, length P.
        nominal: error of each nominal run, shape ``(L, P)``; NaN where the controller failed.
        drawn: error of each drawn run, shape ``(K, L, P)``; NaN where the controller failed.
        safe: whether all runs of a lung passed the safety gate, shape ``(L,)``.
        peak: highest pressure of a lung in any run, cmH2O, shape ``(L,)``.
        figures: secondary figures of the scored nominal inspirations by name, shape
            ``(L, P, scored breaths)``; NaN where one does not exist.
        below: nominal commands below 0 %, shape ``(L,)``.
        above: nominal commands above 100 %, shape ``(L,)``.
        commands: nominal commands on each lung.
        failures: what failed, in all cells.
        requested: all commands, nominal cells first, %, shape
            ``(L, 1 + K, P, BREATHS, INSPIRATION_STEPS)``; 0 once a cell has failed.
        sandbox: the runner's layers; None in this process.
        simulators: what the caller says about the plants (version, hashes); goes into the JSON.
        frozen_sha256: hash of the frozen simulators' manifest if the plants that ran are exactly
            those, to the bit; else None, whatever the caller says about them.
        trajectories: nominal runs with their expirations.
        timing: seconds, by name; the only numbers that differ from run to run.
        controllable: error of each run without the first step of an inspiration, nominal runs
            first, cmH2O, shape ``(L, 1 + K, P)``.
        rig_draws: the draws; None without draws.
        reference: best attainable and best PID of the same runs; None where it was not computed for
            these simulators and draws.
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
    frozen_sha256: str | None
    trajectories: Trajectories
    timing: Mapping[str, float]
    controllable: Floats
    rig_draws: Draws | None = None
    reference: Reference | None = None

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
    def normalised(self) -> Floats | None:
        """Normalised score of each run, nominal runs first, shape ``(L, 1 + K, P)``.

        0 is the best that any commands attain, 100 the lung's best PID; NaN where the controller
        failed; None where there is no :attr:`reference`.
        """
        if self.reference is None:
            return None
        return self.reference.normalised(self.controllable)

    @property
    def official(self) -> bool:
        """Whether nothing stands in the way of calling it so, see :attr:`not_official_because`."""
        return not self.not_official_because

    @property
    def not_official_because(self) -> tuple[str, ...]:
        """Everything that an official score needs and this one lacks, in words."""
        reasons = {
            "no full sandbox": (self.sandbox or {}).get("official") is not True,
            "not on the frozen simulators": self.frozen_sha256 != frozen.MANIFEST_SHA256,
            "not all lungs and PIPs": not self.complete,
            "other draws than the published ones": len(self.drawn) > 0
            and (self.rig_draws is None or self.rig_draws.commitment != PUBLISHED),
        }
        return tuple(reason for reason, holds in reasons.items() if holds)

    @property
    def complete(self) -> bool:
        """Whether all lungs and PIPs of the protocol were run."""
        return self.lungs == LUNG_IDS and self.pips == protocol.PIPS

    def to_json(self) -> dict[str, Any]:
        """Return the score as JSON values, in the order in which a person reads it."""
        manifest = self.submission.manifest
        return {
            "score": _number(self.score),
            "name": manifest.name,
            "track": self.track,
            "official": self.official,
            "complete": self.complete,
            "safe": bool(np.all(self.safe)),
            "draws": self._draws(lung_score(self.drawn), published=True),
            **self._normalised(),
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
            "versions": package_versions(),
            "timing": dict(self.timing),
        }

    def save(self, folder: Path) -> None:
        """Write ``score.json`` and ``trajectories.npz``, creating the folder if it is missing.

        Raises:
            OSError: if they cannot be written.
        """
        files.write_json(folder / "score.json", self.to_json())
        self.trajectories.save(folder / "trajectories.npz")

    def to_frame(self) -> pd.DataFrame:
        """Errors of all runs as a table, one row a cell.

        Returns:
            Columns ``lung`` (id), ``pip_cmH2O``, ``draw`` (0 for the nominal run, then 1..K) and
            ``error_cmH2O`` (mean |pressure - target|; NaN where the controller failed);
            ``L * P * (1 + K)`` rows.
        """
        import pandas as pd

        errors = np.concatenate([self.nominal[None], self.drawn])
        draw, lung, pip = (axis.ravel() for axis in np.indices(errors.shape))
        return pd.DataFrame(
            {
                "lung": np.array(self.lungs)[lung],
                "pip_cmH2O": np.array(self.pips)[pip],
                "draw": draw,
                "error_cmH2O": errors.ravel(),
            }
        )

    def summary(self) -> pd.DataFrame:
        """One row a lung, indexed by its id.

        Returns:
            Columns ``score_cmH2O`` (nominal), ``draws_cmH2O`` (mean over the draws; only with
            draws), ``normalised`` (over the draws, or nominal without; only with a reference),
            ``safe`` and ``peak_cmH2O`` (highest pressure of any run).
        """
        import pandas as pd

        columns: dict[str, Any] = {"score_cmH2O": self.by_lung}
        if len(self.drawn):
            columns["draws_cmH2O"] = lung_score(self.drawn).mean(axis=0)
        if (values := self.normalised) is not None:
            columns["normalised"] = (
                values[:, 1:].mean((1, 2)) if len(self.drawn) else values[:, 0].mean(1)
            )
        columns |= {"safe": self.safe, "peak_cmH2O": self.peak}
        return pd.DataFrame(columns, index=pd.Index(self.lungs, name="lung"))

    def _headline(self) -> str:
        score = "failed" if math.isnan(self.score) else f"{self.score:.3f} cmH2O"
        because = ", ".join(self.not_official_because)
        status = f"not official: {because}" if because else "official"
        return f"{self.submission.manifest.name}, {self.track}: {score} ({status})"

    def __repr__(self) -> str:
        return f"<Score of {self._headline()}>"

    def __str__(self) -> str:
        rows = self.summary().reset_index()
        table = rows.to_string(index=False, float_format="{:.3f}".format, na_rep="failed")
        failures = [failure.message for failure in self.failures[:_FAILURES_SHOWN]]
        more = len(self.failures) - len(failures)
        return "\n".join([self._headline(), table, *failures, *([f"... {more} more"] * (more > 0))])

    def _repr_html_(self) -> str:
        rows = self.summary().reset_index()
        table = rows.to_html(index=False, float_format="{:.3f}".format, na_rep="failed")
        failures = [failure.message for failure in self.failures[:_FAILURES_SHOWN]]
        said = "".join(f"<p>{html.escape(text)}</p>" for text in (self._headline(), *failures))
        return f"<div>{said}{table}</div>"

    def _lung(self, i: int) -> dict[str, Any]:
        pips = zip(self.pips, self.nominal[i], strict=True)
        return {
            "score": _number(self.by_lung[i]),
            "pips": {f"{pip:g}": _number(error) for pip, error in pips},
            "safe": bool(self.safe[i]),
            "peak_pressure_cmH2O": _number(self.peak[i]),
            "draws": self._draws(lung_score(self.drawn)[:, i : i + 1], first=i),
            **self._normalised(i),
            **self._secondary(slice(i, i + 1)),
            "clipped": self._clipped(slice(i, i + 1)),
        }

    def _draws(
        self, values: Floats, *, first: int = 0, published: bool = False
    ) -> dict[str, Any] | None:
        """Mean over draws, shape ``(K, lungs)``, of all lungs or of those from ``first`` on."""
        if not len(values):
            return None
        assert self.rig_draws is not None
        means = values.mean(axis=1)
        # A draw that failed must not be left out of a mean.
        finite = bool(np.isfinite(means).all())
        score, ci95 = self._over_rigs(values, first) if finite else (math.nan, (math.nan,) * 2)
        about = self.rig_draws.about()
        return {
            "score": _number(score),
            "ci95": [_number(limit) for limit in ci95],
            "values": [_number(value) for value in means],
            **(about if published else {}),
        }

    def _normalised(self, lung: int | None = None) -> dict[str, Any]:
        """Normalised score of a lung or of all; null without a reference."""
        values = self.normalised
        if values is None or self.reference is None:
            return {"normalised": None}
        lungs = slice(None) if lung is None else slice(lung, lung + 1)
        drawn = lung_score(values[lungs, 1:]).T
        return {
            "normalised": {
                "nominal": _number(np.mean(values[lungs, 0])),
                "draws": self._draws(drawn, first=lung or 0),
                "attainable_cmH2O": float(self.reference.attainable[lungs].mean()),
                "pid_cmH2O": float(self.reference.pid[lungs].mean()),
            }
        }

    def _over_rigs(self, values: Floats, first: int) -> tuple[float, tuple[float, float]]:
        """Mean over draws with its interval, which resamples draws, rigs and members."""
        assert self.rig_draws is not None
        lungs = slice(first, first + values.shape[1])
        rig, member = self.rig_draws.rig[lungs], self.rig_draws.member[lungs]
        resampled = bootstrap.resampled_scores(values.T, rig, member)
        low, high = np.quantile(resampled, (0.025, 0.975))
        return float(values.mean()), (float(low), float(high))

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


def package_versions() -> dict[str, str]:
    """Versions of ventbench, Python and the packages that compute a score."""
    return {
        "ventbench": ventbench.__version__,
        "python": platform.python_version(),
        **{name: version(name) for name in ("jax", "jaxlib", "numpy")},
    }


def _number(value: float | np.floating) -> float | None:
    return float(value) if math.isfinite(value) else None


def _failure(failure: CellFailure) -> dict[str, Any]:
    cell = {"lung": failure.lung, "pip": failure.pip, "draw": failure.draw}
    return {**cell, **failure.failure.to_json(), "message": failure.message}
