"""Fits side by side give what they give in turn."""

from __future__ import annotations

import threading

import pytest

from ventbench.system_id.parallel import THREADS, parallel_map, thread_count


@pytest.mark.parametrize("count", ["1", "3"])
def test_results_are_in_the_order_of_the_items(monkeypatch, count):
    monkeypatch.setenv(THREADS, count)
    assert parallel_map(lambda x: x * x, range(7)) == [0, 1, 4, 9, 16, 25, 36]
    assert parallel_map(lambda x: x, []) == []


def test_two_run_at_the_same_time(monkeypatch):
    monkeypatch.setenv(THREADS, "2")
    both = threading.Barrier(2, timeout=20.0)  # broken if one had to wait for the other
    assert sorted(parallel_map(lambda _: both.wait(), range(2))) == [0, 1]


def test_what_runs_inside_runs_in_turn(monkeypatch):
    monkeypatch.setenv(THREADS, "2")

    def inner(_):
        return threading.get_ident()

    for found in parallel_map(lambda _: parallel_map(inner, range(4)), range(2)):
        assert len(set(found)) == 1


def test_an_error_comes_through(monkeypatch):
    monkeypatch.setenv(THREADS, "2")
    with pytest.raises(ZeroDivisionError):
        parallel_map(lambda x: 1 // x, (2, 1, 0))


@pytest.mark.parametrize("given", ["", "0", "-2", "many"])
def test_without_a_number_there_are_as_many_as_cores(monkeypatch, given):
    monkeypatch.delenv(THREADS, raising=False)
    usual = thread_count()
    assert 1 <= usual <= 4
    monkeypatch.setenv(THREADS, given)
    assert thread_count() == usual
