"""``python -m proofs challenge``: recordings with concealed effects, answers, and scores."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from proofs.cli import ResultsPage
from ventbench.cli.options import JsonFile, Scheduler, bars, claim_out, emit

app = typer.Typer(
    name="challenge",
    help="Test the diagnosis on recordings with concealed effects.",
    no_args_is_help=True,
)

Folder = Annotated[Path, typer.Argument(metavar="DIR", help="Folder of the challenge.")]
Seed = Annotated[str, typer.Option(help="Secret seed of the challenge; any text.")]
Round = Annotated[
    int,
    typer.Option(
        "--round",
        min=1,
        max=2,
        help="1: the recordings as made; 2: also the breaths that the answers asked for.",
    ),
]
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
    jobs: Annotated[int, typer.Option(min=1, help="Number of processes.")] = 1,
    scheduler: Scheduler = None,
    generator: Annotated[
        Literal["first", "stranger"],
        typer.Option(
            help="Who records: the first generator, or the stranger, with other equations, another "
            "integrator and the nuisances of real laboratories."
        ),
    ] = "first",
) -> None:
    """Write recordings with concealed effects, and the sealed answers.

    Anyone may read DIR/recordings and DIR/cases.json. commitment.txt holds the SHA-256 of the
    answers: publish it before the first diagnosis. The same seed, kind, number of recordings and
    generator give the same files.

    Example: `python -m proofs challenge make --generator stranger --seed "$SECRET" --out runs/s`
    """
    from proofs.challenge.make import make as work

    with bars() as shown:
        task = shown.add_task("recording", total=cases)
        place = out if scheduler is None else out.resolve()
        hashed = work(
            seed, place, kind, cases, jobs=jobs, scheduler=scheduler, source=generator,
            progress=lambda done: shown.update(task, completed=done),
        )  # fmt: skip
    typer.echo(f"wrote {cases} recordings to {out}; commitment {hashed}")


@app.command()
def answer(
    folder: Folder,
    jobs: Annotated[
        int, typer.Option(min=1, help="Number of processes, each with one thread.")
    ] = 2,
    scheduler: Scheduler = None,
    round_: Round = 1,
) -> None:
    """Diagnose every recording without reading the sealed answers.

    Ctrl-C keeps the finished diagnoses; the same command continues.

    Example: `python -m proofs challenge answer runs/challenge --jobs 2`
    """
    from proofs.challenge.answer import answer as work
    from proofs.challenge.folder import ChallengeFolder

    with bars() as shown:
        task = shown.add_task("diagnosing", total=None)

        def progress(done: int, total: int) -> None:
            shown.update(task, completed=done, total=total)

        place = folder if scheduler is None else folder.resolve()
        failed = work(
            ChallengeFolder(place, round_), jobs=jobs, scheduler=scheduler, progress=progress
        )
    for name, problem in sorted(failed.items()):
        typer.echo(f"{name}: no answer: {problem}", err=True)
    if failed:
        raise typer.Exit(1)
    typer.echo(f"answered; now `python -m proofs challenge reveal {folder} --seed ...`")


@app.command()
def record(folder: Folder, seed: Seed) -> None:
    """Record the breaths that the answers asked for, each on its own concealed rig.

    Afterwards, `answer` and `reveal` with `--round 2` use all breaths.

    Example: `python -m proofs challenge record runs/challenge --seed "$SECRET"`
    """
    from proofs.challenge import requests
    from proofs.challenge.folder import ChallengeFolder

    names = requests.record(ChallengeFolder(folder), seed)
    typer.echo(f"recorded the requested breaths of {len(names)} cases")


@app.command()
def reveal(
    folders: Annotated[
        list[Path],
        typer.Argument(metavar="DIR...", help="Folders of challenges from one generator."),
    ],
    seed: Annotated[
        list[str], typer.Option(help="Secret seed of each folder, in the folders' order.")
    ],
    round_: Round = 1,
    oracle: Annotated[
        bool, typer.Option("--oracle", help="Compare with fits that know the true effects; slow.")
    ] = False,
    jobs: Annotated[
        int, typer.Option(min=0, help="Processes for --oracle; 0 for this process alone.")
    ] = 0,
    scheduler: Scheduler = None,
    json: JsonFile = None,
    page: ResultsPage = None,
) -> None:
    """Open the sealed answers, check all hashes, and score the diagnoses.

    Several draws are scored together. The exit code is 1 if a goal is missed.

    Example: `python -m proofs challenge reveal runs/challenge --seed "$SECRET" --json scores.json`
    """
    if len(seed) != len(folders):
        raise typer.BadParameter(
            f"{len(folders)} folders and {len(seed)} seeds were given; give --seed once a folder",
            param_hint="--seed",
        )
    if len(folders) > 1 and (oracle or round_ == 2):
        raise typer.BadParameter("--oracle and --round 2 take one folder", param_hint="DIR")

    from rich.console import Console

    from proofs.challenge.folder import ChallengeFolder
    from proofs.challenge.reveal import pool
    from proofs.challenge.reveal import reveal as work
    from proofs.results_page import challenge_section, write_section

    with bars() as shown:
        task = shown.add_task("oracle" if oracle else "scoring", total=None)

        def progress(done: int, total: int) -> None:
            shown.update(task, completed=done, total=total)

        results = []
        for folder, secret in zip(folders, seed, strict=True):
            place = folder if scheduler is None else folder.resolve()
            opened = work(
                ChallengeFolder(place, round_), secret, with_oracle=oracle, jobs=jobs,
                scheduler=scheduler, progress=progress,
            )  # fmt: skip
            results.append(opened)
        result = pool(results)
    emit(result.as_dict(), json)
    if page is not None:
        write_section(page, f"challenge {result.generator}", challenge_section(result, seed))
    console = Console(stderr=str(json) == "-")
    _show(result, console)
    if any(figure.met is False for figure in result.figures):
        raise typer.Exit(1)


def _show(result: Any, console: Any) -> None:
    for draw in result.draws:
        console.print(f"commitment {draw.commitment}: kept", highlight=False)
    console.print(_confusion(result))
    console.print(_figures(result))
    if result.unanswered:
        console.print(f"{len(result.unanswered)} cases have no answer and are not counted")


def _confusion(result: Any) -> Any:
    from rich.table import Table

    table = Table(title="Truth and answers")
    table.add_column("truth", no_wrap=True)
    table.add_column("n", justify="right")
    table.add_column("answers")
    for truth, counts in result.confusion.items():
        answers = ", ".join(f"{answer} {count}" for answer, count in counts.items())
        table.add_row(truth, str(sum(counts.values())), answers)
    return table


def _figures(result: Any) -> Any:
    from rich.table import Table

    table = Table(title="Figures and goals")
    table.add_column("figure")
    for name in ("value", "95 %", "goal", "n", ""):
        table.add_column(name, justify="right", no_wrap=True)
    words = {True: "met", False: "missed", None: ""}
    for figure in result.figures:
        if figure.value is None:
            value, span = "-", ""
        elif figure.ci95 is None:
            value, span = f"{figure.value:.3g}", ""
        else:
            value = f"{figure.value:.1%}"
            span = f"{figure.ci95[0]:.1%}..{figure.ci95[1]:.1%}"
        table.add_row(figure.what, value, span, figure.goal, str(figure.count), words[figure.met])
    return table
