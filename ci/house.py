"""How big the house is: lines and modules by room, words of the docs, and limits for all of them.

``make check`` runs it. A limit is lowered when a change leaves room below it; raising one needs a
reason in the change that does.
"""

from __future__ import annotations

import re
import statistics
import sys
from collections.abc import Iterable
from pathlib import Path

ROOT = Path(__file__).parents[1]

#: Most lines of Python: of the product, of the proofs beside it; most modules of the product.
LINES = {"ventbench + hardware_eval": 59_020, "proofs": 9_000}
MODULES = 231

#: Most lines of one module, and most modules that lie loose in ``ventbench/``.
LONGEST, LOOSE = 550, 8

#: Most words of Markdown (as ``wc -w`` counts), and the folders that hold it beside the root.
WORDS = 24_950
PROSE = ("docs", "examples", "hardware_eval", "proofs", "submissions", "tests", "ventbench")

#: A branch on a number of the protocol: there is one protocol.
BRANCH = re.compile(r"\b(version|protocol) *(==|!=) *[0-9]")


def lines_of(paths: Iterable[Path]) -> dict[Path, int]:
    """Lines of each file."""
    return {path: len(path.read_text("utf-8").splitlines()) for path in paths}


def problems(root: Path) -> tuple[list[str], list[str]]:
    """Count a checkout.

    Args:
        root: its folder.

    Returns:
        A table, and what is beyond a limit, a line each.
    """
    table, wrong = [f"{'room':32} {'modules':>7} {'lines':>7} {'median':>6} {'longest':>7}"], []
    product: dict[Path, int] = {}
    for package in ("ventbench", "hardware_eval", "proofs"):
        sizes = lines_of(sorted((root / package).rglob("*.py")))
        rooms: dict[str, list[int]] = {}
        for path, count in sizes.items():
            inside = path.relative_to(root / package).parts
            room = f"{package}/{inside[0]}/" if len(inside) > 1 else f"{package}/"
            rooms.setdefault(room, []).append(count)
            if count > LONGEST:
                wrong.append(f"{path.relative_to(root)} has {count} lines, more than {LONGEST}")
            if package != "proofs" and BRANCH.search(path.read_text("utf-8")):
                wrong.append(f"{path.relative_to(root)} branches on a number of the protocol")
        for room, counts in sorted(rooms.items()):
            middle = round(statistics.median(counts))
            table.append(f"{room:32} {len(counts):7} {sum(counts):7} {middle:6} {max(counts):7}")
        if package != "proofs":
            product |= sizes
        elif sum(sizes.values()) > LINES["proofs"]:
            wrong.append(f"proofs has {sum(sizes.values())} lines, more than {LINES['proofs']}")
    total = sum(product.values())
    table.append(f"{'ventbench + hardware_eval':32} {len(product):7} {total:7}")
    if total > LINES["ventbench + hardware_eval"]:
        wrong.append(f"the product has {total} lines, more than the limit in ci/house.py")
    if len(product) > MODULES:
        wrong.append(f"the product has {len(product)} modules, more than {MODULES}")
    pages = [*root.glob("*.md"), *(page for name in PROSE for page in (root / name).rglob("*.md"))]
    words = sum(len(page.read_text("utf-8").split()) for page in pages)
    table.append(f"{'words of Markdown':32} {len(pages):7} {words:7}")
    if words > WORDS:
        wrong.append(f"the docs have {words} words, more than {WORDS}")
    loose = [path.name for path in (root / "ventbench").glob("*.py")]
    if len(loose) > LOOSE:
        wrong.append(f"{len(loose)} modules lie loose in ventbench/, more than {LOOSE}: {loose}")
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
