"""How far simulators stray from recorded breaths: the open-loop test of ``ventbench open-loop``."""

from __future__ import annotations

import html
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ventbench.base import files
from ventbench.base.arrays import Floats, Ints
from ventbench.base.text import number
from ventbench.plants import frozen
from ventbench.plants.catalog import Given, load_simulators, names
from ventbench.plants.stacking import PlantsFor, open_loop_breaths
from ventbench.recordings import Breaths, load
from ventbench.task.metrics import bootstrap
from ventbench.task.metrics.open_loop import mae

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class OpenLoopReport:
    """Open-loop errors of simulators on a recording, cmH2O.

    Attributes:
        plant: name of the simulators.
        simulators: version and hashes of the official ones.
        about: what is known of simulators from a file, a function or the caller; else None.
        lungs: figures by lung id, those of :func:`summary`: without prefix of the simulators that
            make the scores, over all breaths; ``held_out_...`` of each breath by a member of the
            ensemble that has not seen it; ``official_held_out_...`` of the simulators that make the
            scores, on what they have not seen.
        not_judged: ids of breaths without a first or another inspiratory pressure.
        perhaps_copies: ids of breaths with the commands of one of the training, of which blank
            pressures do not tell whether they are copies: they count as such.
        notes: what a reader of the recording should know.
    """

    plant: str
    simulators: dict[str, Any]
    about: dict[str, Any] | None
    lungs: dict[str, dict[str, Any]]
    not_judged: tuple[int, ...]
    perhaps_copies: tuple[int, ...]
    notes: tuple[str, ...]

    def __repr__(self) -> str:
        """Simulators and number of breaths."""
        breaths = sum(figures["breaths"] for figures in self.lungs.values())
        return f"<OpenLoopReport of {self.plant}: {breaths} breaths, {len(self.lungs)} lungs>"

    def as_dict(self) -> dict[str, Any]:
        """JSON values of ``ventbench open-loop --json``."""
        return {
            "plant": self.plant,
            "simulators": self.simulators,
            **({} if self.about is None else {"about": self.about}),
            "unit": "cmH2O",
            "lungs": self.lungs,
            "not_judged": list(self.not_judged),
            "perhaps_copies": list(self.perhaps_copies),
            "notes": list(self.notes),
        }

    def to_frame(self) -> pd.DataFrame:
        """One row a lung: the figures of :attr:`lungs`."""
        import pandas as pd

        return pd.DataFrame.from_dict(self.lungs, orient="index").rename_axis("lung")

    def remarks(self) -> list[str]:
        """Sentences about breaths that were not judged or are perhaps copies."""
        lines = []
        if self.not_judged:
            lines.append(
                f"{len(self.not_judged)} breaths have no first pressure or no other inspiratory "
                "one and were not judged."
            )
        if self.perhaps_copies:
            count = len(self.perhaps_copies)
            lines.append(
                f"{count} {'breath is' if count == 1 else 'breaths are'} perhaps a copy of one in "
                "the training: the commands are the same, and blank pressures do not tell. Their "
                "errors are not those of new breaths."
            )
        return lines

    def __str__(self) -> str:
        """Return mean errors by lung, and the sentences of :meth:`remarks`."""
        title = f"Open-loop MAE of the {self.plant} simulators, cmH2O"
        rows = [
            f"  {name}: {number(figures['mae'])}, held out {number(figures['held_out_mae'])} "
            f"({figures['breaths']} breaths)"
            for name, figures in self.lungs.items()
        ]
        return "\n".join([title, *rows, *self.remarks()])

    def _repr_html_(self) -> str:
        frame = self.to_frame()[["breaths", "mae", "median_mae", "held_out_mae"]]
        title = f"<p>Open-loop MAE of the {html.escape(self.plant)} simulators, cmH2O</p>"
        below = "".join(f"<p>{html.escape(line)}</p>" for line in self.remarks())
        return title + frame.to_html(float_format="%.2f") + below


def open_loop(
    breaths: Breaths | Path | str | pd.DataFrame, simulator: Given = "frozen",
    *, progress: Callable[[int, int], object] | None = None,
) -> OpenLoopReport:  # fmt: skip
    """Measure how far simulators stray from recorded breaths under the recorded commands.

    The error of a breath is the mean |simulated - recorded| pressure over its inspiratory samples,
    from its first recorded pressure, cmH2O.

    Args:
        breaths: n recorded breaths, or what :func:`ventbench.load_recording` takes.
        simulator: a name, a file, a plant, plants by lung, a function of commands or an array of
            simulated pressures ``(n, T)``; see :func:`ventbench.load_simulators`.
        progress: called with how many simulations of a breath are done and how many there are,
            two of each breath.

    Returns:
        Errors by lung.

    Raises:
        InputError: if there is no simulator for a lung of the recording.

    Examples:
        >>> import ventbench
        >>> report = ventbench.open_loop(ventbench.example("sound"), "physics")
        >>> bool(report.to_frame().loc["R5C20", "mae"] < 1.0)
        True
    """
    breaths = load(breaths)
    tested = load_simulators(simulator, breaths=breaths)
    done = 0

    def count(simulated: int) -> None:
        nonlocal done
        done += simulated
        if progress is not None:
            progress(done, 2 * len(breaths))

    error = mean_errors(tested.pressures(breaths, progress=count), breaths)
    crossed = mean_errors(tested.pressures(breaths, cross_fitted=True, progress=count), breaths)
    held_out, unseen = tested.held_out(breaths), tested.unseen(breaths)
    perhaps = breaths.breath_id[tested.perhaps_copies(breaths)].tolist()

    def figures(index: Ints) -> dict[str, Any]:
        return {
            **summary("", error[index]),
            **summary("held_out_", crossed[index][held_out[index]]),
            **summary("official_held_out_", error[index][unseen[index]]),
        }

    return OpenLoopReport(
        plant=simulator if isinstance(simulator, str) and simulator in names() else tested.name,
        simulators=frozen.load().about(),
        about=None if tested.kind in names() else dict(tested.about),
        lungs={lung: figures(index) for lung, index in breaths.by_lung_index.items()},
        not_judged=tuple(breaths.breath_id[np.isnan(error)].tolist()),
        perhaps_copies=tuple(perhaps),
        notes=breaths.notes,
    )


def errors(plants_for: PlantsFor, breaths: Breaths) -> Floats:
    """Open-loop MAE of each breath by some plants; see :func:`mean_errors`."""
    return mean_errors(open_loop_breaths(plants_for, breaths), breaths)


def mean_errors(simulated: Floats, breaths: Breaths) -> Floats:
    """Mean |simulated - recorded| of each breath over its inspiratory samples, cmH2O, ``(n,)``.

    NaN where a breath has no first pressure or no other inspiratory one.

    Args:
        simulated: open-loop answers, cmH2O, shape ``(n, T)``.
        breaths: n recorded breaths.
    """
    blank = np.isnan(breaths.pressure[:, 0])
    error = mae(breaths.pressure, np.nan_to_num(simulated), breaths.inspiratory)
    return np.where(blank, np.nan, error)


def summary(prefix: str, error: Floats) -> dict[str, Any]:
    """Figures of some breaths.

    Args:
        prefix: prefix of the keys, such as ``"held_out_"``.
        error: errors of each breath, cmH2O, shape ``(n,)``; NaN for one that could not be judged.

    Returns:
        JSON values: ``mae``, ``median_mae``, ``ci95`` (bootstrap interval of the mean) and
        ``breaths``, with the prefix; null where there is no breath.
    """
    estimate = bootstrap.summary(error)
    return files.json_values(
        {
            f"{prefix}mae": estimate.mean,
            f"{prefix}median_mae": estimate.median,
            f"{prefix}ci95": estimate.ci95,
            f"{prefix}breaths": estimate.count,
        }
    )
