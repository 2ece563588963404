"""Commands around a run: the trial that sessions make up; and what all commands share."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ventbench.cli.options import JsonFile, emit

if TYPE_CHECKING:
    from hardware_eval.bench.console import ConsoleOperator

Port = Annotated[
    str,
    typer.Option(
        help="Serial port of the device, such as /dev/ttyACM0, socket://HOST:PORT, the path that "
        "`emulate` prints, or virtual:R20C50, an emulated lung in this process, faster than real "
        "time."
    ),
]
Yes = Annotated[
    bool, typer.Option("--yes", help="Confirm every question; for an emulator, not for a bench.")
]


@contextlib.contextmanager
def keys(person: ConsoleOperator) -> Iterator[None]:
    """Any key is the emergency stop; it ends the command with exit code 1."""
    from hardware_eval.bench.loop import EmergencyStop

    with person.keys():
        try:
            yield
        except EmergencyStop:
            print("stopped: the operator pressed the emergency stop", file=sys.stderr)
            raise typer.Exit(1) from None


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
    emit(done.as_dict(), json)
    print(done, file=sys.stderr if str(json) == "-" else sys.stdout)


def register(app: typer.Typer) -> None:
    """Add the commands."""
    app.command()(trial)
