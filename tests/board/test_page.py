"""The pages in a browser: they sort, open, fit, say nothing to the console, ask for nothing."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from .browser import Page, browser, find
from .conftest import HOSTILE

NAMES = (
    "[...document.querySelector('#performance ~ .scroll').querySelectorAll('tbody tr th')]"
    ".map(x => x.innerText)"
)
SORT = "document.querySelector('#performance ~ .scroll thead th:nth-child({}) button')"


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    path = find()
    if path is None:
        pytest.skip("no Chromium is installed")
    with browser(path, tmp_path_factory.mktemp("profile")) as page:
        yield page


@pytest.fixture
def quiet(page: Page) -> Iterator[Page]:
    """The browser; afterwards nothing may have been said to the console or asked of the network."""
    page.complaints.clear()
    page.requests.clear()
    yield page
    page.run("0")  # brings events that are still under way
    assert page.complaints == []
    assert all(url.startswith("file://") for url in page.requests)


def names(page: Page) -> list[str]:
    return [name.split("\n")[0] for name in page.run(NAMES)]


def test_tables_sort_by_click(quiet: Page, site: Path) -> None:
    quiet.open(site / "index.html", 1280)
    assert names(quiet) == ["harder", "pid_best", "softer"]
    quiet.run(SORT.format(2) + ".click()")
    assert names(quiet) == ["harder", "pid_best", "softer"]
    sort = SORT.format(2) + ".closest('th').getAttribute('aria-sort')"
    assert quiet.run(sort) == "ascending"
    quiet.run(SORT.format(2) + ".click()")
    assert names(quiet) == ["softer", "pid_best", "harder"]
    assert quiet.run(sort) == "descending"
    assert (
        quiet.run("document.getElementById('said').textContent") == "Sorted by Entry, descending."
    )
    # The PID has no difference to itself: without a value it stays last either way.
    for expected in (["harder", "softer", "pid_best"], ["softer", "harder", "pid_best"]):
        quiet.run(SORT.format(4) + ".click()")
        assert names(quiet) == expected
    assert quiet.run("document.querySelectorAll('[aria-sort]').length") == 2  # one a table


def test_tables_sort_by_keyboard(quiet: Page, site: Path) -> None:
    quiet.open(site / "index.html", 1280)
    reached = False
    for _ in range(30):
        quiet.press("Tab", 9)
        if quiet.run("document.activeElement === " + SORT.format(3)):
            reached = True
            break
    assert reached
    quiet.press("Enter", 13)
    quiet.press("Enter", 13)
    assert names(quiet) == ["softer", "pid_best", "harder"]


def test_an_entry_opens_and_leads_back(quiet: Page, site: Path) -> None:
    quiet.open(site / "index.html", 1280)
    quiet.follow("tbody a", "performance/harder.html")
    assert quiet.run("document.querySelector('h1').innerText") == "harder"
    assert quiet.run("document.querySelectorAll('.grid figure').length") == 36
    assert quiet.run("document.querySelectorAll('.heat tbody td:not(.mean)').length") == 72
    boxes = "[...document.querySelectorAll('.grid path.p')].every(x => x.getBBox().width > 500)"
    assert quiet.run(boxes)
    quiet.follow(".kicker a", "index.html")


def test_foreign_text_is_text(quiet: Page, site: Path) -> None:
    quiet.open(site / "entries/r1/performance/harder.html", 1280)
    assert quiet.run("document.title") == "harder, performance – ventbench"
    lead = quiet.run("document.querySelector('.lead').innerText")
    assert lead == HOSTILE.replace("\u202e", "\ufffd")
    assert quiet.run("document.images.length") == 0
    assert quiet.run("document.scripts.length") == 1
    quiet.open(site / "entries/r1/performance/broken.html", 1280)
    assert quiet.run("document.title").startswith("broken")
    assert HOSTILE[:40] in quiet.run("document.querySelector('.notice').innerText")


def test_the_policy_stops_a_script_that_got_in(page: Page, site: Path, tmp_path: Path) -> None:
    content = (site / "index.html").read_text()
    copy = tmp_path / "index.html"
    copy.write_text(content.replace("</main>", "<script>document.title='owned'</script></main>"))
    page.open(copy, 1280)
    assert page.run("document.title") == "Leaderboard – ventbench"
    page.run("0")
    assert any("Content Security Policy" in text for text in page.complaints)


@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize("width", [390, 1280])
@pytest.mark.parametrize("name", ["index", "entries/r1/performance/harder"])
def test_pages_fit(quiet: Page, site: Path, name: str, width: int, dark: bool) -> None:
    quiet.open(site / f"{name}.html", width, dark=dark)
    root = "document.documentElement"
    assert quiet.run(f"{root}.scrollWidth <= {root}.clientWidth")
    ground = quiet.run("getComputedStyle(document.body).backgroundColor")
    assert ground == ("rgb(17, 20, 24)" if dark else "rgb(255, 255, 255)")
    # Every text of a table's cell stands out from its ground (WCAG's 4.5).
    assert quiet.run(CONTRAST) >= 4.5
    assert quiet.picture()[:8] == b"\x89PNG\r\n\x1a\n"


def test_a_phone_is_told_of_hidden_columns(quiet: Page, site: Path) -> None:
    """What does not fit can be scrolled to; a line and a shadow say so."""
    hint = "getComputedStyle(document.querySelector('.hint')).display"
    table = "document.querySelector('#performance ~ .scroll')"
    quiet.open(site / "index.html", 390)
    assert quiet.run(f"{table}.scrollWidth > {table}.clientWidth")
    assert quiet.run(hint) == "block"
    assert "gradient" in quiet.run(f"getComputedStyle({table}).backgroundImage")
    quiet.open(site / "index.html", 1280)
    assert quiet.run(f"{table}.scrollWidth <= {table}.clientWidth")
    assert quiet.run(hint) == "none"


def test_ranks_have_their_range(quiet: Page, site: Path) -> None:
    quiet.open(site / "index.html", 1280)
    ranks = quiet.run(
        "[...document.querySelectorAll('#performance ~ .scroll tbody td:first-child')]"
        ".map(x => x.innerText)"
    )
    assert len(ranks) == 3
    assert all(re.fullmatch(r"\d+(\s+\d+ to \d+)?", text) for text in ranks)


#: Least contrast of any cell's text, where the cell has a ground of its own.
CONTRAST = """(() => {
  const canvas = document.createElement('canvas').getContext('2d', {willReadFrequently: true});
  const light = (color) => {
    canvas.fillStyle = color; canvas.fillRect(0, 0, 1, 1);
    const parts = [...canvas.getImageData(0, 0, 1, 1).data].slice(0, 3).map((v) => v / 255)
      .map((v) => v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
    return 0.2126 * parts[0] + 0.7152 * parts[1] + 0.0722 * parts[2];
  };
  let least = 21;
  for (const cell of document.querySelectorAll('td, th, .note, .lead, dt, dd')) {
    let ground = cell, style = getComputedStyle(cell);
    while (ground && getComputedStyle(ground).backgroundColor === 'rgba(0, 0, 0, 0)')
      ground = ground.parentElement;
    const a = light(style.color);
    const b = light(getComputedStyle(ground ?? document.body).backgroundColor);
    least = Math.min(least, (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05));
  }
  return least;
})()"""
