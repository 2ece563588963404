"""Colours of all pictures and pages, in one place: for light and dark ground and colour-blind eyes.

The colours of runs stay apart under protanopia, deuteranopia and tritanopia; a test simulates the
three (Machado, Oliveira and Fernandes 2009).
"""

from __future__ import annotations

from typing import Final

#: Text and the target, text of less weight, rules, shaded ground, scored band: on white.
INK, QUIET, LINE, SOFT, BAND = "#16191d", "#5b636d", "#d9dde2", "#f4f6f8", "#eef1f4"

#: Runs on white: blue the entry, orange what it is compared with (the PID), then others.
RUNS: Final = ("#0065b3", "#c86a12", "#0b947c", "#9e2e70", "#65550c")

#: The same runs on dark ground.
RUNS_DARK: Final = ("#5cb8ff", "#df6a10", "#8bee8a", "#b07bab", "#b9b924")

#: What is neither entry nor reference, such as a simulator as it was given; on white and on dark.
GREY, GREY_DARK = "#808080", "#9d9d9d"

#: One colour a PIP in the rerun viewer, lowest first: cool to warm, on dark or light ground.
PIPS: Final = ("#6f83de", "#2b97d1", "#12a096", "#7f9f2d", "#c98a0c", "#e2603c")

#: The target, and runs to compare with, in the rerun viewer.
TARGET: Final = "#8f8f8f"
REFERENCES: Final = ("#d277b8", "#b58a5a", "#8fb6c9", "#c9b84f")

#: Mark of the scored part of a run in the rerun viewer.
SCORED: Final = "#12a073"

_LIGHT = {
    "ground": "#fff",
    "ink": INK,
    "quiet": QUIET,
    "line": LINE,
    "soft": SOFT,
    "band": BAND,
    "good": "#00704f",
    "bad": "#a8410b",
}
_DARK = {
    "ground": "#111418",
    "ink": "#e9ecef",
    "quiet": "#a2abb5",
    "line": "#333a42",
    "soft": "#1a1f25",
    "band": "#1d232a",
    "good": "#52cba4",
    "bad": "#ffa266",
}


def rgb(color: str) -> tuple[int, int, int]:
    """Red, green and blue, 0..255, of ``#rrggbb``."""
    return int(color[1:3], 16), int(color[3:5], 16), int(color[5:7], 16)


def run_index(index: int) -> int:
    """Index into :data:`RUNS` of a run; blue and orange are not repeated."""
    return index if index < len(RUNS) else 2 + (index - 2) % (len(RUNS) - 2)


def css() -> str:
    """Custom properties of a page: ``--ink``, ``--run0`` and so on; printed pages are light."""
    dark = _properties(_DARK, RUNS_DARK)
    return (
        f":root {{ color-scheme: light dark; {_properties(_LIGHT, RUNS)} }}\n"
        f"@media screen and (prefers-color-scheme: dark) {{ :root {{ {dark} }} }}\n"
    )


def _properties(colors: dict[str, str], runs: tuple[str, ...]) -> str:
    named = {**colors, **{f"run{i}": color for i, color in enumerate(runs)}}
    return " ".join(f"--{name}: {color};" for name, color in named.items())
