"""The runner that a scorer uses by default: every cell in a locked-down process of its own."""

from __future__ import annotations

import functools
import os
import platform
import tempfile
from collections.abc import Mapping, Sequence
from typing import Any

from ventbench.sandbox.child import landlock, lockdown, wire
from ventbench.sandbox.child.lockdown import OFFICIAL
from ventbench.sandbox.child.wire import Reply
from ventbench.sandbox.configuration import Allowance, SandboxError, configuration
from ventbench.sandbox.pipes import Clock, Pipes
from ventbench.sandbox.session import SandboxSession, SubmittedFolder, said
from ventbench.sandbox.zygote import ZygoteClient
from ventbench.task.interfaces import Task

_PROBE_S = 30.0


@functools.cache
def layers() -> tuple[str, ...]:
    """Layers that come into force in every cell on this machine, found by starting one.

    It may start threads, as one with JAX may: where the kernel cannot count them, that shows.

    Raises:
        SandboxError: if a cell cannot be started or does not lock itself down.
    """
    pipes = Pipes()
    with tempfile.TemporaryDirectory() as folder:
        told = configuration(os.path.realpath(folder), "probe", Allowance())
        limits = {**dict(told["limits"]), "threads": True}  # type: ignore[call-overload]
        zygote = ZygoteClient({**told, "limits": limits})
        try:
            pipes.open(0, lambda far: zygote.start(0, None, far))
            outcomes = pipes.collect({0}, 0, wire.LOCKED, _PROBE_S, float("inf"))
        finally:
            pipes.close_all()
            zygote.close()
    reply = outcomes.get(0)
    if not isinstance(reply, Reply) or reply.kind != wire.LOCKED:
        raise SandboxError(f"a submission cannot be locked down here: {said(reply)}")
    return lockdown.names(reply.value)


class SandboxRunner:
    """Runs controllers apart: a :class:`ventbench.entries.runner.Runner`.

    Args:
        require_official: refuse to run where a layer is missing that official results need.
        allowance: what a submission may use.
        clock: times the cells out; the system's if not given.

    Raises:
        SandboxError: if a cell cannot be locked down, or not far enough.
    """

    def __init__(
        self,
        *,
        require_official: bool = False,
        allowance: Allowance | None = None,
        clock: Clock | None = None,
    ):
        if not hasattr(os, "fork"):
            raise SandboxError(f"the sandbox needs Linux or macOS, this is {platform.system()}")
        self._layers, self._allowance = layers(), allowance or Allowance()
        self._clock = clock
        if require_official and self.missing:
            raise SandboxError(
                f"an official score needs {' and '.join(OFFICIAL)}; missing here: "
                f"{', '.join(self.missing)} (kernel {platform.release()} on {platform.machine()})"
            )

    @property
    def missing(self) -> tuple[str, ...]:
        """Layers that an official result needs and this machine does not have."""
        return tuple(layer for layer in OFFICIAL if layer not in self._layers)

    @property
    def sandbox(self) -> Mapping[str, Any]:
        """Layers in force in every cell, for the record."""
        return {
            "layers": list(self._layers),
            "landlock_abi": landlock.abi(),
            "kernel": f"{platform.system()} {platform.release()}",
            "official": not self.missing,
        }

    def start(self, submission: SubmittedFolder, tasks: Sequence[Task]) -> SandboxSession:
        """Start the cells of a submission, as :class:`ventbench.entries.runner.Runner` says.

        Raises:
            SandboxError: if a cell does not show the layers of :attr:`sandbox`.
            SubmissionError: if the code cannot be imported.
        """
        return SandboxSession(submission, tasks, self._layers, self._allowance, self._clock)
