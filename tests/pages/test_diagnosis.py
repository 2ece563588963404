"""The report and the rerun file of a diagnosis."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.diagnosis import made
from ventbench.diagnosis import number_text
from ventbench.diagnosis.findings import MissingMechanism
from ventbench.diagnosis.in_time import ALVEOLUS, CIRCUIT, SUPPLY
from ventbench.diagnosis.residual_analysis import EDGE, profiles
from ventbench.diagnosis.result import Diagnosis
from ventbench.mechanics.labels import Estimate
from ventbench.pages.charts import Chart, limits, log_ticks, ticks
from ventbench.pages.diagnosis import report
from ventbench.pages.diagnosis.charts import by_axis, panels, rmse, window, worst
from ventbench.physics import library
from ventbench.physics.nonparametric import NONPARAMETRIC_COMPONENTS

from .test_report import Page

pytest.importorskip("jinja2", reason="needs the extra ventbench[view]")


@pytest.fixture(scope="module")
def found() -> Diagnosis:
    return made.diagnosis()


def test_report(found: Diagnosis, tmp_path: Path) -> None:
    path = report.write(tmp_path / "report.html", found)
    page = Page(path.read_text())
    assert path.stat().st_size < 200_000
    (heading,) = [tag for tag, _ in page.tags if tag == "h1"]
    assert heading
    assert "Missing in the physics simulator: dead time of the inspiratory valve" in page.text
    assert "41 ms [38, 44]" in page.text
    assert "97 %" in page.text
    assert report.facts(found)[0] == ("How sure?", "posterior probability of 97 %", "")
    one = found.open_loop
    for value in (one.before.rmse, one.refit.rmse, one.after.rmse, one.noise_floor):
        assert f"{value:.2f}" in page.text
    figures = [attrs["aria-label"] for _, attrs in page.tags if attrs.get("role") == "img"]
    assert len([text for text in figures if text.startswith("Pressure of breath")]) == 6
    assert len([text for text in figures if text.endswith("magnified.")]) == 6
    (start,) = [text for text in figures if "Mean error along time since inspiration" in text]
    assert "significant ranges: 0" in start
    assert "This recording cannot tell valve_delay from valve_lag." in page.text
    assert len([text for text in figures if "to record" in text]) == 3
    assert found.notes[0] in page.text
    ids = [attrs["id"] for _, attrs in page.tags if "id" in attrs]
    assert len(ids) == len(set(ids))
    pointed = {attrs["aria-labelledby"] for _, attrs in page.tags if "aria-labelledby" in attrs}
    assert pointed <= set(ids)
    assert all("scope" in attrs for tag, attrs in page.tags if tag == "th")


def test_nothing_from_outside(found: Diagnosis, tmp_path: Path) -> None:
    bad = dataclasses.replace(
        found, simulator="<script>alert('x')</script>", notes=("<img src=http://x>",)
    )
    text = report.write(tmp_path / "r.html", bad).read_text()
    page = Page(text)
    assert not {"script", "iframe", "img", "object", "link"} & {tag for tag, _ in page.tags}
    assert "&lt;script&gt;" in text
    for _, attrs in page.tags:
        assert not [key for key in attrs if key.startswith("on")]
        assert not {"href", "src"} & set(attrs)
    assert "url(" not in text
    assert "default-src 'none'" in text


def test_other_verdicts(tmp_path: Path) -> None:
    unnamed = Page(report.write(tmp_path / "u.html", made.unnamed(12)).read_text())
    assert "Shape of R(V)" in unnamed.text
    assert "Each effect by itself" not in unnamed.text
    nothing = Page(report.write(tmp_path / "n.html", made.nothing(12)).read_text())
    assert "Nothing is missing" in nothing.text
    assert "Nowhere" in nothing.text
    assert "corrected" not in nothing.text
    assert "What would have been seen" not in nothing.text
    limits = {"leak": 0.25, "inertance": float("inf")}
    known = dataclasses.replace(made.nothing(12), detection_limits=limits)
    page = Page(report.write(tmp_path / "l.html", known).read_text())
    assert "leak at the airwayleak0.25 mL/s" in page.text
    assert "not at any strength" in page.text


def test_the_guilty_part_of_the_rig_is_lit(found: Diagnosis, tmp_path: Path) -> None:
    page = Page(report.write(tmp_path / "r.html", found).read_text())
    (rig,) = [attrs for _, attrs in page.tags if attrs.get("class") == "rig"]
    assert rig["aria-label"].endswith("inspiratory valve: dead time of the inspiratory valve.")
    looks = [attrs["class"] for _, attrs in page.tags if attrs.get("class", "").startswith("part")]
    assert len(looks) == len(report.PARTS)
    assert [look.split()[1:] for look in looks].count(["lit"]) == 1
    unnamed = Page(report.write(tmp_path / "u.html", made.unnamed(12)).read_text())
    assert "part suspect" in {attrs.get("class") for _, attrs in unnamed.tags}
    nothing = Page(report.write(tmp_path / "n.html", made.nothing(12)).read_text())
    assert "No part of it is guilty" in nothing.text
    both = dataclasses.replace(
        found, mechanisms=found.mechanisms * 2, nonparametric=made.unnamed(12).nonparametric
    )
    parts = report.parts(report.entries(both))
    assert parts["inspiratory valve"].badge == "1, 2"
    assert (parts["airway"].look, parts["airway"].badge) == ("suspect", "3")


@pytest.mark.parametrize("place", [*NONPARAMETRIC_COMPONENTS, ALVEOLUS, SUPPLY, CIRCUIT])
def test_every_place_is_in_the_picture(place: str) -> None:
    term = made.unnamed(12).nonparametric
    assert term is not None
    assert report.site_of_term(dataclasses.replace(term, name=place)) in report.PARTS


@pytest.mark.parametrize("name", library())
def test_every_mechanism_has_a_page(name: str, tmp_path: Path) -> None:
    """Its formula, its own signal without and with it, and its part of the rig."""
    about = library()[name].description
    strength = about.strength
    estimate = Estimate(strength.strong, strength.unit, (strength.mild, strength.high))
    missing = MissingMechanism(name, {strength.name: estimate}, 0.9, (), 20.0)
    shown = dataclasses.replace(made.diagnosis(12), mechanisms=(missing,), plants={})
    text = report.write(tmp_path / "r.html", shown).read_text()
    page = Page(text)
    formula = text.partition('<p class="eq">')[2].partition("</p>")[0]
    assert "<i>" in formula
    assert not set("^_*") & set(formula)
    figures = [attrs["aria-label"] for _, attrs in page.tags if attrs.get("role") == "img"]
    assert any(text.endswith(f"without and with {about.title}.") for text in figures)


def test_formulas_are_typeset_and_escaped() -> None:
    squared = "<i>P</i><sub>elastic</sub> ≤ <i>a</i> <i>x</i><sup>2</sup>"
    assert report.typeset("P_elastic <= a x^2") == squared
    assert report.typeset("(1 + x)^((m - 1) / 2)") == "(1 + <i>x</i>)<sup>(<i>m</i> − 1) / 2</sup>"
    assert report.typeset("tau dy/dt > <b>") == "<i>τ</i> <i>dy</i>/<i>dt</i> &gt; &lt;<i>b</i>&gt;"


def test_no_nan_reaches_the_page(found: Diagnosis, tmp_path: Path) -> None:
    pressure = found.traces.breaths.pressure.copy()
    pressure[2] = np.nan  # a held-out breath that was not measured
    pressure[5, 10:20] = np.nan
    broken = dataclasses.replace(
        found,
        traces=dataclasses.replace(
            found.traces, breaths=dataclasses.replace(found.traces.breaths, pressure=pressure)
        ),
        open_loop=dataclasses.replace(found.open_loop, noise_floor=float("nan")),
    )
    text = report.write(tmp_path / "r.html", broken).read_text()
    assert not re.search(r"\bnan\b|\binf\b", text.lower())
    assert "breath 3," not in text


def test_equal_input_gives_equal_bytes(found: Diagnosis, tmp_path: Path) -> None:
    one, two = (report.write(tmp_path / name, found).read_bytes() for name in "ab")
    assert one == two


def test_the_breaths_that_are_shown(found: Diagnosis) -> None:
    traces = found.traces
    before, after = rmse(traces, traces.refit), rmse(traces, traces.after)
    error = (traces.breaths.pressure - traces.refit)[7][traces.breaths.inspiratory[7]]
    assert before[7] == pytest.approx(np.sqrt(np.mean(error**2)))
    held = np.flatnonzero(traces.held_out)
    shown = [i for i, _ in worst(found)]
    assert len(set(shown)) == 6
    assert set(shown) <= set(held)
    assert shown[0] == held[np.argmax(before[held])]
    rest = [i for i in held if i not in shown[:3]]
    assert shown[3] == rest[int(np.argmax(after[rest]))]
    panel = panels(found)[0]
    assert [look for look, _ in panel.pressure.paths] == ["seen", "before", "refit", "after"]
    assert panel.errors["refit"] == pytest.approx(before[shown[0]])


def test_a_shift_of_one_percent_shows_in_the_magnified_part() -> None:
    """30 ms in a breath of 3 s: more than 5 % of the width of the magnified chart."""
    time = np.arange(0.0, 3.0, 0.03)
    recorded = np.where(time > 1.215, 20.0, 5.0)
    low, high = window(time, recorded, np.where(time > 1.185, 20.0, 5.0))
    assert low < 1.17
    assert high > 1.23
    assert 0.03 / (high - low) > 0.05
    chart = Chart((low, high), (0.0, 1.0), "s", "", "")
    assert float(chart.at_x(low + 0.03) - chart.at_x(low)) > 15.0
    start, _ = window(time, recorded, recorded)
    assert start == 0.0, "no error: the beginning"
    assert window(time, recorded, np.where(time > 2.9, 0.0, recorded))[1] == time[-1]


def test_axes_of_a_chart() -> None:
    chart = Chart((0.0, 2.0), (-1.0, 3.0), "s", "cmH2O", "")
    left, top, right, bottom = chart.frame
    assert chart.at_x(0.0) == left
    assert chart.at_x(2.0) == right
    assert chart.at_y(-1.0) == bottom
    assert chart.at_y(3.0) == top
    assert chart.zero == pytest.approx(bottom - 0.25 * (bottom - top), abs=0.05)
    chart.band(1.0, 5.0)
    assert chart.bands == [(round((left + right) / 2, 1), round((right - left) / 2, 1))]
    assert ticks(0.0, 1.1, 6) == (
        pytest.approx([0.0, 0.2, 0.4, 0.6, 0.8, 1.0]),
        [
            "0.0",
            "0.2",
            "0.4",
            "0.6",
            "0.8",
            "1.0",
        ],
    )
    assert ticks(-3.0, 12.0, 4)[1] == ["0", "5", "10"]
    assert limits([1.0, np.nan], [3.0], around=0.5) == (0.0, 4.0)
    low, high = limits([2.0])
    assert low < 2.0 < high


def read(path: Path) -> dict[str, dict[str, Any]]:
    chunk = pytest.importorskip("rerun.chunk", reason="reads files back with rerun >= 0.41")
    entities: dict[str, dict[str, Any]] = {}
    for part in chunk.RrdReader(str(path)).store().stream():
        batch, columns = part.to_record_batch(), entities.setdefault(part.entity_path, {})
        for name in batch.schema.names:
            column = batch.column(name)
            if name == "recording_time":
                columns["time"] = np.array([t.value for t in column]) / 1e9
            elif name.startswith("Scalars"):
                columns["values"] = np.array(column.to_pylist()).T[0]
            elif part.is_static and ":" in name:
                columns[name.partition(":")[2]] = column[0].as_py()
    return entities


def test_the_time_since_an_edge_has_a_logarithmic_axis(found: Diagnosis) -> None:
    charts = by_axis(found)
    (edge,) = [chart for chart in charts if chart.x_label.startswith(EDGE)]
    assert edge.log
    assert not any(chart.log for chart in charts if chart is not edge)
    assert log_ticks(0.01, 1.0) == (
        [0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0],
        ["0.01", "0.02", "0.05", "0.1", "0.2", "0.5", "1"],
    )
    chart = Chart((0.01, 1.0), (0.0, 1.0), "s", "", "", log=True)
    left, middle, right = chart.at_x([0.01, 0.1, 1.0])
    assert middle == pytest.approx(0.5 * (left + right))
    assert chart.at_x(0.0) == left, "nothing lies left of the axis"


def test_sentences_and_charts_agree(found: Diagnosis) -> None:
    """A range that a sentence calls too low lies above zero in the chart, by the same mean."""
    traces = found.traces
    shown = {
        p.axis.name: p for p in profiles(traces.breaths, traces.refit, traces.flow, traces.volume)
    }
    told = [region for region in found.location if region.axis in shown]
    assert len(told) > 5
    for region in told:
        profile = shown[region.axis]
        first = 1.0 if region.axis == "breath number" else 0.0
        inside = (profile.axis.edges[:-1] >= region.low - first - 1e-9) & (
            profile.axis.edges[1:] <= region.high + 1e-9
        )
        means = profile.mean[inside]
        assert np.nanmin(means) - 1e-6 <= region.mean_error <= np.nanmax(means) + 1e-6
        sentence = number_text.error_region(region, found.noise[0])
        if "too" in sentence:
            assert ("too low" in sentence) == (np.nanmean(means) > 0)


def test_what_is_left_after_the_correction_is_shown(found: Diagnosis, tmp_path: Path) -> None:
    place = dataclasses.replace(found.location[0], mean_error=0.123)
    shown = dataclasses.replace(found, remaining=(place,))
    text = report.write(tmp_path / "report.html", shown).read_text("utf-8")
    assert "What is left after the correction" in text
    assert "0.12 cmH2O too low" in text
    clean = report.write(tmp_path / "clean.html", found).read_text("utf-8")
    assert "Nothing: no range of any quantity has a significant error." in clean


def test_the_first_line_counts_expirations_too(found: Diagnosis) -> None:
    errors = found.open_loop
    worse = {"expiration": {"refit": errors.after, "after": errors.refit}}
    made = dataclasses.replace(found, open_loop=dataclasses.replace(errors, groups=worse))
    (line,) = [more for question, _, more in report.facts(made) if "worth" in question]
    assert line.startswith("error in inspiration")
    assert line.endswith(f"; expiration {errors.after.rmse:.2f} → {errors.refit.rmse:.2f}")


def test_rerun(found: Diagnosis, tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="needs the extra ventbench[view]")
    from ventbench.pages.diagnosis import rerun_log

    path = rerun_log.write(tmp_path / "diagnosis.rrd", found)
    assert [item.name for item in tmp_path.iterdir()] == ["diagnosis.rrd"]
    assert path.stat().st_size < 2_000_000
    entities = read(path)
    expected = {f"/R20C50/pressure/{x}" for x in ("recorded", "before", "refit", "after")}
    expected |= {f"/R20C50/error/{x}" for x in ("before", "refit", "after")}
    expected |= {"/R20C50/u_in", "/R20C50/u_out", "/R20C50/held_out", "/about"}
    assert {name for name in entities if not name.startswith("/__")} == expected
    breaths = found.traces.breaths
    recorded = entities["/R20C50/pressure/recorded"]
    np.testing.assert_array_equal(recorded["values"], breaths.pressure.ravel())
    assert (np.diff(recorded["time"]) > 0).all(), "breaths lie end to end"
    error = entities["/R20C50/error/refit"]["values"]
    np.testing.assert_allclose(error, (breaths.pressure - found.traces.refit).ravel())
    held = entities["/R20C50/held_out"]["values"].reshape(breaths.pressure.shape)
    np.testing.assert_array_equal(np.isfinite(held).all(axis=1), found.traces.held_out)
    assert "41 ms" in entities["/about"]["text"][0]


def test_rerun_of_other_verdicts_and_names(tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="needs the extra ventbench[view]")
    from ventbench.pages.diagnosis import rerun_log

    odd = dataclasses.replace(made.nothing(6), simulator="\u673a ![i](http:)")
    entities = read(rerun_log.write(tmp_path / "n.rrd", odd))
    assert "/R20C50/error/after" not in entities
    text = entities["/about"]["text"][0]
    assert all(ord(c) < 0x180 for c in text), "the viewer ends itself over what its font lacks"
    assert "\\!\\[i\\]" in text, "a name is neither link nor image"
