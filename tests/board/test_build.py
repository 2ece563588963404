"""CSV and pages: the same bytes each time, everything in them text."""

from __future__ import annotations

import csv
import io
import re
import subprocess
import sys
from pathlib import Path

from ventbench.board import build, pages, store

from .conftest import HOSTILE, put


def test_a_second_build_changes_nothing(leaderboard: Path) -> None:
    before = {path: path.read_bytes() for path in leaderboard.rglob("*") if path.is_file()}
    done = build.build(leaderboard)
    assert done.changed == ()
    assert {p: p.read_bytes() for p in leaderboard.rglob("*") if p.is_file()} == before


def test_a_build_in_another_process_gives_the_same_bytes(leaderboard: Path) -> None:
    before = {name: (leaderboard / name).read_bytes() for name in build.present(leaderboard)}
    for name in before:
        (leaderboard / name).unlink()
    code = "import sys, pathlib; from ventbench.board import build; "
    code += "build.build(pathlib.Path(sys.argv[1]))"
    # Another seed of str hashes: no order of a set may reach a page.
    environment = {"PYTHONHASHSEED": "1", "PYTHONPATH": ":".join(filter(None, sys.path))}
    subprocess.run([sys.executable, "-c", code, leaderboard], check=True, env=environment)
    assert {n: (leaderboard / n).read_bytes() for n in build.present(leaderboard)} == before


def test_stale_pages_go_and_other_files_stay(leaderboard: Path) -> None:
    stale = leaderboard / "entries/v1/performance/nobody.html"
    stale.write_text("old")
    (leaderboard / "README.md").write_text("mine")
    (leaderboard / "index.html").write_text("changed")
    done = build.build(leaderboard)
    assert set(done.changed) == {"index.html", "entries/v1/performance/nobody.html"}
    assert not stale.exists()
    assert (leaderboard / "README.md").read_text() == "mine"


def test_the_csv_has_every_entry(full: Path) -> None:
    rows = list(csv.DictReader(io.StringIO((full / "leaderboard.csv").read_text())))
    status = {row["name"]: row["status"] for row in rows}
    assert status == {
        "softer": "ranked",
        "pid_best": "ranked",
        "harder": "ranked",
        "broken": "not ranked",
        "open": "not ranked",
        "home": "not official",
        "robust": "ranked",
        "pid_robust": "ranked",
    }
    by_name = {row["name"]: row for row in rows}
    assert by_name["broken"]["failed_cells"] == "2"
    assert by_name["open"]["safe"] == "no"
    scores = [float(row["score_cmH2O"]) for row in rows if row["track"] == "performance"][:3]
    assert scores == sorted(scores)
    assert by_name["pid_best"]["to_pid_cmH2O"] == ""
    gap = float(by_name["harder"]["score_cmH2O"]) - float(by_name["pid_best"]["score_cmH2O"])
    assert abs(float(by_name["harder"]["to_pid_cmH2O"]) - gap) < 2e-6


def test_text_of_records_is_escaped_everywhere(full: Path) -> None:
    shown = 0
    for path in full.rglob("*.html"):
        page = path.read_text()
        assert page.count("<script>") == page.count("</script>") == 1  # ours
        assert "<img" not in page
        assert "{{" not in page.replace("{{ 7*7 }}", "")
        assert "\u202e" not in page
        shown += page.count("&lt;script&gt;document.title=&#39;owned&#39;&lt;/script&gt;")
    assert shown >= 6
    assert "\u202e" in HOSTILE


def test_pages_stand_alone(full: Path) -> None:
    for path in full.rglob("*.html"):
        page = path.read_text()
        policy = re.search(r'Content-Security-Policy" content="([^"]+)"', page)
        assert policy
        assert policy[1].startswith("default-src &#39;none&#39;; style-src &#39;sha256-")
        assert "unsafe" not in policy[1]
        assert not re.search(r"https?://|style=|\son\w+=", page.replace(_texts(page), ""))
        for link in re.findall(r'href="([^"#]+)"', page):
            assert (path.parent / link).exists(), f"{path}: {link}"


def _texts(page: str) -> str:
    """The hostile text as it stands on a page."""
    found = re.search(r"&lt;img[^&]*&gt;", page)
    return found[0] if found else "\0"


def test_a_new_leaderboard_has_a_page(tmp_path: Path) -> None:
    done = build.build(tmp_path)
    assert done.records == 0
    assert set(done.changed) == {"index.html", "leaderboard.csv"}
    assert "No ranked entry yet" in (tmp_path / "index.html").read_text()


def test_versions_are_kept_apart() -> None:
    assert pages.version_path(2, [2, 1]) == "index.html"
    assert pages.version_path(1, [2, 1]) == "version-1.html"


def test_a_correction_takes_the_place_of_its_record(leaderboard, draft, drafts, simulators) -> None:
    old = store.load(leaderboard).scores[2]
    assert old.name == "softer"
    corrected = draft("softer", factor=0.95, supersedes=old.sha256, reason="a better number")
    new = put(leaderboard, corrected, simulators)
    done = build.build(leaderboard)
    page = (leaderboard / "entries/v1/performance/softer.html").read_text()
    assert "entries/v1/performance/softer.html" in done.changed
    assert page.index(new.sha256[:12]) < page.index("superseded")
    assert f"<b>counts</b>: {'a better number'}" in page
    assert f"records/{old.sha256}.json" in page
    rows = csv.DictReader(io.StringIO((leaderboard / "leaderboard.csv").read_text()))
    assert [row["record"] for row in rows if row["name"] == "softer"] == [new.sha256]
