"""Reads hostile files in a process that may do nothing else: locked down like a cell.

One function of ventbench is imported, the process locks itself down, the function reads, and its
answer leaves as JSON. Whatever a parser does with a hostile file ends here.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
from typing import Any

from .lockdown import CellLimits, Lockdown

#: Exit codes: the parser ran out of memory or of recursion depth.
OUT_OF_MEMORY, TOO_DEEP = 3, 4

#: Descriptors from here on are closed: 1 takes the answer.
_END = 3


def main(request: str) -> None:
    """Answer one request on standard output.

    Args:
        request: JSON with ``function`` (``"module:name"``), ``arguments``, ``readable`` folders,
            ``site``, ``memory`` in bytes, ``cpu_s``.
    """
    told = json.loads(request)
    sys.path.append(told["site"])
    module, _, name = told["function"].partition(":")
    function = getattr(importlib.import_module(module), name)
    limits = CellLimits(told["memory"], told["cpu_s"], threads=False)
    Lockdown(told["readable"], []).finish(limits, _END)
    try:
        _write(function(*told["arguments"]))
    except MemoryError:
        os._exit(OUT_OF_MEMORY)
    except RecursionError:
        os._exit(TOO_DEEP)
    os._exit(0)


def _write(answer: Any) -> None:
    data = json.dumps(answer).encode()
    while data:
        data = data[os.write(1, data) :]
