"""``python -m proofs challenge``: recordings with concealed effects, answers, and scores."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from proofs.cli import ResultsPage
from ventbench.cli.options import JsonFile, Workers, bar, bars, claim_out, emit

app = typer.Typer(
    name="challenge",
    help="Test diagnosers on recordings with concealed effects.",
    no_args_is_help=True,
)

Folder = Annotated[Path, typer.Argument(metavar="DIR", help="Folder of the challenge.")]
Seed = Annotated[str, typer.Option(help="Secret seed of the challenge; any text.")]
Kind = Literal["single", "null", "pair", "four", "outside", "form", "masked", "all"]


@app.command()
def make(
    seed: Seed,
    out: Annotated[
        Path, typer.Option(metavar="DIR", callback=claim_out, help="Folder of the challenge.")
    ],
    cases: Annotated[int, typer.Option(min=1, help="Number of recordings.")] = 200,
    kind: Annotated[
        Kind,
        typer.Option(
            help="Effects of each recording: one (single), none (null), two (pair), four, one "
            "outside the library, one in another form, one in few closed-loop breaths (masked); or "
            "all of these kinds."
        ),
    ] = "all",
    workers: Workers = 0,
    generator: Annotated[
        Literal["first", "stranger", "faults"],
        typer.Option(
            help="Who records: the first generator; the stranger, with other equations, another "
            "integrator and the nuisances of real laboratories; or faults of the recording, the "
            "session and the circuit."
        ),
    ] = "first",
) -> None:
    """Write recordings with concealed effects, and the sealed answers.

    Anyone may read DIR/recordings, without the withheld pressures, and DIR/cases.json.
    commitment.txt holds the SHA-256 of the answers: publish it before the first diagnosis. The same
    seed, kind, number of recordings and generator give the same files.

    Example: `python -m proofs challenge make --generator stranger --seed "$SECRET" --out runs/s`
    """
    from proofs.challenge.make import make as work

    with bar("recording") as recording:
        hashed = work(seed, out, kind, cases, workers=workers, source=generator, progress=recording)
    typer.echo(f"wrote {cases} recordings to {out}; commitment {hashed}")


Diagnoser = Annotated[
    str,
    typer.Option(
        help="Who answers: module:function, a folder with diagnoser.toml, or one of the project's, "
        "such as ventbench or refit. `reveal` takes the name alone."
    ),
]


@app.command()
def answer(
    folder: Folder,
    diagnoser: Diagnoser = "ventbench",
    seconds: Annotated[float, typer.Option(min=1, help="Processor seconds a case.")] = 300.0,
    memory: Annotated[float, typer.Option(min=0.5, help="Address space a case, GiB.")] = 16.0,
    workers: Workers = 0,
    case: Annotated[list[str], typer.Option(help="Only this case; may be repeated.")] = [],  # noqa: B006
) -> None:
    """Let a diagnoser answer every case, each in a process of its own.

    Ctrl-C keeps the finished answers; the same command continues.

    Example: `python -m proofs challenge answer runs/challenge --diagnoser refit`
    """
    from proofs.challenge.answer import answer as work
    from proofs.challenge.folder import ChallengeFolder
    from proofs.challenge.run import Limits, find

    who = find(diagnoser)
    with bar("answering") as progress:
        lost = work(
            ChallengeFolder(folder),
            who,
            limits=Limits(seconds, memory),
            workers=workers,
            only=tuple(case),
            progress=progress,
        )
    for name, problem in sorted(lost.items()):
        typer.echo(f"{name}: lost: {problem}", err=True)
    typer.echo(
        f"answered; now `python -m proofs challenge reveal {folder} --diagnoser {who.name} "
        "--seed ...`"
    )
    if lost:
        raise typer.Exit(1)


Folders = Annotated[
    list[Path], typer.Argument(metavar="DIR...", help="Folders of challenges from one generator.")
]
Seeds = Annotated[
    list[str], typer.Option("--seed", help="Secret seed of each folder, in the folders' order.")
]


@app.command()
def reveal(
    folders: Folders,
    seed: Seeds,
    diagnoser: Diagnoser = "ventbench",
    json: JsonFile = None,
) -> None:
    """Open the seal, check all hashes, and judge a diagnoser by the withheld pressures and effects.

    Several draws are judged together. The exit code is 1 if a goal is missed.

    Example: `python -m proofs challenge reveal runs/challenge --seed "$SECRET" --json scores.json`
    """
    from proofs.challenge.reveal import reveal as work
    from proofs.results_page import challenge_section

    result = work(_draws(folders, seed), seed, diagnoser)
    _told(result, challenge_section(result), json)
    if any(figure.met is False for figure in result.figures):
        raise typer.Exit(1)


@app.command()
def board(
    folders: Folders,
    seed: Seeds,
    against: Annotated[
        str, typer.Option(help="Diagnoser with whom all others are compared case by case.")
    ] = "ventbench",
    json: JsonFile = None,
    page: ResultsPage = None,
) -> None:
    """Compare all diagnosers that have answered, with intervals of paired differences.

    Folders may be from different generators; each generator has a table of its own.

    Example: `python -m proofs challenge board runs/challenge --seed "$SECRET"`
    """
    from proofs.challenge.reveal import board as work
    from proofs.results_page import board_section

    result = work(_draws(folders, seed), seed, against)
    _told(result, board_section(result), json, page)


@app.command()
def freeze(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of the round.")],
    diagnoser: Annotated[
        list[str],
        typer.Option(help="Folder with diagnoser.toml, or one of the project's; repeated."),
    ],
    world: Annotated[
        list[str],
        typer.Option(metavar="NAME:CASES", help="Generator and its cases; may be repeated."),
    ] = ["faults:60", "stranger:60"],  # noqa: B006
    delay: Annotated[int, typer.Option(min=1, help="From the freeze to the beacon, s.")] = 600,
    seconds: Annotated[float, typer.Option(min=1, help="Processor seconds a case.")] = 300.0,
    rehearsal: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Chain of a referee in place of the public beacon."),
    ] = None,
) -> None:
    """Freeze the diagnosers of a round; a public beacon decides later on their cases.

    Example: `python -m proofs challenge freeze runs/r1 --diagnoser mine --diagnoser ventbench`
    """
    from proofs import rounds
    from ventbench.board import beacon

    worlds: dict[str, int] = {}
    for given in world:
        name, _, count = given.partition(":")
        if not count.isdecimal() or not int(count):
            raise typer.BadParameter(f"{given}: give NAME:CASES", param_hint="--world")
        worlds[name] = int(count)
    chain = beacon.QUICKNET if rehearsal is None else beacon.chain_of(rehearsal)
    own = rounds.freeze(folder, diagnoser, worlds, delay_s=delay, seconds=seconds, chain=chain)
    due = own.frozen.chain.time_of(own.number)
    typer.echo(f"{len(own.frozen.diagnosers)} diagnosers frozen as {own.sha256}: publish that")
    typer.echo(f"`challenge round {folder}` takes value {own.number} of the beacon, at {due:%F %T}")


@app.command(name="round")
def round_(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of the round.")],
    beacon: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Value of the beacon; default: ask a public relay."),
    ] = None,
    workers: Workers = 0,
    json: JsonFile = None,
    page: ResultsPage = None,
) -> None:
    """Draw a frozen round, let all answer, and compare them; the same command continues.

    Example: `python -m proofs challenge round runs/r1`
    """
    from proofs import rounds
    from proofs.results_page import board_section
    from ventbench.board import beacon as beacons

    own = rounds.load(folder)
    if own.value is None:
        chain = own.frozen.chain
        content = beacon.read_bytes() if beacon else beacons.fetch(chain, own.number)
        own = rounds.draw(own, content)
    with bars() as tell:
        result = rounds.play(own, workers=workers, tell=tell)
    _told(result, board_section(result), json, page)


def _told(result: Any, text: str, json: Path | None, page: Path | None = None) -> None:
    from proofs.results_page import write_section

    emit(result.as_dict(), json)
    if page is not None:
        write_section(page, "board of diagnosers", text)
    if str(json) != "-":
        typer.echo(text)


def _draws(folders: list[Path], seed: list[str]) -> Any:
    from proofs.challenge.folder import ChallengeFolder

    if len(seed) != len(folders):
        raise typer.BadParameter(
            f"{len(folders)} folders and {len(seed)} seeds were given; give --seed once a folder",
            param_hint="--seed",
        )
    return [ChallengeFolder(folder) for folder in folders]
