"""The board as tables: ``leaderboard.csv``, and pandas frames for a notebook."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ventbench.board import pages, ranking, store
from ventbench.board.hardware import HardwareRecord
from ventbench.board.ranking import Interval, Row, Track
from ventbench.board.record import Record, Sealed, Withdrawal, commands_of
from ventbench.errors import InputError
from ventbench.submissions.manifest import TRACKS
from ventbench.text import plain

if TYPE_CHECKING:
    import pandas as pd

#: Columns of ``leaderboard.csv``.
COLUMNS = (
    "version", "track", "status", "rank", "rank_low", "rank_high", "name", "family",
    "score_cmH2O", "score_low", "score_high", "to_pid_cmH2O", "to_pid_low", "to_pid_high",
    "to_above_cmH2O", "to_above_low", "to_above_high", "nominal_cmH2O", "worst_cmH2O",
    "worst_lung", "worst_pip", "exploitation_cmH2O", "clipped_share", "act_median_us",
    "failed_cells", "safe", "created", "record", "submission", "reasons",
    "normalised", "normalised_low", "normalised_high", "normalised_to_pid",
    "normalised_to_pid_low", "normalised_to_pid_high", "normalised_to_above",
    "normalised_to_above_low", "normalised_to_above_high", "season",
    "stress_cmH2O", "stress_low", "stress_high", "stress_rise_cmH2O", "stress_survived",
    "stress_unsafe_runs",
)  # fmt: skip

#: Where commands look for a leaderboard.
FOLDER = Path("leaderboard")

#: Whole numbers that an entry may lack.
_NULLABLE_INTEGERS = ("rank", "rank_low", "rank_high", "stress_unsafe_runs")


def load_board(
    folder: Path | str | None = None, *, track: str | None = None, version: int | None = None
) -> pd.DataFrame:
    """Read a leaderboard into a frame: one row an entry, in the order of the pages.

    Columns:

    - ``version``, ``track``, ``status`` (``"ranked"``, ``"not ranked"``, ``"not official"``),
      ``name``, ``family``;
    - ``rank``, ``rank_low``, ``rank_high``: rank and its 95 % interval; missing if not ranked;
    - ``score_cmH2O``, ``score_low``, ``score_high``: mean error over draws, lungs and PIPs with its
      95 % interval, cmH2O;
    - ``to_pid_cmH2O``, ``to_pid_low``, ``to_pid_high``: difference of the score to the track's PID,
      cmH2O; ``to_above_cmH2O``, ``to_above_low``, ``to_above_high``: to the entry above, cmH2O;
    - ``nominal_cmH2O``: the paper's score without noise, cmH2O;
    - ``worst_cmH2O``, ``worst_lung``, ``worst_pip``: highest mean error over draws of one lung and
      PIP, cmH2O, and which cell it is (PIP in cmH2O);
    - ``exploitation_cmH2O``: spread of the ensemble along the nominal commands, cmH2O;
    - ``clipped_share``: share of commands outside 0..100 %, 0 to 1;
    - ``act_median_us``: median time of one ``act``, µs;
    - ``failed_cells``, ``safe`` (whether all lungs pass the safety gate), ``created`` (UTC),
      ``record`` and ``submission`` (SHA-256), ``reasons`` (why an entry is not ranked);
    - ``normalised``, ``normalised_low``, ``normalised_high``: normalised score, by which version 2
      ranks, with its interval; ``normalised_to_pid``, ``normalised_to_above`` with limits: its
      differences; ``normalised_R5C10``, ...: of each lung; missing in version 1;
    - ``season``: of the draws, in version 2;
    - ``stress_cmH2O``, ``stress_low``, ``stress_high``: stress score with its interval, cmH2O;
      ``stress_rise_cmH2O``: what the stressors add; ``stress_survived``: share of runs, 0 to 1;
      ``stress_unsafe_runs``: how many; missing where the stress track was not run;
    - ``score_R5C10_cmH2O``, ...: mean error over draws and PIPs of each lung, cmH2O, and
      ``nominal_R5C10_cmH2O``, ...: mean nominal error over PIPs of each lung, cmH2O.

    Args:
        folder: of the leaderboard; ``leaderboard`` in the working directory by default.
        track: ``"performance"`` or ``"robustness"``; both by default.
        version: of the protocol; the newest by default.

    Returns:
        A frame whose numbers are those of the records, not rounded; NaN where a cell failed.

    Raises:
        InputError: if there is no leaderboard, a record was changed, or the track or version is
            not there.
        OSError: if a file cannot be read.

    Examples:
        >>> import ventbench
        >>> board = ventbench.load_board("leaderboard", track="performance")
        >>> board[["rank", "name", "score_cmH2O", "score_R5C10_cmH2O"]].shape[1]
        4
    """
    import pandas as pd

    frame = pd.DataFrame(
        [
            _values(tracks.version, tracks.name, status, row) | _by_lung(row)
            for tracks in load_tracks(folder, track=track, version=version)
            for status, row in tracks.rows
        ]
    )
    return frame.astype({name: "Int64" for name in _NULLABLE_INTEGERS})


def load_cells(
    folder: Path | str | None = None, *, track: str | None = None, version: int | None = None
) -> pd.DataFrame:
    """Read every cell of every entry: one row a lung, PIP and draw.

    Columns: ``track``, ``name``, ``lung``, ``pip`` (cmH2O), ``draw`` (0 is the nominal run, the
    published draws count from 1), ``error_cmH2O`` (mean absolute error over the scored
    inspirations; NaN if the cell failed), ``peak_cmH2O`` (highest pressure, to 0.01) and
    ``steps_above`` (longest time above the safety limit, control steps).

    Args:
        folder: of the leaderboard; ``leaderboard`` in the working directory by default.
        track: ``"performance"`` or ``"robustness"``; both by default.
        version: of the protocol; the newest by default.

    Raises:
        InputError: if there is no leaderboard, a record was changed, or the track or version is
            not there.
        OSError: if a file cannot be read.
    """
    import numpy as np
    import pandas as pd

    parts = []
    for tracks in load_tracks(folder, track=track, version=version):
        for _, row in tracks.rows:
            record = row.record
            errors = np.concatenate([record.nominal[None], record.drawn])
            draw, lung, pip = np.indices(errors.shape).reshape(3, -1)
            parts.append(
                pd.DataFrame(
                    {
                        "track": tracks.name,
                        "name": record.name,
                        "lung": np.array(record.lungs)[lung],
                        "pip": np.array(record.pips)[pip],
                        "draw": draw,
                        "error_cmH2O": errors.ravel(),
                        "peak_cmH2O": record.peak.ravel(),
                        "steps_above": record.steps_above.ravel(),
                    }
                )
            )
    return pd.concat(parts, ignore_index=True)


def load_tracks(
    folder: Path | str | None = None, *, track: str | None = None, version: int | None = None
) -> list[Track]:
    """Read and rank a leaderboard; arguments and errors as of :func:`load_board`."""
    path = FOLDER if folder is None else Path(folder)
    leaderboard = store.load(path)
    boards = ranking.boards(leaderboard.records, leaderboard.attested, leaderboard.breaches)
    if not boards:
        raise InputError(f"{path} holds no record; add one with `ventbench board add`")
    chosen = next(iter(boards)) if version is None else version
    if chosen not in boards:
        known = ", ".join(map(str, sorted(boards)))
        raise InputError(f"{path} has no version {chosen}; there are {known}")
    if track is not None and track not in TRACKS:
        raise InputError(f"track {track!r} is not one of {', '.join(TRACKS)}")
    return [tracks for tracks in boards[chosen] if track in (None, tracks.name)]


def record_index(folder: Path | str | None = None) -> list[dict[str, Any]]:
    """List every record of a leaderboard in the order of the chain: whose each file is.

    Args:
        folder: of the leaderboard; ``leaderboard`` in the working directory by default.

    Returns:
        For each record ``record`` and ``commands`` (SHA-256, or None: they name the files in
        ``records/``), ``kind`` (``"score"``, ``"hardware"``, ``"sealed"``, ``"withdrawal"``),
        ``version``, ``track`` and ``name`` (of what is withdrawn, for a withdrawal), ``created``
        (UTC) and ``state``: ``"ranked"``, ``"not ranked"``, ``"not official"``, ``"superseded"``,
        ``"withdrawn"``, or empty for what has none.

    Raises:
        InputError: if there is no leaderboard, or a record was changed.
    """
    path = FOLDER if folder is None else Path(folder)
    leaderboard = store.load(path)
    if not leaderboard.records:
        raise InputError(f"{path} holds no record; add one with `ventbench board add`")
    boards = ranking.boards(leaderboard.records, leaderboard.attested, leaderboard.breaches)
    states = {
        row.record.sha256: status
        for tracks in boards.values()
        for track in tracks
        for status, row in track.rows
    }
    by_hash = {entry.sha256: entry for entry in leaderboard.records}
    taken_back = {x.withdraws for x in leaderboard.records if isinstance(x, Withdrawal)}
    rows = []
    for entry in leaderboard.records:
        about = by_hash.get(entry.withdraws) if isinstance(entry, Withdrawal) else entry
        if about is None or isinstance(about, Withdrawal):  # refused when the folder is verified
            continue
        kind, state = "score", states.get(entry.sha256, "superseded")
        if not isinstance(entry, Record):
            kind = type(entry).__name__.removesuffix("Record").lower()
            state = ""
        rows.append(
            {
                "record": entry.sha256,
                "commands": commands_of(entry),
                "kind": kind,
                "version": about.content.protocol
                if isinstance(about, Sealed)
                else about.header.protocol,
                "track": about.track,
                "name": about.name,
                "created": entry.created if isinstance(entry, Withdrawal) else _created(entry),
                "state": "withdrawn" if entry.sha256 in taken_back else state,
            }
        )
    return rows


def _created(entry: Record | Sealed | HardwareRecord) -> str:
    return entry.content.created if isinstance(entry, Sealed) else entry.header.created


def cell_means(record: Record, lung: str) -> dict[str, float | None]:
    """Means over draws of one lung by PIP, or of all lungs.

    Args:
        record: of an entry.
        lung: id of a lung, or ``"all"``.

    Returns:
        Normalised score in version 2, error in cmH2O in version 1, by lung or by PIP, with their
        mean; None where a cell failed.

    Raises:
        InputError: if the record has no such lung.
    """
    cells = record.drawn if record.headroom is None else record.headroom.normalised[1:]
    means = cells.mean(axis=0)
    if lung == "all":
        named = dict(zip(record.lungs, means.mean(axis=1).tolist(), strict=True))
    elif lung in record.lungs:
        names = (f"PIP {pip:g}" for pip in record.pips)
        named = dict(zip(names, means[record.lungs.index(lung)].tolist(), strict=True))
    else:
        raise InputError(f"--lung {lung}: the board has {', '.join(record.lungs)}, or all")
    named["mean"] = sum(named.values()) / len(named)
    return {name: value if math.isfinite(value) else None for name, value in named.items()}


def csv_text(boards: Mapping[int, Sequence[Track]]) -> str:
    """Text of ``leaderboard.csv``: every entry of every board."""
    output = io.StringIO()
    writer = csv.writer(output, lineterminator="\n")
    writer.writerow(COLUMNS)
    for tracks in boards.values():
        for track in tracks:
            writer.writerows(csv_row(track, *row) for row in track.rows)
    return output.getvalue()


def csv_row(track: Track, status: str, row: Row) -> list[Any]:
    """One line of the CSV, in the order of :data:`COLUMNS`: text, or a whole number."""
    values = _values(track.version, track.name, status, row)
    return [_csv_cell(key, value) for key, value in values.items()]


def _values(version: int, track: str, status: str, row: Row) -> dict[str, Any]:
    """Values of an entry by :data:`COLUMNS`; None or NaN where there is none."""
    record, header = row.record, row.record.header
    worst, lung, pip = row.worst
    rank_low, rank_high = row.ranks or (None, None)
    values = (
        version,
        track,
        status,
        row.rank,
        rank_low,
        rank_high,
        record.name,
        record.manifest.family,
        *_interval(row.score),
        *_interval(row.to_baseline),
        *_interval(row.to_above),
        row.nominal,
        worst,
        lung,
        pip,
        record.exploitation,
        record.clipped_share,
        pages.step_time(header.timing),
        header.failed_cells,
        all(header.safe),
        header.created,
        record.sha256,
        header.submission.sha256,
        plain("; ".join(row.entry.reasons)),
        *_normalised(row),
        header.draws.season or "",
        *_stress(record),
    )
    return dict(zip(COLUMNS, values, strict=True))


def _by_lung(row: Row) -> dict[str, float]:
    record = row.record
    drawn, nominal = record.drawn.mean(axis=(0, 2)), record.nominal.mean(axis=1)
    lungs = record.lungs
    scores = {f"score_{lung}_cmH2O": float(drawn[i]) for i, lung in enumerate(lungs)}
    values = scores | {f"nominal_{lung}_cmH2O": float(nominal[i]) for i, lung in enumerate(lungs)}
    if record.headroom is not None:
        means = record.ranked_values.mean(axis=1)
        values |= {f"normalised_{lung}": float(means[i]) for i, lung in enumerate(lungs)}
    return values


def _normalised(row: Row) -> tuple[float, ...]:
    own = row.normalised
    if own is None:
        return (math.nan,) * 9
    return (*_interval(own.score), *_interval(own.to_baseline), *_interval(own.to_above))


def _stress(record: Record) -> tuple[float | int | None, ...]:
    if record.stress is None:
        return (math.nan,) * 5 + (None,)
    own = record.stress.tables
    low, high = own.interval(own.by_lung_and_draw)
    rise = own.score - own.unstressed
    return own.score, low, high, rise, own.survived_share, int((~own.safe[1:]).sum())


def _interval(estimate: Interval | None) -> tuple[float, float, float]:
    if estimate is None:
        return math.nan, math.nan, math.nan
    return estimate.value, estimate.low, estimate.high


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
