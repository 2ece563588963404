"""Keeps this process from being read by others of the same user while cells run."""

from __future__ import annotations

import threading

from ventbench.sandbox.child import libc

_lock = threading.Lock()
_holders = 0
_before = 1


def hide() -> None:
    """No tracing, no ``/proc/PID/mem`` for others; counts how often it was asked for."""
    global _holders, _before
    with _lock:
        if libc.LINUX and _holders == 0:
            _before = libc.prctl(libc.PR_GET_DUMPABLE)
            libc.prctl(libc.PR_SET_DUMPABLE, 0)
        _holders += 1


def show() -> None:
    """Undo one :func:`hide`; the last one restores what was before."""
    global _holders
    with _lock:
        _holders -= 1
        # 2, "for root alone", cannot be set again by hand; 0 is what it means for others.
        if libc.LINUX and _holders == 0 and _before == 1:
            libc.prctl(libc.PR_SET_DUMPABLE, 1)
