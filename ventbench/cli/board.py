"""``ventbench board``: add records, build, verify and show the leaderboard."""

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
    name="board", help="The leaderboard: add records, build and verify pages.", no_args_is_help=True
)

Folder = Annotated[
    Path,
    typer.Option(
        "--folder", metavar="DIR", help="Folder of the leaderboard; default: leaderboard."
    ),
]
FOLDER = Path("leaderboard")


@app.command()
def add(
    record: Annotated[
        Path,
        typer.Argument(
            help="JSON file of `ventbench score --record DIR`, with its commands next to it."
        ),
    ],
    supersedes: Annotated[
        str | None,
        typer.Option(
            metavar="HASH", help="SHA-256 (or its beginning) of the record that this one corrects."
        ),
    ] = None,
    reason: Annotated[str, typer.Option(help="Reason of the correction, shown on the page.")] = "",
    source: Annotated[
        list[str] | None,
        typer.Option(metavar="KEY=TEXT", help="Origin of the submission; may be repeated."),
    ] = None,
    folder: Folder = FOLDER,
) -> None:
    """Add a record if its replay gives the recorded numbers.

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
    record: Annotated[str, typer.Argument(help="SHA-256 of the record, or its beginning.")],
    reason: Annotated[str, typer.Option(help="Reason, shown on the page.")],
    folder: Folder = FOLDER,
) -> None:
    """Withdraw a record: it stays in the history, but its entry is no longer ranked.

    Example: `ventbench board withdraw 3f2a91 --reason "the authors found a bug"`
    """
    from ventbench.board import store

    withdrawal = store.withdraw(folder, record, reason)
    typer.echo(f"withdrew {withdrawal.withdraws}")
    typer.echo("next: ventbench board build")


@app.command()
def sign(
    record: Annotated[str, typer.Argument(help="SHA-256 of the record, or the beginning of it.")],
    folder: Folder = FOLDER,
) -> None:
    """Sign a record with the secret key in the environment variable VENTBENCH_SIGNING_KEY.

    Whoever signs says that the record's code gave its commands: run `board verify --rerun` first.

    Example: `ventbench board sign 3f2a91`
    """
    import os

    from ventbench.board import attestation, store
    from ventbench.errors import InputError

    secret = os.environ.get(attestation.SECRET, "")
    if not secret:
        raise InputError(f"environment variable {attestation.SECRET} holds no key")
    sha256 = store.find_record(store.load(folder), record).sha256
    typer.echo(f"signed {sha256}: {attestation.sign(folder, sha256, secret)}")
    typer.echo("next: ventbench board build")


@app.command(name="new-key")
def new_key() -> None:
    """Make a key that signs records: the secret, and the lines for leaderboard/keys.toml.

    Example: `ventbench board new-key`
    """
    from ventbench.board import attestation

    secret, lines = attestation.new_key()
    typer.echo(f"# secret: {attestation.SECRET} of the workflow; keep it nowhere else\n{secret}\n")
    typer.echo(f"# public: for leaderboard/keys.toml\n{lines}", nl=False)


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
        str | None, typer.Option(help="Earlier head of the chain, which must still be part of it.")
    ] = None,
    json: JsonFile = None,
) -> None:
    """Check every hash, replay the commands of every record and rebuild every page.

    The exit code is 1 if there is any problem. Each problem names its file.

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
    state = f"{count} problem{'s' if count > 1 else ''}" if count else "no problems"
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
        int | None, typer.Option(help="Version of the protocol; default: the newest.")
    ] = None,
    json: JsonFile = None,
) -> None:
    """Show the ranking of both tracks.

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
    """Add the group of commands."""
    parent.add_typer(app)
