"""Checks of ``submission.toml``, with the line of each key and an example of what it wants."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterator
from pathlib import Path

from ventbench.interfaces import API_VERSION
from ventbench.submissions import manifest
from ventbench.submissions.errors import SubmissionError
from ventbench.submissions.findings import Finding
from ventbench.submissions.folder import MANIFEST
from ventbench.submissions.manifest import FAMILIES, TRACKS, Manifest
from ventbench.submissions.scaffold import AUTHOR

#: SPDX identifiers that most authors use.
LICENCES = (
    *("0BSD", "AGPL-3.0-only", "AGPL-3.0-or-later", "Apache-2.0", "Artistic-2.0", "BSD-2-Clause"),
    *("BSD-3-Clause", "BSL-1.0", "CC-BY-4.0", "CC-BY-SA-4.0", "CC0-1.0", "ECL-2.0", "EPL-2.0"),
    *("EUPL-1.2", "GPL-2.0-only", "GPL-2.0-or-later", "GPL-3.0-only", "GPL-3.0-or-later", "ISC"),
    *("LGPL-2.1-only", "LGPL-2.1-or-later", "LGPL-3.0-only", "LGPL-3.0-or-later", "MIT", "MIT-0"),
    *("MPL-2.0", "MulanPSL-2.0", "NCSA", "OSL-3.0", "PostgreSQL", "UPL-1.0", "Unlicense", "Zlib"),
)
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
_ELSE = "see submission.toml in submissions/README.md for the keys and their values"

# How manifest.read names a key, and tomllib a place.
_KEY = re.compile(
    rf"{re.escape(MANIFEST)}, key (?P<table>training\.)?(?P<key>\w+|(['\"]).*?\3)"
    r"(: (?P<what>.*)| (?P<unknown>is not .*))",
    re.DOTALL,
)
_TOML_PLACE = re.compile(r" \(at line (\d+), column (\d+)\)")


def check(folder: Path) -> tuple[list[Finding], Manifest | None]:
    """Read the manifest and look at what it says.

    Args:
        folder: of the submission.

    Returns:
        What was found, and the manifest unless it cannot be read.
    """
    path = folder / MANIFEST
    if not path.is_file():
        return [], None  # told with the files
    try:
        read = manifest.read(path, MANIFEST)
    except SubmissionError as error:
        lines = _lines(path)
        return [_explained(problem, lines) for problem in error.problems], None
    return list(_sense(read, folder, _lines(path))), read


def _explained(problem: str, lines: list[str]) -> Finding:
    """A finding of one of the manifest's problems, whose text names the key."""
    known = _KEY.fullmatch(problem)
    if known is None:
        text = problem.removeprefix(f"{MANIFEST}: ")
        at = _TOML_PLACE.search(text)
        line, column = (int(at[1]), int(at[2])) if at else (None, None)
        what = _TOML_PLACE.sub("", text)
        return Finding("manifest", MANIFEST, what, _ELSE, line, column)
    key = (known["table"] or "") + known["key"].strip("'\"")
    advice = "remove or rename it" if known["unknown"] else _EXAMPLES.get(key, _ELSE)
    what = f"key {key} {known['unknown'] or known['what']}"
    return Finding("manifest", MANIFEST, what, advice, _line(lines, key))


def _line(lines: list[str], key: str) -> int | None:
    table, _, name = key.rpartition(".")
    pattern = re.compile(rf"\s*[\"']?{re.escape(name)}[\"']?\s*=|\s*\[\s*{re.escape(name)}\s*\]")
    within = ""
    for number, line in enumerate(lines, 1):
        if pattern.match(line) and within == table:
            return number
        header = re.match(r"\s*\[\s*(\w+)\s*\]", line)
        within = header[1] if header else within
    return None


def _lines(path: Path) -> list[str]:
    small = path.stat().st_size < 100_000
    return path.read_text(errors="replace").splitlines() if small else []


def _sense(read: Manifest, folder: Path, lines: list[str]) -> Iterator[Finding]:
    def found(key: str, what: str, advice: str, *, problem: bool = False) -> Finding:
        text = f"key {key} {what}"
        return Finding("manifest", MANIFEST, text, advice, _line(lines, key), problem=problem)

    if not _SPDX.fullmatch(read.licence):
        what = f"{read.licence!r} is not an SPDX identifier{_hint(read.licence)}"
        yield found("licence", what, _EXAMPLES["licence"], problem=True)
    else:
        for name in re.split(r" (?:AND|OR|WITH) ", read.licence):
            if name.strip("()") not in LICENCES:
                what = f"{name!r} is not a well-known SPDX identifier{_hint(name)}"
                advice = "make sure that it allows others to run and publish the submission"
                yield found("licence", what, advice)
    if read.name != folder.name:
        what = f"is {read.name}, the folder is {folder.name}"
        yield found("name", what, f"a pull request must put it into submissions/{read.name}/")
    if AUTHOR in read.authors:
        yield found("authors", f"still says {AUTHOR}", "write your name")
    if read.training.per_lung and "robustness" in read.tracks:
        what = "is true, but task.lung is None on the robustness track"
        yield found("training.per_lung", what, "make sure that it can do without, or leave it out")
    if read.family not in ("pid", "other") and not read.training.data:
        yield found("training.data", "is missing", "say what it was trained on")


def _hint(licence: str) -> str:
    close = difflib.get_close_matches(licence.strip("()"), LICENCES, n=1, cutoff=0.5)
    return f"; did you mean {close[0]}?" if close else ""
