"""The runner that a scorer uses by default: every cell in a locked-down process of its own."""

from __future__ import annotations

import functools
import os
import platform
import tempfile
from collections.abc import Mapping, Sequence
from typing import Any

from ventbench.sandbox.child import landlock, libc, lockdown, wire
from ventbench.sandbox.child.lockdown import FLOOR, OFFICIAL
from ventbench.sandbox.child.wire import Reply
from ventbench.sandbox.configuration import Allowance, SandboxError, configuration
from ventbench.sandbox.pipes import Clock, Pipes
from ventbench.sandbox.session import SandboxSession, SubmittedFolder, said
from ventbench.sandbox.zygote import ZygoteClient
from ventbench.task.interfaces import Task

_PROBE_S = 30.0

#: What submitted code could do without a line of the floor, and what gives it.
_WITHOUT = {
    ("empty-root", "landlock"): (
        "read every file of this user",
        "allow user namespaces (docs/security_manual.md) or boot a kernel with Landlock",
    ),
    ("seccomp",): (
        "reach the network and other processes",
        "use a kernel that filters system calls, on x86-64 or ARM64",
    ),
}


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
            outcomes = pipes.collect({0}, [0], wire.LOCKED, _PROBE_S, float("inf"))
        finally:
            pipes.close_all()
            zygote.close()
    reply = outcomes.get(0)
    if not isinstance(reply, Reply) or reply.kind != wire.LOCKED:
        raise SandboxError(f"a submission cannot be locked down here: {said(reply)}")
    return lockdown.names(reply.value)


def check_floor(shown: Sequence[str]) -> None:
    """Refuse to go on where the layers in force confine too little for any foreign code.

    Raises:
        SandboxError: naming the missing layers first.
    """
    lacking = [line for line in FLOOR if not set(line) & set(shown)]
    if lacking:
        missing = " and ".join("/".join(line) for line in lacking)
        could, advice = (
            " and ".join(parts) for parts in zip(*map(_WITHOUT.get, lacking), strict=True)
        )
        raise SandboxError(
            f"{missing} missing on this machine ({platform.system()} {platform.release()}): "
            f"submitted code could {could}, so it does not run. To run it: {advice}; or use "
            "--in-process, which gives it all your rights, for code that you trust"
        )


class SandboxRunner:
    """Runs controllers apart: a :class:`ventbench.entries.runner.Runner`.

    It does not exist below the floor of :data:`~ventbench.sandbox.child.lockdown.FLOOR`.

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
        self._layers = layers() if libc.LINUX else ()
        check_floor(self._layers)
        self._allowance = allowance or Allowance()
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
