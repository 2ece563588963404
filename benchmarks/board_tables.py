"""Table of README.md from the records of the leaderboard.

Prints it; ``--write`` puts it where it belongs. Usage:

    python benchmarks/board_tables.py [--write]
"""

from __future__ import annotations

import argparse
import re
from pathlib import Path

from ventbench.board import frames

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "README.md"


def markdown() -> str:
    """The table of the leaderboard of this repository."""
    return frames.markdown(frames.load_tracks(ROOT / "leaderboard"))


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
