"""The documentation as a site: every page is in it, and every link leads somewhere."""

import os
import re
import subprocess
import sys
from pathlib import Path

import ventbench
from ventbench.physics import library
from ventbench.task.stressors import STRESSORS

ROOT = Path(__file__).parents[2]


def test_the_site_builds_without_a_warning_and_needs_no_network(tmp_path):
    built = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)],
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
    )
    assert built.returncode == 0, built.stderr
    pages = {path.stem for path in tmp_path.glob("*.html")}
    assert pages > {path.stem for path in (ROOT / "docs").glob("*.md")} | {"index", "contributing"}
    for page in tmp_path.glob("*.html"):
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
        text = (tmp_path / f"{page}.html").read_text("utf-8")
        assert all(f"<td><code>{name}</code></td>" in text for name in names), page
    reference = (tmp_path / "python.html").read_text("utf-8")
    for name in set(ventbench.__all__) - {"__version__", "LUNGS"}:
        heading = re.search(rf"<h3[^>]*>\s*ventbench\.{name}\s*<", reference)
        assert heading, f"docs/python.md lacks {name}"
