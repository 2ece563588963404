"""``submission.toml``: what an author says about an entry, read and checked, and what is wrong."""

from __future__ import annotations

import dataclasses
import re
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, get_type_hints

import msgspec

from ventbench.base.files import data_beside
from ventbench.base.text import suggestion
from ventbench.sandbox.child.cell import SubmissionError, printable
from ventbench.task.interfaces import API_VERSION

#: What submissions hold and import: what is said of words, and the words.
RULES = data_beside(__file__, "rules.toml")


def by_word(table: dict[str, str]) -> dict[str, str]:
    """What a table of :data:`RULES` says of each word."""
    return {word: said for said, words in table.items() for word in words.split()}


#: Name of the file.
MANIFEST = "submission.toml"

#: Stands for the author until the author fills in a name.
AUTHOR = "Your Name"

#: Kinds of controller that the board distinguishes, and what a new submission of one says.
#: A file ``templates/FAMILY.py`` is what it starts from; without one it is that of ``pid``.
FAMILIES = {
    "pid": "One set of PID gains for all lungs.",
    "residual": "A PI controller plus a small network that corrects it; untrained: it adds zero.",
    "ppo": "A policy network for PPO; untrained: its weights are made to act as a PI controller.",
    "dqn": "Values of 51 commands for DQN; untrained: its weights are made to choose as a PI does.",
    "other": "One set of PID gains for all lungs.",
}

#: The two boards.
TRACKS = ("performance", "robustness")

_MAX_BYTES = 64_000
_MAX_TEXT = 2000
_MAX_QUOTED = 120
_MAX_SEED = 1 << 64

#: Names that an entry may have, and the rule in words.
NAME = re.compile(r"[a-z][a-z0-9_]{0,39}")
NAME_RULE = (
    "must be lower-case letters, digits and underscores, "
    "begin with a letter and have at most 40 characters"
)


_SOME = msgspec.Meta(min_length=1)


@dataclass(frozen=True)
class Training:
    """Table ``[training]``: where the parameters come from; every key may be left out."""

    data: str = ""  #: what they were learned or tuned on.
    simulators: str = ""  #: version of the frozen simulators used; empty if none.
    seeds: tuple[int, ...] = ()  #: those of all runs.
    compute: str = ""  #: such as ``"20 min on 2 CPU cores"``.
    per_lung: bool = False  #: whether there is one set of parameters for each lung.


@dataclass(frozen=True)
class Manifest:
    """The content of ``submission.toml``."""

    name: str  #: lower-case letters, digits and underscores, at most 40.
    authors: Annotated[tuple[str, ...], _SOME]  #: at least one.
    licence: str  #: SPDX identifier, such as ``"Apache-2.0"``.
    api_version: int  #: version of the submission interface, now 1.
    family: str  #: one of :data:`FAMILIES`.
    #: one or both of :data:`TRACKS`; the first is scored if none is asked for.
    tracks: Annotated[tuple[str, ...], _SOME]
    description: str  #: a sentence or two.
    training: Training = field(default_factory=Training)  #: see :class:`Training`.


def _quoted(value: Any) -> str:
    """Return a value of a hostile file for a message: short, and never an error itself."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # an integer of thousands of digits; a deep list
        return f"such a {type(value).__name__}"
    return text if len(text) <= _MAX_QUOTED else f"{text[:_MAX_QUOTED]}..."


#: Values that keys may have.
_CHOICES = {"family": tuple(FAMILIES), "tracks": TRACKS}


def _value(key: str, kind: Any, value: Any) -> Any:
    """A TOML value of a key as it is kept.

    Raises:
        ValueError: with what is wrong, or msgspec.ValidationError.
    """
    converted = msgspec.convert(value, kind)
    entries = converted if isinstance(converted, tuple) else (converted,)
    for entry in entries:
        if isinstance(entry, str):
            _check_text(entry)
            if key == "name" and not NAME.fullmatch(entry):
                raise ValueError(f"{_quoted(entry)} {NAME_RULE}")
        elif abs(entry) >= _MAX_SEED:
            raise ValueError("must be an integer of at most 64 bits")
        choices = _CHOICES.get(key, (entry,))
        if entry not in choices:
            hint = _hint(entry, choices)
            raise ValueError(f"{_quoted(entry)} is not one of {', '.join(choices)}{hint}")
    if key == "api_version" and converted != API_VERSION:
        speaks = f"this ventbench speaks version {API_VERSION}"
        raise ValueError(f"{_quoted(converted)} is not supported; {speaks}")
    clean = tuple(entry.strip() if isinstance(entry, str) else entry for entry in entries)
    if len(set(clean)) < len(clean):
        raise ValueError("contains something twice")
    return clean if isinstance(converted, tuple) else clean[0]


def _check_text(text: str) -> None:
    if not text.strip():
        raise ValueError("is blank")
    if len(text) > _MAX_TEXT:
        raise ValueError(f"is longer than {_MAX_TEXT} characters")
    if not all(c.isprintable() or c in "\n\t" for c in text):
        raise ValueError("contains characters that cannot be printed")


def _hint(value: Any, choices: tuple[str, ...]) -> str:
    return suggestion(value[:_MAX_QUOTED], choices) if isinstance(value, str) else ""


#: What is wrong with a key that is none of the manifest's begins so.
_UNKNOWN = "is not known"


def _checked(
    table: dict[str, Any], kinds: dict[str, Any], where: str, problems: list[_Problem]
) -> dict[str, Any]:
    values = {}
    for key, value in table.items():
        if key not in kinds:
            problems.append((f"{where}{_quoted(key)}", f"{_UNKNOWN}{_hint(key, tuple(kinds))}"))
            continue
        try:
            values[key] = _value(key, kinds[key], value)
        except (ValueError, msgspec.ValidationError) as error:
            message = str(error)
            problems.append((f"{where}{key}", message[0].lower() + message[1:]))
    return values


def read_manifest(path: Path, label: str | None = None) -> Manifest:
    """Read and check a manifest, which messages name by its path or by ``label``.

    Raises:
        SubmissionError: naming every problem with file and key.
    """
    label, read = label or str(path), _read(path)
    if isinstance(read, Manifest):
        return read
    texts = []
    for key, message in read:
        between = " " if message.startswith(_UNKNOWN) else ": "
        texts.append(f"{label}, key {key}{between}{message}" if key else f"{label}: {message}")
    raise SubmissionError(*texts)


#: A key, empty where the file as a whole is wrong, and what is wrong with it.
_Problem = tuple[str, str]


def _read(path: Path) -> Manifest | list[_Problem]:
    problems: list[_Problem] = []
    try:
        if path.stat().st_size > _MAX_BYTES:
            return [("", f"larger than {_MAX_BYTES // 1000} kB")]
        content = tomllib.loads(path.read_bytes().decode())
    except UnicodeDecodeError as error:
        return [("", f"not UTF-8 text (byte {error.start})")]
    except (ValueError, RecursionError) as error:  # ValueError: an integer of 5,000 digits too
        return [("", f"not TOML: {error}")]
    except OSError as error:
        return [("", f"cannot be read: {error.strerror}")]
    training, kinds = content.pop("training", {}), get_type_hints(Manifest, include_extras=True)
    del kinds["training"]
    if not isinstance(training, dict):
        problems.append(("training", "must be a table, [training]"))
        training = {}
    values = _checked(content, kinds, "", problems)
    problems += [(key, "is missing") for key in kinds if key not in content]
    trained = _checked(training, get_type_hints(Training), "training.", problems)
    return problems or Manifest(**values, training=Training(**trained))


def read_as_json(folder: str, label: str) -> dict[str, Any]:
    """Read the manifest of a folder, for a process that answers in JSON; ``label`` names the file.

    ``manifest``, its values, or None; and ``problems``, in words.
    """
    try:
        manifest = read_manifest(Path(folder, MANIFEST), label)
    except SubmissionError as error:
        return {"manifest": None, "problems": error.problems}
    return {"manifest": dataclasses.asdict(manifest), "problems": ()}


#: What is looked at, in this order.
Group = Literal["files", "manifest", "source", "run", "repeat", "time"]
GROUPS: tuple[Group, ...] = ("files", "manifest", "source", "run", "repeat", "time")


@dataclass(frozen=True)
class Finding:
    """One problem or note."""

    group: Group  #: what was looked at, one of :data:`GROUPS`.
    file: str  #: path below the folder, or words such as ``"the folder"``; printable.
    what: str  #: is wrong with it; printable.
    advice: str  #: what to do; printable.
    line: int | None = None  #: counted from 1; None where there is none.
    column: int | None = None  #: counted from 1; None where there is none.
    problem: bool = True  #: whether it stops the submission.

    def __post_init__(self) -> None:
        # File names, values and exceptions are the author's; a terminal and a page show this.
        for name in ("file", "what", "advice"):
            object.__setattr__(self, name, printable(getattr(self, name), 500))

    @property
    def where(self) -> str:
        """File, line and column, such as ``"controller.py line 3, column 8"``."""
        line = "" if self.line is None else f" line {self.line}"
        return self.file + line + ("" if self.column is None else f", column {self.column}")

    def message(self, label: str) -> str:
        """Two lines for a person."""
        kind = "" if self.problem else "note: "
        return f"{label}: {kind}{self.where}: {self.what}\n    {self.advice}"

    def to_json(self) -> dict[str, Any]:
        """Return the finding as JSON values."""
        names = ("group", "file", "line", "column", "what", "advice")
        return {name: getattr(self, name) for name in names}


#: The form of SPDX identifiers and of what they combine to.
_SPDX = re.compile(r"\(?[A-Za-z0-9.+-]+\)?( (AND|OR|WITH) \(?[A-Za-z0-9.+-]+\)?)*")

_EXAMPLES = {
    "name": 'write name = "my_controller"',
    "authors": 'write authors = ["A. Name", "B. Name"]',
    "licence": 'write licence = "Apache-2.0"',
    "api_version": f"write api_version = {API_VERSION}",
    "family": f"write one of {', '.join(FAMILIES)} in quotes",
    "tracks": f"write tracks = {list(TRACKS)}, or one of them".replace("'", '"'),
    "description": 'write description = "What it does, in a sentence or two."',
    "training": "write a line [training], and its keys below it",
    "training.data": 'write data = "what it was learned or tuned on"',
    "training.simulators": 'write simulators = "1", or leave it out',
    "training.seeds": "write seeds = [0, 1, 2], or leave it out",
    "training.compute": 'write compute = "20 min on 2 CPU cores", or leave it out',
    "training.per_lung": "write per_lung = true or false, or leave it out",
}
_GENERAL_ADVICE = "see submission.toml in submissions/README.md for the keys and their values"

# How tomllib names a place.
_TOML_PLACE = re.compile(r" \(at line (\d+), column (\d+)\)")


def check_manifest(folder: Path) -> list[Finding]:
    """Find what is wrong with the manifest of a folder."""
    path = folder / MANIFEST
    if not path.is_file():
        return []  # reported by check_files
    read, lines = _read(path), _lines(path)
    if isinstance(read, Manifest):
        return list(_consistency(read, folder, lines))
    return [_explained(*problem, lines) for problem in read]


def _explained(key: str, message: str, lines: list[str]) -> Finding:
    """A finding of one of the manifest's problems."""
    if not key:
        at = _TOML_PLACE.search(message)
        place = (int(at[1]), int(at[2])) if at else (None, None)
        return Finding("manifest", MANIFEST, _TOML_PLACE.sub("", message), _GENERAL_ADVICE, *place)
    unknown, table = message.startswith(_UNKNOWN), "training." * key.startswith("training.")
    key = table + key.removeprefix(table).strip("'\"")
    advice = "remove or rename it" if unknown else _EXAMPLES.get(key, _GENERAL_ADVICE)
    return Finding("manifest", MANIFEST, f"key {key} {message}", advice, _line(lines, key))


def _line(lines: list[str], key: str) -> int | None:
    table, _, name = key.rpartition(".")
    pattern = re.compile(rf"\s*[\"']?{re.escape(name)}[\"']?\s*=|\s*\[\s*{re.escape(name)}\s*\]")
    current_table = ""
    for number, line in enumerate(lines, 1):
        if pattern.match(line) and current_table == table:
            return number
        header = re.match(r"\s*\[\s*(\w+)\s*\]", line)
        current_table = header[1] if header else current_table
    return None


def _lines(path: Path) -> list[str]:
    small = path.stat().st_size < 100_000
    return path.read_text(errors="replace").splitlines() if small else []


def _consistency(manifest: Manifest, folder: Path, lines: list[str]) -> Iterator[Finding]:
    def finding(key: str, message: str, advice: str, *, problem: bool = False) -> Finding:
        text = f"key {key} {message}"
        return Finding("manifest", MANIFEST, text, advice, _line(lines, key), problem=problem)

    if not _SPDX.fullmatch(manifest.licence):
        message = f"{manifest.licence!r} is not an SPDX identifier"
        yield finding("licence", message, _EXAMPLES["licence"], problem=True)
    if manifest.name != folder.name:
        message = f"is {manifest.name}, the folder is {folder.name}"
        yield finding(
            "name", message, f"a pull request must put it into submissions/{manifest.name}/"
        )
    if AUTHOR in manifest.authors:
        yield finding("authors", f"still says {AUTHOR}", "write your name")
    if manifest.training.per_lung and "robustness" in manifest.tracks:
        message = "is true, but task.lung is None on the robustness track"
        advice = "make sure that it can do without, or leave it out"
        yield finding("training.per_lung", message, advice)
    if manifest.family not in ("pid", "other") and not manifest.training.data:
        yield finding("training.data", "is missing", "say what it was trained on")
