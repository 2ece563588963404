"""The scorer's ends of the pipes to all cells: send a frame to each, collect a reply from each."""

from __future__ import annotations

import contextlib
import os
import random
import selectors
import time
from collections.abc import Callable, Mapping

from ventbench.sandbox.child import wire
from ventbench.sandbox.child.wire import Reply, WireError

#: Of bytes that nothing had asked for, whether they are found with the reply or before the next.
_UNASKED = "bytes came after the reply"

#: What became of a cell: its reply, a breach of the wire's rules, or None: its pipe has ended.
Outcome = Reply | WireError | None


class Pipes:
    """Two pipes for each cell."""

    def __init__(self) -> None:
        self._ends: dict[int, tuple[int, int]] = {}  # cell -> observations, replies
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

    def early(self) -> dict[int, Outcome]:
        """Cells that have written although nothing was due, or have ended."""
        found: dict[int, Outcome] = {}
        for key, _ in self._selector.select(0):
            data = self._read(key.fd)
            found[key.data] = WireError(_UNASKED) if data else None
        return found

    def send(self, frames: Mapping[int, bytes]) -> None:
        """Send each cell its frame, in random order; one that has ended is found by reading."""
        for cell in self._random.sample(list(frames), len(frames)):
            with contextlib.suppress(OSError):
                os.write(self._ends[cell][0], frames[cell])

    def collect(
        self, due: set[int], sequence: int, kind: int, patience_s: float, deadline: float
    ) -> dict[int, Outcome]:
        """Wait for one reply of each cell.

        Args:
            due: the cells; those that have not answered in time are left in it.
            sequence: number of the observation that they answer.
            kind: of reply that is due, besides a failure.
            patience_s: how long to wait for the next cell to answer.
            deadline: when to stop waiting altogether, as of ``time.monotonic``.

        Returns:
            By cell, what came.
        """
        found: dict[int, Outcome] = {}
        partial: dict[int, bytes] = {}
        progress = time.monotonic()
        while due:
            wait = min(progress + patience_s, deadline) - time.monotonic()
            events = self._selector.select(max(wait, 0.0))
            if not events and wait <= 0:
                break
            for key, _ in events:
                cell, data = key.data, self._read(key.fd)
                try:
                    if cell not in due and data:
                        raise WireError(_UNASKED)
                    data = partial[cell] + data if data and cell in partial else data
                    outcome = wire.unpack_reply(data, sequence, (kind,)) if data else None
                except WireError as error:
                    outcome = error
                if data and outcome is None:
                    partial[cell] = data
                    continue
                # A cell that has answered and then ends, or writes more, is found here too.
                found[cell] = outcome
                due.discard(cell)
                progress = time.monotonic()
                if not isinstance(outcome, Reply) or outcome.kind == wire.FAILED:
                    self._selector.unregister(key.fd)  # nothing that follows counts
        return found

    def _read(self, descriptor: int) -> bytes:
        # One byte more than fits: an endless stream is told from the longest reply.
        try:
            return os.read(descriptor, wire.REPLY.size + wire.TEXT_LIMIT + 1)
        except BlockingIOError:
            return b""
