"""Commands before and after runs, calibration and trial; and what all commands share."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TextIO

import msgspec
import typer

from ventbench.base import files
from ventbench.base.errors import InputError
from ventbench.cli.options import JsonFile, complete_lungs, emit
from ventbench.task.lungs import scored_lung

if TYPE_CHECKING:
    from hardware_eval.bench.calibrate import Calibration
    from hardware_eval.bench.console import ConsoleOperator
    from hardware_eval.bench.loop import Bench
    from hardware_eval.results.evaluate import Line

Port = Annotated[
    str,
    typer.Option(
        help="Serial port of the device, such as /dev/ttyACM0, socket://HOST:PORT, the path that "
        "`emulate` prints, or virtual:R20C50, an emulated lung in this process, faster than real "
        "time."
    ),
]
Lung = Annotated[
    str, typer.Option(help="Label of the mounted lung.", autocompletion=complete_lungs)
]
Yes = Annotated[
    bool, typer.Option("--yes", help="Confirm every question; for an emulator, not for a bench.")
]


def told(json: Path | None) -> TextIO:
    """Where a command speaks to people: not where its JSON goes."""
    return sys.stderr if str(json) == "-" else sys.stdout


def show(value: object, json: Path | None, *lines: object, ok: bool = True) -> None:
    """Write the result of a command to the file of ``--json``, and lines for people.

    The result may hold dataclasses, paths and what NumPy makes; a number that is not finite
    becomes null.

    Raises:
        typer.Exit: with code 1 if the answer is no.
    """
    emit(files.json_values(msgspec.to_builtins(value, enc_hook=_plain)), json)
    print(*lines, sep="\n", file=told(json))
    if not ok:
        raise typer.Exit(1)


def _plain(value: Any) -> Any:
    """What JSON has for a value of NumPy, or a path."""
    return value.tolist() if hasattr(value, "tolist") else str(value)


@contextlib.contextmanager
def bench_on(
    port: str,
    *,
    yes: bool,
    confirmed: bool = True,
    kept: Path | None = None,
) -> Iterator[tuple[Line, Bench, ConsoleOperator]]:
    """A bench with a person at it; the line is released at the end.

    Real devices must have been brought up before, unless they need not be ``confirmed``. Any key is
    the emergency stop, which ends the command with exit code 1. However it ends early, the message
    says whether the lung is vented, and where ``kept`` lies what the same command continues.
    """
    from hardware_eval.bench.console import ConsoleOperator
    from hardware_eval.bench.loop import Bench, EmergencyStop
    from hardware_eval.bench.safety import DEFAULT
    from hardware_eval.results import evaluate as ev

    line = ev.connect(port, confirmed)
    client = line.client

    def ending(reason: str) -> str:
        begun = kept is not None and kept.exists()
        left = f"; what is done is in {kept}: the same command continues" if begun else ""
        return f"{reason}; {client.ending()}{left}"

    try:
        person = ConsoleOperator(yes=yes, device=line.device)
        with contextlib.closing(client), person.keys():
            yield line, Bench(client, line.clock, DEFAULT, person), person
    except EmergencyStop:
        print(ending("stopped: the operator pressed the emergency stop"), file=sys.stderr)
        raise typer.Exit(1) from None
    except KeyboardInterrupt:
        print(ending("interrupted"), file=sys.stderr)
        raise
    except BrokenPipeError as error:
        raise InputError(ending("nobody reads this program's output any more")) from error
    except OSError as error:
        raise InputError(ending(f"{error.filename or 'output'}: {error.strerror}")) from error
    except InputError as error:
        raise InputError(ending(str(error))) from error


Calibrated = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="Calibration of this device, by `calibrate`."),
]


def trial(
    sessions: Annotated[
        list[Path],
        typer.Argument(help="Folders of finished sessions, or their raw.jsonl: one trial."),
    ],
    json: JsonFile = None,
) -> None:
    """Errors, gaps to simulation, success and rank agreement, with 95 % intervals.

    Sessions of one trial have the same entries, PIPs and repeats, and mount lungs anew.

    Example: `ventbench-hardware trial runs/monday runs/tuesday`
    """
    from hardware_eval.results.trial import analyse

    done = analyse(sessions)
    show(done, json, done)


def report(
    session: Annotated[Path, typer.Argument(help="Folder of a session, finished or not.")],
    json: JsonFile = None,
) -> None:
    """Write a session's page and its acceptance report in the form of ISO 80601-2-12, as HTML.

    Example: `ventbench-hardware report runs/hardware`
    """
    from hardware_eval.results import acceptance, page

    written = {"session": page.write(session)}
    try:
        written["acceptance"] = acceptance.write(session)
    except InputError as error:  # no run is complete yet
        print(error, file=told(json))
    show(written, json, *written.values())


def calibrate(
    part: Annotated[str, typer.Argument(help="zero, span, valve, peep, flow, leak or lung.")],
    port: Port,
    lung: Lung = "R5C20",
    reference: Annotated[
        str | None,
        typer.Option(
            metavar="LIST",
            help="Reference values in the order of setting, up and down: pressures of span, flows "
            "of flow, openings of valve, PEEP by an instrument.",
        ),
    ] = None,
    out: Annotated[
        Path, typer.Option(metavar="FILE", help="The device's calibration; parts are added to it.")
    ] = Path("calibration.json"),
    yes: Yes = False,
    json: JsonFile = None,
) -> None:
    """Measure a part of a bench's calibration, with intervals, and keep it in a dated file.

    The valve of a device without a flow sensor is read from a meter, opening by opening.

    Example: `ventbench-hardware calibrate span --port /dev/ttyACM0 --reference 0,20,40,20,0`
    """
    from hardware_eval.bench import calibrate as calibration

    values = numbers("--reference", reference)
    label = scored_lung(lung).id
    files.claim_folder(out.parent)  # what a person reads off instruments must not be lost
    with bench_on(port, yes=yes) as (line, bench, _):
        device = line.client.identity.device
        kept = calibration.load(out, device, stale=True).parts if out.exists() else {}
        if part not in calibration.BASE and kept:
            line.client.calibrate(calibration.Calibration(device, kept).correction())
        made = calibration.measure(bench, part, lung=label, reference=values)
    dropped = [x for x in kept if part in calibration.BASE and x not in calibration.BASE]
    kept = {kind: x for kind, x in kept.items() if kind not in dropped}
    saved = calibration.Calibration(device, {**kept, part: made}).save(out)
    lines = [str(made)]
    if part == "leak":
        lines.append(f"leak: {calibration.lost_flow(made, label)} mL/s of {label}")
    if dropped:
        lines.append(f"measured by the readings of before, measure again: {', '.join(dropped)}")
    show(
        {"part": part, "fit": made.fit, "file": out, "sha256": saved.sha256},
        json,
        *lines,
        f"readings are corrected to {saved.correction()}",
        f"{out}: {', '.join(saved.parts)}; SHA-256 {saved.sha256}",
    )


def bringup(
    port: Port,
    operator: Annotated[str, typer.Option(help="Who stands at the machine and confirms.")],
    only: Annotated[
        str | None,
        typer.Option(
            metavar="STEP",
            help="Only one step, and keep nothing: room or reference (read the sensor), "
            "expiratory or inspiratory (click a valve), vent.",
        ),
    ] = None,
    json: JsonFile = None,
) -> None:
    """Walk through a machine before anything runs on it: sensor, each valve, the vent.

    Exit code 1 if a step was wrong. No real device is armed without it; it is stale after 30 days,
    and after any change of wiring or calibration.

    Example: `ventbench-hardware bringup --port /dev/ttyACM0 --operator "A. Name"`
    """
    from hardware_eval.bench import bringup as steps

    if not operator.strip():
        raise InputError("--operator: give the name of who stands at the machine")
    if only is not None and only not in steps.STEPS:
        raise InputError(f"--only {only!r}: choose of {', '.join(steps.STEPS)}")
    with bench_on(port, yes=False, confirmed=False) as (line, bench, _):
        if line.client.simulated and only is None:
            needless = "a simulated device: no valve moves, so that it needs no bring-up"
            show({"simulated": True}, json, needless)
            return
        if only is not None:
            findings = steps.look(bench, only)
            content, ok = [x.as_dict() for x in findings], all(x.ok for x in findings)
            show({"findings": content}, json, *findings, ok=ok)
            return
        findings = steps.bring_up(bench)
        kept = steps.keep(line.client, operator, findings)
    about = f"bring-up by {operator}: {'confirmed' if kept['go'] else 'NOT CONFIRMED'}"
    file = f"{kept['file']}; SHA-256 {kept['sha256']}"
    show(kept, json, about, *findings, file, ok=kept["go"])


def calibration_of(line: Line, path: Path | None) -> Calibration:
    """The calibration that a command is given, or one without parts; it corrects readings now.

    Raises:
        InputError: if it is stale, was changed, or is of another device than the line's.
    """
    from hardware_eval.bench import calibrate as calibration

    if path is None:
        return calibration.Calibration({}, {})
    found = calibration.load(path, line.client.identity.device)
    line.client.calibrate(found.correction())
    print(f"calibrated by {path}: {found.correction()}", file=sys.stderr)
    return found


def numbers(option: str, text: str | None) -> list[float]:
    """Numbers separated by commas.

    Raises:
        InputError: if they are none.
    """
    try:
        return [float(part) for part in text.split(",")] if text else []
    except ValueError:
        raise InputError(f"{option} {text!r}: write numbers separated by commas") from None
