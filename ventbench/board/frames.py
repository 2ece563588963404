"""The board as tables: one list of columns for pages, terminal, CSV and pandas frames."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ventbench.base import files
from ventbench.base.errors import InputError
from ventbench.base.interval import Interval
from ventbench.base.text import plain
from ventbench.board import comparison, pages, ranking, replay
from ventbench.board.ranking import Row, Track
from ventbench.board.record import Record
from ventbench.entries.manifest import TRACKS
from ventbench.task import protocol
from ventbench.task.lungs import LUNG_IDS

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class Column:
    """One figure of an entry, wherever the board is shown."""

    #: of its columns in the CSV and in frames: one, or value, low and high end.
    names: tuple[str, ...]
    #: of an entry: text, a number, None, or an :class:`~ventbench.base.interval.Interval`.
    value: Callable[[Row], Any]
    description: str  #: what it is, with its unit; on the page as the hint of its heading.
    title: str = ""  #: heading on the page; empty where the page does not show it.
    digits: int = 3  #: that page and terminal show.
    #: whether it is a difference to another entry, of which less than zero is better.
    sign: bool = False
    unit: str = ""  #: that follows the number on the page.
    #: below the number on the page, where it is no interval.
    small: Callable[[Row], str] = lambda line: ""
    #: headings of the number, and of what is below it, in the terminal.
    terminal: tuple[str, ...] = ()

    def cell(self, row: Row) -> dict[str, Any]:
        """Text, small text, value to sort by, and kind, for page and terminal."""
        value = self.value(row)
        if value is None or isinstance(value, Interval):
            return pages.interval(value, self.digits, sign=self.sign)
        text = str(value)
        if isinstance(value, float):
            exists = math.isfinite(value)
            text = f"{pages.figure(value, self.digits)}{self.unit if exists else ''}"
            value = f"{value:.9g}" if exists else ""
        return {"text": text, "small": self.small(row), "value": value, "kind": ""}

    def values(self, row: Row) -> tuple[Any, ...]:
        """Values by :attr:`names`; NaN or None where there is none."""
        value = self.value(row)
        if len(self.names) == 1:
            return (value,)
        if value is None:
            return (math.nan,) * 3
        return value.value, value.low, value.high


def _of_three(name: str, stem: str = "") -> tuple[str, str, str]:
    stem = stem or name
    return name, f"{stem}_low", f"{stem}_high"


def _family(row: Row) -> str:
    source = f", commands as of {row.source}" if row.source else ""
    return f"{row.record.manifest.family}{source}"


def _held_out_gap(row: Row) -> float:
    """NaN in practice, where draws are on all rigs."""
    figures = row.record.figures
    training = figures.training_values
    return float(figures.ranked_values.mean() - training.mean()) if training.size else math.nan


def _of_stress(figure: Callable[[Any], Any], missing: Any = math.nan) -> Callable[[Row], Any]:
    """A figure of the stressed runs; ``missing`` where there are none."""

    def value(row: Row) -> Any:
        stressed = row.record.figures.stressed
        return missing if stressed is None else figure(stressed)

    return value


#: Every figure of an entry, in the order of pages and CSV.
COLUMNS = (
    Column(("track",), lambda x: x.record.track, "performance or robustness"),
    Column(("status",), lambda x: x.status, "ranked, practice, not ranked or not official"),
    Column(
        ("rank",),
        lambda x: x.place and x.place.rank,
        "Rank, and the ranks that it may have",
        title="Rank",
        small=lambda x: x.place.range if x.place else "",
        terminal=("rank", "ranks"),
    ),
    Column(("rank_low",), lambda x: x.place and x.place.best, "best rank that it may have"),
    Column(("rank_high",), lambda x: x.place and x.place.worst, "worst rank"),
    Column(
        ("name",),
        lambda x: x.record.name,
        "Name and family of the controller",
        title="Entry",
        small=_family,
        terminal=("entry",),
    ),
    Column(("family",), lambda x: x.record.manifest.family, "family of the controller"),
    Column(
        _of_three("normalised"),
        lambda x: x.normalised,
        "0 = best attainable, 100 = best PID of the lung; mean over the draws that rank",
        title="Normalised",
        digits=1,
        terminal=("score", "95 %"),
    ),
    Column(
        _of_three("normalised_to_pid"),
        lambda x: x.to_baseline,
        "Difference of the normalised score to the track's baseline, pid_best or pid_robust",
        title="To the baseline",
        digits=1,
        sign=True,
    ),
    Column(
        _of_three("normalised_to_above"),
        lambda x: x.to_above,
        "Normalised score minus that of the entry above it",
        title="To the entry above",
        digits=1,
        sign=True,
    ),
    Column(
        _of_three("score_cmH2O", "score"),
        lambda x: x.error,
        "The paper's figure: mean |pressure − target| over the draws that rank, cmH₂O",
        title="Error",
        terminal=("error",),
    ),
    Column(
        ("nominal_cmH2O",),
        lambda x: float(x.record.figures.nominal.mean()),
        "error without noise and deviations on the reference rigs, as in the paper, cmH2O",
    ),
    Column(
        ("worst_cmH2O",),
        lambda x: x.worst[0],
        "highest mean of one lung and PIP over all draws, cmH2O",
    ),
    Column(("worst_lung",), lambda x: x.worst[1], "lung of the worst cell"),
    Column(("worst_pip",), lambda x: x.worst[2], "PIP of the worst cell, cmH₂O"),
    Column(
        ("exploitation_cmH2O",),
        lambda x: x.record.figures.exploitation,
        "how far the ensemble of simulators disagrees on this entry's pressures, cmH2O",
    ),
    Column(
        ("held_out_gap",),
        _held_out_gap,
        "Normalised score on rigs that nobody trained on, less that on rigs of the training",
        title="Unseen less seen",
        digits=1,
        sign=True,
    ),
    Column(
        _of_three("seeds"),
        lambda x: comparison.over_seeds(x.seeds) if x.seeds else None,
        "Interquartile mean of the normalised score over seeds of the training",
        title="Seeds",
        digits=1,
    ),
    Column(
        ("derived_from",),
        lambda x: x.source,
        "earlier entry whose commands it follows nearly everywhere",
    ),
    Column(
        ("act_median_us",),
        lambda x: pages.step_time(x.record.header.timing),
        "Median time of one step of the controller, µs",
        title="Step",
        digits=0,
        unit=" µs",
    ),
    Column(_of_three("stress_cmH2O", "stress"), lambda x: x.stress, "stress score, cmH₂O"),
    Column(
        ("stress_rise_cmH2O",),
        _of_stress(lambda t: t.score - t.unstressed),
        "what the stressors add, cmH₂O",
    ),
    Column(
        ("stress_survived",),
        _of_stress(lambda t: t.survived_share),
        "share of stressed runs survived, 0 to 1",
    ),
    Column(
        ("stress_unsafe_runs",),
        _of_stress(lambda t: int((~t.safe[1:]).sum()), None),
        "stressed runs with unsafe pressure",
    ),
    Column(("failed_cells",), lambda x: len(x.record.header.failures), "cells that failed"),
    Column(
        ("safe",), lambda x: bool(x.record.figures.safe.all()), "all lungs pass the safety gate"
    ),
    Column(("reasons",), lambda x: plain("; ".join(x.reasons)), "why it is not ranked"),
    Column(("created",), lambda x: x.record.header.created, "when it was scored, UTC"),
    Column(("draws",), lambda x: x.record.draws, "name of the draws"),
    Column(("record",), lambda x: x.record.sha256, "SHA-256 of the record"),
    Column(
        ("submission",),
        lambda x: x.record.header.submission.sha256,
        "SHA-256 of the submission's files",
    ),
)

#: Where commands look for a leaderboard first.
FOLDER = Path("leaderboard")

#: Whole numbers that an entry may lack.
_NULLABLE_INTEGERS = ("rank", "rank_low", "rank_high", "stress_unsafe_runs")


def load_board(folder: Path | str | None = None, *, track: str | None = None) -> pd.DataFrame:
    """Read a leaderboard into a frame: one row an entry and draws, in the order of the pages.

    Its columns are those of :data:`COLUMNS`, which say what each is: among them ``track``,
    ``draws`` (a round, or ``"development"``), ``status`` (``"ranked"``, ``"practice"``,
    ``"not ranked"``, ``"not official"``), ``name``, ``rank`` with
    ``rank_low`` and ``rank_high``, ``normalised`` (the score that ranks, points) and
    ``score_cmH2O`` (the error of the same runs) with their 95 % intervals, ``nominal_cmH2O`` (the
    paper's score) and ``stress_cmH2O``. Three more a lung follow: ``normalised_R5C10``,
    ``score_R5C10_cmH2O`` and ``nominal_R5C10_cmH2O``.

    Args:
        folder: of the leaderboard; by default ``leaderboard`` in the working directory, or else
            the board of the last round, which came with ventbench.
        track: ``"performance"`` or ``"robustness"``; both by default.

    Returns:
        A frame whose numbers are those of the records, not rounded; NaN where a cell failed.

    Raises:
        InputError: if there is no leaderboard, a record was changed, or the track is not there.
        OSError: if a file cannot be read.

    Examples:
        >>> import ventbench
        >>> board = ventbench.load_board("leaderboard", track="performance")
        >>> board[["rank", "name", "normalised", "score_R5C10_cmH2O"]].shape[1]
        4
    """
    import pandas as pd

    tracks = load_tracks(folder, track=track)
    frame = pd.DataFrame([_values(row) | _by_lung(row.record) for row in entries(tracks)])
    return frame.astype({name: "Int64" for name in _NULLABLE_INTEGERS})


def load_cells(folder: Path | str | None = None, *, track: str | None = None) -> pd.DataFrame:
    """Read every cell of every entry: one row a lung, PIP and draw; see :func:`load_board`.

    Columns: ``track``, ``draws``, ``name``, ``lung``, ``pip`` (cmH2O), ``draw`` (0 is the nominal
    run, draws count from 1), ``error_cmH2O`` (mean absolute error over the scored
    inspirations; NaN if the cell failed), ``peak_cmH2O`` (highest pressure) and
    ``steps_above`` (samples above the safety limit in a breath, the most of the run).
    """
    import numpy as np
    import pandas as pd

    parts = []
    for record in (row.record for row in entries(load_tracks(folder, track=track))):
        figures = record.figures
        draw, lung, pip = np.indices(figures.error.shape).reshape(3, -1)
        columns = {
            "track": record.track,
            "draws": record.draws,
            "name": record.name,
            "lung": np.array(LUNG_IDS)[lung],
            "pip": np.array(protocol.PIPS)[pip],
            "draw": draw,
            "error_cmH2O": figures.error.ravel(),
            "peak_cmH2O": figures.peak.ravel(),
            "steps_above": figures.steps_above.ravel(),
        }
        parts.append(pd.DataFrame(columns))
    return pd.concat(parts, ignore_index=True)


def load_tracks(folder: Path | str | None = None, *, track: str | None = None) -> list[Track]:
    """Read and rank a leaderboard; arguments and errors as of :func:`load_board`."""
    if track is not None and track not in TRACKS:
        raise InputError(f"track {track!r} is not one of {', '.join(TRACKS)}")
    leaderboard = replay.load(path := folder_of(folder))
    if not leaderboard.records:
        raise InputError(f"{path} holds no record; add one with `ventbench board add`")
    return [tracks for tracks in ranking.board(leaderboard) if track in (None, tracks.name)]


def folder_of(folder: Path | str | None) -> Path:
    """Folder of a leaderboard; for want of the usual one, that of the last round in the package."""
    path = Path(folder or FOLDER)
    return files.leaderboard_folder() if path == FOLDER and not path.is_dir() else path


def entries(tracks: Sequence[Track]) -> list[Row]:
    """All entries of some tracks, in the order in which they are shown."""
    return [row for track in tracks for row in track.rows]


def csv_text(tracks: Sequence[Track]) -> str:
    """Text of ``leaderboard.csv``: every entry."""
    output = io.StringIO()
    writer = csv.writer(output, lineterminator="\n")
    writer.writerow(name for column in COLUMNS for name in column.names)
    writer.writerows(csv_row(row).values() for row in entries(tracks))
    return output.getvalue()


def markdown(tracks: Sequence[Track]) -> str:
    """The newest ranked entries as a table of Markdown, a line for each, by the first track."""
    blank = {"performance": [""] * 3, "robustness": [""] * 4}
    listed = [row for row in entries(tracks) if row.listed]
    cells: dict[str, dict[str, list[str]]] = {}
    for row in listed:
        record, score = row.record, row.normalised
        if record.draws != listed[0].record.draws:
            continue
        rank = str(row.place.rank) if row.place else row.status
        if row.place and row.place.range:
            rank += f" ({row.place.range})"
        text = f"**{score.value:.1f}** [{score.low:.1f}, {score.high:.1f}]" if score else ""
        if record.track == "performance":
            secondary = [f"{row.error.value:.3f}" if row.error else ""]
        else:
            stressed = record.figures.stressed
            secondary = [
                f"{row.stress.value:.2f}" if row.stress else "",
                f"{100 * stressed.survived_share:.0f} %" if stressed else "",
            ]
        cells.setdefault(record.name, {})[record.track] = [text, rank, *secondary]
    titles = ["entry", "performance", "rank", "error"]
    titles += ["robustness", "rank", "stress", "runs survived"]
    table = [titles, ["---"] * len(titles)]
    table += [sum((blank | tracks).values(), [name]) for name, tracks in cells.items()]
    return "\n".join(f"| {' | '.join(line)} |" for line in table)


def csv_row(row: Row) -> dict[str, Any]:
    """One line of the CSV by column: text, or a whole number."""
    return {key: _csv_cell(key, value) for key, value in _values(row).items()}


def _values(row: Row) -> dict[str, Any]:
    """Values of an entry by column; None or NaN where there is none."""
    pairs = (zip(column.names, column.values(row), strict=True) for column in COLUMNS)
    return {name: value for pair in pairs for name, value in pair}


def _by_lung(record: Record) -> dict[str, float]:
    figures = {
        "score_{}_cmH2O": record.figures.drawn.mean(axis=(0, 2)),
        "nominal_{}_cmH2O": record.figures.nominal.mean(axis=1),
        "normalised_{}": record.figures.ranked_values.mean(axis=1),
    }
    return {
        name.format(lung): float(values[i])
        for name, values in figures.items()
        for i, lung in enumerate(LUNG_IDS)
    }


def _csv_cell(key: str, value: Any) -> Any:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if not isinstance(value, float):
        return value
    if not math.isfinite(value):
        return ""
    if key == "worst_pip":
        return f"{value:g}"
    digits = 2 if key == "act_median_us" else 6
    # + 0.0: no "-0.000000".
    return f"{round(value, digits) + 0.0:.{digits}f}"
