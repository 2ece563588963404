"""How big the house is, in ideas: names, operators and numbers of its Python by room, and limits.

``make check`` runs it. Packing lines or moving files changes none of these counts; strings,
comments and layout do not count. A limit is lowered when a change leaves room below it; raising
one needs a reason in the change that does.
"""

from __future__ import annotations

import io
import re
import sys
import tokenize
from pathlib import Path

ROOT = Path(__file__).parents[1]

#: Most tokens of all that is kept by hand beside the tests, and of the largest parts of it.
LIMITS = {"sum": 483_621, "ventbench": 326_508, "hardware_eval": 59_939}

#: What is counted together.
PACKAGES = ("ventbench", "hardware_eval", "proofs", "benchmarks", "ci")

#: What counts: neither strings and comments nor layout.
COUNTED = {tokenize.NAME, tokenize.OP, tokenize.NUMBER}

#: Layout that somebody set by hand: code is formatted plainly.
UNFORMATTED = re.compile(r"#\s*fmt:\s*(?:skip|off)")

#: A branch on a number of the protocol: there is one protocol.
BRANCH = re.compile(r"\b(version|protocol) *(==|!=) *[0-9]")


def tokens_of(source: str) -> int:
    """Names, operators and numbers in a source text."""
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    return sum(token.type in COUNTED for token in tokens)


def problems(root: Path) -> tuple[list[str], list[str]]:
    """Count a checkout.

    Args:
        root: its folder.

    Returns:
        A table, and what is beyond a limit, a line each.
    """
    table, wrong = [f"{'room':32} {'modules':>7} {'tokens':>7}"], []
    sums: dict[str, int] = {"sum": 0}
    for package in PACKAGES:
        rooms: dict[str, list[int]] = {}
        for path in sorted((root / package).rglob("*.py")):
            source, name = path.read_text("utf-8"), path.relative_to(root)
            if UNFORMATTED.search(source):
                wrong.append(f"{name} is formatted by hand (fmt: skip or off); format it plainly")
            if package in ("ventbench", "hardware_eval") and BRANCH.search(source):
                wrong.append(f"{name} branches on a number of the protocol")
            room = "/".join(name.parts[:2]) + "/" if len(name.parts) > 2 else f"{package}/"
            rooms.setdefault(room, []).append(tokens_of(source))
        table += [f"{room:32} {len(n):7} {sum(n):7}" for room, n in sorted(rooms.items())]
        sums[package] = sum(map(sum, rooms.values()))
        sums["sum"] += sums[package]
    for name, limit in LIMITS.items():
        table.append(f"{name:32} {'':7} {sums[name]:7} of {limit}")
        if sums[name] > limit:
            wrong.append(f"{name}: {sums[name]} tokens, more than the {limit} in ci/house.py")
    return table, wrong


def main() -> None:
    """Print the table; exit with 1 if a limit is exceeded."""
    table, wrong = problems(ROOT)
    print("\n".join(table))
    for line in wrong:
        print(line, file=sys.stderr)
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
