"""Tables of README.md and docs/stress.md from the records of the leaderboard.

Prints them, and paired differences between the best entry under stress and the others; ``--write``
puts the tables where they belong. Usage:

    python benchmarks/board_tables.py [--write]
"""

from __future__ import annotations

import re
from pathlib import Path

import typer

from ventbench.board import frames
from ventbench.board.ranking import stressed_runs
from ventbench.entries.runs import Runs

ROOT = Path(__file__).parents[1]


def stressed() -> dict[str, Runs]:
    """Runs of the entries on the stress track, best first; none if their commands are not here."""
    tracks = frames.load_tracks(ROOT / "leaderboard", track="robustness")
    rows = next((track.stress for track in tracks if track.stress), ())
    return {row.record.name: stressed_runs(row) for row in rows}


def stress_table(runs: dict[str, Runs]) -> str:
    """Figures of entries on the stress track as Markdown, one column an entry."""
    scores = [entry.headline() for entry in runs.values()]
    rows = {
        "": list(runs),
        "stress score, cmH2O": [
            "**{:.2f}** [{:.2f}, {:.2f}]".format(x["score"], *x["ci95"]) for x in scores
        ],
        "survived": [f"{x['survived']:.1%}" for x in scores],
        f"unsafe of {scores[0]['stressed_runs']} runs": [str(x["unsafe_runs"]) for x in scores],
        "stressors held out of tuning, cmH2O": [f"{x['held_out_score']:.2f}" for x in scores],
    }
    lines = [f"| {title} | {' | '.join(cells)} |" for title, cells in rows.items()]
    return "\n".join([lines[0], "|---|" + "---|" * len(runs), *lines[1:]])


def tables() -> dict[str, tuple[str, str]]:
    """Mark and table by page."""
    board = frames.markdown(frames.load_tracks(ROOT / "leaderboard"))
    of_stress = {"docs/stress.md": ("figures", stress_table(runs))} if (runs := stressed()) else {}
    return {"README.md": ("board", board)} | of_stress


def main(write: bool = False) -> None:
    """Print the tables; ``--write`` puts them into their pages."""
    for page, (mark, table) in tables().items():
        print(table, end="\n\n")
        if write:
            block = re.compile(rf"<!-- {mark} -->\n.*?<!-- end -->", re.S)
            text = f"<!-- {mark} -->\n{table}\n<!-- end -->"
            path = ROOT / page
            path.write_text(block.sub(lambda _, text=text: text, path.read_text("utf-8")), "utf-8")
    if not (runs := stressed()):
        return
    (best, first), *others = runs.items()
    for name, entry in others:
        lead = first.difference(entry)
        limits = f"paired 95 % interval {lead.low:+.3f} to {lead.high:+.3f}"
        print(f"{best} less {name}: {lead.value:+.3f} cmH2O, {limits}")


if __name__ == "__main__":
    typer.run(main)
