"""Submissions made on the spot, and textbook lungs to score them on."""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from pathlib import Path

import pytest

from ventbench import precision
from ventbench.lungs import LUNGS
from ventbench.plants.single_compartment import SingleCompartment, single_compartment
from ventbench.plants.stacking import stack

MANIFEST = """\
name = "mine"
authors = ["A. Name"]
licence = "Apache-2.0"
api_version = 1
family = "other"
tracks = ["robustness", "performance"]
description = "A test."
"""

Make = Callable[..., Path]


@pytest.fixture(scope="session")
def plants() -> SingleCompartment:
    """The six lungs, float64, stacked."""
    with precision.float64():
        return stack([single_compartment(lung) for lung in LUNGS])


@pytest.fixture
def make(tmp_path: Path) -> Make:
    """Write a submission; `act` is the body of a method of a Controller that does nothing else."""

    def write(
        source: str | None = None,
        *,
        act: str = "return 0.0",
        manifest: str = MANIFEST,
        name: str = "mine",
        **files: str,
    ) -> Path:
        folder = tmp_path / name
        folder.mkdir(exist_ok=True)
        if source is None:
            body = textwrap.indent(textwrap.dedent(act), " " * 8)
            source = (
                "class Controller:\n    def reset(self, task):\n        self.task = task\n"
                f"    def act(self, observation):\n{body}\n"
            )
        (folder / "controller.py").write_text(textwrap.dedent(source))
        (folder / "submission.toml").write_text(manifest)
        for stem, text in files.items():
            (folder / f"{stem}.py").write_text(textwrap.dedent(text))
        return folder

    return write
