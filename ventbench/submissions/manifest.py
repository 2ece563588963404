"""``submission.toml``: what an author says about an entry."""

from __future__ import annotations

import difflib
import re
import tomllib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ventbench.interfaces import API_VERSION
from ventbench.submissions.errors import SubmissionError

#: What kinds of controller the board distinguishes.
FAMILIES = ("pid", "residual", "ppo", "dqn", "other")

#: The two boards.
TRACKS = ("performance", "robustness")

_MAX_BYTES = 64_000
_MAX_TEXT = 2000

#: What an entry may be called, and the same in words.
NAME = re.compile(r"[a-z][a-z0-9_]{0,39}")
NAME_RULE = (
    "must be lower-case letters, digits and underscores, "
    "begin with a letter and have at most 40 characters"
)


@dataclass(frozen=True)
class Training:
    """Table ``[training]``: where the parameters come from; every key may be left out.

    Attributes:
        data: what they were learned or tuned on.
        simulators: version of the frozen simulators used; empty if none.
        seeds: of all runs.
        compute: such as ``"20 min on 2 CPU cores"``.
        per_lung: whether there is one set of parameters for each lung.
    """

    data: str = ""
    simulators: str = ""
    seeds: tuple[int, ...] = ()
    compute: str = ""
    per_lung: bool = False


@dataclass(frozen=True)
class Manifest:
    """The content of ``submission.toml``.

    Attributes:
        name: of the entry: lower-case letters, digits and underscores, at most 40.
        authors: at least one.
        licence: SPDX identifier, such as ``"Apache-2.0"``.
        api_version: of the submission interface, now 1.
        family: one of :data:`FAMILIES`.
        tracks: one or both of :data:`TRACKS`; the first is scored if none is asked for.
        description: a sentence or two.
        training: see :class:`Training`.
    """

    name: str
    authors: tuple[str, ...]
    licence: str
    api_version: int
    family: str
    tracks: tuple[str, ...]
    description: str
    training: Training = field(default_factory=Training)


# A check takes a TOML value and returns the value to keep, or raises ValueError with what is wrong.
Check = Callable[[Any], Any]


def _text(value: Any) -> str:
    if not isinstance(value, str) or not value.strip():
        raise ValueError("must be text in quotes")
    if len(value) > _MAX_TEXT:
        raise ValueError(f"is longer than {_MAX_TEXT} characters")
    if not all(c.isprintable() or c in "\n\t" for c in value):
        raise ValueError("contains characters that cannot be printed")
    return value.strip()


def _name(value: Any) -> str:
    if not NAME.fullmatch(_text(value)):
        raise ValueError(f"{value!r} {NAME_RULE}")
    return value


def _one_of(choices: tuple[str, ...]) -> Check:
    def check(value: Any) -> str:
        if value not in choices:
            raise ValueError(f"{value!r} is not one of {', '.join(choices)}{_hint(value, choices)}")
        return value

    return check


def _version(value: Any) -> int:
    if type(value) is not int or value != API_VERSION:
        raise ValueError(f"{value!r} is not supported; this ventbench speaks version {API_VERSION}")
    return value


def _many(check: Check, *, least: int) -> Check:
    def checked(value: Any) -> tuple[Any, ...]:
        if not isinstance(value, list) or len(value) < least:
            raise ValueError("must be a list" + (" that is not empty" if least else ""))
        items = tuple(check(item) for item in value)
        if len(set(items)) < len(items):
            raise ValueError("contains something twice")
        return items

    return checked


def _typed(kind: type, text: str) -> Check:
    def check(value: Any) -> Any:
        if type(value) is not kind:
            raise ValueError(f"must be {text}, not {value!r}")
        return value

    return check


_TRAINING: dict[str, Check] = {
    "data": _text,
    "simulators": _text,
    "seeds": _many(_typed(int, "an integer"), least=0),
    "compute": _text,
    "per_lung": _typed(bool, "true or false"),
}
_REQUIRED: dict[str, Check] = {
    "name": _name,
    "authors": _many(_text, least=1),
    "licence": _text,
    "api_version": _version,
    "family": _one_of(FAMILIES),
    "tracks": _many(_one_of(TRACKS), least=1),
    "description": _text,
}


def _hint(value: Any, choices: tuple[str, ...]) -> str:
    close = difflib.get_close_matches(str(value), choices, n=1)
    return f"; did you mean {close[0]}?" if close else ""


def _checked(
    table: dict[str, Any], checks: dict[str, Check], where: str, problems: list[str]
) -> dict[str, Any]:
    kept = {}
    for key, value in table.items():
        if key not in checks:
            problems.append(f"{where}{key!r} is not known{_hint(key, tuple(checks))}")
            continue
        try:
            kept[key] = checks[key](value)
        except ValueError as error:
            problems.append(f"{where}{key}: {error}")
    return kept


def read(path: Path, label: str | None = None) -> Manifest:
    """Read and check a manifest.

    Args:
        path: of ``submission.toml``.
        label: how messages name it; the path if not given.

    Raises:
        SubmissionError: naming every problem with file and key.
    """
    label, problems = label or str(path), []
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise SubmissionError(f"{label}: larger than {_MAX_BYTES // 1000} kB")
        content = tomllib.loads(path.read_bytes().decode())
    except UnicodeDecodeError as error:
        raise SubmissionError(f"{label}: not UTF-8 text (byte {error.start})") from None
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise SubmissionError(f"{label}: not TOML: {error}") from None
    except OSError as error:
        raise SubmissionError(f"{label}: cannot be read: {error.strerror}") from None

    training = content.pop("training", {})
    if not isinstance(training, dict):
        problems.append(f"{label}, key training: must be a table, [training]")
        training = {}
    kept = _checked(content, _REQUIRED, f"{label}, key ", problems)
    problems += [f"{label}, key {key}: is missing" for key in _REQUIRED if key not in content]
    trained = _checked(training, _TRAINING, f"{label}, key training.", problems)
    if problems:
        raise SubmissionError(*problems)
    return Manifest(**kept, training=Training(**trained))
