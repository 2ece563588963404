"""``python -m proofs paper``: published results beside ours; ``study``: those that take hours."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from ventbench.base import files
from ventbench.base.errors import InputError, require
from ventbench.cli.options import (
    InProcess,
    JsonFile,
    RecordingsDir,
    SimulatorName,
    Workers,
    bar,
    bars,
    claim_out,
    emit,
    recordings_folder,
    written_console,
)

app = typer.Typer(
    name="study", help="Compare training methods, and variants of a design.", no_args_is_help=True
)

Only = Annotated[
    list[str] | None,
    typer.Option(metavar="NAME", help="Only this variant and the base; may be repeated."),
]

Store = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="Also put the results into this file, in the form of proofs/paper/stored.json.",
    ),
]


def paper(
    recordings: RecordingsDir = None,
    workers: Workers = 0,
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Also write a page with the figures as pictures."),
    ] = None,
    store: Store = None,
    json: JsonFile = None,
) -> None:
    """Set each table and figure of the paper that needs no hardware beside ours, as Markdown.

    The grid of PIDs and the bundled entries run on the frozen simulators; what takes minutes is
    read from stored results. With --recordings the errors by horizon are measured again; `study
    --store` renews the others.

    Example: `python -m proofs paper --out paper.html --json paper.json`
    """
    from proofs.paper.page import page
    from proofs.paper.paper import reproduce_paper

    if out is not None:
        require("matplotlib")

    with bar("paper") as progress:
        result, stored = reproduce_paper(
            recordings=recordings,
            workers=workers,
            progress=lambda what, share: progress(share, text=what),
        )
    if out is not None:
        files.write_text(out, page(result))
    emit(result.to_json(), json)
    typer.echo(result.to_markdown(), err=str(json) == "-")
    _keep(store, **stored)


@app.command()
def samples(
    lung: Annotated[str, typer.Option(metavar="ID", help="Lung, such as R20C50.")] = "R20C50",
    seeds: Annotated[
        int, typer.Option(min=1, max=32, help="Number of trainings of each method.")
    ] = 5,
    out: Annotated[
        Path, typer.Option(metavar="DIR", callback=claim_out, help="Folder for the results.")
    ] = Path("runs/study"),
    share: Annotated[
        float,
        typer.Option(min=0.001, max=1.0, help="Share of the full length of each training to run."),
    ] = 1.0,
    store: Store = None,
    json: JsonFile = None,
) -> None:
    """Compare how many breaths policy gradient, PPO and DQN need for a score.

    Writes study-samples.png. Ctrl-C keeps the finished work; the same command continues. The
    picture needs the extra `view`.

    Example: `python -m proofs study samples --lung R20C50 --seeds 5`
    """
    from proofs.studies import samples as work
    from ventbench.task.lungs import scored_lung

    require("matplotlib")
    with bars() as tell:
        result = work.sample_efficiency(
            scored_lung(lung),
            range(seeds),
            out,
            share=share,
            progress=lambda name, done, best: tell(name, done, text=f"{name}: {best:.3f} cmH2O"),
        )
    picture = work.learning_curves_png(result)
    files.write_atomically(out / "study-samples.png", lambda file: file.write(picture))
    _keep(store, samples=result.stored())
    table = result.summary()
    title = (
        f"{result.lung}: nominal score, cmH2O, and breaths of experience; the corrected PID has "
        f"{result.start:.3f}, the best of the grid {result.best_pid:.3f}"
    )
    values = {"lung": result.lung, "methods": table.to_dict("records")}
    _tell(values, title, table.set_index("method").T, out, json)


@app.command()
def controllers(
    seeds: Annotated[
        int, typer.Option(min=1, max=32, help="Number of trainings of each variant.")
    ] = 3,
    updates: Annotated[int, typer.Option(min=1, help="Number of updates of each training.")] = 1000,
    only: Only = None,
    out: Annotated[
        Path, typer.Option(metavar="DIR", callback=claim_out, help="Folder for the results.")
    ] = Path("runs/controllers"),
    workers: Workers = 0,
    store: Store = None,
    json: JsonFile = None,
) -> None:
    """Remove or change one part of the residual controller at a time.

    Each variant is trained with each seed as one network for all six lungs. Reports the nominal
    score, the score on the 20 published draws and the exploitation index. Ctrl-C keeps the finished
    trainings; the same command continues.

    Example: `python -m proofs study controllers --seeds 3 --updates 1000`
    """
    from proofs.studies import controllers as work
    from submissions.residual_mlp.train import ResidualConfig
    from ventbench.plants import frozen

    config = ResidualConfig(updates=updates)
    _check(only, work.variants(config))
    with bar("controllers") as progress:
        runs = work.compare(
            frozen.load(),
            out,
            range(seeds),
            config=config,
            only=only,
            workers=workers,
            progress=lambda what, share: progress(share, text=what),
        )
    _keep(store, controllers=work.stored(runs, config))
    table = work.summary(runs)
    title = "Mean |pressure - target|, cmH2O, averaged over seeds, and difference to the base"
    values = {"updates": updates, "variants": table.to_dict("records")}
    shown = ["variant", *work.FIGURES, "nominal_change_low", "nominal_change_high"]
    _tell(values, title, table[shown].set_index("variant"), out, json)


@app.command()
def networks(
    recordings: RecordingsDir = None,
    only: Only = None,
    out: Annotated[
        Path, typer.Option(metavar="DIR", callback=claim_out, help="Folder for the results.")
    ] = Path("runs/networks"),
    workers: Workers = 0,
    store: Store = None,
    json: JsonFile = None,
) -> None:
    """Change windows, width, depth and boundary networks of the paper's simulators, one at a time.

    The networks are trained on the public recordings in five folds. Each breath is simulated, open
    loop, by the network that was not trained on it. Ctrl-C keeps the finished trainings; the same
    command continues.

    Example: `python -m proofs study networks --recordings ../shared/recordings`
    """
    from proofs.studies import networks as work

    folder = recordings_folder(recordings)
    _check(only, work.variants(work.ARCHITECTURE))
    with bar("networks") as progress:
        breaths = work.compare(
            folder,
            out,
            only=only,
            workers=workers,
            progress=lambda what, share: progress(share, text=what),
        )
    _keep(store, networks=work.stored(breaths))
    table = work.summary(breaths)
    title = "Held-out open-loop MAE, cmH2O, and its change from the base, paired by breath"
    values = {"variants": table.to_dict("records")}
    _tell(values, title, table.set_index("variant"), out, json)


@app.command()
def adversary(
    name: Annotated[
        str,
        typer.Argument(metavar="SUBMISSION", help="Folder or name of a bundled submission."),
    ],
    lung: Annotated[
        list[str] | None,
        typer.Option(help="Lung to search on; may be repeated. Default: all."),
    ] = None,
    stressor: Annotated[
        list[str] | None,
        typer.Option(help="Stressor that may act; may be repeated. Default: all, and the rig."),
    ] = None,
    simulator: SimulatorName = "frozen",
    in_process: InProcess = False,
    json: JsonFile = None,
) -> None:
    """Search for the mildest plausible physics that makes a controller unsafe.

    Severity 0 is the rig in the middle of the population, 1 the end of the range: a stressor at its
    strong strength, or a rig three standard deviations away; what acts together adds as squares.
    The exit code is 1 if something unsafe was found.

    Example: `python -m proofs study adversary pid_robust --lung R5C10`
    """
    from proofs.studies import adversary as work

    with bar(f"searching for what makes {name} unsafe"):
        unsafe = work.adversary(
            name,
            simulator=simulator,
            lungs=lung or (),
            stressors=stressor or (),
            sandbox=not in_process,
        )
    emit({"submission": name, "lungs": [asdict(critical) for critical in unsafe]}, json)
    text = "\n".join(line for critical in unsafe for line in critical.lines())
    typer.echo(text, err=str(json) == "-")
    raise typer.Exit(int(any(critical.severity is not None for critical in unsafe)))


def _check(only: list[str] | None, known: dict[str, Any]) -> None:
    for name in only or ():
        if name not in known:
            raise InputError(
                f"--only {name}: there is no such variant; choose from {', '.join(known)}"
            )


def _keep(store: Path | None, **section: Any) -> None:
    """Put the results of a study into a file of such, beside those of others."""
    from proofs.paper.paper import load_stored

    if store is not None:
        kept = load_stored(store) if store.is_file() else {}
        files.write_json(store, kept | section)


def _tell(values: Any, title: str, table: Any, out: Path, json: Path | None) -> None:
    # What is not reached is NaN in a table and null in JSON.
    console = written_console(files.json_values(values), json)
    text = table.to_string(na_rep="-", float_format="{:.3f}".format)
    console.print(f"{title}\n\n{text}\n\nwrote {out}", soft_wrap=True)
