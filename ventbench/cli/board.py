"""``ventbench board``: add records, build, verify and show the leaderboard."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ventbench.base.errors import InputError
from ventbench.base.text import plain
from ventbench.cli.options import (
    JsonFile,
    Scheduler,
    Sources,
    Workers,
    bar,
    console_of,
    written_console,
)

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from ventbench.board.ranking import Track

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


def at_hand(folder: Path) -> Path:
    """The folder that is shown: for want of the usual one, that of the package, which is said."""
    from ventbench.board import frames

    path = frames.folder_of(folder)
    if path != folder:
        note = f"no folder {folder} here; the board of the last round, which came with ventbench:"
        typer.echo(note, err=True)
    return path


#: Characters of a hash that tables show, as `withdraw` and `verify --rerun` take them.
HASH_DIGITS = 8


@app.command()
def add(
    paths: Annotated[
        list[Path],
        typer.Argument(
            metavar="RECORD...",
            help="JSON files of `ventbench score --record DIR`, each with its commands next to it.",
        ),
    ],
    folder: Folder = FOLDER,
) -> None:
    """Add records that replay: on these simulators, with commands that can be honest.

    Example: `ventbench board add runs/record/3f2a....json`
    """
    from ventbench.board import store
    from ventbench.board.replay import require_replay
    from ventbench.plants import frozen

    require, records = partial(require_replay, frozen.load()), []
    try:
        with bar("replaying records") as replaying:
            for path in paths:
                records.append(store.add(folder, path, require))
                replaying(len(records), len(paths))
    finally:  # also those before one that is refused
        for added in records:
            typer.echo(f"added {added.name} ({added.track}): record {added.sha256}")
    typer.echo("next: ventbench board build")


@app.command()
def withdraw(
    record: Annotated[str, typer.Argument(help="SHA-256 of the record, or its beginning.")],
    reason: Annotated[str, typer.Option(help="Reason, shown on the page.")],
    folder: Folder = FOLDER,
) -> None:
    """Withdraw a record: it stays in the history, but its entry is no longer ranked.

    A withdrawal counts once a key of the leaderboard has signed it: with the key in the environment
    variable VENTBENCH_SIGNING_KEY that is done here, else by `ventbench board sign`.

    Example: `ventbench board withdraw 3f2a91 --reason "the authors found a bug"`
    """
    import os

    from ventbench.board import attestation, store

    withdrawal = store.withdraw(folder, record, reason)
    typer.echo(f"withdrew {withdrawal.header.withdraws}")
    secret = os.environ.get(attestation.SECRET, "")
    if secret:
        attestation.sign(folder, store.path_of(folder, withdrawal.sha256), secret)
    typer.echo(f"next: ventbench board {'build' if secret else f'sign {withdrawal.sha256[:12]}'}")


@app.command()
def sign(
    record: Annotated[
        str,
        typer.Argument(
            help="SHA-256 of the record or withdrawal, or its beginning; or the path of "
            "attestations.toml, or of result.json or notes.toml of a round."
        ),
    ],
    folder: Folder = FOLDER,
) -> None:
    """Sign a file with the secret key in the environment variable VENTBENCH_SIGNING_KEY.

    Whoever signs says that the record's code gave its commands: run `board verify --rerun` first.

    Example: `ventbench board sign 3f2a91`
    """
    import os

    from ventbench.board import attestation, store

    secret = os.environ.get(attestation.SECRET, "")
    if not secret:
        raise InputError(f"environment variable {attestation.SECRET} holds no key")
    signed = store.find_signed(folder, record)
    typer.echo(f"signed {signed}: {attestation.sign(folder, signed, secret)}")
    typer.echo("next: ventbench board build")


@app.command(name="new-key")
def new_key() -> None:
    """Make a key that signs records: the secret, and the lines for attestations.toml.

    Example: `ventbench board new-key`
    """
    from ventbench.board import attestation

    secret, lines = attestation.new_key()
    typer.echo(f"# secret: {attestation.SECRET} of the workflow; keep it nowhere else\n{secret}\n")
    typer.echo(f"# public: for leaderboard/attestations.toml\n{lines}", nl=False)


@app.command()
def build(
    folder: Folder = FOLDER,
    out: Annotated[
        Path, typer.Option(metavar="DIR", help="Site: pages, CSV and the records.")
    ] = Path("runs/board"),
    json: JsonFile = None,
) -> None:
    """Build pages and CSV from the records; the same records give the same bytes.

    Example: `ventbench board build --out runs/board`
    """
    from ventbench.board import build as builder

    built = builder.build(folder, out)
    figures = {"records": built.records, "files": built.files, "changed": list(built.changed)}
    written_console(figures, json).print(
        f"{out}: {built.records} records, {built.files} pages, {len(built.changed)} files changed",
        soft_wrap=True,
    )


@app.command()
def verify(
    records: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[HASH]...",
            help="With --rerun: records to run again, or the beginnings of their hashes; "
            "default: all.",
        ),
    ] = None,
    folder: Folder = FOLDER,
    rerun: Annotated[
        bool,
        typer.Option("--rerun", help="Also run the code of records again, in the sandbox."),
    ] = False,
    source: Sources = None,
    workers: Workers = 0,
    scheduler: Scheduler = None,
    site: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Built pages to compare; default: those in the folder, if any."
        ),
    ] = None,
    bounds: Annotated[
        int | None,
        typer.Option(
            min=0,
            metavar="CELLS",
            help="Cells of each round whose bound a second optimiser computes anew, chosen by the "
            "beacon; default: two minutes of them; 0: none, in a hurry.",
        ),
    ] = None,
    json: JsonFile = None,
) -> None:
    """Derive the board anew from frozen lists and signed records, and compare all that is there.

    Every entry that was frozen must have a record or a signed failure, every record must replay,
    and results, ranks, pages, CSV and the README's table must be what follows. No bound of a round
    may be worse than what a second optimiser finds in cells that its beacon chooses.

    With --rerun, the code that each record names by its hashes runs again, and its commands must
    be the recorded ones to 0.001 %. Records whose code is not at hand are listed.

    The exit code is 1 if there is any problem. Each problem names its file.

    Example: `ventbench board verify --rerun --workers 2`
    """
    import dataclasses

    from ventbench.board import official_runs
    from ventbench.board import verify as verifier
    from ventbench.plants import frozen

    if records and not rerun:
        raise InputError("records are chosen for --rerun; without it all are verified")
    with bar("replaying records") as replaying:
        report = verifier.verify(
            folder,
            frozen.load,
            site=site,
            recomputed=verifier.RECOMPUTED if bounds is None else bounds,
            progress=replaying,
        )
    if rerun and not report.problems:  # else the records are not what they were
        with bar("running code again") as running:
            outcomes = official_runs.rerun(
                folder,
                records=records or (),
                sources=source or (),
                workers=workers,
                scheduler=scheduler,
                progress=running,
            )
        report.reproduced = sum(x.state == official_runs.REPRODUCED for x in outcomes)
        report.second_runs = [str(x) for x in outcomes]
        report.problems += [str(x) for x in outcomes if x.state == official_runs.DIFFERENT]
        report.notes += [str(x) for x in outcomes if x.state == official_runs.NOT_RERUN]
    console = written_console(dataclasses.asdict(report), json)
    for note in report.notes:
        console.print(f"note: {plain(note)}")
    for line in report.bounds:
        console.print(line, soft_wrap=True)
    for problem in report.problems:
        console.print(plain(problem), style="red", soft_wrap=True)
    count = len(report.problems)
    state = f"{count} problem{'s' if count > 1 else ''}" if count else "no problems"
    reproduced = f", {report.reproduced} reproduced by their code" if report.reproduced else ""
    console.print(
        f"{state}: {report.records} records, {report.replayed} replayed{reproduced}",
        soft_wrap=True,
    )
    if report.problems:
        raise typer.Exit(1)


@app.command()
def show(
    folder: Folder = FOLDER,
    json: JsonFile = None,
) -> None:
    """Show the newest round's ranking of both tracks and under missing physics, and practice.

    Example: `ventbench board show`
    """
    from ventbench.board import frames, ranking

    folder = at_hand(folder)
    tracks = ranking.newest(frames.load_tracks(folder))
    console = written_console(
        {"rows": [frames.csv_row(row) for row in frames.entries(tracks)]}, json
    )
    for track in tracks:
        _print_track(console, track)


def tables_of(folder: Path, name: str, *, err: bool = False) -> None:
    """Print the tables of a round."""
    from ventbench.board import frames

    for track in frames.load_tracks(folder):
        if track.draws == name:
            _print_track(console_of(err), track)


def _print_track(console: Console, track: Track) -> None:
    """Print the ranking of a track, why others are not ranked, and the ranking under stress."""
    if not track.rows:
        return
    console.print(_table(track))
    for row in track.rows:
        if not row.listed:
            reported = any(reason.startswith(row.status) for reason in row.reasons)
            why = plain("; ".join(row.reasons if reported else (row.status, *row.reasons))[:300])
            console.print(f"{row.record.name}: {why}")
    if track.stress:
        console.print(_stress_table(track))


def _plain_table(title: str) -> Table:
    """Return a table without frames, which fits 80 columns."""
    from rich import box
    from rich.table import Table

    return Table(
        title=title or None,
        box=box.SIMPLE_HEAD,
        padding=(0, 0, 0, 1),
        pad_edge=False,
        title_justify="left",
        caption_justify="left",
    )


def _table(track: Track) -> Table:
    """Return the ranking: the columns of the board that have a heading for the terminal."""
    from ventbench.board import frames

    columns = [column for column in frames.COLUMNS if column.terminal]
    table = _plain_table(f"{track.name}: 0 = best attainable, 100 = best PID")
    table.caption = f"{track.title}; error in cmH2O"
    for name in (*(name for column in columns for name in column.terminal), "record"):
        table.add_column(name, justify="left" if name in ("entry", "record") else "right")
    for row in track.rows:
        texts = []
        for column in columns:
            cell = column.cell(row)
            values = (cell["text"] if cell["value"] not in ("", None) else "", cell["small"])
            texts += values[: len(column.terminal)]
        table.add_row(*texts, row.record.sha256[:HASH_DIGITS])
    return table


def _stress_table(track: Track) -> Table:
    """Entries of the robustness track under missing physics."""
    from ventbench.board import pages

    rows = [pages.stress_context(row) for row in track.stress]
    table = _plain_table("stress: mean |airway pressure - PIP|, cmH2O")
    runs = ", ".join(sorted({str(row["runs"]) for row in rows}))
    table.caption = f"survived, unsafe: of {runs} runs; calm: without stressors"
    for name in ("rank", "entry", "score", "95 %", "ranks", "calm", "survived", "unsafe"):
        table.add_column(name, justify="left" if name == "entry" else "right", no_wrap=True)
    for row in rows:
        score, place = row["score"], row["row"].stress_place
        table.add_row(
            "" if place is None else str(place.rank),
            row["row"].record.name,
            "failed" if score is None else score["text"],
            "" if score is None else score["small"],
            "" if place is None else f"{place.best} to {place.worst}",
            row["unstressed"],
            f"{row['survived']} %",
            str(row["unsafe"]),
        )
    return table
