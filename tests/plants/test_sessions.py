"""Rigs and sessions of breaths by their clocks, on clocks that were made."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ventbench.base.errors import InputError
from ventbench.plants.sessions import Session, Sessions, find, sample_timing

TABLE = Sessions(
    (
        Session("R5C10", 33.8, False, 30, 9),
        Session("R5C10", 31.9, True, 31, 9),
        Session("R5C10", 34.3, True, 29, 9),
        Session("R20C50", 34.0, False, 29, 9),
        Session("R20C50", 34.0, False, 30, 9),
    )
)


def assigned(breaths):
    return TABLE.assign(breaths).tolist()


def test_reads_a_clock(make_recording):
    seen = sample_timing(
        make_recording(
            ["R5C10"] * 4,
            [31.8, 34.0, 34.0, 33.0],
            inspiratory=[31, 29, 30, 30],
            late=[0, 0.1, 0, 0],
        )
    )
    np.testing.assert_allclose(seen.interval_ms, [31.8, 34.0, 34.0, 33.0], atol=1e-6)
    assert seen.spiky.tolist() == [False, True, False, False]
    assert seen.inspiratory.tolist() == [31, 29, 30, 30]
    assert seen.known.all()


def test_padding_is_no_part_of_a_clock(make_recording):
    breaths = make_recording(["R5C10"], 31.8)
    valid = breaths.valid.copy()
    valid[:, 40:] = False
    dt = breaths.dt.copy()
    dt[:, 39:] = 0.5
    seen = sample_timing(replace(breaths, valid=valid, dt=dt))
    assert seen.interval_ms[0] == pytest.approx(31.8)
    assert not seen.spiky[0]


def test_the_kind_of_rig_is_slow_or_fast_and_spiky_or_not():
    rigs = [
        Session("R5C10", ms, spiky, 30, 1).rig for ms in (34.0, 31.8) for spiky in (False, True)
    ]
    assert rigs == [0, 1, 2, 3]
    assert TABLE.rigs().tolist() == [0, 3, 1, 0, 0]


def test_finds_the_sessions_that_were_made(make_recording):
    """Slow by samples of inspiration, spiky by interval alone, one lung after the other."""
    kinds = [
        ("R5C10", 33.8, 30, 0.0, 7),
        ("R5C10", 31.9, 31, 0.1, 6),
        ("R5C10", 34.3, 29, 0.1, 8),
        ("R20C50", 34.0, 29, 0.0, 6),
        ("R20C50", 34.0, 30, 0.0, 9),
    ]
    rng = np.random.default_rng(0)
    columns = ([], [], [], [])
    for lung, interval, samples, late, count in kinds:
        columns[0].extend([lung] * count)
        columns[1].extend(interval + rng.uniform(-0.03, 0.03, count))
        columns[2].extend([samples] * count)
        columns[3].extend([late] * count)
    lungs, interval, inspiratory, late = columns
    breaths = make_recording(lungs, interval, inspiratory=inspiratory, late=late)
    order = rng.permutation(len(breaths))
    table = find(breaths.select(order))
    found = {
        (s.lung, round(s.interval_ms, 1), s.inspiratory, s.spiky, s.breaths) for s in table.table
    }
    assert found == {(lung, ms, n, late > 0, count) for lung, ms, n, late, count in kinds}
    assert table == find(breaths)
    # Each breath then belongs to the session it was made for.
    session = table.assign(breaths)
    made = np.repeat(np.arange(len(kinds)), [kind[-1] for kind in kinds])
    assert len({*zip(session.tolist(), made.tolist(), strict=True)}) == len(kinds)


def test_few_breaths_are_no_session_unless_there_are_no_others(make_recording):
    breaths = make_recording(["R5C10"] * 8 + ["R20C20"] * 2, [33.8] * 6 + [31.8] * 2 + [34.0, 31.8])
    assert [(s.lung, s.breaths) for s in find(breaths).table] == [("R5C10", 6), ("R20C20", 2)]


def test_spiky_breaths_may_differ_in_samples_of_inspiration(make_recording):
    breaths = make_recording(["R5C10"] * 9, 34.3, inspiratory=[29] * 5 + [30] * 4, late=0.1)
    assert find(breaths).table == (Session("R5C10", 34.3, True, 29, 9),)


def test_assigns_the_nearest_clock_of_the_lung(make_recording):
    breaths = make_recording(
        ["R5C10", "R5C10", "R5C10", "R20C50", "R20C50", "R20C50"],
        [33.9, 31.8, 34.3, 34.0, 34.0, 31.8],
        inspiratory=[30, 31, 29, 29, 30, 30],
        late=[0.0, 0.1, 0.1, 0.0, 0.0, 0.0],
    )
    # The last was never seen: a slow rig's session is all that its lung has.
    assert assigned(breaths) == [0, 1, 2, 3, 4, 4]
    assert assigned(breaths.select([5, 2, 0])) == [4, 2, 0]


def test_blank_times_do_not_tell_spikes(make_recording):
    """Times that were estimated are even: a breath of a spiky rig must not be held against it."""
    breaths = make_recording(["R5C10"], 34.2, inspiratory=30)
    assert assigned(breaths) == [0]
    assert not sample_timing(replace(breaths, time_inferred=np.array([True]))).known[0]
    assert assigned(replace(breaths, time_inferred=np.array([True]))) == [2]


def test_a_lung_without_a_session_is_named_with_the_known_ones(make_recording):
    with pytest.raises(InputError, match=r"breath 2 is of lung R50C50.*known are R5C10, R20C50$"):
        TABLE.assign(make_recording(["R5C10", "R50C50"]))


def test_to_plain_values_and_back():
    plain = TABLE.to_list()
    assert plain[1] == {
        "lung": "R5C10",
        "interval_ms": 31.9,
        "spiky": True,
        "inspiratory": 31,
        "breaths": 9,
    }
    assert Sessions.from_list(plain) == TABLE
    assert len(TABLE) == 5
    for wrong in ([{"lung": "R5C10"}], [plain[0] | {"colour": "red"}]):
        with pytest.raises(InputError, match="table of sessions"):
            Sessions.from_list(wrong)
