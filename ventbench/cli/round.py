"""``ventbench round``: open a round, freeze its entries, draw, score, show."""

from __future__ import annotations

import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ventbench.base.errors import InputError
from ventbench.base.text import plain
from ventbench.cli.board import FOLDER, Folder, at_hand, tables_of
from ventbench.cli.options import JsonFile, Scheduler, Sources, Workers, bars, emit

if TYPE_CHECKING:
    from ventbench.board.rounds import Round

app = typer.Typer(
    name="round",
    help="Rounds of the leaderboard: freeze entries, draw by a public beacon, score.",
    no_args_is_help=True,
)

Name = Annotated[str, typer.Argument(metavar="NAME", help="Name of the round.")]


@app.command(name="open")
def open_(
    name: Name,
    closes: Annotated[
        datetime.datetime,
        typer.Option(
            formats=["%Y-%m-%d", "%Y-%m-%dT%H:%M", "%Y-%m-%dT%H:%M:%S"],
            help="When entries are frozen at the earliest, UTC.",
        ),
    ],
    delay: Annotated[
        int, typer.Option(min=1, help="Least time from the freeze to the beacon's value, s.")
    ] = 600,
    limit: Annotated[int, typer.Option(min=1, help="Most entries of an account.")] = 3,
    project: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ENTRY",
            help="Entry of the project, which no account asks for; may be repeated. Default: those "
            "of the round before, or the bundled submissions before the first.",
        ),
    ] = None,
    rehearsal: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Rehearse, with a referee in the place of the public beacon: JSON with "
            "public_key, genesis, period and hash of the referee's chain. Never official.",
        ),
    ] = None,
    folder: Folder = FOLDER,
    json: JsonFile = None,
) -> None:
    """Open a round.

    Example: `ventbench round open 2027-1 --closes 2027-03-01T12:00`
    """
    from ventbench.board import beacon, rounds

    made = rounds.open_round(
        folder,
        name,
        closes.replace(tzinfo=datetime.UTC),
        project or rounds.project_entries(folder),
        delay_s=delay,
        limit=limit,
        chain=beacon.QUICKNET if rehearsal is None else beacon.chain_of(rehearsal),
    )
    _told(made, json)


@app.command()
def freeze(
    name: Name,
    submissions: Annotated[
        Path, typer.Option(metavar="DIR", help="Folder with the submissions, one each.")
    ] = Path("submissions"),
    requests: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="JSON list of who asked for what: name, account and asked (time) of each entry.",
        ),
    ] = None,
    folder: Folder = FOLDER,
    json: JsonFile = None,
) -> None:
    """Take the hashes of all entries; from then on nobody can change one.

    Example: `ventbench round freeze 2027-1 --requests requests.json`
    """
    from ventbench.board import rounds
    from ventbench.plants import frozen

    asked = [] if requests is None else rounds.read_requests(requests)
    _told(rounds.freeze(folder, name, submissions, asked, frozen.load().about()), json)


@app.command()
def draw(
    name: Name,
    beacon: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Value of the beacon, as its relays and referees publish it; default: ask a "
            "public relay. Its signature is checked either way.",
        ),
    ] = None,
    folder: Folder = FOLDER,
    json: JsonFile = None,
) -> None:
    """Take the beacon's first value after the freeze and the delay; the draws follow from it.

    Example: `ventbench round draw 2027-1`
    """
    from ventbench.board import beacon as beacons
    from ventbench.board import rounds

    own = rounds.load(folder, name)
    if own.frozen is None:
        raise InputError(f"round {name} is {own.state}; freeze its entries first")
    content = beacon.read_bytes() if beacon else beacons.fetch(own.opened.chain, own.number)
    _told(rounds.draw(folder, name, content), json)


@app.command()
def score(
    name: Name,
    source: Sources = None,
    plan: Annotated[
        bool, typer.Option("--plan", help="Only say what there is to run, and how long it takes.")
    ] = False,
    workers: Workers = 0,
    scheduler: Scheduler = None,
    only: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ENTRY",
            help="Score this entry alone, in a job of its own; may be repeated. What it gives is "
            "kept in --out, and the same command without it closes the round.",
        ),
    ] = None,
    out: Annotated[
        Path, typer.Option(metavar="DIR", help="What is finished; the same command continues.")
    ] = Path("runs/round"),
    folder: Folder = FOLDER,
    json: JsonFile = None,
) -> None:
    """Score every frozen entry in the full sandbox, and write the records.

    Bounds of the draws come first. With a key in VENTBENCH_SIGNING_KEY the records are signed.

    Example: `ventbench round score 2027-1 --workers 2`
    """
    import os

    from ventbench.base.executor import executor
    from ventbench.board import gate, official_runs, rounds

    own = rounds.load(folder, name)
    if plan:
        runs = official_runs.plan(own)
        seconds = sum(official_runs.SECONDS[track] for _, track in runs)
        emit({"runs": runs, "processor_s": seconds}, json)
        typer.echo(
            f"{len(runs)} runs of {len({x for x, _ in runs})} entries: about "
            f"{seconds / 3600:.1f} h of processor time, and the bounds of the draws",
            err=str(json) == "-",
        )
        return
    with bars() as tell, executor(workers, scheduler) as pool:
        made = official_runs.score(
            folder,
            name,
            pool,
            out / name,
            places=[folder.parent / "submissions", *(source or [])],
            only=only or (),
            secret=os.environ.get(gate.SECRET) or None,
            progress=tell,
        )
    _told(made, json)


@app.command()
def show(
    name: Annotated[
        str | None, typer.Argument(metavar="[NAME]", help="Name of the round; default: list all.")
    ] = None,
    folder: Folder = FOLDER,
    json: JsonFile = None,
) -> None:
    """Show how far a round is, who is in it, and its ranking.

    Example: `ventbench round show 2027-1`
    """
    from ventbench.board import rounds

    folder = at_hand(folder)
    if name is None:
        made = rounds.load_all(folder)
        emit({"rounds": [_about(own) for own in made]}, json)
        for own in made:
            typer.echo(f"{own.name}: {own.state}", err=str(json) == "-")
        return
    own = rounds.load(folder, name)
    _told(own, json)
    if own.result is not None:
        tables_of(folder, name, err=str(json) == "-")


def _about(own: Round) -> dict[str, object]:
    """What is known of a round, as JSON values."""
    frozen = own.frozen
    return {
        "name": own.name,
        "state": own.state,
        "rehearsal": own.opened.rehearsal,
        "closes": own.opened.closes.isoformat(),
        "beacon_round": own.number if frozen else None,
        "beacon_time": own.opened.chain.time_of(own.number).isoformat() if frozen else None,
        "entries": [entry.name for entry in frozen.entries] if frozen else [],
        "left_out": frozen.left_out if frozen else {},
        "failed": own.result.failed if own.result else {},
        "draws": own.commitment if own.value else None,
    }


def _told(own: Round, json: Path | None) -> None:
    """Say how far a round is, and what comes next."""
    about, err = _about(own), str(json) == "-"
    emit(about, json)
    kind = "rehearsal" if own.opened.rehearsal else "round"
    typer.echo(f"{kind} {own.name} is {own.state}", err=err)
    if own.frozen is not None:
        typer.echo(
            f"{len(own.frozen.entries)} entries, {own.frozen_sha256}; value {own.number} of the "
            f"beacon, at {about['beacon_time']}",
            err=err,
        )
        reasons = {**own.frozen.left_out, **(own.result.failed if own.result else {})}
        for entry, why in reasons.items():
            typer.echo(f"{entry}: {plain(why)}", err=err)
    following = {"open": "freeze", "frozen": "draw", "drawn": "score"}.get(own.state)
    next_ = f"ventbench round {following} {own.name}" if following else "ventbench board build"
    typer.echo(f"next: {next_}", err=err)
