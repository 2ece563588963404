"""``ventbench board``: add records, build the pages, verify everything, look at it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ventbench.cli.options import JsonFile, emit

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from ventbench.board.ranking import Interval, Track

app = typer.Typer(
    name="board", help="The leaderboard: records in, pages out.", no_args_is_help=True
)

Folder = Annotated[
    Path, typer.Option("--folder", metavar="DIR", help="The leaderboard; leaderboard by default.")
]
FOLDER = Path("leaderboard")


@app.command()
def add(
    record: Annotated[
        Path,
        typer.Argument(
            help="The JSON that `ventbench score --record DIR` wrote; its commands lie beside it."
        ),
    ],
    supersedes: Annotated[
        str | None,
        typer.Option(metavar="HASH", help="Record that this one corrects, or the beginning of it."),
    ] = None,
    reason: Annotated[str, typer.Option(help="Why, for the page.")] = "",
    source: Annotated[
        list[str] | None,
        typer.Option(metavar="KEY=TEXT", help="Where the submission came from; may be repeated."),
    ] = None,
    folder: Folder = FOLDER,
) -> None:
    """Add a record, if it replays to the same numbers.

    Example: `ventbench board add runs/record/3f2a....json --source commit=9c1e5d0`
    """
    from ventbench.board import create, store
    from ventbench.errors import InputError
    from ventbench.plants import frozen

    parts = [text.partition("=") for text in source or ()]
    about = {key: text for key, _, text in parts}
    if not all(about.values()):
        raise InputError("--source needs KEY=TEXT, such as commit=9c1e5d0")
    if supersedes is not None:
        supersedes = store.find_record(store.load(folder), supersedes).sha256
    new = create.amend(record, supersedes=supersedes, reason=reason, source=about)
    added = store.add(folder, new, frozen.load())
    typer.echo(f"added {added.name} ({added.track}): record {added.sha256}")
    typer.echo("next: ventbench board build")


@app.command()
def withdraw(
    record: Annotated[str, typer.Argument(help="SHA-256 of the record, or the beginning of it.")],
    reason: Annotated[str, typer.Option(help="Shown on the page.")],
    folder: Folder = FOLDER,
) -> None:
    """Take a record back; it stays in the history and its entry is no longer ranked.

    Example: `ventbench board withdraw 3f2a91 --reason "the authors found a bug"`
    """
    from ventbench.board import store

    withdrawal = store.withdraw(folder, record, reason)
    typer.echo(f"withdrew {withdrawal.withdraws}")
    typer.echo("next: ventbench board build")


@app.command()
def build(folder: Folder = FOLDER, json: JsonFile = None) -> None:
    """Build the CSV and all pages from the records; the same records give the same bytes.

    Example: `ventbench board build`
    """
    from ventbench.board import build as builder

    done = builder.build(folder)
    emit({"records": done.records, "files": done.pages, "changed": list(done.changed)}, json)
    typer.echo(
        f"{folder}: {done.records} records, {done.pages} files, {len(done.changed)} changed",
        err=str(json) == "-",
    )


@app.command()
def verify(
    folder: Folder = FOLDER,
    head: Annotated[
        str | None, typer.Option(help="Head of the chain as noted before; it must still be there.")
    ] = None,
    json: JsonFile = None,
) -> None:
    """Check every hash, replay every record's commands and build every page again.

    Exit code 1 if anything is not as it must be; every problem names its file.

    Example: `ventbench board verify`
    """
    import dataclasses

    from rich.console import Console

    from ventbench.board import verify as verifier
    from ventbench.plants import frozen
    from ventbench.text import plain

    console = Console(stderr=str(json) == "-")
    with Console(stderr=True).status("replaying") as status:
        report = verifier.verify(
            folder,
            frozen.load,
            head=head,
            progress=lambda done, all_: status.update(f"replayed {done} of {all_} records"),
        )
    emit(dataclasses.asdict(report), json)
    for note in report.notes:
        console.print(f"note: {plain(note)}", markup=False, highlight=False)
    for problem in report.problems:
        console.print(plain(problem), style="red", markup=False, highlight=False, soft_wrap=True)
    _summary(console, report)
    if report.problems:
        raise typer.Exit(1)


def _summary(console: Console, report: Any) -> None:
    count = len(report.problems)
    state = f"{count} problem{'s' if count > 1 else ''}" if count else "all is well"
    console.print(
        f"{state}: {report.records} records, {report.replayed} replayed "
        f"(largest difference {report.deviation:.1e} cmH2O)\nhead {report.head}",
        markup=False,
        highlight=False,
        soft_wrap=True,
    )


@app.command()
def show(
    folder: Folder = FOLDER,
    version: Annotated[
        int | None, typer.Option(help="Of the protocol; the newest by default.")
    ] = None,
    json: JsonFile = None,
) -> None:
    """Show both tracks in the terminal.

    Example: `ventbench board show`
    """
    from rich.console import Console

    from ventbench.board import frames

    tracks = frames.load_tracks(folder, version=version)
    rows = [
        dict(zip(frames.COLUMNS, frames.csv_row(track, *row), strict=True))
        for track in tracks
        for row in track.rows
    ]
    emit({"version": tracks[0].version, "rows": rows}, json)
    console = Console(stderr=str(json) == "-")
    for track in tracks:
        console.print(_table(track))


def _table(track: Track) -> Table:
    from rich.markup import escape
    from rich.table import Table

    from ventbench.text import plain

    table = Table(title=f"{track.name}, version {track.version}: score over draws, cmH2O")
    for name in ("rank", "entry", "score", "95 %", "to PID", "nominal", "worst cell", "state"):
        left = name in ("entry", "state")
        table.add_column(name, justify="left" if left else "right", no_wrap=name == "entry")
    for status, row in track.rows:
        worst, lung, pip = row.worst
        table.add_row(
            "" if row.rank is None else str(row.rank),
            row.record.name,
            "failed" if row.score is None else f"{row.score.value:.3f}",
            _limits(row.score),
            "" if row.to_baseline is None else f"{row.to_baseline.value:+.3f}",
            f"{row.nominal:.3f}" if row.nominal == row.nominal else "failed",
            f"{worst:.3f} {lung} {pip:g}" if lung else "",
            escape(plain("; ".join((status, *row.entry.reasons)))[:120]),
        )
    return table


def _limits(interval: Interval | None) -> str:
    return "" if interval is None else f"{interval.low:.3f} to {interval.high:.3f}"


def register(parent: typer.Typer) -> None:
    """Add the group."""
    parent.add_typer(app)
