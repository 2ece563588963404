"""``ventbench round``: open a round, freeze its entries, draw, score, show."""

from __future__ import annotations

import datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ventbench.base.errors import InputError
from ventbench.base.text import plain
from ventbench.cli.board import FOLDER, Folder, at_hand, tables_of
from ventbench.cli.options import (
    JsonFile,
    Scheduler,
    Sources,
    Workers,
    bar,
    bars,
    written_console,
)

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

    opened = rounds.open_round(
        folder,
        name,
        closes.replace(tzinfo=datetime.UTC),
        project or rounds.project_entries(folder),
        delay_s=delay,
        limit=limit,
        chain=beacon.QUICKNET if rehearsal is None else beacon.chain_of(rehearsal),
    )
    _print_round(opened, json)


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

    entries = [] if requests is None else rounds.read_requests(requests)
    _print_round(rounds.freeze(folder, name, submissions, entries, frozen.load().about()), json)


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

    round_ = rounds.load(folder, name)
    if round_.frozen is None:
        raise InputError(f"round {name} is {round_.state}; freeze its entries first")
    content = beacon.read_bytes() if beacon else beacons.fetch(round_.opened.chain, round_.number)
    _print_round(rounds.draw(folder, name, content), json)


#: Folder of a round's bounds and entries.
Out = Annotated[
    Path, typer.Option(metavar="DIR", help="What is finished; the same command continues.")
]


@app.command()
def bounds(
    name: Name,
    workers: Workers = 0,
    scheduler: Scheduler = None,
    out: Out = Path("runs/round"),
    folder: Folder = FOLDER,
) -> None:
    """Compute the bounds of the draws, on a machine where no submission has run.

    `ventbench round score` takes them; it computes those that are not there, before any entry.

    Example: `ventbench round bounds 2027-1 --workers 2`
    """
    from ventbench.base.executor import executor
    from ventbench.board import official_runs, rounds

    with bar("bounds of the draws") as progress, executor(workers, scheduler) as pool:
        round_ = official_runs.bound(folder, name, pool, out / name, progress=progress)
    typer.echo(round_.folder / rounds.BOUNDS)


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
    out: Out = Path("runs/round"),
    folder: Folder = FOLDER,
    json: JsonFile = None,
) -> None:
    """Score every frozen entry in the full sandbox, and write the records.

    Bounds of the draws come first, unless they are there. With a key in VENTBENCH_SIGNING_KEY the
    records are signed.

    Example: `ventbench round score 2027-1 --workers 2`
    """
    import os

    from ventbench.base.executor import executor
    from ventbench.board import attestation, official_runs, rounds

    round_ = rounds.load(folder, name)
    if plan:
        runs = official_runs.plan(round_)
        seconds = sum(official_runs.SECONDS[track] for _, track in runs)
        written_console({"runs": runs, "processor_s": seconds}, json).print(
            f"{len(runs)} runs of {len({x for x, _ in runs})} entries: about "
            f"{seconds / 3600:.1f} h of processor time, and the bounds of the draws",
            soft_wrap=True,
        )
        return
    with bars() as tell, executor(workers, scheduler) as pool:
        result = official_runs.score(
            folder,
            name,
            pool,
            out / name,
            places=[folder.parent / "submissions", *(source or [])],
            only=only or (),
            secret=os.environ.get(attestation.SECRET) or None,
            progress=tell,
        )
    _print_round(result, json)


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
        every_round = rounds.load_all(folder)
        console = written_console({"rounds": [_summary(x) for x in every_round]}, json)
        for round_ in every_round:
            console.print(f"{round_.name}: {round_.state}")
        return
    round_ = rounds.load(folder, name)
    _print_round(round_, json)
    if round_.result is not None:
        tables_of(folder, name, err=str(json) == "-")


def _summary(round_: Round) -> dict[str, object]:
    """What is known of a round, as JSON values."""
    frozen = round_.frozen
    return {
        "name": round_.name,
        "state": round_.state,
        "rehearsal": round_.opened.rehearsal,
        "closes": round_.opened.closes.isoformat(),
        "beacon_round": round_.number if frozen else None,
        "beacon_time": round_.opened.chain.time_of(round_.number).isoformat() if frozen else None,
        "entries": [entry.name for entry in frozen.entries] if frozen else [],
        "left_out": frozen.left_out if frozen else {},
        "failed": round_.result.failed if round_.result else {},
        "draws": round_.commitment if round_.value else None,
    }


def _print_round(round_: Round, json: Path | None) -> None:
    """Say how far a round is, and what comes next."""
    summary = _summary(round_)
    say = partial(written_console(summary, json).print, soft_wrap=True)
    kind = "rehearsal" if round_.opened.rehearsal else "round"
    say(f"{kind} {round_.name} is {round_.state}")
    if round_.frozen is not None:
        say(
            f"{len(round_.frozen.entries)} entries, {round_.frozen_sha256}; value "
            f"{round_.number} of the beacon, at {summary['beacon_time']}"
        )
        reasons = {**round_.frozen.left_out, **(round_.result.failed if round_.result else {})}
        for entry, why in reasons.items():
            say(f"{entry}: {plain(why)}")
    following = {"open": "freeze", "frozen": "draw", "drawn": "score"}.get(round_.state)
    next_ = f"ventbench round {following} {round_.name}" if following else "ventbench board build"
    say(f"next: {next_}")
