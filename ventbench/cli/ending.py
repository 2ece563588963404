"""How a command ends: bad input in one line, Ctrl-C with what is kept, and the exit codes."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable
from types import FrameType
from typing import NoReturn

from ventbench.errors import InputError
from ventbench.text import plain

#: Exit code after Ctrl-C, as shells have it.
INTERRUPTED = 130


def run(app: Callable[[], object], program: str, *, stopped: str = "") -> None:
    """Run a command line to its end.

    Args:
        app: runs the commands with the arguments of the process.
        program: what the messages begin with.
        stopped: what is true after Ctrl-C, besides what a command keeps.
    """
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
        print(f"{program}:", "\n".join(lines), file=sys.stderr)
        sys.exit(2)
    except SystemExit as end:
        if end.code == INTERRUPTED:
            _stop(program, stopped)
        raise


def _stop(program: str, stopped: str) -> NoReturn:
    """End after Ctrl-C, and say whether the same command goes on from here."""
    resume = sys.modules.get("ventbench.resume")
    kept = resume.opened() if resume else None
    print(
        f"{program}: stopped"
        + (f"; {stopped}" if stopped else "")
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
