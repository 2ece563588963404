"""The optional packages of ``ventbench[view]``: asked for when needed, never at import."""

from __future__ import annotations

import importlib

from ventbench.errors import InputError


def require(*modules: str) -> None:
    """Check that packages of the extra are here.

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
