"""How many names in the code are everyday words, where the field has a term.

    python benchmarks/everyday_words.py [FOLDER...]

Counts every use of a name (keywords left out) that is one of the words below or has one between its
underscores, per mille of all uses, by room, with the most frequent names. Mature packages of the
field have 0 to 3 per mille.
"""

from __future__ import annotations

import io
import keyword
import re
import sys
import tokenize
from collections import Counter
from pathlib import Path

#: Participles, pronouns and fillers that say nothing a reader could search for.
WORDS = set(
    re.findall(
        r"\w+",
        "about alike asked away begun besides bigger called done drawn each else enough ended far "
        "found given going gone had here it kept known left made meant moved near nearly one other "
        "others own played said seen shown spoilt stood taken tried told wanted way what who whole "
        "whose without",
    )
)


def uses(path: Path) -> list[str]:
    """Names that a file uses, in order, without keywords."""
    text = path.read_text("utf-8")
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    return [t.string for t in tokens if t.type == tokenize.NAME and not keyword.iskeyword(t.string)]


def is_everyday(name: str) -> bool:
    """Whether a name is an everyday word, or contains one between underscores."""
    return any(part in WORDS for part in name.lower().split("_"))


def main(folders: list[str]) -> None:
    """Print a line a room, the sum, and the names that occur most."""
    most: Counter[str] = Counter()
    total = everyday = 0
    for folder in folders:
        for room in sorted({path.parent for path in Path(folder).rglob("*.py")}):
            names = [name for path in sorted(room.glob("*.py")) for name in uses(path)]
            counted = Counter(name for name in names if is_everyday(name))
            most += counted
            total, everyday = total + len(names), everyday + counted.total()
            print(f"{room!s:40} {len(names):7} {1000 * counted.total() / max(len(names), 1):6.1f}")
    print(f"{'all':40} {total:7} {1000 * everyday / max(total, 1):6.1f} per mille")
    print(", ".join(f"{name} {count}" for name, count in most.most_common(40)))


if __name__ == "__main__":
    main(sys.argv[1:] or ["ventbench"])
