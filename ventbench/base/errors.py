"""The base of all errors that a user can mend, and the check for optional packages."""

from __future__ import annotations

import importlib


class InputError(ValueError):
    """Something given to ventbench is wrong; the message says what, where, and what to do.

    The command line prints the message alone and exits with 2.
    """


def require(*modules: str) -> None:
    """Check that packages of ``ventbench[view]`` are here; call it when they are needed.

    Args:
        modules: names to import.

    Raises:
        InputError: if one is missing, with the command that brings it.
    """
    for module in modules:
        try:
            importlib.import_module(module)
        except ImportError as error:
            raise InputError(
                f"pictures need {module}: install ventbench[view] "
                f"(pip install 'ventbench[view]'); import failed with: {error}"
            ) from error
