"""What several commands share: options, progress, output, and how they end.

Bad input ends a command in one line, Ctrl-C with what is kept; each has its exit code.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, NoReturn, TypeVar

import typer

from ventbench.base.errors import InputError
from ventbench.base.text import plain

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress, ProgressColumn

    from ventbench.entries.folder import Submission
    from ventbench.plants.fmu import Fmu

ResultT = TypeVar("ResultT")


def claim_out(folder: Path | None) -> Path | None:
    """Check a folder of results before anything is computed; see ``files.claim_folder``."""
    from ventbench.base import files

    if folder is not None:
        files.claim_folder(folder)
    return folder


def claim_json(path: Path | None) -> Path | None:
    """Check the file of ``--json`` before anything is computed.

    Raises:
        InputError: if it is a folder, or lies in what is none.
    """
    from ventbench.base.errors import InputError

    if path is None or str(path) == "-":
        return path
    if path.is_dir():
        raise InputError(f"--json {path} is a folder; name a file, such as {path / 'result.json'}")
    above = next((folder for folder in path.parents if folder.exists()), None)
    if above is not None and not above.is_dir():
        raise InputError(f"--json {path}: {above} is a file, not a folder; choose another place")
    return path


def known_lungs(incomplete: str) -> list[str]:
    """Ids of the six lungs, for completion by the shell."""
    from ventbench.task.lungs import LUNG_IDS

    return [name for name in LUNG_IDS if name.startswith(incomplete.upper())]


def known_entries(incomplete: str) -> list[str]:
    """Names of bundled submissions, and folders, for completion by the shell."""
    from ventbench.entries.folder import bundled

    folders = [f"{path}/" for path in Path().glob(f"{incomplete}*") if path.is_dir()]
    return [name for name in bundled() if name.startswith(incomplete)] + sorted(folders)


def known_plants(incomplete: str) -> list[str]:
    """Names of simulators, and files, for completion by the shell."""
    from ventbench.plants.catalog import names

    files = sorted(str(path) for path in Path().glob(f"{incomplete}*"))
    return [name for name in names() if name.startswith(incomplete)] + files


JsonFile = Annotated[
    Path | None,
    typer.Option(
        "--json",
        metavar="FILE",
        help="Also write the result as JSON; '-' for stdout.",
        callback=claim_json,
    ),
]
Clip = Annotated[
    bool, typer.Option("--clip", help="Clip u_in to 0..100 % instead of refusing the file.")
]
Pad = Annotated[bool, typer.Option("--pad", help="Accept breaths of unequal length.")]
InProcess = Annotated[
    bool,
    typer.Option("--in-process", help="Run without the sandbox; only for code that you trust."),
]
PlantName = Annotated[
    str,
    typer.Option(
        "--plant",
        metavar="PLANT",
        autocompletion=known_plants,
        help="Simulators: frozen (the official ones), physics, two_balloon, a file of plants such "
        "as corrected.json, a CSV or Parquet file of simulated pressures, or module:function.",
    ),
]
TrustFmu = Annotated[
    bool,
    typer.Option("--in-process", help="Run the machine code of a --plant that is an FMU."),
]
Workers = Annotated[
    int,
    typer.Option(min=0, help="Number of processes; 0 uses this one, with all cores."),
]
Scheduler = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS",
        help="Dask scheduler, such as tcp://host:8786, in place of processes on this machine; its "
        "workers must see the same files.",
    ),
]
RecordingsDir = Annotated[
    Path | None,
    typer.Option(
        metavar="DIR", help="Folder of the public recordings; VENTBENCH_RECORDINGS by default."
    ),
]


def simulator_of(plant: str, in_process: bool) -> str | Fmu:
    """Return what ``--plant`` names; an FMU is opened only where its code is trusted."""
    if not in_process or not plant.lower().endswith(".fmu"):
        return plant
    from ventbench.plants.fmu import Fmu

    return Fmu(plant)


def recordings_folder(given: Path | None) -> Path:
    """Return the folder of the public recordings.

    Raises:
        InputError: if there is none.
    """
    from ventbench.base.errors import InputError
    from ventbench.recordings import recordings_dir

    folder = given or recordings_dir()
    if folder is None or not folder.is_dir():
        what = "no folder of the public recordings" if folder is None else f"{folder} is no folder"
        raise InputError(f"{what}; give --recordings DIR or set VENTBENCH_RECORDINGS")
    return folder


def emit(value: object, target: Path | None) -> None:
    """Write the result of a command to the file of ``--json``, atomically."""
    from ventbench.base import files

    if target is None:
        return
    if str(target) == "-":
        print(files.as_json(value), end="")
    else:
        files.write_json(target, value)


_quiet = False


def be_quiet(value: bool = True) -> None:
    """Switch progress and notes off for the rest of this process: the option ``--quiet``."""
    global _quiet
    _quiet = value


def quiet_first(arguments: list[str]) -> list[str]:
    """Move ``--quiet`` to the front, where the program takes it whatever the command."""
    end = arguments.index("--") if "--" in arguments else len(arguments)
    own = [text for text in arguments[:end] if text != "--quiet"]
    return ["--quiet"] * (len(own) < end) + own + arguments[end:]


def notes() -> Console:
    """Return the console on stderr for progress and notes; it says nothing after ``--quiet``."""
    from rich.console import Console

    return Console(stderr=True, quiet=_quiet)


def bars() -> Progress:
    """Return progress bars on stderr: the finished share, the time taken and the time left."""
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
    from rich.progress import TimeRemainingColumn as Remaining

    columns = (
        TextColumn("{task.description}", markup=False), BarColumn(), TimeElapsedColumn(),
        TextColumn("left"), Remaining(),
    )  # fmt: skip
    return _progress(*columns)


def _progress(*columns: ProgressColumn) -> Progress:
    from rich.progress import Progress

    console = notes()
    # Where stderr is a file, bars would leave nothing but an empty line.
    return Progress(*columns, transient=True, console=console, disable=not console.is_terminal)


def counted(shown: Progress, text: str) -> Callable[[int, int], None]:
    """Add a bar and return what moves it: a function of how much is done and of how much in all."""
    task = shown.add_task(text, total=None)

    def progress(done: int, total: int) -> None:
        shown.update(task, completed=done, total=total)

    return progress


def of_each_entry(
    what: str,
    work: Callable[..., ResultT],
    jobs: Sequence[tuple[Submission, str, *tuple[object, ...]]],
    workers: int = 0,
    scheduler: str | None = None,
) -> list[ResultT]:
    """Compute something of entries: one job after the other with a bar each, or side by side.

    What JAX compiles for it is kept from one run to the next, see ``ventbench.base.compilation``.

    Args:
        what: is done, such as ``scoring``.
        work: takes what a job holds, and ``progress`` in this process; side by side, a function of
            a module with arguments that can be sent.
        jobs: an entry each, its track, and what else the work is told; in the order of the
            results.
        workers: processes; 0 for this one.
        scheduler: address of a Dask scheduler instead.
    """
    from functools import partial

    from ventbench.base import compilation
    from ventbench.base.executor import executor, in_order

    if not workers and scheduler is None:
        compilation.keep()
        done = []
        for job in jobs:
            with bars() as shown:
                progress = counted(shown, f"{what} {job[0].label}, {job[1]}")
                done.append(work(*job, progress=progress))
        return done
    with bars() as shown, executor(workers, scheduler) as pool:
        progress = counted(shown, f"{what}, {len(jobs)} jobs")
        return in_order(pool, partial(_keeping, work), jobs, progress)


def _keeping(work: Callable[..., ResultT], *job: object) -> ResultT:
    """Do a job in another process, which keeps what it compiles too."""
    from ventbench.base import compilation

    compilation.keep()
    return work(*job)


def waiting(text: str) -> Progress:
    """Return a spinner on stderr with the time taken, for work whose length nobody knows."""
    from rich.progress import SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (
        SpinnerColumn(), TextColumn("{task.description}", markup=False), TimeElapsedColumn()
    )  # fmt: skip
    shown = _progress(*columns)
    shown.add_task(text, total=None)
    return shown


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
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
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
    except KeyboardInterrupt:  # before typer takes it, or behind it
        _stop(program, stopped)
    except SystemExit as end:
        if end.code == INTERRUPTED:
            _stop(program, stopped)
        raise


def _stop(program: str, stopped: str) -> NoReturn:
    """End after Ctrl-C, and say whether the same command goes on from here."""
    resume = sys.modules.get("ventbench.base.resume")
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
