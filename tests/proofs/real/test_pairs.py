"""Real against real: truths, splits, added leaks and lags, sealed halves, report."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from proofs.real import pairs
from proofs.real.pairs import Answered, Material, Pair, changed, with_leak
from ventbench.base.errors import InputError
from ventbench.mechanics.identify import identify
from ventbench.recordings.breaths import Breaths, make_breaths


def run(R: float, C: float, label: tuple[float, float], seed: int) -> Breaths:
    """A run with flow: R, C lung with noise, at 100 Hz."""
    rng, n = np.random.default_rng(seed), 8
    time = np.arange(0.0, 2.5, 0.01) * np.ones((n, 1))
    size = rng.uniform(500.0, 1100.0, (n, 1))
    flow = np.where(time < 0.8, size * np.minimum(time / 0.1, 1.0), 0.0)
    out = time >= 0.8
    inside = np.cumsum(flow * 0.01, axis=1)
    decay = np.exp(-(time - 0.8) / ((R + 5.0) * C * 1e-3))
    flow = np.where(out, -inside.max(axis=1, keepdims=True) * decay / ((R + 5.0) * C * 1e-3), flow)
    volume = np.cumsum(flow * 0.01, axis=1)
    pressure = 5.0 + volume / C + R * flow * 1e-3 + 0.1 * rng.standard_normal(time.shape)
    return make_breaths(
        np.arange(n),
        [label[0]] * n,
        [label[1]] * n,
        time,
        0 * time,
        out,
        pressure,
        flow=flow,
        volume=volume,
    )


@pytest.fixture(scope="module")
def material() -> Material:
    day = "day"
    runs = {
        f"{day}#1": run(5.5, 49.0, (5.0, 50.0), 1),
        f"{day}#2": run(19.0, 51.0, (20.0, 50.0), 2),
        "other#1": run(5.0, 51.0, (5.0, 50.0), 3),
        f"{day}#4": run(21.0, 52.0, (20.0, 20.0), 4),  # somebody forgot to set the lung
    }
    drives = {name: "blower" for name in runs} | {"other#1": "proportional valve"}
    return Material(runs, drives)


def test_pairs_know_their_truth_and_their_half(material):
    listed = list(pairs.pairs(material))
    assert len({pair.name for pair in listed}) == len(listed)
    halves = [pair.split for pair in listed]
    assert {"development", "sealed"} == set(halves)
    assert [pair.split for pair in pairs.pairs(material)] == halves
    kinds = {pair.kind for pair in listed}
    assert {"label", "lung", "drive", "leak", "lag"} <= kinds
    assert changed("R5C50", "R20C50") == "R 5 -> 20"
    assert changed("R5C50", "R20C20") == "R 5 -> 20, C 50 -> 20"
    assert changed("R5C50", "R5C50") == "nothing of the lung"


def answered(material: Material, kind: str, **fields: str) -> Answered:
    found = [
        pair
        for pair in pairs.pairs(material)
        if pair.kind == kind and all(getattr(pair, k) == v for k, v in fields.items())
    ]
    return pairs.answer(found[0], material)


def test_lungs_are_told_apart_and_a_wrong_label_is_seen(material):
    assert answered(material, "label", first="day#1").right
    assert not answered(material, "label", first="day#4").right
    lung = answered(material, "lung", first="day#1")
    assert lung.pair.truth.startswith("R 5 -> 20")
    assert lung.right, lung.answer
    assert lung.answer.startswith("R ")
    assert answered(material, "drive", first="day#1").right


def test_an_added_leak_is_exact(material):
    """The sensor sees the leak's flow; pressure stays."""
    breaths = material.runs["day#1"]
    leaking = with_leak(breaths, 3.0)
    np.testing.assert_array_equal(leaking.pressure, breaths.pressure)
    assert leaking.flow is not None
    assert breaths.flow is not None
    np.testing.assert_allclose(leaking.flow - breaths.flow, 3.0 * breaths.pressure)
    assert leaking.volume is not None
    assert breaths.volume is not None
    lost = leaking.volume - breaths.volume
    mean = float(breaths.pressure.mean())
    np.testing.assert_allclose(lost[:, -1].mean(), 3.0 * mean * 2.49, rtol=0.02)
    assert identify(leaking)[0].match.fitted_C > 0


def test_answers_are_kept_and_the_seal_is_broken_once(material, tmp_path, monkeypatch):
    monkeypatch.setattr(pairs, "load", lambda folder: material)
    calls = []
    counted = pairs.answer

    def answer(pair, own):
        calls.append(pair.name)
        return counted(pair, own)

    monkeypatch.setattr(pairs, "answer", answer)
    first = pairs.run(tmp_path, tmp_path / "out", kinds=("label", "drive"))
    again = pairs.run(tmp_path, tmp_path / "out", kinds=("label", "drive"))
    assert again == first
    assert len(calls) == len(first)
    assert all(entry.pair.split == "development" for entry in first)
    sealed = pairs.run(tmp_path, tmp_path / "out", sealed=True, kinds=("label",))
    assert all(entry.pair.split == "sealed" for entry in sealed)
    opened = json.loads((tmp_path / "out" / "opened.json").read_text())
    assert list(opened) == ["label"]
    monkeypatch.setattr(pairs.ventbench, "__version__", "99.0")
    with pytest.raises(InputError, match="can be opened once"):
        pairs.run(tmp_path, tmp_path / "out", sealed=True, kinds=("label",))
    with pytest.raises(InputError, match="no kind 'magic'"):
        pairs.run(tmp_path, tmp_path / "out", kinds=("magic",))


def test_the_report_counts():
    def made(kind: str, right: bool, strength: float = 0.0, **more) -> Answered:
        pair = Pair(f"{kind} {right} {strength}", kind, "", "a", "b", strength)
        return Answered(pair, "", right, **more)

    text = pairs.report(
        [
            made("label", True),
            made("label", False),
            made("lag", True, 0.02, value=0.021, in_class=True),
            made("lag", False, 0.02, new_names=("leak",)),
            made("lag", False, 0.02, new_names=("turbulent_resistance",)),
        ]
    )
    assert "| `label` | which lung a run was recorded with (flow) | 1 of 2 (9–91) |" in text
    assert "| 20 | 1 of 3 (6–79) | 1 | 21 | 2 | 1 |" in text


def test_a_rival_that_grows_counts_as_of_its_class(material):
    lung = material.mechanics("day#1")
    term = next(iter(lung.terms), None)
    if term is None:
        term = pairs.Term("circuit_compliance", {}, 9.0, 1.0, ())
    from ventbench.mechanics.labels import Estimate

    small = replace(term, parameters={"c": Estimate(1.0, "", (0.8, 1.2))})
    large = replace(term, parameters={"c": Estimate(2.0, "", (1.8, 2.2))})
    assert pairs._has_grown(large, small)
    assert pairs._has_grown(small, None)
    assert not pairs._has_grown(small, large)
    assert not pairs._has_grown(None, small)
