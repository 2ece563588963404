"""Sections of the page of results, written by the commands that measure.

A section stands between two marks in a Markdown file, ``<!-- NAME -->`` and ``<!-- end NAME -->``;
what is written replaces what stood there, so that no figure is copied by hand.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from proofs import code_version
from proofs.challenge.figures import Figure, full_answer
from ventbench.base import files
from ventbench.base.errors import InputError

if TYPE_CHECKING:
    from proofs.challenge.reveal import Board, Draw, Judged
    from proofs.real.rig import Proof


def write_section(path: Path, name: str, text: str) -> None:
    """Replace a section of a Markdown file, or write a file of it if there is none.

    Args:
        path: Markdown file.
        name: name of the section.
        text: its content.

    Raises:
        InputError: if the file has no such section.
        OSError: if it cannot be read or written.
    """
    first, last = f"<!-- {name} -->", f"<!-- end {name} -->"
    section = f"{first}\n\n{text.strip()}\n\n{last}"
    if not path.exists():
        files.write_text(path, section + "\n")
        return
    before = path.read_text("utf-8")
    start, end = before.find(first), before.find(last)
    if start < 0 or end < start:
        raise InputError(
            f"{path} has no section between {first} and {last}; add the two lines where it belongs"
        )
    files.write_text(path, before[:start] + section + before[end + len(last) :])


def challenge_section(result: Judged) -> str:
    """Figures of a diagnoser on one or more draws as Markdown."""
    versions = ", ".join(result.versions) or "unknown"
    answered = ", ".join(f"{draw.answered} of {draw.total}" for draw in result.draws)
    lines = [
        f"Diagnoser `{result.diagnoser}`, code {versions}, answered {answered} of "
        f"`{result.generator}`:",
        "",
        "| figure | measured | cases | goal |",
        "|---|---|---|---|",
        *(
            f"| {figure.what} | {_cell(figure)} | {figure.count} | {figure.goal}"
            + (", missed |" if figure.met is False else " |")
            for figure in result.figures
            if figure.count and figure.goal
        ),
    ]
    others = [figure for figure in result.figures if figure.count and not figure.goal]
    if others:
        told = "; ".join(f"{figure.what} {_cell(figure)}" for figure in others)
        lines += ["", f"Without a goal: {told}."]
    return "\n".join([*lines, *_wrong_answers(result)])


def _wrong_answers(result: Judged) -> list[str]:
    """Answers that are not right, and what was the truth."""
    wrong = [case for case in result.cases.values() if not case.right]
    if not wrong:
        return []
    truths: dict[str, list[str]] = {}
    for case in sorted(wrong, key=lambda case: (case.effects, case.strengths)):
        truth = " + ".join(
            f"{strength} {effect.name}{'' if effect.seen else ' (below the detection limit)'}"
            for effect, strength in zip(case.truth, case.strengths, strict=True)
        )
        truths.setdefault(full_answer(case), []).append(truth or "nothing")
    return [
        "",
        f"Answers that are not right ({len(wrong)} of {len(result.cases)}):",
        "",
        "| answer | truth |",
        "|---|---|",
        *(f"| {answer} | {'; '.join(given)} |" for answer, given in sorted(truths.items())),
    ]


def _commands(tables: Mapping[str, Sequence[Draw]], diagnosers: Sequence[str]) -> list[str]:
    """Commands that make, answer and judge draws, and what was committed."""
    call, make, folders, seeds, drawn = "python -m proofs challenge", [], [], [], []
    for source, draws in tables.items():
        for k, draw in enumerate(draws, start=1):
            folders.append(f"runs/{source}{k if k > 1 else ''}")
            seeds.append(f"--seed={draw.seed}")
            given = f"--generator {source} {seeds[-1]} --cases {draw.total} --out {folders[-1]}"
            make.append(f"{call} make {given}")
            drawn.append(f"| `{source}` | `{draw.seed}` | `{draw.commitment}` |")
    each = f"for who in {' '.join(diagnosers)}; do {call} answer $where --diagnoser $who; done"
    answer = f"for where in {' '.join(folders)}; do {each}; done"
    end = f"{call} board {' '.join(folders)} {' '.join(seeds)}"
    head = ["| world | seed | commitment |", "|---|---|---|"]
    return ["```sh", *make, answer, end, "```", "", *head, *drawn]


#: Figures of the board, and their heads.
_BOARD = {
    "log score, nats": "log score, nats",
    "isolation accuracy": "isolation accuracy",
    "detected, where something is missing": "detected",
    "false alarms, where nothing is missing": "false alarms",
    "right name and size": "right name and size",
    "a confident wrong name": "confident wrong name",
}

#: Paired differences beside them.
_PAIRED = ("log score", "isolation error")


def board_section(result: Board) -> str:
    """Figures of all diagnosers side by side, and paired differences with their 95 % intervals."""
    every = [row for rows in result.tables.values() for row in rows]
    names = list(dict.fromkeys(row.diagnoser for row in every))
    drawn = {generator: rows[0].draws for generator, rows in result.tables.items()}
    lines = _commands(drawn, names)
    lines += ["", f"The last two columns are `{result.against}` minus the other, case by case."]
    heads = ["world", "diagnoser", "code", "cases", *_BOARD.values()]
    heads += [f"less: {what}" for what in _PAIRED]
    lines += ["", f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for generator, rows in result.tables.items():
        for row in rows:
            figures = {figure.what: figure for figure in row.figures}
            compared = result.differences(row)
            code = ", ".join(row.versions) or "–"
            cells = [f"`{generator}`", row.diagnoser, code, str(len(row.cases))]
            cells += [_cell(figures[what]) for what in _BOARD]
            cells += [_cell(compared[what]) if compared else "" for what in _PAIRED]
            lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def _cell(figure: Figure) -> str:
    """Value and interval of a figure."""
    if figure.value is None:
        return "–"
    form = "{:.0%}" if figure.is_share else "{:.3g}"
    span = "" if figure.ci95 is None else f" ({'..'.join(map(form.format, figure.ci95))})"
    return form.format(figure.value) + span


def proof_sections(proof: Proof) -> dict[str, str]:
    """Figures of each finished part of the proof on the real rig as Markdown, by its section.

    A part that is run alone so replaces nothing but its own figures.
    """
    return {f"proof {name}": _part(name, proof) for name in (*proof.parts, *proof.impossible)}


def _part(name: str, proof: Proof) -> str:
    """Figures of a part of the proof, or why there are none, and its claims."""
    part = proof.parts.get(name)
    lines = [
        "```sh",
        f"python -m proofs rig --recordings DIR --out runs/proof --only {name}",
        "```",
    ]
    if part is None:
        return "\n".join([*lines, "", proof.impossible[name]])
    errors = " | ".join(_error(part["mae"][stage]) for stage in ("before", "refit", "after"))
    cut = "–" if part["cut_percent"] is None else f"{part['cut_percent']:.0f} %"
    named = ", ".join(f"`{m['name']}`" for m in part["mechanisms"]) or "nothing"
    if part["slot"]:
        named += f"; place: {part['slot']['name']}"
    lines += [
        "",
        f"Code {part['code'] or 'unknown'}, recording `{proof.sha256[:16]}`; mean absolute error "
        "of held-out inspirations, cmH2O:",
        "",
        "| breaths held out | as given | refitted | corrected | cut | named |",
        "|---|---|---|---|---|---|",
        f"| {part['held_out']} | {errors} | {cut} | {named} |",
    ]
    if name == "rc":
        lines += ["", *_by_lung(part)]
    claims = [claim for claim in proof.claims if claim.part == name]
    if claims:
        lines += ["", "| claim | outcome | met |", "|---|---|---|"]
    lines += [
        f"| {claim.what} | {claim.value} | {'yes' if claim.met else 'no'} |" for claim in claims
    ]
    return "\n".join(lines)


def pairs_section(report: str, half: str) -> str:
    """Tables of :func:`~proofs.real.pairs.report` for a half of the pairs as Markdown."""
    option = " --sealed" if half == "sealed" else ""
    return (
        f"```sh\npython -m proofs pairs --recordings DIR --out runs/pairs{option}\n```\n\n"
        f"The {half} half, code {code_version()}.\n\n{report}"
    )


def _by_lung(part: Mapping[str, Any]) -> list[str]:
    """Errors and strengths of a part lung by lung."""
    lines = [
        "Lung by lung:",
        "",
        "| | as given | refitted | corrected |",
        "|---|---|---|---|",
    ]
    for group, stages in part.get("groups", {}).items():
        if group.startswith("lung "):
            errors = (_error(stages[stage]["mae"]) for stage in ("before", "refit", "after"))
            lines.append(f"| {group.removeprefix('lung ')} | {' | '.join(errors)} |")
    lines += ["", "| named | value | 95 % interval |", "|---|---|---|"]
    for mechanism in part["mechanisms"]:
        for name, estimate in mechanism["parameters"].items():
            low, high = estimate["ci95"]
            unit = "" if estimate["unit"] == "1" else f" {estimate['unit']}"
            span = "–" if low is None or high is None else f"{low:.3g} to {high:.3g}"
            lines.append(
                f"| `{mechanism['name']}` {name} | {estimate['value']:.3g}{unit} | {span} |"
            )
    return lines


def _error(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f}"
