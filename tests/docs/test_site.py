"""The documentation as a site: every page is in it, and every link leads somewhere."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import ventbench
from tests.board.browser import find
from ventbench.physics import library
from ventbench.task.stressors import STRESSORS

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    built = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)],
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
    )
    assert built.returncode == 0, built.stderr
    return folder


@pytest.mark.slow
def test_search_works_in_a_page_opened_from_a_folder(site, tmp_path):
    path = find()
    if path is None:
        pytest.skip("no Chromium is installed")
    options = ["--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path}"]
    page = f"{(site / 'index.html').as_uri()}?q=exhalation_valve_delay"
    shown = subprocess.run(
        [path, *options, "--virtual-time-budget=60000", "--dump-dom", page],
        capture_output=True,
        text=True,
    ).stdout
    assert re.search(r'href="[^"]*physics.html[^"]*" class="md-search-result__link', shown)


def test_the_site_builds_without_a_warning_and_needs_no_network(site):
    pages = {path.stem for path in site.glob("*.html")}
    assert pages > {path.stem for path in (ROOT / "docs").glob("*.md")} | {"index", "contributing"}
    for page in site.glob("*.html"):
        loaded = re.findall(r'(?:src|<link[^>]*href)="(https?:[^"]*)"', page.read_text("utf-8"))
        assert not loaded, f"{page.name} loads {loaded}"
    tables = {
        "stress": [line.name for line in STRESSORS],
        "physics": list(library()),
        "commands": [
            "ventbench board withdraw",
            "ventbench-hardware emulate",
            "python -m proofs challenge reveal",
        ],
    }
    for page, names in tables.items():
        text = (site / f"{page}.html").read_text("utf-8")
        assert all(f"<td><code>{name}</code></td>" in text for name in names), page
    reference = (site / "python.html").read_text("utf-8")
    for name in set(ventbench.__all__) - {"__version__", "LUNGS"}:
        heading = re.search(rf"<h3[^>]*>\s*ventbench\.{name}\s*<", reference)
        assert heading, f"docs/python.md lacks {name}"
