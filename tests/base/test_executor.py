"""Work in threads, in processes and on a cluster: every result once, every failure told."""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from ventbench.base.errors import InputError
from ventbench.base.executor import (
    THREADS,
    InProcess,
    executor,
    in_order,
    parallel_map,
    results,
    thread_count,
)
from ventbench.task import protocol


def test_an_error_of_a_job_is_that_of_the_search():
    running = results(InProcess(), lambda x: 1 / x, {"a": (1,), "b": (0,), "c": (2,)})
    assert next(running) == ("a", 1.0)
    with pytest.raises(ZeroDivisionError):
        next(running)


def test_in_this_process_each_result_is_told_before_the_next_job_begins():
    begun = []

    def job(name):
        begun.append(name)
        return name

    for name, result in results(InProcess(), job, {"a": ("a",), "b": ("b",)}):
        assert name == result
        assert begun[-1] == name


def test_an_executor_is_one_or_the_other():
    with pytest.raises(InputError, match="one of the two"), executor(2, "tcp://x:1"):
        pass
    with pytest.raises(InputError, match="must not be negative"), executor(-1):
        pass


def _die(_: int) -> None:
    os._exit(3)


@pytest.mark.slow
def test_a_dead_worker_process_is_told():
    with pytest.raises(InputError, match="a worker process died"), executor(1) as pool:
        list(results(pool, _die, {"a": (1,)}))


def _waits_for_ever(begun: str) -> None:
    Path(begun).touch()
    threading.Event().wait()


@pytest.mark.slow
def test_an_interrupt_of_this_process_alone_ends_its_workers(tmp_path):
    begun, before = tmp_path / "begun", set(multiprocessing.active_children())
    with pytest.raises(KeyboardInterrupt), executor(1) as pool:  # noqa: PT012
        pool.submit(_waits_for_ever, str(begun))
        while not begun.exists():
            time.sleep(0.01)
        raise KeyboardInterrupt
    assert set(multiprocessing.active_children()) == before


def _waits_with_its_number(begun: str) -> None:
    Path(begun).with_suffix(".new").write_text(str(os.getpid()))
    Path(begun).with_suffix(".new").rename(begun)
    threading.Event().wait()


def _opens_an_executor(begun: str) -> None:
    with executor(1) as pool:
        pool.submit(_waits_with_its_number, begun).result()


def _runs(process: int) -> bool:
    """Whether a process is there and no zombie that nobody has asked after."""
    shown = subprocess.run(
        ["ps", "-o", "stat=", "-p", str(process)], capture_output=True, text=True, check=False
    )
    return bool(shown.stdout.strip()) and not shown.stdout.startswith("Z")


@pytest.mark.slow
def test_a_worker_ends_with_a_parent_that_is_killed(tmp_path):
    begun = tmp_path / "begun"
    parent = multiprocessing.get_context("spawn").Process(
        target=_opens_an_executor, args=(str(begun),)
    )
    parent.start()
    while not begun.exists():
        assert parent.is_alive()
        time.sleep(0.01)
    worker = int(begun.read_text())
    assert _runs(worker)
    parent.kill()
    parent.join()
    while _runs(worker):  # else the test's own time limit ends it
        time.sleep(0.01)


def _slowly(plant, gains):
    """A part that takes long enough to be interrupted, and leaves a mark."""
    time.sleep(0.4)
    return np.full((len(gains), len(protocol.PIPS)), gains.sum(), np.float32)


def test_a_job_with_which_workers_of_a_cluster_died_is_named():
    class KilledWorker(Exception):
        """What Dask raises."""

    def job():
        raise KilledWorker

    with ThreadPoolExecutor(1) as pool, pytest.raises(InputError, match=r"died.* with heavy"):
        list(results(pool, job, {"heavy": ()}))


@pytest.mark.slow
@pytest.mark.filterwarnings("default")  # of Dask's own, about ports and closing
def test_a_dask_worker_that_is_killed_loses_nothing_and_counts_nothing_twice(tmp_path):
    distributed = pytest.importorskip("distributed", reason="the extra ventbench[dask] is missing")
    started = distributed.LocalCluster(
        n_workers=3,
        threads_per_worker=1,
        processes=True,
        dashboard_address=None,
        host="127.0.0.1",
        local_directory=str(tmp_path),
    )
    with started as cluster:
        jobs = {f"{n}": (None, np.full((2, 3), float(n))) for n in range(24)}
        found, killed = [], None
        with executor(0, cluster.scheduler_address) as pool:
            for name, error in results(pool, _slowly, jobs):
                found.append(name)
                np.testing.assert_array_equal(error, 6.0 * float(name))
                if len(found) == 3:
                    killed = next(iter(cluster.workers.values()))
                    os.kill(killed.pid, 9)
        assert killed is not None
    assert sorted(found, key=int) == list(jobs)


@pytest.mark.parametrize("workers", [0, 2])
def test_results_of_jobs_are_in_the_order_of_their_arguments(workers):
    second, told = threading.Event(), []

    def job(number):
        if workers and number == 0:
            assert second.wait(600.0)  # the first ends last
        if number == 1:
            second.set()
        return number * number

    pool = ThreadPoolExecutor(workers) if workers else InProcess()
    arguments = [(number,) for number in range(5)]
    with pool:
        assert in_order(pool, job, arguments, lambda *x: told.append(x)) == [0, 1, 4, 9, 16]
    assert told == [(number, 5) for number in range(1, 6)]


@pytest.mark.parametrize("count", ["1", "3"])
def test_results_are_in_the_order_of_the_items(monkeypatch, count):
    monkeypatch.setenv(THREADS, count)
    assert parallel_map(lambda x: x * x, range(7)) == [0, 1, 4, 9, 16, 25, 36]
    assert parallel_map(lambda x: x, []) == []


def test_two_run_at_the_same_time(monkeypatch):
    monkeypatch.setenv(THREADS, "2")
    both = threading.Barrier(2, timeout=600.0)  # broken if one had to wait for the other
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
