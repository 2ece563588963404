"""Table of README.md from the records of the leaderboard.

Prints it; ``--write`` puts it where it belongs. Usage:

    python benchmarks/board_tables.py [--write]
"""

from __future__ import annotations

import argparse
import math
import re
from pathlib import Path
from typing import Any

from ventbench.board.frames import load_board

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "README.md"


def markdown() -> str:
    """The ranked entries as a table, a line for each, by the first track that ranks it."""
    performance = ["performance", "rank", "error"]
    robustness = ["robustness", "rank", "stress", "runs survived"]
    titles = ["entry", *performance, *robustness]
    board = load_board(ROOT / "leaderboard")
    shown: Any = board[board["status"].isin(["ranked", "practice"])]
    newest = shown[shown["draws"] == shown["draws"].iloc[0]]
    cells: dict[str, dict[str, list[str]]] = {}
    for row in newest.to_dict(orient="records"):
        ranked = row["status"] == "ranked"
        ranks = f"{row['rank']}" if ranked else "practice"
        if ranked and row["rank_low"] != row["rank_high"]:
            ranks += f" ({row['rank_low']} to {row['rank_high']})"
        limits = f"[{row['normalised_low']:.1f}, {row['normalised_high']:.1f}]"
        stress = row["stress_cmH2O"]
        told = (
            [f"{row['score_cmH2O']:.3f}"]
            if row["track"] == "performance"
            else [f"{stress:.2f}", f"{100 * row['stress_survived']:.0f} %"]
            if math.isfinite(stress)
            else ["", ""]
        )
        score = f"**{row['normalised']:.1f}** {limits}"
        cells.setdefault(row["name"], {})[row["track"]] = [score, ranks, *told]
    lines = [titles, ["---"] * len(titles)]
    for name, tracks in cells.items():
        lines.append(
            [
                name,
                *tracks.get("performance", [""] * len(performance)),
                *tracks.get("robustness", [""] * len(robustness)),
            ]
        )
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true", help="put the table into the page")
    given = parser.parse_args()
    table = markdown()
    print(table)
    if given.write:
        block = re.compile(r"<!-- board -->\n.*?<!-- end -->", re.S)
        text = f"<!-- board -->\n{table}\n<!-- end -->"
        PAGE.write_text(block.sub(lambda _: text, PAGE.read_text("utf-8")), "utf-8")


if __name__ == "__main__":
    main()
