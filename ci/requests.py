"""Who asked for which entry: the accounts of merged pull requests, as the platform tells them.

What a submission or a commit says of its author decides nothing.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from ci import workflow
from ci.take import PARENT
from ventbench.base.errors import InputError

TITLE = "Requests"


def requests(merged: list[dict[str, Any]]) -> list[dict[str, str]]:
    """Turn merged pull requests into requests for ``ventbench round freeze``.

    Args:
        merged: of ``gh pr list --state merged --json author,files,mergedAt``.

    Returns:
        A request for each submission that a pull request touches; the freeze takes the first.

    Raises:
        InputError: if it is not such a list.
    """
    made = []
    try:
        for own in merged:
            paths = (Path(file["path"]).parts for file in own["files"])
            names = {parts[1] for parts in paths if len(parts) > 2 and parts[0] == PARENT}
            account, asked = str(own["author"]["login"]), str(own["mergedAt"])
            made += [{"name": x, "account": account, "asked": asked} for x in sorted(names)]
    except (KeyError, TypeError) as error:
        raise InputError(f"no list of merged pull requests: {error!r}") from None
    return sorted(made, key=lambda x: (x["asked"], x["name"]))


def main() -> int:
    """Read ``MERGED``, write ``OUT``; see ``round.yml``."""
    merged, out = Path(workflow.required("MERGED")), Path(workflow.required("OUT"))
    made = requests(json.loads(merged.read_text("utf-8")))
    out.write_text(json.dumps(made, indent=1), "utf-8")
    workflow.summary(TITLE, [f"{own['name']}: {own['account']}" for own in made])
    return 0


if __name__ == "__main__":
    sys.exit(workflow.run(TITLE, main))
