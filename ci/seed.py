"""The seed of a season, from a secret of the workflow to a file that the scorer reads and deletes.

A step of its own: the environment of the process that starts submissions never held the seed, so no
process below it and no dump of it does.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

from ci import workflow
from ventbench import seasons
from ventbench.seasons import Season

TITLE = "Season"

#: Environment variable with the secret: 64 hexadecimal digits.
SECRET = "VENTBENCH_SEASON_SEED"


def hand_over(season: str, seed: str, path: Path) -> bool:
    """Write the seed where the scorer finds it.

    Args:
        season: id; empty for a score on published draws, which needs no seed.
        seed: 64 hexadecimal digits.
        path: of the file.

    Returns:
        Whether one was written.

    Raises:
        InputError: if it is not a seed.
    """
    if not season:
        return False
    seasons.write_seed(path, seasons.parse_seed(seed, SECRET))
    return True


def take_over(season: str, path: Path, leaderboard: Path) -> tuple[Season, bytes]:
    """Read the seed and delete the file.

    Args:
        season: id.
        path: of the file.
        leaderboard: folder with the season's file.

    Raises:
        InputError: if it is not the seed of the season, or the season is over.
    """
    try:
        seed = seasons.read_seed(path)
    finally:
        path.unlink(missing_ok=True)
    known = seasons.read_season(leaderboard / "seasons" / f"{season}.toml")
    seasons.require_seed(known, seed)
    return known, seed


def main() -> int:
    """Hand over the seed that the environment holds; see ``score-official.yml``."""
    given = os.environ.get("SEASON", ""), os.environ.get(SECRET, "")
    written = hand_over(*given, Path(workflow.required("SEED_FILE")))
    print("| hidden draws" if written else "| published draws")
    return 0


if __name__ == "__main__":
    sys.exit(workflow.run(TITLE, main))
