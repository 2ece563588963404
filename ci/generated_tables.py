"""What the site has from the code: tables and the reference; a page has a mark where one goes."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from typing import Any

#: A mark in a page, such as ``<!-- commands -->``.
_MARK = re.compile(r"^<!-- ([a-z]+) -->$", re.M)


def commands() -> str:
    """Every command with what it does and an example."""
    import typer.main

    from hardware_eval import cli as hardware
    from proofs import __main__ as proofs
    from ventbench import cli

    programs = {
        "ventbench": cli.app,
        "ventbench-hardware": hardware.app,
        "python -m proofs": proofs.app,
    }
    lines = ["| command | what it does | example |", "|---|---|---|"]
    for program, app in programs.items():
        for name, command in _leaves(program, typer.main.get_command(app)):
            example = re.search(r"Example: `([^`]+)`", command.help or "")
            shown = f"`{' '.join(example[1].split())}`" if example else ""
            lines.append(f"| `{name}` | {command.get_short_help_str(200)} | {shown} |")
    return "\n".join(lines)


def _leaves(path: str, command: Any) -> Iterator[tuple[str, Any]]:
    """A command, or those of a group, with what is typed to call it."""
    for name, inner in getattr(command, "commands", {}).items():
        yield from _leaves(f"{path} {name}", inner)
    if not hasattr(command, "commands"):
        yield path, command


def mechanisms() -> str:
    """Every mechanism of the library with its equation, parameters and strengths."""
    from ventbench.physics import library

    head = "| name | equation | parameters (*: shape), bounds | mild, strong | source |"
    lines = [head, "|---|---|---|---|---|"]
    for name, mechanism in library().items():
        about = mechanism.description
        parameters = "; ".join(
            f"`{p.name}`{'*' if p.shape else ''} {p.low:g}..{p.high:g}"
            f"{'' if p.unit == '1' else f' {p.unit}'}: {p.meaning}"
            for p in about.parameters
        )
        strengths = f"{about.strength.mild:g}, {about.strength.strong:g}"
        cells = (f"`{name}`", f"`{about.equation}`", parameters, strengths, about.source)
        lines.append("| " + " | ".join(cell.replace("|", r"\|") for cell in cells) + " |")
    return "\n".join(lines)


def stressors() -> str:
    """Every stressor with its strengths and their reason, and the pairs."""
    from ventbench.physics.catalogue import parameter
    from ventbench.task.stressors import PAIRS, STRESSORS

    lines = [
        "| stressor | what happens | changes | mild | strong | why these strengths |",
        "|---|---|---|---|---|---|",
    ]
    for line in STRESSORS:
        unit = "" if line.rule == "scale" else f" {parameter(line.strength).unit}"
        unit = unit.replace(" 1/", " /").removesuffix(" 1")
        sign = {"add": "+", "scale": "x ", "label": ""}[line.rule]
        mild, strong = (
            f"{sign if value > 0 else ''}{float(f'{value:.3g}'):g}{unit}"
            for value in (line.mild, line.strong)
        )
        lines.append(
            f"| `{line.name}` | {line.title} | `{line.strength}` | {mild} | {strong} "
            f"| {line.reason} |"
        )
    pairs = "; ".join(" + ".join(f"`{name}`" for name in pair) for pair in PAIRS)
    return "\n".join([*lines, "", f"Pairs, both mild: {pairs}."])


def reference() -> str:
    """Every name of the front door, as mkdocstrings is told of it."""
    import ventbench

    named = {"entries.runs.Runs": ("entries.runs", "Runs")}  # what a score is made of
    named |= {name: place for name, place in ventbench._SOURCES.items() if name != "LUNGS"}
    return "\n\n".join(
        f"::: ventbench.{module}.{attribute}\n    options:\n      heading: ventbench.{name}\n"
        f"      toc_label: {name}"
        for name, (module, attribute) in sorted(named.items(), key=lambda item: item[0].lower())
    )


_TABLES: dict[str, Callable[[], str]] = {
    table.__name__: table for table in (commands, mechanisms, reference, stressors)
}


def with_tables(markdown: str) -> str:
    """A page with its tables in the place of their marks; other comments stay."""
    return _MARK.sub(lambda m: _TABLES[m[1]]() if m[1] in _TABLES else m[0], markdown)
