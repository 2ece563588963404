from __future__ import annotations

import dataclasses
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ventbench.base.errors import InputError
from ventbench.base.text import number
from ventbench.pages import charts, panels, report, write_report
from ventbench.task import protocol
from ventbench.trajectories import Trajectories

pytest.importorskip("jinja2", reason="needs the extra ventbench[view]")

VOID = {"meta", "input", "br", "path", "rect", "link", "img"}


class Page(HTMLParser):
    """Checks nesting, and collects tags and text."""

    def __init__(self, text: str):
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str]]] = []
        self.words: list[str] = []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, {key: value or "" for key, value in attrs}))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, {key: value or "" for key, value in attrs}))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if "style" not in self.open:
            self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join("".join(self.words).split())


def score_file(run: Trajectories, **more: Any) -> dict[str, Any]:
    cells = run.errors().to_numpy()
    lungs = {
        lung: {
            "score": float(row.mean()),
            "pips": {f"{p:g}": float(e) for p, e in zip(run.pips, row, strict=True)},
        }
        for lung, row in zip(run.lungs, cells, strict=True)
    }
    return {"score": float(cells.mean()), "lungs": lungs, **more}


def test_report(best: Trajectories, robust: Trajectories, tmp_path: Path) -> None:
    path = write_report(tmp_path / "report.html", [best, robust])
    text = path.read_text()
    page = Page(text)
    assert path.stat().st_size < 300_000
    figures = [attrs["aria-label"] for tag, attrs in page.tags if attrs.get("role") == "img"]
    errors = best.errors().to_numpy()
    assert len(figures) == 36
    for i, lung in enumerate(best.lungs):
        assert lung in page.text
        for j, pip in enumerate(best.pips):
            alt = figures[6 * i + j]
            assert f"{lung} at PIP {pip:g} cmH2O" in alt
            assert f"pid_best {errors[i, j]:.2f} cmH2O; pid_robust" in alt
    assert f"{errors.mean():.2f}" in page.text
    ids = [attrs["id"] for _, attrs in page.tags if "id" in attrs]
    assert len(ids) == len(set(ids))
    pointed = {
        attrs[key].removeprefix("#")
        for _, attrs in page.tags
        for key in ("href", "aria-labelledby")
        if key in attrs
    }
    assert pointed <= set(ids)
    heads = [attrs for tag, attrs in page.tags if tag == "th"]
    assert all("scope" in attrs for attrs in heads)


def test_nothing_from_outside(failed: Trajectories, best: Trajectories, tmp_path: Path) -> None:
    text = write_report(tmp_path / "r.html", [failed, best], None).read_text()
    page = Page(text)
    assert "<script" not in text
    assert "&lt;script&gt;alert(&#39;x&#39;)&lt;/script&gt;" in text
    assert not {"script", "iframe", "img", "object", "link"} & {tag for tag, _ in page.tags}
    for _, attrs in page.tags:
        assert not [key for key in attrs if key.startswith("on")]
        assert all(attrs[key].startswith("#") for key in ("href", "src") if key in attrs)
    assert "url(" not in text
    assert "@import" not in text
    assert "\u202e" not in text, "no text direction from a name"


def test_failed_cells(failed: Trajectories, best: Trajectories, tmp_path: Path) -> None:
    text = write_report(tmp_path / "r.html", [failed, best]).read_text()
    assert not re.search(r"\bnan\b|\binf\b", text.lower())
    assert Page(text).text.count("failed") >= 4


def test_equal_input_gives_equal_bytes(best: Trajectories, robust: Trajectories, tmp_path: Path):
    one, two = (write_report(tmp_path / name, [best, robust]).read_bytes() for name in "ab")
    assert one == two


def test_score_files(best: Trajectories, robust: Trajectories, tmp_path: Path) -> None:
    hashes = {"sha256": "5eed" * 16, "name": "pid <b>bold</b>"}
    given = [score_file(best, submission=hashes, failures=[]), score_file(robust)]
    given[0]["lungs"]["R5C10"]["score"] = 0.123
    given[0]["lungs"]["R5C20"] = {"score": None, "pips": {"10": None}}
    given[0]["failures"] = [{"message": "controller.py raised <i>ValueError</i> at step 3"}]
    given[1].update(safe=False, draws={"score": 3.1234, "ci95": [3.0, 3.25], "sha256": "d" * 64})
    text = write_report(tmp_path / "r.html", [best, robust], given).read_text()
    page = Page(text)
    assert "0.12" in page.text
    assert "3.12 [3.00, 3.25]" in page.text
    assert "did not pass the safety gate" in page.text
    assert hashes["sha256"] in page.text
    assert "submission sha256" in page.text
    assert "raised <i>ValueError</i> at step 3" in page.text
    assert "<i>" not in text
    assert "<b>bold" not in text
    assert "failed" in page.text
    assert "from the score files" in page.text


def test_wrong_score_files(best: Trajectories, tmp_path: Path) -> None:
    other = score_file(best)
    del other["lungs"]["R20C50"]
    wrong = score_file(best)
    wrong["score"] = "<script>"
    for given, message in (
        ([], "0 scores for 1 runs"),
        ([other], "no lung R20C50"),
        ([wrong], "where a number belongs"),
    ):
        with pytest.raises(InputError, match=message):
            write_report(tmp_path / "r.html", [best], given)
    assert not list(tmp_path.iterdir())


def test_best_and_differences(best: Trajectories, robust: Trajectories) -> None:
    numbers = panels.collect([best, robust])
    row = report.table(best.lungs, numbers)[0]
    ours, base = row["cells"]
    assert row["name"] == "All lungs"
    assert ours["best"]
    assert not base["best"]
    assert (ours["class"], base["difference"]) == ("better", "")
    assert ours["difference"] == number(
        best.errors().to_numpy().mean() - robust.errors().to_numpy().mean(), sign=True
    )
    same = report.table(best.lungs, panels.collect([best, best]))[0]["cells"][0]
    assert (same["difference"], same["class"]) == ("±0.00", "same")
    alone = report.table(best.lungs, panels.collect([best]))[0]["cells"][0]
    assert (alone["best"], alone["difference"]) == (False, "")


def test_path_does_not_drift() -> None:
    rng = np.random.default_rng(0)
    line = np.cumsum(rng.uniform(0.0, 3.0, (200, 2)), axis=0)
    x = y = 0.0
    points = []
    for kind, body in re.findall(r"([Mlhv])([^Mlhv]*)", charts.path(line)):
        numbers = [float(n) for n in re.findall(r"-?\d*\.?\d+", body)]
        if kind == "M":
            x, y = numbers
        else:
            x += numbers[0] if kind in "lh" else 0.0
            y += numbers[-1] if kind in "lv" else 0.0
        points.append((x, y))
    np.testing.assert_allclose(points[-1], line[-1], atol=0.06)


def test_path_breaks_at_gaps() -> None:
    line = np.array([[0.0, 0.0], [1.0, 1.0], [2.0, np.nan], [3.0, 3.0], [4.0, 2.5]])
    assert charts.path(line) == "M0 0l1 1M3 3l1-.5"
    assert charts.area(line, line) == ""


def test_protocol_is_the_shown_one(best: Trajectories, tmp_path: Path) -> None:
    text = Page(write_report(tmp_path / "r.html", [best]).read_text()).text
    assert f"{protocol.INSPIRATION_STEPS} inspiratory steps of breaths 2 and 3" in text
    assert "30 ms" in text


def test_every_panel_has_the_numbers_of_all_runs(best: Trajectories, robust: Trajectories) -> None:
    third = dataclasses.replace(best, name="third", pressure=best.pressure + 1.0)
    text = report.html([best, robust, third])
    for panel in re.findall(r'<span class="mae">(.*?)</span></figcaption>', text):
        assert re.findall(r'<span class="(r\d)">\d+\.\d\d', panel) == ["r0", "r1", "r2"]
    heads = re.findall(r'<p class="sum">(.*?)</p>', text)
    assert [head.count("<b>") for head in heads] == [3] * 6
    assert "third" in heads[0]


def test_the_valve_has_one_axis(best: Trajectories, robust: Trajectories) -> None:
    """0, 50 and 100 % at the same heights in every panel, whatever the commands."""
    quiet = dataclasses.replace(best, u_in=best.u_in * 0.1)
    for runs in ([best, robust], [quiet]):
        text = report.html(runs)
        figures = re.findall(r"<figure>.*?</figure>", text, re.S)
        marks = {
            tuple(re.findall(rf'y="([\d.]+)">({mark})</text>', figure)[-1] for mark in (0, 50, 100))
            for figure in figures
        }
        assert len(figures) == 36
        assert len(marks) == 1
    _, valve = report.sections([quiet], ["quiet"], panels.collect([quiet]))[0]["panels"][0][
        "charts"
    ]
    _, top, _, bottom = valve.frame
    ((_, drawn),) = valve.paths
    steps = [float(y) for kind, y in re.findall(r"([vM])(?:[\d.]+ )?(-?[\d.]+)", drawn)]
    share = quiet.u_in[0, 0, panels.WINDOW].max() / protocol.U_MAX
    assert min(np.cumsum(steps)) == pytest.approx(bottom - share * (bottom - top), abs=0.2), (
        "not stretched to its range"
    )


def test_runs_of_two_tracks_are_headed_by_both(best: Trajectories, robust: Trajectories) -> None:
    other = dataclasses.replace(robust, track="robustness")
    assert "performance and robustness tracks" in Page(report.html([best, other])).text
    alone = Page(report.html([best, robust])).text
    assert "performance track" in alone
    assert "robustness" not in alone.split("Provenance")[0].replace("pid_robust", "")


def test_two_runs_are_compared_cell_by_cell(best: Trajectories, robust: Trajectories) -> None:
    own, other = best.errors().to_numpy(), robust.errors().to_numpy()
    draws = {"sha256": "d" * 64, "version": 1}
    given = [
        score_file(best, draws={"score": 2.0, "ci95": [1.9, 2.1], "values": [1.9, 2.1], **draws}),
        score_file(robust, draws={"score": 3.0, "ci95": [2.9, 3.1], "values": [2.9, 3.1], **draws}),
    ]
    text = Page(report.html([best, robust], given)).text
    better = int((own < other).sum())
    assert f"lower error on {int((own.mean(1) < other.mean(1)).sum())} of 6 lungs" in text
    assert f"in {better} of 36 cells" in text
    assert f"Largest gain: {np.max(other - own):.2f} cmH2O" in text
    # Differences of the two draws are both 1: what the draws share cancels.
    assert "Over the 2 draws, paired: −1.00 [−1.00, −1.00] cmH2O" in text
    given[1]["draws"]["sha256"] = "e" * 64
    assert "paired" not in Page(report.html([best, robust], given)).text, "other draws"
