"""Clocks: real time, and a virtual one on which many breaths pass in a second."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Protocol


class Clock(Protocol):
    """Time that never goes back."""

    def now(self) -> float:
        """Time since an arbitrary start, s."""
        ...

    def sleep_until(self, instant: float) -> None:
        """Return at ``instant``, s, or at once if it has passed."""
        ...


class RealClock:
    """The system's monotonic clock."""

    def now(self) -> float:
        """Time since an arbitrary start, s."""
        return time.monotonic()

    def sleep_until(self, instant: float) -> None:
        """Sleep; accurate to what the system's scheduler gives."""
        while (left := instant - time.monotonic()) > 0.0:
            time.sleep(left)


class VirtualClock:
    """A clock that moves when it is told to, and takes along what runs on it."""

    def __init__(self, start: float = 0.0) -> None:
        """Start at ``start``, s."""
        self._now = start
        self._passengers: list[Callable[[float], None]] = []

    def now(self) -> float:
        """Time, s."""
        return self._now

    def carry(self, run_until: Callable[[float], None]) -> None:
        """Call ``run_until(instant)`` whenever time passes, before :meth:`now` shows it."""
        self._passengers.append(run_until)

    def sleep_until(self, instant: float) -> None:
        """Let time pass until ``instant``, s."""
        if instant > self._now:
            for run_until in self._passengers:
                run_until(instant)
            self._now = instant

    def advance(self, seconds: float) -> None:
        """Let time pass."""
        self.sleep_until(self._now + seconds)
