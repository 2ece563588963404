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

from ventbench.base import VERSION, files
from ventbench.base.arrays import Bools, Floats
from ventbench.entries.cells import Protocol
from ventbench.entries.folder import Submission
from ventbench.entries.runs import CellFailure, Runs, number
from ventbench.plants import frozen
from ventbench.task import protocol, stressors
from ventbench.task.draws import Draws
from ventbench.task.lungs import LUNG_IDS
from ventbench.task.metrics import bootstrap
from ventbench.task.metrics.score import lung_score
from ventbench.trajectories import Trajectories

if TYPE_CHECKING:
    import pandas as pd


#: Failures and stressed conditions that a printed score names; the JSON has all.
_LISTED_FAILURES, _LISTED_CONDITIONS = 3, 10


@dataclass(frozen=True, eq=False, repr=False)
class Score:
    """Scores of one submission on one track; L lungs, P PIPs, K draws, cmH2O.

    ``print(score)`` and a notebook show one row a lung, and what stressors cost most. The JSON
    holds all but the commands, which a record is replayed from, and ``trajectories``.

    Attributes:
        submission: what was scored.
        track: ``"performance"`` or ``"robustness"``.
        protocol: on what: rigs, cells, bounds.
        runs: figures of the nominal cells and the draws, ``(1 + K) P`` cells of each lung.
        stressed: figures under missing physics; None if not run.
        controllable: error of each run without the first step of an inspiration, nominal runs
            first, cmH2O, shape ``(L, 1 + K, P)``.
        figures: secondary figures of the scored nominal inspirations by name, shape
            ``(L, P, scored breaths)``; NaN where one does not exist.
        trajectories: nominal runs with their expirations.
        sandbox: the runner's layers; None in this process.
        timing: seconds, by name; the only numbers that differ from run to run.
    """

    submission: Submission
    track: str
    protocol: Protocol
    runs: Runs
    stressed: Runs | None
    controllable: Floats
    figures: Mapping[str, Floats]
    trajectories: Trajectories
    sandbox: Mapping[str, Any] | None
    timing: Mapping[str, float]

    @property
    def lungs(self) -> tuple[str, ...]:
        """Ids, length L."""
        return self.runs.lungs

    @property
    def pips(self) -> tuple[float, ...]:
        """Nominal PIPs, cmH2O, length P."""
        return self.protocol.pips

    def _by_draw(self, values: NDArray[Any]) -> NDArray[Any]:
        """From ``(1, L, (1 + K) P, ...)`` to ``(L, 1 + K, P, ...)``."""
        return values[0].reshape(*self.controllable.shape, *values.shape[3:])

    @property
    def nominal(self) -> Floats:
        """Error of each nominal run, shape ``(L, P)``; NaN where the controller failed."""
        return self._by_draw(self.runs.error)[:, 0]

    @property
    def drawn(self) -> Floats:
        """Error of each drawn run, shape ``(K, L, P)``; NaN where the controller failed."""
        return np.moveaxis(self._by_draw(self.runs.error)[:, 1:], 1, 0)

    @property
    def safe(self) -> Bools:
        """Whether all runs of a lung passed the safety gate, shape ``(L,)``."""
        return self.runs.safe[0].all(axis=-1)

    @property
    def peak(self) -> Floats:
        """Highest pressure of a lung in any run, cmH2O, shape ``(L,)``."""
        return self.runs.peak[0].max(axis=-1)

    @property
    def requested(self) -> Floats:
        """All commands, %, shape ``(L, 1 + K, P, BREATHS, INSPIRATION_STEPS)``; nominal first."""
        assert self.runs.requested is not None
        return self._by_draw(self.runs.requested)

    @property
    def failures(self) -> tuple[CellFailure, ...]:
        """What failed in the nominal cells and the draws."""
        return tuple(self.runs.failures)

    @property
    def failed(self) -> tuple[CellFailure, ...]:
        """What failed in any run, those under missing physics last."""
        return (*self.failures, *(self.stressed.failures if self.stressed else ()))

    @property
    def rig_draws(self) -> Draws | None:
        """The draws; None without draws."""
        return self.protocol.drawn

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
        failed; None where the bounds were not computed.
        """
        reference = self.protocol.reference
        return None if reference is None else reference.normalised(self.controllable)

    @property
    def ranked(self) -> Bools:
        """Whether each draw is on rigs that nobody trained on, shape ``(K,)``."""
        return np.zeros(0, bool) if self.rig_draws is None else self.rig_draws.ranked

    @property
    def official(self) -> bool:
        """Whether nothing stands in the way of calling it so, see :attr:`not_official_because`."""
        return not self.not_official_because

    @property
    def not_official_because(self) -> tuple[str, ...]:
        """Everything that an official score needs and this one lacks, in words."""
        reasons = {
            "no full sandbox": (self.sandbox or {}).get("official") is not True,
            "not on the frozen simulators": self.protocol.rigs.sha256 != frozen.MANIFEST_SHA256,
            "not all lungs and PIPs": not self.complete,
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
            "score": number(self.score),
            "name": manifest.name,
            "track": self.track,
            "official": self.official,
            "complete": self.complete,
            "safe": bool(np.all(self.safe)),
            **self._figures(slice(None)),
            "lungs": {lung: self._lung(i) for i, lung in enumerate(self.lungs)},
            "failures": [failure.to_json() for failure in self.failures],
            "stress": self._stress(),
            "sandbox": None if self.sandbox is None else dict(self.sandbox),
            "submission": {
                "sha256": self.submission.sha256,
                **dataclasses.asdict(manifest),
            },
            "simulators": dict(self.protocol.rigs.about),
            "versions": package_versions(),
            "timing": dict(self.timing),
        }

    def save(self, folder: Path) -> None:
        """Write ``score.json``, ``trajectories.npz`` and, one row a stressed run, ``stress.csv``.

        The folder is created if it is missing.

        Raises:
            OSError: if they cannot be written.
        """
        files.write_json(folder / "score.json", self.to_json())
        self.trajectories.save(folder / "trajectories.npz")
        if self.stressed is not None:
            table = self.stressed.to_frame().to_csv(index=False, lineterminator="\n")
            files.write_text(folder / "stress.csv", table)

    def to_frame(self) -> pd.DataFrame:
        """Figures of all runs, one row each, stressed ones last.

        See :meth:`ventbench.entries.runs.Runs.to_frame`; under stress ``draw`` counts from 1 too.
        """
        import pandas as pd

        parts = [runs for runs in (self.runs, self.stressed) if runs is not None]
        return pd.concat([runs.to_frame() for runs in parts], ignore_index=True)

    def summary(self) -> pd.DataFrame:
        """One row a lung, indexed by its id.

        Returns:
            Columns ``score_cmH2O`` (nominal), ``draws_cmH2O`` (mean over the draws; only with
            draws), ``normalised`` (over the ranked draws, or nominal without; only with a
            reference), ``held_out_gap`` (that less the same on rigs of the training), ``safe`` and
            ``peak_cmH2O`` (highest pressure of any run).
        """
        import pandas as pd

        columns: dict[str, Any] = {"score_cmH2O": self.by_lung}
        if len(self.drawn):
            columns["draws_cmH2O"] = lung_score(self.drawn).mean(axis=0)
        if self.normalised is not None:
            means = [self._normalised(slice(i, i + 1)) for i in range(len(self.lungs))]
            scores = [(x["draws"] or {"score": x["nominal"]})["score"] for x in means]
            columns["normalised"] = np.array(scores, float)
            if not self.ranked.all():
                columns["held_out_gap"] = np.array([x["held_out_gap"] for x in means], float)
        columns |= {"safe": self.safe, "peak_cmH2O": self.peak}
        return pd.DataFrame(columns, index=pd.Index(self.lungs, name="lung"))

    def _headline(self) -> str:
        score = "failed" if math.isnan(self.score) else f"{self.score:.3f} cmH2O"
        because = ", ".join(self.not_official_because)
        status = f"not official: {because}" if because else "official"
        return f"{self.submission.manifest.name}, {self.track}: {score} ({status})"

    def __repr__(self) -> str:
        return f"<Score of {self._headline()}>"

    def _sentences(self) -> list[str]:
        """Headline, failures, and the headline of the stressed runs."""
        failures = [failure.message for failure in self.failed[:_LISTED_FAILURES]]
        more = len(self.failed) - len(failures)
        sentences = [*failures, *([f"... {more} more"] * (more > 0))]
        if (runs := self.stressed) is not None:
            score = runs.interval(runs.by_lung_and_draw)
            failed = f"failed in {len(runs.failures)} runs"
            sentences.append(
                f"Under missing physics: {failed}"
                if math.isnan(score.value)
                else f"Under missing physics: {score.value:.3f} cmH2O [{score.low:.3f}, "
                f"{score.high:.3f}], "
                f"{runs.unstressed:.3f} without; {100 * runs.survived_share:.0f} % survived, "
                f"{int(np.sum(~runs.safe[1:]))} of {runs.safe[1:].size} runs unsafe. What costs "
                "most:"
            )
        return sentences

    def _worst(self) -> pd.DataFrame | None:
        """Conditions that cost most."""
        if self.stressed is None:
            return None
        columns = ["error_cmH2O", "rise_cmH2O", "survived", "unsafe_runs", "volume_ratio"]
        table = self.stressed.summary().iloc[1:].sort_values("error_cmH2O", ascending=False)
        return table[columns].head(_LISTED_CONDITIONS).reset_index()

    def _tables(self, method: str) -> list[str]:
        """Tables of lungs and of the worst conditions, written by a method of frames."""
        frames = [(self.summary().reset_index(), "{:.3f}", "failed")]
        if (worst := self._worst()) is not None:
            frames.append((worst, "{:.2f}", "NaN"))
        return [
            getattr(frame, method)(index=False, float_format=form.format, na_rep=missing)
            for frame, form, missing in frames
        ]

    def __str__(self) -> str:
        first, *others = self._tables("to_string")
        return "\n".join([self._headline(), first, *self._sentences(), *others])

    def _repr_html_(self) -> str:
        first, *others = self._tables("to_html")
        texts = map(html.escape, (self._headline(), *self._sentences()))
        headline, *paragraphs = (f"<p>{text}</p>" for text in texts)
        return f"<div>{headline}{first}{''.join([*paragraphs, *others])}</div>"

    def _stress(self) -> dict[str, Any] | None:
        """What missing physics does, as JSON values."""
        if self.stressed is None:
            return None
        return {
            "name": self.submission.manifest.name,
            "stressors_version": stressors.VERSION,
            **self.stressed.headline(),
            "draws": self.stressed.pips.shape[1],
            "failures": [failure.to_json() for failure in self.stressed.failures],
        }

    def _lung(self, i: int) -> dict[str, Any]:
        pips = zip(self.pips, self.nominal[i], strict=True)
        return {
            "score": number(self.by_lung[i]),
            "pips": {f"{pip:g}": number(error) for pip, error in pips},
            "safe": bool(self.safe[i]),
            "peak_pressure_cmH2O": number(self.peak[i]),
            **self._figures(slice(i, i + 1)),
        }

    def _figures(self, lungs: slice) -> dict[str, Any]:
        """What is said of one lung and of all: draws, normalised, secondary figures, clipping."""
        draws = self._mean(lung_score(self.drawn)[:, lungs], lungs)
        if draws is not None and self.rig_draws is not None and lungs == slice(None):
            draws |= self.rig_draws.about()
        means, missing = {}, {}
        for name, values in self.figures.items():
            finite = values[lungs][~np.isnan(values[lungs])]
            means[name] = number(np.mean(finite)) if finite.size else None
            if finite.size < values[lungs].size:
                missing[name] = int(values[lungs].size - finite.size)
        requested = self.requested[lungs, 0]
        below, above = int(np.sum(requested < 0.0)), int(np.sum(requested > protocol.U_MAX))
        return {
            "draws": draws,
            "normalised": self._normalised(lungs),
            "secondary": means,
            "secondary_missing": missing,
            "clipped": {
                "below": below,
                "above": above,
                "commands": requested.size,
                "share": (below + above) / requested.size,
            },
        }

    def _mean(
        self, values: Floats, lungs: slice, selection: Bools | slice = slice(None)
    ) -> dict[str, Any] | None:
        """Mean over the selected draws of values ``(k, lungs)``.

        Its interval resamples draws, rigs and members.
        """
        if not len(values) or self.rig_draws is None:
            return None
        means, ci95 = values.mean(axis=1), (math.nan, math.nan)
        if np.isfinite(means).all():  # a draw that failed must not be left out of a mean
            rig, member = (x[lungs, selection] for x in (self.rig_draws.rig, self.rig_draws.member))
            ci95 = bootstrap.limits(bootstrap.resampled_scores(values.T, rig, member))
        return {
            "score": number(values.mean()),
            "ci95": [number(limit) for limit in ci95],
            "values": [number(value) for value in means],
        }

    def _normalised(self, lungs: slice) -> Any:
        """Normalised score of some lungs; None without a reference.

        ``draws`` are those on rigs that nobody trained on, which rank; ``training`` is the score on
        rigs of the training, and ``held_out_gap`` the difference.
        """
        values, reference, ranked = self.normalised, self.protocol.reference, self.ranked
        if values is None or reference is None:
            return None
        by_draw = lung_score(values[lungs, 1:]).T
        score, training = (
            by_draw[some].mean() if some.any() else math.nan for some in (ranked, ~ranked)
        )
        return {
            "nominal": number(np.mean(values[lungs, 0])),
            "draws": self._mean(by_draw[ranked], lungs, ranked),
            "training": number(training),
            "held_out_gap": number(score - training),
            "attainable_cmH2O": float(reference.attainable[lungs].mean()),
            "pid_cmH2O": float(reference.pid[lungs].mean()),
        }


def package_versions() -> dict[str, str]:
    """Versions of ventbench, Python and the packages that compute a score."""
    return {
        "ventbench": VERSION,
        "python": platform.python_version(),
        **{name: version(name) for name in ("jax", "jaxlib", "numpy")},
    }
