"""The base of all errors that a user can mend, and the check for optional packages."""

from __future__ import annotations

import importlib
import os
import re
from collections.abc import Mapping
from inspect import Signature
from numbers import Integral, Real
from typing import Any


class InputError(ValueError):
    """Something given to ventbench is wrong; the message says what, where, and what to do.

    The command line prints the message alone and exits with 2, and so does a notebook.
    """

    def _render_traceback_(self) -> list[str]:
        """What IPython shows: the message, as the place in ventbench does not matter."""
        return [f"{type(self).__name__}: {self}"]


class InputTypeError(InputError, TypeError):
    """What was given is of a type that is not taken; the message says what is wanted instead."""

    def __init__(self, what: str, given: object, expected: str):
        super().__init__(f"{what} is of type {type(given).__name__}; give {expected}")


#: What values of an annotation are, in words.
_WORDS = {
    "None": "None",
    "str": "text",
    "Path": "a path",
    "bool": "True or False",
    "int": "a whole number",
    "float": "a number",
}
_MANY = re.compile(r"(Sequence|Iterable|Mapping)\[(?:str, )?(\w+)\]")


def check_types(signature: Signature, args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> None:
    """Check arguments whose annotation is of plain types: text, paths, numbers, many of these.

    The signature has its annotations as text.

    Raises:
        InputTypeError: if one is of another type.
        TypeError: if the function takes no such arguments.
    """
    for name, value in signature.bind(*args, **kwargs).arguments.items():
        parts = re.split(r" \| (?![^\[]*\])", str(signature.parameters[name].annotation))
        if any(_is(value, part) is not False for part in parts):
            continue
        words = []
        for part in parts:
            many = _MANY.fullmatch(part)
            kind = "a mapping to" if many and many[1] == "Mapping" else "a list, each"
            words.append(f"{kind} {_WORDS[many[2]]}" if many else _WORDS[part])
        raise InputTypeError(name, value, " or ".join(words))


def _is(value: Any, part: str) -> bool | None:
    """Whether a value is of a type; None where the type is not plain."""
    many = _MANY.fullmatch(part)
    if many and many[2] in _WORDS:
        if many[1] == "Mapping":
            return isinstance(value, Mapping) and all(_is(x, many[2]) for x in value.values())
        if not hasattr(value, "__len__"):
            return hasattr(value, "__iter__")  # read once only: not here
        one_text = isinstance(value, str) and many[2] == "str"
        return one_text or (
            not isinstance(value, Mapping | str) and all(_is(x, many[2]) for x in value)
        )
    truth = type(value).__name__ in ("bool", "bool_")  # also numpy's, which is imported elsewhere
    kinds = {
        "None": value is None,
        "str": isinstance(value, str),
        "Path": isinstance(value, os.PathLike),
        "bool": truth,
        "int": isinstance(value, Integral) and not truth,
        "float": isinstance(value, Real) and not truth,
    }
    return kinds.get(part)


def require(*modules: str, extra: str = "view", what: str = "pictures") -> None:
    """Check that modules of an extra are here when ``what``, in words, needs them.

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
