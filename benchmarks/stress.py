"""Figures of the bundled entries on the stress track: the table of docs/stress.md.

Prints the table, and paired differences between the best entry and the others. The figures are
those of the leaderboard's records; ``--run`` runs the bundled entries anew. Usage:

    python benchmarks/stress.py [--run [--draws N]] [--write]

``--write`` puts the table into docs/.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ventbench.base import compilation
from ventbench.board.frames import load_tracks
from ventbench.entries.runs import DRAWS, Runs
from ventbench.entries.scoring import score

ENTRIES = ("pid_robust", "residual_mlp_all", "ppo", "dqn", "adaptive_pid")
DOCS = Path(__file__).parents[1] / "docs"
LEADERBOARD = DOCS.parent / "leaderboard"


def table(scores: list[dict[str, Any]]) -> str:
    """The figures as Markdown, one column an entry."""

    def row(title: str, show: Callable[[dict[str, Any]], str]) -> str:
        return f"| {title} | " + " | ".join(map(show, scores)) + " |"

    def scored(entry: dict[str, Any]) -> str:
        low, high = entry["ci95"]
        return f"**{entry['score']:.2f}** [{low:.2f}, {high:.2f}]"

    lines = [
        row("", lambda e: e["name"]),
        "|---|" + "---|" * len(scores),
        row("stress score, cmH2O", scored),
        row("survived", lambda e: f"{e['survived']:.1%}"),
        row(f"unsafe of {scores[0]['stressed_runs']} runs", lambda e: f"{e['unsafe_runs']}"),
        row("stressors held out of tuning, cmH2O", lambda e: f"{e['held_out_score']:.2f}"),
    ]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true", help="put the table into docs/")
    parser.add_argument("--run", action="store_true", help="run the entries anew, in this process")
    parser.add_argument("--draws", type=int, default=DRAWS, help="with --run: number of draws")
    given = parser.parse_args()
    tables = anew(given.draws) if given.run else recorded()
    if not tables:
        raise SystemExit(f"{LEADERBOARD} has no stressed commands at hand")
    scores = [{"name": name, **own.headline()} for name, own in tables.items()]
    text = table(scores)
    print(text)
    best = min(tables, key=lambda name: tables[name].score)
    for name, own in tables.items():
        if name != best:
            difference, (low, high) = tables[best].difference(own)
            limits = f"paired 95 % interval {low:+.3f} to {high:+.3f}"
            print(f"{best} less {name}: {difference:+.3f} cmH2O, {limits}")
    if given.write:
        page = DOCS / "stress.md"
        block = f"<!-- figures -->\n{text}\n<!-- end -->"
        old = re.compile(r"<!-- figures -->\n.*?\n<!-- end -->", re.S)
        page.write_text(old.sub(lambda _: block, page.read_text("utf-8")), "utf-8")


def recorded() -> dict[str, Runs]:
    """Tables of the records of the leaderboard, best first; empty where none are at hand."""
    tracks = load_tracks(LEADERBOARD, track="robustness")
    rows = next((track.stress for track in tracks if track.stress), ())
    return {row.name: row.tables for row in rows}


def anew(draws: int) -> dict[str, Runs]:
    """Tables of the bundled entries, run in this process."""
    compilation.keep()
    tables = {}
    for name in ENTRIES:
        stressed = score(name, track="robustness", stress=draws, sandbox=False).stressed
        assert stressed is not None
        tables[name] = stressed
    return tables


if __name__ == "__main__":
    main()
