"""Everything that reading a folder shows, found in a limited process that runs none of it."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from ventbench.sandbox.reader import UnreadableError, read_apart
from ventbench.submissions.errors import Finding
from ventbench.submissions.file_checks import check_files
from ventbench.submissions.manifest import check_manifest
from ventbench.submissions.review import review
from ventbench.submissions.static_checks import check_sources

#: Most findings of one kind that are listed.
LISTED = 200

_CHECKS = ("manifest", "files", "sources", "review")


def findings_as_json(folder: str, check: str) -> list[dict[str, Any]]:
    """Make one kind of check on a folder, for a process that answers in JSON.

    Args:
        folder: the submission's.
        check: ``"manifest"``, ``"files"``, ``"sources"`` or ``"review"``.
    """
    path = Path(folder)
    if check == "manifest":
        findings = check_manifest(path)[0]
    else:
        checks = {"files": check_files, "sources": check_sources, "review": review}
        findings = checks[check](path)
    # Problems first: what is cut off must not be what stops the submission.
    kept = sorted(findings, key=lambda finding: not finding.problem)[:LISTED]
    return [dataclasses.asdict(finding) for finding in findings if finding in kept]


def all_findings_as_json(folder: str) -> list[dict[str, Any]]:
    """Make every check on a folder, for a process that answers in JSON.

    Args:
        folder: the submission's.
    """
    return [finding for check in _CHECKS for finding in findings_as_json(folder, check)]


def inspect_folder(folder: Path) -> tuple[Finding, ...]:
    """Return what is wrong with the manifest, the files and the sources of a submission.

    One process makes all checks. Where a check ends the process, each check gets its own, so that
    the answer says which files cannot be read and still has what the other checks find.

    Args:
        folder: the submission's; nothing in it is run or imported.
    """
    try:
        together = read_apart("ventbench.submissions.inspection:all_findings_as_json", folder)
        return tuple(Finding(**finding) for finding in together)
    except UnreadableError:
        return _each_apart(folder)


def _each_apart(folder: Path) -> tuple[Finding, ...]:
    findings: list[Finding] = []
    for check in _CHECKS:
        try:
            function = "ventbench.submissions.inspection:findings_as_json"
            found = read_apart(function, folder, [check])
        except UnreadableError as error:
            group = check if check in ("manifest", "files") else "source"
            advice = "make its files smaller and plainer"
            findings.append(Finding(group, "the folder", str(error), advice))  # type: ignore[arg-type]
            continue
        findings += [Finding(**finding) for finding in found]
    return tuple(findings)
