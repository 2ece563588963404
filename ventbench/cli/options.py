"""What several commands share: options, progress, output, and how they end.

Bad input ends a command in one line, Ctrl-C with what is kept; each has its exit code.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any, NoReturn, TypeVar

import typer
from typer.core import TyperGroup

from ventbench import __version__
from ventbench.base import files
from ventbench.base.errors import InputError
from ventbench.base.text import plain

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import TaskID
    from rich.table import Table

    from ventbench.entries.folder import Submission
    from ventbench.recordings.breaths import Breaths

ResultT = TypeVar("ResultT")


def claim_out(folder: Path | None) -> Path | None:
    """Check a folder of results before anything is computed; see ``files.claim_folder``."""
    if folder is not None:
        files.claim_folder(folder)
    return folder


def claim_json(path: Path | None) -> Path | None:
    """Check the file of ``--json`` before anything is computed; InputError if it cannot be one."""
    if path is None or str(path) == "-":
        return path
    if path.is_dir():
        raise InputError(f"--json {path} is a folder; name a file, such as {path / 'result.json'}")
    above = next((folder for folder in path.parents if folder.exists()), None)
    if above is not None and not above.is_dir():
        raise InputError(f"--json {path}: {above} is a file, not a folder; choose another place")
    return path


def complete_lungs(incomplete: str) -> list[str]:
    """Ids of the six lungs, for completion by the shell."""
    from ventbench.task.lungs import LUNG_IDS

    return [name for name in LUNG_IDS if name.startswith(incomplete.upper())]


def complete_entries(incomplete: str) -> list[str]:
    """Names of bundled submissions, and folders, for completion by the shell."""
    from ventbench.entries.folder import bundled

    folders = [f"{path}/" for path in Path().glob(f"{incomplete}*") if path.is_dir()]
    return [name for name in bundled() if name.startswith(incomplete)] + sorted(folders)


def complete_plants(incomplete: str) -> list[str]:
    """Names of simulators, and files, for completion by the shell."""
    from ventbench.plants.catalog import names

    files = sorted(str(path) for path in Path().glob(f"{incomplete}*"))
    return [name for name in names() if name.startswith(incomplete)] + files


Entries = Annotated[
    list[str],
    typer.Argument(
        metavar="SUBMISSION...",
        help="Folders or names of bundled submissions.",
        autocompletion=complete_entries,
    ),
]
Sources = Annotated[
    list[Path] | None,
    typer.Option(
        "--source",
        metavar="DIR",
        help="Code of entries: a submission or a folder of them; may be repeated. submissions/ "
        "beside the leaderboard is looked through anyway.",
    ),
]
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
Missing = Annotated[
    list[float] | None,
    typer.Option(
        metavar="VALUE",
        help="A value of pressure, flow or volume that stands for a missing one, such as -99; may "
        "be repeated. Marks that come again and again are found without it.",
    ),
]
Pad = Annotated[bool, typer.Option("--pad", help="Accept breaths of unequal length.")]
InProcess = Annotated[
    bool,
    typer.Option("--in-process", help="Run without the sandbox; only for code that you trust."),
]
SimulatorName = Annotated[
    str,
    typer.Option(
        metavar="SIMULATOR",
        autocompletion=complete_plants,
        help="Simulators: frozen (those that rank), physics, two_balloon, a file of plants such "
        "as corrected.json, a CSV or Parquet file of simulated pressures, or module:function.",
    ),
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


def recordings_folder(folder_option: Path | None) -> Path:
    """Return the folder of the public recordings; InputError if there is none."""
    from ventbench.recordings import recordings_dir

    folder = folder_option or recordings_dir()
    if folder is None or not folder.is_dir():
        reason = (
            "no folder of the public recordings" if folder is None else f"{folder} is no folder"
        )
        raise InputError(f"{reason}; give --recordings DIR or set VENTBENCH_RECORDINGS")
    return folder


def emit(value: object, target: Path | None) -> None:
    """Write the result of a command to the file of ``--json``, atomically."""
    if target is None:
        return
    if str(target) == "-":
        print(files.as_json(value), end="")
    else:
        files.write_json(target, value)


def console_of(err: bool, *, quiet: bool = False) -> Console:
    """Return the console on stdout or stderr; it shows texts, also those of others, as they are."""
    from rich.console import Console

    return Console(stderr=err, quiet=quiet, markup=False, highlight=False)


def written_console(value: object, json: Path | None) -> Console:
    """Write a result as of :func:`emit`; return the console for people, beside that of the JSON."""
    emit(value, json)
    return console_of(str(json) == "-")


def table_of(
    title: str,
    columns: Iterable[str],
    rows: Iterable[Iterable[str]] = (),
    *,
    left: Iterable[str] = (),
    no_wrap: bool = False,
    caption: str | None = None,
) -> Table:
    """Return a table of texts: the first column and those named stand to the left, others right."""
    from rich.table import Table

    table, left_aligned = Table(title=title, caption=caption), set(left)
    for place, name in enumerate(columns):
        justify = "left" if place == 0 or name in left_aligned else "right"
        overflow = "ellipsis" if no_wrap else "fold"
        table.add_column(name, justify=justify, no_wrap=no_wrap, overflow=overflow)
    for row in rows:
        table.add_row(*row)
    return table


_quiet = False


def be_quiet(value: bool = True) -> None:
    """Switch progress and notes off for the rest of this process: the option ``--quiet``."""
    global _quiet
    _quiet = value


def quiet_first(arguments: list[str]) -> list[str]:
    """Move ``--quiet`` to the front, where the program takes it whatever the command."""
    end = arguments.index("--") if "--" in arguments else len(arguments)
    arguments_of_command = [text for text in arguments[:end] if text != "--quiet"]
    return ["--quiet"] * (len(arguments_of_command) < end) + arguments_of_command + arguments[end:]


def notes() -> Console:
    """Return the console on stderr for progress and notes; it says nothing after ``--quiet``."""
    return console_of(True, quiet=_quiet)


@contextmanager
def bars() -> Iterator[Callable[..., None]]:
    """Show progress bars on stderr: the finished share, the time taken and the time left.

    Yields what moves them: a function of the name of a bar, which comes when it is first told of,
    how much is done, how much in all (1; None if nobody knows), and a text in place of the name.
    """
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
    from rich.progress import TimeRemainingColumn as Remaining

    console = notes()
    tasks: dict[str, TaskID] = {}
    with Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        Remaining(),
        transient=True,
        console=console,
        # Where stderr is a file, bars would leave nothing but an empty line.
        disable=not console.is_terminal,
        speed_estimate_period=600.0,  # of long work whose steps take minutes
    ) as display:

        def tell(name: str, completed: float, total: float | None = 1.0, text: str = "") -> None:
            if name not in tasks:
                tasks[name] = display.add_task(name, total=total)
            display.update(tasks[name], completed=completed, total=total, description=text or name)

        yield tell


@contextmanager
def bar(name: str) -> Iterator[Callable[..., None]]:
    """Show one of :func:`bars` from the start; yields a function of how much is done and in all.

    Who never calls it shows the time taken by work whose length nobody knows.
    """
    with bars() as tell:
        tell(name, 0, None)
        yield partial(tell, name)


def read_recording(
    path: Path, *, clip: bool, pad: bool, missing: Sequence[float] | None = None
) -> Breaths:
    """Read a recording with a bar; its notes go to stderr."""
    from ventbench import recordings

    with bar(f"reading {path}") as reading:
        breaths = recordings.load(path, clip=clip, pad=pad, missing=missing or (), progress=reading)
    for note in breaths.notes:
        notes().print(f"note: {note}")
    return breaths


def map_entries(
    task: str,
    work: Callable[..., ResultT],
    jobs: Sequence[tuple[Submission, str, *tuple[object, ...]]],
    workers: int = 0,
    scheduler: str | None = None,
) -> list[ResultT]:
    """Compute something of entries: one job after the other with a bar each, or side by side.

    What JAX compiles for it is kept from one run to the next, see ``ventbench.base.compilation``.

    Args:
        task: what is done, such as ``scoring``.
        work: takes what a job holds, and ``progress`` in this process; side by side, a function of
            a module with arguments that can be sent.
        jobs: an entry each, its track, and what else the work is told; in the order of the
            results.
        workers: processes; 0 for this one.
        scheduler: address of a Dask scheduler instead.
    """
    from ventbench.base import compilation
    from ventbench.base.executor import executor, in_order

    if not workers and scheduler is None:
        compilation.keep()
        results = []
        for job in jobs:
            with bar(f"{task} {job[0].label}, {job[1]}") as progress:
                results.append(work(*job, progress=progress))
        return results
    with bar(f"{task}, {len(jobs)} jobs") as progress, executor(workers, scheduler) as pool:
        return in_order(pool, partial(_keeping, work), jobs, progress)


def _keeping(work: Callable[..., ResultT], *job: object) -> ResultT:
    """Do a job in another process, which keeps what it compiles too."""
    from ventbench.base import compilation

    compilation.keep()
    return work(*job)


#: Exit code after Ctrl-C, as shells have it.
INTERRUPTED = 130


def program(
    name: str, help_text: str, *, former: Mapping[str, str], completion: bool = True
) -> typer.Typer:
    """Return a command line without commands: its help, ``--version`` and ``--quiet``.

    Whoever calls a command or gives an option by a ``former`` name is told what it is now.
    """

    class Commands(TyperGroup):
        def resolve_command(self, ctx: Any, args: list[str]) -> Any:
            called = [text.partition("=")[0] for text in args if text.startswith("--")]
            for words in {args[0], " ".join(args[:2]), *called} & former.keys():
                raise InputError(f"`{words}` is now {former[words]}")
            return super().resolve_command(ctx, args)

    app = typer.Typer(
        cls=Commands,
        name=name,
        help=help_text,
        no_args_is_help=True,
        add_completion=completion,
        pretty_exceptions_enable=False,
        rich_markup_mode="markdown",
    )

    def show(value: bool) -> None:
        if value:
            print(f"{name} {__version__}")
            raise typer.Exit

    @app.callback()
    def _root(
        version: bool = typer.Option(
            False, "--version", callback=show, is_eager=True, help="Print the version and exit."
        ),
        quiet: bool = typer.Option(
            False, "--quiet", help="No progress and no notes on stderr; also behind any command."
        ),
    ) -> None:
        be_quiet(quiet)

    return app


def run(app: typer.Typer, program: str, *, named: str | None = None, stopped: str = "") -> None:
    """Run a command line with the arguments of the process to its end.

    Args:
        app: the commands.
        program: what the messages begin with.
        named: what the help calls it, if another name than the process has.
        stopped: what is true after Ctrl-C, besides what a command keeps.
    """
    sys.unraisablehook = _interrupt_again
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, _interrupt)
    try:
        app(quiet_first(sys.argv[1:]), prog_name=named)
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
    folder = resume.opened() if resume else None
    print(
        f"{program}: stopped"
        + (f"; {stopped}" if stopped else "")
        + (f"; what is finished is kept in {folder}: the same command continues" if folder else ""),
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
