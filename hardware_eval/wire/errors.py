"""Errors of the link to a device; each message says what to do."""

from __future__ import annotations

from hardware_eval.wire.messages import Refusal
from ventbench.base.errors import InputError


class LinkError(InputError):
    """The base of all errors of the link."""


class PortMissingError(LinkError):
    """There is no such port."""


class PortBusyError(LinkError):
    """Another program has the port."""


class PortForbiddenError(LinkError):
    """The user may not open the port."""


class DisconnectedError(LinkError):
    """The port went away while it was open; the device vents by itself."""


class NoAnswerError(LinkError):
    """The device did not answer in time."""


class RefusedError(LinkError):
    """The device refused a message.

    Attributes:
        refusal: its answer.
    """

    def __init__(self, message: str, refusal: Refusal) -> None:
        """Keep the device's answer."""
        super().__init__(message)
        self.refusal = refusal
