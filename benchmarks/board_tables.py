"""Tables of README.md and docs/protocol.md from the records of the leaderboard.

Prints both; ``--write`` puts them where they belong. Usage:

    python benchmarks/board_tables.py [--write]
"""

from __future__ import annotations

import argparse
import math
import re
from pathlib import Path

from ventbench.board.frames import load_board

ROOT = Path(__file__).parents[1]

#: Pages with a table; that of README is shorter.
PAGES = (ROOT / "README.md", ROOT / "docs" / "protocol.md")


def rows(short: bool) -> list[list[str]]:
    """Title and rows of a table.

    Args:
        short: for README: without the nominal error and the difference to the PID.
    """
    board = load_board(ROOT / "leaderboard")
    titles = ["track", "rank", "entry", "normalised", "error", "nominal", "to PID", "stress"]
    table = [[*titles, "runs survived"]]
    for row in board.query("status == 'ranked'").to_dict(orient="records"):
        ranks = f"{row['rank']}"
        if row["rank_low"] != row["rank_high"]:
            ranks += f" ({row['rank_low']} to {row['rank_high']})"
        limits = f"[{row['normalised_low']:.1f}, {row['normalised_high']:.1f}]"
        pid, stress = row["normalised_to_pid"], row["stress_cmH2O"]
        table.append(
            [
                row["track"],
                ranks,
                row["name"],
                f"**{row['normalised']:.1f}** {limits}",
                f"{row['score_cmH2O']:.3f}",
                f"{row['nominal_cmH2O']:.3f}",
                f"{pid:+.1f}" if math.isfinite(pid) else "",
                f"{stress:.2f}" if math.isfinite(stress) else "",
                f"{100 * row['stress_survived']:.0f} %" if math.isfinite(stress) else "",
            ]
        )
    left_out = {5, 6} if short else set()
    return [[cell for k, cell in enumerate(line) if k not in left_out] for line in table]


def markdown(short: bool) -> str:
    """A table of :func:`rows`."""
    title, *body = rows(short)
    lines = [title, ["---"] * len(title), *body]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true", help="put the tables into the pages")
    given = parser.parse_args()
    block = re.compile(r"<!-- board -->\n.*?<!-- end -->", re.S)
    for page in PAGES:
        table = markdown(short=page.name == "README.md")
        print(f"{page.name}\n{table}\n")
        if given.write:
            text = f"<!-- board -->\n{table}\n<!-- end -->"
            page.write_text(block.sub(lambda _, t=text: t, page.read_text("utf-8")), "utf-8")


if __name__ == "__main__":
    main()
