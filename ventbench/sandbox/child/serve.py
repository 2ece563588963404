"""The life of one cell: lock down, import the submission, reset, answer, end."""

from __future__ import annotations

import os
import signal
import sys
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import NoReturn

from ventbench.interfaces import Task
from ventbench.submissions.cell import Cell, Failed, controller_class, describe
from ventbench.submissions.errors import SubmissionError

from . import lockdown, sources, wire
from .lockdown import Limits, Lockdown
from .printed import Tail

#: Descriptors of a cell: 0 to 2 are /dev/null.
OBSERVATIONS, REPLIES, END = 3, 4, 5


@dataclass(frozen=True)
class Setup:
    """What is the same for all cells of a session.

    Attributes:
        folder: of the submission.
        label: how messages name it.
        limits: of each cell.
    """

    folder: Path
    label: str
    limits: Limits


class _Replies:
    """Writes replies; knows which observation is being answered."""

    def __init__(self, setup: Setup):
        self._folder = setup.folder
        self._printed = sys.stdout = sys.stderr = Tail()
        self.sequence = 0

    def send(self, kind: int, value: float = 0.0) -> None:
        os.write(REPLIES, wire.pack_reply(self.sequence, kind, value))

    def fail(self, kind: str, what: str, detail: str = "") -> NoReturn:
        fields = (field.replace("\0", "") for field in (kind, what, detail, self._printed.kept))
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


def run(setup: Setup, prepared: Lockdown, task: Task | None) -> NoReturn:
    """Be a cell; never returns.

    Args:
        setup: what all cells share.
        prepared: by the zygote.
        task: what the controller is told; None to lock down, say so and end.
    """
    replies = _Replies(setup)
    signal.signal(signal.SIGTERM, replies.interrupted)
    try:
        layers = prepared.finish(setup.limits, END)
        replies.send(wire.LOCKED, lockdown.bits(layers))
    except BaseException as error:
        replies.fail("sandbox", f"{type(error).__name__}: {error}")
    if task is None or os.read(OBSERVATIONS, len(wire.BEGIN)) != wire.BEGIN:
        os._exit(0)
    try:
        sources.only_sources(setup.folder)
        cell = Cell(controller_class(setup.folder, setup.label), task, setup.folder)
        replies.send(wire.READY)
        _answer(replies, cell)
    except SubmissionError as error:
        replies.fail("import", str(error))
    except Failed as failed:
        replies.fail(failed.failure.kind, failed.failure.what, failed.failure.detail)
    except BaseException as error:  # KeyboardInterrupt and the like, raised by the submission
        replies.fail("act" if replies.sequence else "reset", *describe(error, setup.folder))


def _answer(replies: _Replies, cell: Cell) -> NoReturn:
    while True:
        frame = os.read(OBSERVATIONS, wire.OBSERVATION.size)
        if not frame:  # the scorer has closed its end
            os._exit(0)
        replies.sequence += 1
        value = cell.act(wire.unpack_observation(frame, replies.sequence))
        replies.send(wire.COMMAND, value)
