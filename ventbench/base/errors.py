"""The base of all errors that a user can mend, and the check for optional packages."""

from __future__ import annotations

import importlib


class InputError(ValueError):
    """Something given to ventbench is wrong; the message says what, where, and what to do.

    The command line prints the message alone and exits with 2, and so does a notebook.
    """

    def _render_traceback_(self) -> list[str]:
        """What IPython shows: the message, as the place in ventbench does not matter."""
        return [f"{type(self).__name__}: {self}"]


class InputTypeError(InputError, TypeError):
    """What was given is of a type that is not taken there.

    Args:
        what: was given, and for what, such as ``"recording"``.
        given: the value.
        wanted: what to give instead, in words.
    """

    def __init__(self, what: str, given: object, wanted: str):
        super().__init__(f"{what} is of type {type(given).__name__}; give {wanted}")


def require(*modules: str, extra: str = "view", what: str = "pictures") -> None:
    """Check that packages of an extra are here; call it when they are needed.

    Args:
        modules: names to import.
        extra: of ventbench, that brings them.
        what: needs them, in words.

    Raises:
        InputError: if one is missing, with the command that brings it.
    """
    for module in modules:
        try:
            importlib.import_module(module)
        except ImportError as error:
            raise InputError(
                f"{what} need {module}: install ventbench[{extra}] "
                f"(pip install 'ventbench[{extra}]'); import failed with: {error}"
            ) from error
