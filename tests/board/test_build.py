"""CSV and pages: the same bytes each time, everything in them text."""

from __future__ import annotations

import csv
import io
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from ventbench.board import build, canonical, store

from .conftest import HOSTILE, accept, put


def read(folder: Path) -> dict[str, bytes]:
    names = canonical.walk(folder)[0]
    return {name: (folder / name).read_bytes() for name in names}


@pytest.fixture
def out(site: Path, tmp_path: Path) -> Path:
    """A site to change."""
    return shutil.copytree(site, tmp_path / "site")


def test_a_second_build_changes_nothing(leaderboard: Path, out: Path) -> None:
    before = read(out)
    assert build.build(leaderboard, out).changed == ()
    assert read(out) == before


def test_a_site_has_the_records_that_its_pages_link_to(full: Path, site: Path) -> None:
    records = {name for name in canonical.walk(full)[0] if name.startswith("records/")}
    assert len(records) >= 15
    assert {name for name in read(site) if name.startswith("records/")} == records
    assert not any(canonical.BUILT.fullmatch(name) for name in canonical.walk(full)[0])


def test_a_build_in_another_process_gives_the_same_bytes(
    full: Path, site: Path, tmp_path: Path
) -> None:
    code = "import sys; from pathlib import Path; from ventbench.board import build; "
    code += "from tests.textbook_rigs import TextbookRigs; "
    code += "build.build(Path(sys.argv[1]), Path(sys.argv[2]), TextbookRigs)"
    # Another seed of str hashes: no order of a set may reach a page.
    environment = {"PYTHONHASHSEED": "1", "PYTHONPATH": ":".join(filter(None, sys.path))}
    command = [sys.executable, "-c", code, full, tmp_path / "other"]
    subprocess.run(command, check=True, env=environment)
    assert read(tmp_path / "other") == read(site)


def test_stale_pages_go_and_other_files_stay(leaderboard: Path, out: Path) -> None:
    stale = out / "entries/r1/performance/nobody.html"
    stale.write_text("old")
    (out / "README.md").write_text("mine")
    (out / "index.html").write_text("changed")
    done = build.build(leaderboard, out)
    assert set(done.changed) == {"index.html", "entries/r1/performance/nobody.html"}
    assert not stale.exists()
    assert (out / "README.md").read_text() == "mine"


def test_the_csv_has_every_entry(site: Path) -> None:
    rows = list(csv.DictReader(io.StringIO((site / "leaderboard.csv").read_text())))
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
    scores = [float(row["normalised"]) for row in rows if row["track"] == "performance"][:3]
    assert scores == sorted(scores)
    assert by_name["pid_best"]["normalised_to_pid"] == ""
    gap = float(by_name["harder"]["normalised"]) - float(by_name["pid_best"]["normalised"])
    assert abs(float(by_name["harder"]["normalised_to_pid"]) - gap) < 2e-6


def test_text_of_records_is_escaped_everywhere(site: Path) -> None:
    shown = 0
    for path in site.rglob("*.html"):
        page = path.read_text()
        assert page.count("<script>") == page.count("</script>") == 1  # ours
        assert "<img" not in page
        assert "{{" not in page.replace("{{ 7*7 }}", "")
        assert "\u202e" not in page
        shown += page.count("&lt;script&gt;document.title=&#39;owned&#39;&lt;/script&gt;")
    assert shown >= 6
    assert "\u202e" in HOSTILE


def test_a_rehearsal_says_who_could_choose(site: Path) -> None:
    page = (site / "index.html").read_text("utf-8")
    assert "Rehearsal, never official." in page
    assert "nobody could know or choose" not in page
    assert "mean over 20 draws" not in page


def test_pages_stand_alone(site: Path) -> None:
    for path in site.rglob("*.html"):
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
    (tmp_path / "none").mkdir()
    done = build.build(tmp_path / "none", tmp_path)
    assert done.records == 0
    assert set(done.changed) == {"index.html", "leaderboard.csv"}
    assert "No round has been scored yet" in (tmp_path / "index.html").read_text()


def test_a_correction_takes_the_place_of_its_record(leaderboard, out, draft, simulators) -> None:
    old = next(x for x in store.load(leaderboard).scores if x.name == "softer")
    store.withdraw(leaderboard, old.sha256, "a bug")
    accept(leaderboard)
    new = put(leaderboard, draft("softer", factor=0.95), simulators)
    done = build.build(leaderboard, out)
    page = (out / "entries/r1/performance/softer.html").read_text()
    assert "entries/r1/performance/softer.html" in done.changed
    assert f"<code>{new.sha256[:12]}</code></a> <b>counts</b>" in page
    assert f"<code>{old.sha256[:12]}</code></a> <b>withdrawn</b>: a bug" in page
    assert f"records/{old.sha256}.json" in page
    rows = csv.DictReader(io.StringIO((out / "leaderboard.csv").read_text()))
    assert [row["record"] for row in rows if row["name"] == "softer"] == [new.sha256]


def test_what_the_maintainers_say_of_entries_is_text(leaderboard: Path, out: Path) -> None:
    notes = leaderboard / "rounds/r1/notes.toml"
    notes.write_text('[entries]\npid_best = "its <b>grid</b> ends"\n')
    build.build(leaderboard, out)
    assert "<dd>its &lt;b&gt;grid&lt;/b&gt; ends</dd>" in (out / "index.html").read_text()
