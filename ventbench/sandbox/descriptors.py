"""Room for the descriptors of many pipes."""

from __future__ import annotations

import contextlib
import resource
from collections.abc import Iterator

from ventbench.sandbox.errors import SandboxError

#: What else a process has open.
_OTHERS = 256


@contextlib.contextmanager
def room_for(count: int) -> Iterator[None]:
    """Raise the limit of open descriptors if need be, and restore it afterwards.

    Raises:
        SandboxError: if the system's own limit is too low.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = count + _OTHERS
    enough = soft == resource.RLIM_INFINITY or soft >= wanted
    if not enough:
        if hard != resource.RLIM_INFINITY and hard < wanted:
            raise SandboxError(
                f"{count} pipes are needed and the system allows {hard} open files; "
                f"raise it (ulimit -Hn {wanted}) or score fewer cells at a time"
            )
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
    try:
        yield
    finally:
        if not enough:
            with contextlib.suppress(OSError, ValueError):
                resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
