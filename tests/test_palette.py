"""Colours of pictures stay apart for every eye, and every page takes them from one place."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray

from ventbench import palette

#: Colour vision deficiencies of full severity: Machado, Oliveira, Fernandes, IEEE TVCG 15 (2009),
#: table 1, for linear RGB.
EYES = {
    "normal": np.eye(3),
    "protanopia": np.array(
        [
            [0.152286, 1.052583, -0.204868],
            [0.114503, 0.786281, 0.099216],
            [-0.003882, -0.048116, 1.051998],
        ]
    ),
    "deuteranopia": np.array(
        [
            [0.367322, 0.860646, -0.227968],
            [0.280085, 0.672501, 0.047413],
            [-0.011820, 0.042940, 0.968881],
        ]
    ),
    "tritanopia": np.array(
        [
            [1.255528, -0.076749, -0.178779],
            [-0.078411, 0.930809, 0.147602],
            [0.004733, 0.691367, 0.303900],
        ]
    ),
}


def linear(color: str) -> NDArray[np.float64]:
    share = np.array(palette.rgb(color)) / 255.0
    return np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)


def oklab(light: NDArray[np.float64]) -> NDArray[np.float64]:
    """Ottosson's Oklab, in which equal distances look equally far: 0.02 is just noticeable."""
    cones = np.array(
        [
            [0.4122214708, 0.5363325363, 0.0514459929],
            [0.2119034982, 0.6806995451, 0.1073969566],
            [0.0883024619, 0.2817188376, 0.6299787005],
        ]
    )
    opponent = np.array(
        [
            [0.2104542553, 0.7936177850, -0.0040720468],
            [1.9779984951, -2.4285922050, 0.4505937099],
            [0.0259040371, 0.7827717662, -0.8086757660],
        ]
    )
    return opponent @ np.cbrt(cones @ np.clip(light, 0.0, 1.0))


def luminance(color: str) -> float:
    return float(linear(color) @ [0.2126, 0.7152, 0.0722])


@pytest.mark.parametrize("eye", EYES)
@pytest.mark.parametrize(
    ("runs", "target"), [(palette.RUNS, palette.INK), (palette.RUNS_DARK, "#e9ecef")]
)
def test_runs_and_target_stay_apart(eye: str, runs: tuple[str, ...], target: str) -> None:
    seen = [oklab(EYES[eye] @ linear(color)) for color in (*runs, target)]
    distances = [float(np.linalg.norm(a - b)) for a, b in itertools.combinations(seen, 2)]
    assert min(distances) > 0.08


@pytest.mark.parametrize(
    ("runs", "ground"), [(palette.RUNS, "#ffffff"), (palette.RUNS_DARK, "#111418")]
)
def test_runs_stand_out_from_the_ground(runs: tuple[str, ...], ground: str) -> None:
    for color in runs:
        lights = sorted((luminance(color), luminance(ground)))
        assert (lights[1] + 0.05) / (lights[0] + 0.05) > 3.5, "WCAG wants 3 for lines"


def test_entry_and_reference_keep_their_colours() -> None:
    indices = [palette.run_index(i) for i in range(12)]
    assert indices.count(0) == indices.count(1) == 1
    assert max(indices) < len(palette.RUNS)


def test_board_and_report_take_the_colours_from_here() -> None:
    pytest.importorskip("jinja2", reason="needs the extra ventbench[view]")
    from importlib import resources

    from ventbench.board import pages

    assert palette.css() in str(pages.environment().globals["style"])
    for room, name in (("board", "board.css"), ("pages", "report.css.j2")):
        sheet = resources.files(f"ventbench.{room}").joinpath("templates", name).read_text("utf-8")
        assert "--ink:" not in sheet
        assert "--run0:" not in sheet


def test_print_is_light() -> None:
    assert "@media screen and (prefers-color-scheme: dark)" in palette.css()
