"""The scorer's ends of the pipes to all cells: send a frame to each, collect a reply from each."""

from __future__ import annotations

import contextlib
import os
import random
import selectors
import time
from collections.abc import Callable, Mapping, Sequence, Set

import numpy as np

from ventbench.base.arrays import Floats, Ints
from ventbench.sandbox.child import wire
from ventbench.sandbox.child.wire import Reply, WireError

#: Of bytes that nothing had asked for, whether they are found with the reply or before the next.
_UNASKED = "bytes came after the reply"

#: How long answers of further cells are gathered after the first, s: a step of the plants costs
#: the same for few cells as for many. Slow cells keep nobody waiting for longer.
GATHERED_S = 0.05

#: What became of a cell: its reply, a breach of the wire's rules, or None: its pipe has ended.
Outcome = Reply | WireError | None


class Asked:
    """Controllers that are asked each by itself; none waits for another."""

    def ask(self, cells: Ints, observations: Floats) -> None:
        """Give some controllers an observation each; see ``ControllerSession``."""
        raise NotImplementedError

    def answers(self) -> tuple[Ints, Floats]:
        """Take what has been answered; see ``ControllerSession``."""
        raise NotImplementedError

    def act(self, observations: Floats) -> Floats:
        """Ask every controller for its next command, and wait for all of them.

        Args:
            observations: one row a cell, shape ``(cells, ROW)``.

        Returns:
            ``u_in``, %, shape ``(cells,)``.
        """
        commands, waiting = np.zeros(len(observations)), len(observations)
        self.ask(np.arange(waiting), observations)
        while waiting:
            cells, values = self.answers()
            commands[cells] = values
            waiting -= len(cells)
        return commands


class Clock:
    """The time of a session, and waiting in it; a test can put another in its place."""

    #: How long the exit status of a cell may take to arrive once its pipe has ended, s.
    status_s = 2.0

    def now(self) -> float:
        """Return the time of a clock that never goes back, s."""
        return time.monotonic()

    def wait(
        self, selector: selectors.BaseSelector, timeout_s: float, due: Set[int], kind: int
    ) -> list[tuple[selectors.SelectorKey, int]]:
        """Wait until a pipe can be read, or the time is over.

        Args:
            selector: watches the pipes.
            timeout_s: how long to wait at most, s.
            due: cells whose reply is waited for.
            kind: what kind of reply that is.

        Returns:
            As of ``selector.select``; empty if the time is over.
        """
        return selector.select(timeout_s)


class Pipes:
    """Two pipes for each cell.

    Args:
        clock: waits for replies.
    """

    def __init__(self, clock: Clock | None = None) -> None:
        self._clock = clock or Clock()
        self._ends: dict[int, tuple[int, int]] = {}  # cell -> observations, replies
        self._partial: dict[int, bytes] = {}  # of replies, until the rest of them comes
        self._selector = selectors.DefaultSelector()
        self._random = random.Random()  # seeded by the system; nobody else's stream is touched

    def open(self, cell: int, start: Callable[[list[int]], None]) -> None:
        """Make the pipes of a cell.

        Args:
            cell: its index.
            start: gives the far ends, for observations and for replies, to the cell.

        Raises:
            OSError: if there are not enough descriptors.
        """
        far, observations = os.pipe()
        try:
            replies, away = os.pipe()
        except OSError:
            os.close(far)
            os.close(observations)
            raise
        os.set_blocking(observations, False)
        os.set_blocking(replies, False)
        self._ends[cell] = observations, replies
        self._selector.register(replies, selectors.EVENT_READ, cell)
        try:
            start([far, away])
        finally:
            os.close(far)
            os.close(away)

    def close(self, cell: int) -> None:
        """Close the pipes of a cell if they are open; it then ends by itself."""
        ends = self._ends.pop(cell, None)
        if ends:
            with contextlib.suppress(KeyError):  # when it was found to have ended
                self._selector.unregister(ends[1])
            os.close(ends[0])
            os.close(ends[1])

    def close_all(self) -> None:
        """Close everything; may be called more than once."""
        for cell in list(self._ends):
            self.close(cell)
        self._selector.close()

    def early(self, due: Set[int] = frozenset()) -> dict[int, Outcome]:
        """Cells that have written although nothing was due, or have ended; not those in ``due``."""
        outcomes: dict[int, Outcome] = {}
        for key, _ in self._selector.select(0):
            if key.data not in due:
                data = self._read(key.fd)
                outcomes[key.data] = WireError(_UNASKED) if data else None
        return outcomes

    def send(self, frames: Mapping[int, bytes]) -> None:
        """Send each cell its frame, in random order; one that has ended is found by reading."""
        for cell in self._random.sample(list(frames), len(frames)):
            with contextlib.suppress(OSError):
                os.write(self._ends[cell][0], frames[cell])

    def collect(
        self, due: set[int], sequence: Mapping[int, int] | Sequence[int], kind: int,
        patience_s: float, deadline: float, *, some: bool = False,
    ) -> dict[int, Outcome]:  # fmt: skip
        """Wait for one reply of each cell.

        Args:
            due: the cells; those that have not answered in time are left in it.
            sequence: number of the observation that each cell answers.
            kind: what kind of reply is due, besides a failure.
            patience_s: how long to wait for the next cell to answer.
            deadline: when to stop waiting altogether, by the clock, s.
            some: take what is there once half have answered, or :data:`GATHERED_S` after the
                first, and wait for nobody else.

        Returns:
            By cell, what came.
        """
        outcomes: dict[int, Outcome] = {}
        progress, asked, gathered = self._clock.now(), len(due), float("inf")
        while due:
            wait = min(progress + patience_s, deadline, gathered) - self._clock.now()
            if some and 2 * len(outcomes) >= asked:
                wait = 0.0
            events = self._clock.wait(self._selector, max(wait, 0.0), due, kind)
            if not events and wait <= 0:
                break
            for key, _ in events:
                cell, data = key.data, self._read(key.fd)
                try:
                    if cell not in due and data:
                        raise WireError(_UNASKED)
                    data = self._partial.pop(cell, b"") + data if data else data
                    outcome = wire.unpack_reply(data, sequence[cell], (kind,)) if data else None
                except WireError as error:
                    outcome = error
                if data and outcome is None:
                    self._partial[cell] = data
                    continue
                # A cell that has answered and then ends, or writes more, is found here too.
                outcomes[cell] = outcome
                if some and len(outcomes) == 1:
                    gathered = self._clock.now() + GATHERED_S
                due.discard(cell)
                progress = self._clock.now()
                if not isinstance(outcome, Reply) or outcome.kind == wire.FAILED:
                    self._selector.unregister(key.fd)  # nothing that follows counts
        return outcomes

    def _read(self, descriptor: int) -> bytes:
        # One byte more than fits: an endless stream is told from the longest reply.
        try:
            return os.read(descriptor, wire.REPLY.size + wire.TEXT_LIMIT + 1)
        except BlockingIOError:
            return b""
