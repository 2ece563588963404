"""The command line ``ventbench-hardware``: parses, calls, prints.

Exit codes: 0 done; 1 the command ran and the answer is no (a plan that is not finished, an entry
without a score, a no-go); 2 bad input or no device.
"""

from __future__ import annotations

import contextlib
import secrets
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Annotated

import typer

from hardware_eval.commands import (
    Calibrated,
    Lung,
    Port,
    Yes,
    bench_on,
    bringup,
    calibrate,
    calibration_of,
    numbers,
    report,
    show,
    told,
    trial,
)
from ventbench.base import files
from ventbench.base.text import number, plain
from ventbench.cli import options
from ventbench.cli.options import JsonFile, bar
from ventbench.task.lungs import scored_lung

#: What options are called now, by their former names.
FORMER = {
    "--largest-rise": "in the TOML file of `ventbench-hardware run --plan FILE`",
    "--largest-u-in": "in the TOML file of `ventbench-hardware run --plan FILE`",
    "--perturb": "in the TOML file of `ventbench-hardware run --plan FILE`",
    "--pip": "`--pips`",
    "--plant": "`--simulator`",
}

app = options.program(
    "ventbench-hardware",
    "Entries on a physical lung: run, check and compare; or an emulator of the bench.",
    former=FORMER,
)

Lungs = Annotated[
    list[str],
    typer.Option(
        "--lung",
        metavar="LUNG",
        help="Lung, such as R20C50; repeatable.",
        autocompletion=options.complete_lungs,
    ),
]
Skip = Annotated[
    list[str] | None,
    typer.Option(
        "--skip",
        metavar="PART",
        help="Leave out a part of the self-test: sensor, leak, sweep or lung; repeatable. The "
        "record says so, and without sensor or lung has no rank.",
    ),
]


@app.command()
def run(
    submissions: Annotated[
        list[str],
        typer.Argument(
            help="Folders of submissions, or names of bundled ones.",
            autocompletion=options.complete_entries,
        ),
    ],
    port: Port,
    lung: Lungs,
    plan: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="How to run, in TOML; the manual lists the keys."),
    ] = None,
    pips: Annotated[
        str | None, typer.Option(metavar="LIST", help="PIPs, such as 10,20,35. Default: all six.")
    ] = None,
    repeats: Annotated[
        int | None, typer.Option(min=1, max=100, help="Runs of each lung and PIP. Default: 10.")
    ] = None,
    out: Annotated[
        Path, typer.Option(metavar="DIR", help="Log, recording and records; a plan continues.")
    ] = Path("runs/hardware"),
    operator: Annotated[str, typer.Option(help="Who stands at the bench, for the record.")] = "",
    in_process: options.InProcess = False,
    yes: Yes = False,
    json: JsonFile = None,
) -> None:
    """Run entries on lungs by a plan; interrupted, the same command continues it.

    While it runs, any key is the emergency stop; Ctrl-C vents too.

    Example: `ventbench-hardware run submissions/pid_best --port /dev/ttyACM0 --lung R20C50`
    """
    from hardware_eval.bench.console import Blind, show_bars, show_in_rerun
    from hardware_eval.bench.plan import make_plan, read_procedure
    from hardware_eval.results import evaluate as ev

    how = read_procedure(plan)
    entries, track = ev.open_entries(submissions, how.track)
    files.claim_folder(out)
    begun = ev.begun_plan(out)
    seed = secrets.randbits(32) if begun is None else int(begun["seed"])
    planned = make_plan(
        [x.manifest.name for x in entries],
        lung,
        track=track,
        pips=numbers("--pips", pips) or how.pips,
        repeats=repeats or how.repeats,
        control_every=how.control_every,
        perturbations=how.perturb,
        seed=seed if how.seed is None else how.seed,
    )
    shows = [show_bars, *([show_in_rerun(how.rerun)] if how.rerun else [])]
    calibration = None if how.calibration is None else Path(how.calibration)

    with bench_on(port, yes=yes, kept=out) as (line, _, person):
        calibrated = calibration_of(line, calibration)
        masked = Blind(planned, how.blind)
        person.hidden = masked.hidden
        done = ev.evaluate(
            entries,
            line,
            out,
            person,
            plan=planned,
            how=how,
            shows=[masked.hiding(show) for show in shows],
            sandbox=not in_process,
            operator_name=operator,
            calibration=calibrated,
        )
    reason = masked.hidden(done.reason)
    complete, lines = not (reason or done.stopped), list[str]()
    if reason:
        lines.append(f"stopped: {plain(reason)}; {line.client.ending()}")
        lines.append(f"what is done is in {done.log}; the same command continues")
    for name, path in done.records.items():
        if name in masked.called:
            lines.append(f"{masked.called[name]} is {name}")
        lines.append(f"{name}: record {path}")
        if name in done.stopped:
            lines.append(f"{name}: no score: {plain(done.stopped[name])}")
        if name not in done.unrun:
            lines.append(f"next: ventbench board add {path}")
    about = {
        "complete": complete,
        "reason": reason,
        "log": done.log,
        "recording": done.recording,
        "records": done.records,
        "stopped": done.stopped,
    }
    show(about, json, *lines, ok=complete)


@app.command()
def emulate(
    lung: Lung = "R20C50",
    simulator: options.SimulatorName = "frozen",
    link: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Symbolic link to make to the terminal.")
    ] = None,
    firmware: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="A program of hardware_eval/firmware as the device; .elf runs under QEMU.",
        ),
    ] = None,
) -> None:
    """Emulate the ventilator and a lung on a pseudo-terminal; prints its path.

    Example: `ventbench-hardware emulate --lung R20C50 --link ./lung`
    """
    from hardware_eval.device.program import DeviceService
    from hardware_eval.emulation import emulator, simulated
    from hardware_eval.emulation.firmware import Firmware, command_of
    from hardware_eval.realtime import prefer, told_to_end
    from ventbench.plants.catalog import load_simulators

    emulator.check_link(link)
    command = None if firmware is None else command_of(firmware)
    lung_plant = load_simulators(simulator).plant(lung)
    print("compiling the lung; the terminal appears when it answers", file=sys.stderr, flush=True)
    hal = simulated.SimulatedHal(lung_plant, name=f"emulated {lung}", sensor=simulated.PVP_SENSOR)
    begun = time.monotonic()
    running = contextlib.nullcontext()
    if command is not None:
        running = contextlib.closing(Firmware(command, hal, begun))
    with running as image:
        device = emulator.Emulator(image or DeviceService(hal, 0.0), link=link, begun=begun)
        prefer()
        ended = told_to_end()
        if image is not None:
            image.start(lambda: device.port.inbox.put(b""))
        print(device.terminal, flush=True)
        print(f"ready: {hal.identity.name}; Ctrl-C ends it", file=sys.stderr, flush=True)
        device.run(lambda: ended() or (image is not None and image.lost))
        print(f"longest lateness of the device: {1e3 * device.lateness:.1f} ms", file=sys.stderr)
    if image is not None and image.lost:
        raise typer.Exit(1)


@app.command()
def selftest(
    port: Port,
    lung: Lung,
    simulator: options.SimulatorName = "frozen",
    skip: Skip = None,
    calibration: Calibrated = None,
    json: JsonFile = None,
) -> None:
    """Test sensor, valves, tubes, clock and lung; exit code 1 if it is no-go.

    Example: `ventbench-hardware selftest --port /dev/ttyACM0 --lung R20C50`
    """
    from hardware_eval.bench.selftest import chosen_parts
    from hardware_eval.bench.selftest import selftest as run_selftest
    from ventbench.plants.catalog import load_simulators

    label, simulators = scored_lung(lung).id, load_simulators(simulator)
    left_out = chosen_parts(skip or ())
    with bench_on(port, yes=True) as (line, bench, _):
        baseline = calibration_of(line, calibration).baseline()
        sheet = run_selftest(bench, label, simulator=simulators, baseline=baseline, skip=left_out)
    show(sheet.as_dict(), json, sheet, ok=sheet.go)


@app.command()
def conformance(
    port: Port,
    json: JsonFile = None,
) -> None:
    """Does a device follow PROTOCOL.md? Exit code 1 if a line of it does not hold.

    The valves move, up to 100 % for a moment: supply off, or an open tube.

    Example: `ventbench-hardware conformance --port /dev/ttyACM0`
    """
    from hardware_eval.results import evaluate as ev
    from hardware_eval.wire import conformance as judge

    shown = told(json)
    line = ev.connect(port)
    transport = line.client.transport
    try:
        clauses = judge.conformance(
            transport, line.clock, lambda clause: print(clause, file=shown, flush=True)
        )
    finally:
        transport.close()
    counts = Counter(clause.holds for clause in clauses)
    failed = counts[False]
    show(
        {"holds": not failed, "clauses": clauses},
        json,
        f"{counts[True]} hold, {failed} fail, {counts[None]} not tried",
        ok=not failed,
    )


@app.command()
def compare(
    recorded: Annotated[
        Path,
        typer.Argument(
            metavar="RECORD",
            help="Hardware record, with its raw.jsonl beside it; or a session's folder, a log, or "
            "a recording in the public schema.",
        ),
    ],
    simulator: options.SimulatorName = "frozen",
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Folder for the diagnosis of each lung: report, JSON, corrected simulator.",
        ),
    ] = None,
    diagnose: Annotated[
        bool, typer.Option(help="Also say which physics is missing; --no-diagnose is quick.")
    ] = True,
    json: JsonFile = None,
) -> None:
    """Show how far simulators and the lung part by lung, and diagnose it.

    Example: `ventbench-hardware compare runs/hardware --out runs/mismatch`
    """
    from hardware_eval.results.record import recorded_breaths, scored_plants
    from ventbench.simulation import error_summary, mean_errors

    breaths = recorded_breaths(recorded)
    tested = scored_plants(simulator, list(breaths.by_lung_index))
    error = mean_errors(tested.pressures(breaths), breaths)
    lungs = {lung: error_summary("", error[index]) for lung, index in breaths.by_lung_index.items()}
    diagnoses = {}
    if diagnose:
        from ventbench.diagnosis.diagnose import diagnose as run_diagnosis

        for lung in lungs:
            diagnoses[lung] = run_diagnosis(breaths, simulator=tested, lung=lung)
            if out is not None:
                diagnoses[lung].save(out / lung)
    found = {lung: diagnosis.as_dict() for lung, diagnosis in diagnoses.items()}
    show(
        {"simulator": tested.name, "unit": "cmH2O", "lungs": lungs, "diagnoses": found},
        json,
        f"open-loop MAE of the {tested.name} simulators, cmH2O",
        *(f"  {lung}: {number(x['mae'])} ({x['breaths']} breaths)" for lung, x in lungs.items()),
        *(f"{lung}: {diagnosis}" for lung, diagnosis in diagnoses.items()),
    )


#: Pressure above which `collect` closes the valve, cmH2O.
_EASE = 45.0


@app.command()
def collect(
    port: Port,
    lung: Lung,
    breaths: Annotated[int, typer.Option(min=1, help="Breaths in all.")] = 60,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the disturbances.")] = 0,
    out: Annotated[
        Path, typer.Option(metavar="DIR", help="Log and recording; a collection continues.")
    ] = Path("runs/exploration"),
    yes: Yes = False,
    json: JsonFile = None,
) -> None:
    """Explore a lung as in the paper, safely, to make a training recording.

    Example: `ventbench-hardware collect --port /dev/ttyACM0 --lung R20C50 --breaths 600`
    """
    from hardware_eval.bench.drive import collect as run_collection
    from hardware_eval.bench.raw_log import RECORDING
    from hardware_eval.results import evaluate as ev

    label = scored_lung(lung).id
    files.claim_folder(out)
    with bench_on(port, yes=yes, kept=out) as (line, bench, person):
        if not person.confirm(f"set the lung to {label} and connect it. Is it set?"):
            raise typer.Exit(1)
        with bar("exploring") as exploring:
            explored, stopped = run_collection(
                bench,
                label,
                breaths,
                out,
                seed=seed,
                ease=_EASE,
                about={"device": ev.device_about(line)},
                progress=lambda number: exploring(number, breaths),
            )
    count, recording = len(explored), out / RECORDING
    lines = [f"{count} whole breaths: {recording}"]
    if stopped:
        lines.append(f"stopped: {plain(stopped)}; {line.client.ending()}")
        lines.append(f"what is done is in {out}; the same command continues")
    about = {"breaths": count, "recording": recording, "stopped": stopped}
    show(about, json, *lines, ok=not stopped)


@app.command()
def demo(
    conceal: Annotated[
        str, typer.Option(metavar="WORDS", help="They determine the concealed physics.")
    ] = "monday",
    out: Annotated[Path, typer.Option(metavar="DIR", help="Empty folder for everything.")] = Path(
        "runs/demo"
    ),
    breaths: Annotated[int, typer.Option(min=12, help="Breaths to explore.")] = 36,
    simulator: options.SimulatorName = "physics",
    in_process: options.InProcess = False,
    json: JsonFile = None,
) -> None:
    """Close the loop on an emulated lung that conceals physics: find it, correct, control better.

    Example: `ventbench-hardware demo --conceal "any words" --out runs/demo`
    """
    from hardware_eval.demo import demo as run_demo

    to = told(json)
    done = run_demo(
        conceal,
        out,
        breaths=breaths,
        simulator=simulator,
        sandbox=not in_process,
        tell=lambda text: print(text, file=to, flush=True),
    )
    said = f"{done.seconds:.0f} s; all figures: {out / 'demo.json'}"
    show(done, json, said, ok=done.better)


@app.command()
def replay(
    log: Annotated[Path, typer.Argument(help="raw.jsonl of a session, or its folder.")],
    record: Annotated[
        Path | None, typer.Option(help="Hardware record whose errors the log must give.")
    ] = None,
    rerun: Annotated[
        str | None, typer.Option(metavar="FILE|live", help="Show the breaths in rerun.")
    ] = None,
    mcap: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write the breaths to an MCAP file.")
    ] = None,
    json: JsonFile = None,
) -> None:
    """Show a session again, compute its timing from the raw log, and check a record by it.

    Example: `ventbench-hardware replay runs/hardware`
    """
    from hardware_eval.results.record import replay as run_replay

    report = run_replay(log, record=record, rerun=rerun, mcap=mcap)
    show(report, json, report, ok=not report.problems)


app.command()(bringup)
app.command()(trial)
app.command()(report)
app.command()(calibrate)


def main() -> None:
    """Entry point of the console script."""
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(AttributeError):  # closed, or replaced
            stream.reconfigure(errors="replace")  # type: ignore[union-attr]
    options.run(app, "ventbench-hardware")
