"""What a submission prints: kept short, for the message if it fails."""

from __future__ import annotations

import io

#: Characters kept of the last that was printed.
LIMIT = 2000


class Tail(io.TextIOBase):
    """A text stream of which only the end is kept."""

    def __init__(self) -> None:
        self.kept = ""

    def writable(self) -> bool:
        """Say that one may write to it."""
        return True

    def write(self, text: str) -> int:
        """Add text."""
        self.kept = (self.kept + text[-LIMIT:])[-LIMIT:]
        return len(text)
