"""The life of one cell: lock down, import the submission, reset, answer, end."""

from __future__ import annotations

import fcntl
import io
import json
import os
import signal
import sys
from dataclasses import dataclass
from importlib.machinery import FileFinder, SourceFileLoader
from pathlib import Path
from types import CodeType, FrameType
from typing import NamedTuple, NoReturn

from ventbench.task.interfaces import Task

from . import lockdown, wire
from .cell import Cell, Failed, SubmissionError, controller_class, describe, source_text
from .lockdown import CellLimits, Lockdown

#: Descriptors of a cell: 0 to 2 are /dev/null.
OBSERVATIONS, REPLIES, END = 3, 4, 5


@dataclass(frozen=True)
class Setup:
    """What all cells share: the submission's folder, its name in messages, what a cell may use."""

    folder: Path
    label: str
    limits: CellLimits


class _Replies:
    """Writes replies; knows which observation is being answered."""

    def __init__(self, setup: Setup):
        self._folder = setup.folder
        self._printed = sys.stdout = sys.stderr = Tail()
        self.sequence = 0

    def send(self, kind: int, value: float = 0.0) -> None:
        os.write(REPLIES, wire.pack_reply(self.sequence, kind, value))

    def fail(self, kind: str, message: str, detail: str = "") -> NoReturn:
        fields = (field.replace("\0", "") for field in (kind, message, detail, self._printed.kept))
        data = "\0".join(fields).encode("utf-8", "backslashreplace")
        os.write(REPLIES, wire.pack_reply(self.sequence, wire.FAILED, 0.0, data))
        os._exit(1)

    def interrupted(self, _signal: int, frame: FrameType | None) -> NoReturn:
        """Say where the submission was when the scorer lost patience."""
        while frame is not None:
            file = Path(frame.f_code.co_filename)
            if file.is_relative_to(self._folder):
                name = file.relative_to(self._folder).as_posix()
                self.fail("timeout", "", f"{name} line {frame.f_lineno} was running")
            frame = frame.f_back
        self.fail("timeout", "")


class Start(NamedTuple):
    """What one cell alone gets from the zygote: task, ends of two pipes, the zygote's number.

    The task is JSON; empty to lock down, say so and end.
    """

    task: bytes
    pipes: list[int]
    parent: int


def run(handover: list[tuple[Setup, Lockdown, Start]]) -> NoReturn:
    """Be a cell; never returns. Call it with nothing of the zygote's left on the stack.

    Args:
        handover: what all cells share, what the zygote has prepared, and what is this cell's; taken
            out of the list, so that it stays in no caller's variable.
    """
    setup, prepared, start = handover.pop()
    _take_descriptors(start.pipes)
    os.chdir(setup.folder)
    replies = _Replies(setup)
    signal.signal(signal.SIGTERM, replies.interrupted)
    try:
        layers = prepared.finish(setup.limits, END, start.parent)
        replies.send(wire.LOCKED, lockdown.bits([*layers, "own-descriptors", "clean-fork"]))
    except BaseException as error:
        replies.fail("sandbox", f"{type(error).__name__}: {error}")
    if not start.task or os.read(OBSERVATIONS, len(wire.BEGIN)) != wire.BEGIN:
        os._exit(0)
    task = Task(*json.loads(start.task))
    del prepared, start, layers
    try:
        only_sources(setup.folder)
        cell = Cell(controller_class(setup.folder, setup.label), task, setup.folder)
        replies.send(wire.READY)
        _answer(replies, cell)
    except SubmissionError as error:
        replies.fail("import", str(error))
    except Failed as failed:
        replies.fail(failed.failure.kind, failed.failure.what, failed.failure.detail)
    except BaseException as error:  # KeyboardInterrupt and the like, raised by the submission
        replies.fail("act" if replies.sequence else "reset", *describe(error, setup.folder))


def _take_descriptors(pipes: list[int]) -> None:
    # Away from the numbers they shall have, then there.
    copies = [fcntl.fcntl(pipe, fcntl.F_DUPFD, 16) for pipe in pipes]
    for number in (0, 1, 2):
        # Each opened anew: an open file that cells share would carry flags between them.
        null = os.open(os.devnull, os.O_RDWR)
        if null != number:
            os.dup2(null, number)
            os.close(null)
    for source, number in zip(copies, (OBSERVATIONS, REPLIES), strict=True):
        os.dup2(source, number)


def _answer(replies: _Replies, cell: Cell) -> NoReturn:
    while True:
        frame = os.read(OBSERVATIONS, wire.OBSERVATION.size)
        if not frame:  # the scorer has closed its end
            os._exit(0)
        replies.sequence += 1
        value = cell.act(wire.unpack_observation(frame, replies.sequence))
        replies.send(wire.COMMAND, value)


class _SourceLoader(SourceFileLoader):
    def get_code(self, fullname: str) -> CodeType:
        path = self.get_filename(fullname)
        text = source_text(self.get_data(path))
        return compile(text, path, "exec", dont_inherit=True)


def only_sources(folder: Path) -> None:
    """Let modules of a folder and all below be imported from their sources alone.

    What was reviewed and hashed is then what runs: no ``__pycache__`` that says something else, no
    compiled extension.
    """

    def hook(path: str) -> FileFinder:
        if not Path(path).is_relative_to(folder):
            raise ImportError(path)
        return FileFinder(path, (_SourceLoader, [".py"]))

    sys.path_hooks.insert(0, hook)


#: Characters kept of the last that was printed.
_PRINTED = 2000


class Tail(io.TextIOBase):
    """What a submission prints: only the end is kept, for the message if it fails."""

    def __init__(self) -> None:
        self.kept = ""

    def writable(self) -> bool:
        """Say that one may write to it."""
        return True

    def write(self, text: str) -> int:
        """Add text."""
        self.kept = (self.kept + text[-_PRINTED:])[-_PRINTED:]
        return len(text)
