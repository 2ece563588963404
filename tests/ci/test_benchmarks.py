"""Benchmarks that take options can be asked for them."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

FOLDER = Path(__file__).parents[2] / "benchmarks"
WITH_OPTIONS = sorted(p.name for p in FOLDER.glob("*.py") if "typer.run(main)" in p.read_text())


@pytest.mark.parametrize("name", WITH_OPTIONS)
def test_a_benchmark_tells_its_options(name: str) -> None:
    app = typer.Typer()
    app.command()(runpy.run_path(str(FOLDER / name))["main"])
    result = CliRunner().invoke(app, ["--help"])
    assert result.exit_code == 0, result.output
    assert "Usage" in result.output
