"""The command line ``ventbench-hardware``: parses, calls, prints.

Exit codes: 0 done; 1 the command ran and the answer is no (a plan that is not finished, a no-go);
2 bad input or no device.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from ventbench import __version__
from ventbench.cli.options import JsonFile, emit
from ventbench.errors import InputError
from ventbench.text import plain

app = typer.Typer(
    name="ventbench-hardware",
    help="Entries on a physical lung: run, check and compare; or an emulator of the bench.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
)

Port = Annotated[
    str,
    typer.Option(
        help="Serial port of the device, such as /dev/ttyACM0, socket://HOST:PORT, or the path "
        "that `emulate` prints."
    ),
]
Lungs = Annotated[
    list[str], typer.Option("--lung", metavar="LUNG", help="Lung, such as R20C50; repeatable.")
]
Yes = Annotated[
    bool, typer.Option("--yes", help="Confirm every question; for an emulator, not for a bench.")
]
Control = Annotated[
    Path | None,
    typer.Option(
        metavar="SOCKET", help="Control socket of an emulator, which then disturbs the tube itself."
    ),
]


def _version(value: bool) -> None:
    if value:
        print(f"ventbench-hardware {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: bool = typer.Option(
        False, "--version", callback=_version, is_eager=True, help="Print the version and exit."
    ),
) -> None:
    pass


@app.command()
def run(
    submissions: Annotated[
        list[str], typer.Argument(help="Folders of submissions, or names of bundled ones.")
    ],
    port: Port,
    lung: Lungs,
    pip: Annotated[
        list[float] | None,
        typer.Option("--pip", metavar="CMH2O", help="PIP; repeatable. Default: all six."),
    ] = None,
    pips: Annotated[
        str | None, typer.Option(metavar="LIST", help="PIPs separated by commas, such as 10,20,35.")
    ] = None,
    repeats: Annotated[int, typer.Option(min=1, max=100, help="Runs of each lung and PIP.")] = 10,
    track: Annotated[
        str | None,
        typer.Option(help="performance (the lung is told) or robustness; default: the entry's."),
    ] = None,
    perturb: Annotated[
        list[str] | None,
        typer.Option(help="Also run with a disturbed tube: leak or pinch; repeatable."),
    ] = None,
    control_every: Annotated[
        int, typer.Option(min=0, help="Scored runs between two control runs of the PID; 0: none.")
    ] = 10,
    seed: Annotated[int, typer.Option(help="Seed of the order of the runs.")] = 0,
    out: Annotated[
        Path, typer.Option(metavar="DIR", help="Log, recording and records; a plan continues.")
    ] = Path("runs/hardware"),
    operator: Annotated[str, typer.Option(help="Who stands at the bench, for the record.")] = "",
    notes: Annotated[str, typer.Option(help="Notes for the record.")] = "",
    largest_u_in: Annotated[
        float, typer.Option(help="Commands are cut to this, %; the record says so.")
    ] = 100.0,
    largest_rise: Annotated[
        float, typer.Option(help="Largest rise of the command in one step, %.")
    ] = 100.0,
    sandbox: Annotated[
        bool, typer.Option(help="Run entries as in scoring; --no-sandbox only for trusted code.")
    ] = True,
    dry_run: Annotated[
        bool, typer.Option(help="Run the plan on the frozen simulators first.")
    ] = True,
    selftest: Annotated[bool, typer.Option(help="Test the bench once each lung is set.")] = True,
    rest: Annotated[float, typer.Option(min=0.5, help="Time at rest before each run, s.")] = 4.0,
    rerun: Annotated[
        str | None,
        typer.Option(metavar="FILE|live", help="Also show breaths in rerun: a file, or live."),
    ] = None,
    control: Control = None,
    yes: Yes = False,
    json: JsonFile = None,
) -> None:
    """Run entries on lungs by a plan; interrupted, the same command continues it.

    While it runs, any key is the emergency stop; Ctrl-C vents too.

    Example: `ventbench-hardware run submissions/pid_best --port /dev/ttyACM0 --lung R20C50`
    """
    from hardware_eval import clock
    from hardware_eval import evaluate as ev
    from hardware_eval.console import ConsoleOperator, RerunView, TerminalView, Views
    from hardware_eval.plan import make_plan
    from hardware_eval.safety import SafetySettings
    from hardware_eval.selftest import selftest as run_selftest
    from hardware_eval.session import Bench
    from ventbench import files, protocol

    chosen = [*(pip or ()), *_numbers("--pips", pips)] or list(protocol.PIPS)
    entries, track = ev.open_entries(submissions, track)
    plan = make_plan(
        [x.manifest.name for x in entries], lung, track=track, pips=chosen, repeats=repeats,
        control_every=control_every, perturbations=perturb or (), seed=seed,
    )  # fmt: skip
    settings = SafetySettings(largest_u_in=largest_u_in, largest_rise=largest_rise)
    person = ConsoleOperator(yes=yes, control=control)
    views = Views(TerminalView(), *([RerunView(rerun)] if rerun else []))

    def before_lung(bench: Bench, mounted: str) -> str:
        if not selftest:
            return ""
        sheet = run_selftest(bench, mounted)
        files.write_json(out / f"selftest-{mounted}.json", sheet.as_dict())
        print(sheet, flush=True)
        return "" if sheet.go else "the self-test says no-go: " + "; ".join(sheet.problems())

    line = ev.connect(port)
    try:
        with person.keys(), clock.priority():
            done = ev.evaluate(
                entries, line, out, person, plan=plan, view=views, sandbox=sandbox, dry=dry_run,
                before_lung=before_lung, settings=settings, operator_name=operator, notes=notes,
                rest=rest,
            )  # fmt: skip
    finally:
        line.client.close()
    emit(
        {
            "complete": done.complete,
            "reason": done.reason,
            "log": str(done.log),
            "recording": None if done.recording is None else str(done.recording),
            "records": {name: str(path) for name, path in done.records.items()},
        },
        json,
    )
    shown = sys.stderr if str(json) == "-" else sys.stdout
    if not done.complete:
        print(f"stopped: {plain(done.reason)}", file=shown)
        print(f"what is done is in {done.log}; the same command continues", file=shown)
        raise typer.Exit(1)
    for name, path in done.records.items():
        print(f"{name}: record {path}", file=shown)
        print(f"next: ventbench board add {path}", file=shown)


def _numbers(option: str, text: str | None) -> list[float]:
    try:
        return [float(part) for part in text.split(",")] if text else []
    except ValueError:
        raise InputError(f"{option} {text!r}: write numbers separated by commas") from None


@app.command(
    context_settings={
        "allow_extra_args": True,
        "ignore_unknown_options": True,
        "help_option_names": [],
    }
)
def emulate(context: typer.Context) -> None:
    """Emulate the ventilator and a lung on a pseudo-terminal; prints its path.

    Options: --lung, --plant, --conceal WORDS, --seal FILE, --link PATH, --control SOCKET, --fault
    KIND@START[-END][:STRENGTH], --noise, --quantum, --log FILE; `emulate --help` explains them.

    Example: `ventbench-hardware emulate --lung R20C50 --link ./lung`
    """
    import os

    # In the thread that asks, which has priority; read when JAX is first imported.
    os.environ.setdefault("JAX_CPU_ENABLE_ASYNC_DISPATCH", "false")
    from hardware_eval.clock import priority
    from hardware_eval.emulator import main as run_emulator

    with priority():
        code = run_emulator(context.args)
    if code:
        raise typer.Exit(code)


@app.command()
def selftest(
    port: Port,
    lung: Annotated[str, typer.Option(help="Label of the mounted lung.")],
    plant: Annotated[str, typer.Option(help="Simulators that know the lungs.")] = "frozen",
    json: JsonFile = None,
) -> None:
    """Test sensor, valves, tubes, clock and lung; exit code 1 if it is no-go.

    Example: `ventbench-hardware selftest --port /dev/ttyACM0 --lung R20C50`
    """
    from hardware_eval import clock
    from hardware_eval import evaluate as ev
    from hardware_eval.console import ConsoleOperator
    from hardware_eval.safety import DEFAULT
    from hardware_eval.selftest import selftest as run_selftest
    from hardware_eval.session import Bench
    from ventbench.lungs import scored_lung

    label = scored_lung(lung).id
    person = ConsoleOperator(yes=True)
    line = ev.connect(port)
    try:
        with person.keys(), clock.priority():
            sheet = run_selftest(
                Bench(line.client, line.clock, DEFAULT, person), label, simulator=plant
            )
    finally:
        line.client.close()
    emit(sheet.as_dict(), json)
    print(sheet, file=sys.stderr if str(json) == "-" else sys.stdout)
    if not sheet.go:
        raise typer.Exit(1)


@app.command()
def replay(
    log: Annotated[Path, typer.Argument(help="raw.jsonl of a session, or its folder.")],
    record: Annotated[
        Path | None, typer.Option(help="Hardware record whose errors the log must give.")
    ] = None,
    rerun: Annotated[
        str | None, typer.Option(metavar="FILE|live", help="Show the breaths in rerun.")
    ] = None,
    json: JsonFile = None,
) -> None:
    """Show a session again, and compute its errors and timing from the raw log.

    Example: `ventbench-hardware replay runs/hardware`
    """
    from hardware_eval.replay import replay as run_replay

    report = run_replay(log, record=record, rerun=rerun)
    emit(report.as_dict(), json)
    print(report, file=sys.stderr if str(json) == "-" else sys.stdout)
    if report.problems:
        raise typer.Exit(1)


def main() -> None:
    """Entry point of the console script."""
    try:
        app()
    except KeyboardInterrupt:
        print("ventbench-hardware: interrupted; the lung is vented", file=sys.stderr)
        sys.exit(130)
    except (InputError, OSError) as error:
        lines = [plain(line) for line in str(error).split("\n")]
        print("ventbench-hardware:", "\n".join(lines), file=sys.stderr)
        sys.exit(2)
