"""What is wrong with the sandbox itself, never with a submission."""

from __future__ import annotations

from ventbench.errors import InputError


class SandboxError(InputError):
    """This machine cannot run submissions apart as was asked for; the message says what to do."""
