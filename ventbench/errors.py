"""The one base of all errors that a user can mend."""

from __future__ import annotations


class InputError(ValueError):
    """Something given to ventbench is wrong; the message says what, where, and what to do.

    The command line prints the message alone and exits with 2.
    """
