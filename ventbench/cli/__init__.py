"""The command line ``ventbench``: parses, calls, prints. One module per group of commands.

Exit codes: 0 done; 1 the command ran and the answer is no; 2 bad input; 130 stopped by Ctrl-C.
Heavy packages are imported inside the commands, so that ``ventbench --help`` answers at once.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from types import FrameType
from typing import NoReturn

import typer

from ventbench import __version__
from ventbench.cli import (
    board,
    challenge,
    data,
    diagnose,
    doctor,
    headroom,
    mechanics,
    proof,
    real_pairs,
    score,
    simulators,
    stress,
    study,
    submit,
    train,
    transfer,
    tune,
    view,
)
from ventbench.errors import InputError
from ventbench.text import plain

#: Exit code after Ctrl-C, as shells have it.
INTERRUPTED = 130

app = typer.Typer(
    name="ventbench",
    help="A benchmark for the control of mechanical ventilators.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
)


def _version(value: bool) -> None:
    if value:
        print(f"ventbench {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: bool = typer.Option(
        False, "--version", callback=_version, is_eager=True, help="Print the version and exit."
    ),
) -> None:
    pass


score.register(app)
headroom.register(app)
transfer.register(app)
submit.register(app)
simulators.register(app)
tune.register(app)
train.register(app)
stress.register(app)
study.register(app)
view.register(app)
board.register(app)
diagnose.register(app)
challenge.register(app)
mechanics.register(app)
doctor.register(app)
proof.register(app)
real_pairs.register(app)
app.add_typer(data.app)


def main() -> None:
    """Entry point of the console script."""
    sys.unraisablehook = _interrupt_again
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _interrupt)
    try:
        app()
    except (InputError, OSError) as error:
        # Messages quote files and records of others, which may hold commands to the terminal.
        text = str(error)
        if isinstance(error, OSError) and error.filename and error.strerror:
            text = f"{error.filename}: {error.strerror[0].lower()}{error.strerror[1:]}"
        lines = [plain(line) for line in text.split("\n")]
        print("ventbench:", "\n".join(lines), file=sys.stderr)
        sys.exit(2)
    except SystemExit as end:
        if end.code == INTERRUPTED:
            _stop()
        raise


def _stop() -> NoReturn:
    """End after Ctrl-C, and say whether the same command goes on from here."""
    resume = sys.modules.get("ventbench.resume")
    kept = resume.opened() if resume else None
    print(
        "ventbench: stopped"
        + (f"; what is finished is kept in {kept}: the same command continues" if kept else ""),
        file=sys.stderr,
    )
    sys.stdout.flush()
    sys.stderr.flush()
    # Threads of the compiler may be at work; they crash if the interpreter is taken down normally.
    os._exit(INTERRUPTED)


_in_hook = False


def _interrupt(number: int, frame: FrameType | None) -> None:
    """Raise KeyboardInterrupt, but not in the hook, which would drop it: then a moment later."""
    if _in_hook:
        threading.Timer(0.05, os.kill, (os.getpid(), signal.SIGINT)).start()
    else:
        raise KeyboardInterrupt


def _interrupt_again(unraisable: sys.UnraisableHookArgs) -> None:
    """Repeat a Ctrl-C that came while Python called back from compiled code, which drops it."""
    global _in_hook
    if unraisable.exc_type is not KeyboardInterrupt:
        sys.__unraisablehook__(unraisable)
        return
    _in_hook = True
    try:
        threading.Timer(0.05, os.kill, (os.getpid(), signal.SIGINT)).start()
    finally:
        _in_hook = False
