from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pytest

from ventbench.recordings import Breaths, make_breaths

HEADER = "id,breath_id,R,C,time_step,u_in,u_out,pressure"
Write = Callable[..., Path]


def sound_rows(breaths: int = 3, samples: int = 6, dt: float = 0.25) -> list[list[str]]:
    """Rows of a sound file: breath b is id b+1 on R=5 C=10, 4 inspiratory samples of 6."""
    return [
        [
            str(1 + b * samples + i),
            str(b + 1),
            "5",
            "10",
            repr(i * dt),
            repr(10.0 + i),
            str(int(i >= 4)),
            repr(5.0 + b + i),
        ]
        for b in range(breaths)
        for i in range(samples)
    ]


@pytest.fixture
def rows() -> list[list[str]]:
    """Three sound breaths of six samples: the row at index k is line k + 2."""
    return sound_rows()


@pytest.fixture
def write_csv(tmp_path: Path) -> Write:
    """Write a header and rows to `lab.csv`."""

    def write(
        rows: Iterable[Iterable[str]], header: str = HEADER, end: str = "\n", name: str = "lab.csv"
    ) -> Path:
        path = tmp_path / name
        lines = [header, *(",".join(row) for row in rows)]
        path.write_bytes("".join(line + end for line in lines).encode())
        return path

    return write


@pytest.fixture
def make() -> Callable[..., Breaths]:
    """Make n random breaths on lungs that take turns."""

    def build(
        n: int, samples: int = 8, seed: int = 0, *, lungs: int = 3, optional: bool = False
    ) -> Breaths:
        rng = np.random.default_rng(seed)
        time = np.cumsum(rng.uniform(0.02, 0.05, (n, samples)), axis=1)
        more = {name: rng.normal(size=(n, samples)) for name in ("flow", "volume")}
        return make_breaths(
            np.arange(n) + 1,
            np.array([5.0, 20.0, 50.0])[np.arange(n) % lungs],
            np.full(n, 10.0),
            time - time[:, :1],
            rng.uniform(0.0, 100.0, (n, samples)),
            np.arange(samples) >= samples // 2 + np.zeros((n, 1)),
            rng.uniform(0.0, 40.0, (n, samples)),
            **(more if optional else {}),
        )

    return build
