"""The grid in parts: kept, gone on with, run elsewhere; its table, picture and command."""

from __future__ import annotations

import io
import json
import os
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from typer.testing import CliRunner

from ventbench import protocol
from ventbench.cli import app
from ventbench.errors import InputError
from ventbench.lungs import LUNG_IDS, LUNGS
from ventbench.plants.single_compartment import single_compartment
from ventbench.plants.stacking import stack
from ventbench.training import pid_grid, pid_tuning
from ventbench.training.executor import InProcess, executor, results
from ventbench.training.pid_tuning import Grid, grid

GAINS = np.array([(p, i, d) for p in (0.0, 2.0, 5.0) for i in (0.0, 4.0) for d in (0.0, 1.0)])
PLANTS = {lung.id: single_compartment(lung) for lung in LUNGS[:3]}
IDENTITY = {"version": "textbook"}


def tune(**options):
    return pid_tuning.tune(PLANTS, identity=IDENTITY, gains=GAINS, part=5, **options)


@pytest.fixture(scope="module")
def whole() -> Grid:
    return tune()


def test_parts_make_up_the_whole_grid(whole):
    expected = pid_grid.errors(stack(list(PLANTS.values())), GAINS)
    np.testing.assert_allclose(whole.error, expected, rtol=1e-6)
    assert whole.lungs == tuple(PLANTS)
    assert whole.pips == protocol.PIPS


def test_tells_how_far_it_is():
    told = []
    tune(progress=lambda done, total: told.append((done, total)))
    sizes = 6 * np.array([0, 5, 5, 2] + 2 * [5, 5, 2])
    assert told == [(done, 3 * 12 * 6) for done in np.cumsum(sizes)]


def test_goes_on_after_ctrl_c_without_computing_anything_twice(whole, tmp_path, monkeypatch):
    calls, compute = [], grid.errors

    def counted(plant, gains):
        calls.append(len(gains))
        return compute(plant, gains)

    monkeypatch.setattr(grid, "errors", counted)

    def stop(done, total):
        if done >= total / 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        tune(folder=tmp_path, progress=stop)
    assert sorted(path.name for path in tmp_path.glob("*.npy"))[:2] == [
        "R5C10-0.npy", "R5C10-10.npy",
    ]  # fmt: skip
    before = len(calls)
    assert 0 < before < 9
    found = tune(folder=tmp_path)
    np.testing.assert_array_equal(found.error, whole.error)
    assert len(calls) == 9
    assert sum(calls) == 3 * len(GAINS)
    tune(folder=tmp_path)
    assert len(calls) == 9


def test_parts_of_another_search_are_refused(tmp_path):
    tune(folder=tmp_path)
    with pytest.raises(InputError, match=r"other settings \(simulators\); delete it"):
        pid_tuning.tune(PLANTS, identity={"version": "x"}, gains=GAINS, part=5, folder=tmp_path)


@pytest.mark.parametrize("content", [b"", b"not an array"], ids=["empty", "text"])
def test_a_damaged_part_is_named(tmp_path, content):
    tune(folder=tmp_path)
    (tmp_path / "R5C20-5.npy").write_bytes(content)
    with pytest.raises(InputError, match=r"R5C20-5\.npy is damaged, delete it"):
        tune(folder=tmp_path)
    np.save(tmp_path / "R5C20-5.npy", np.zeros((5, 5), np.float32))
    with pytest.raises(InputError, match=r"R5C20-5\.npy holds float32 \(5, 5\)"):
        tune(folder=tmp_path)


def test_parts_may_end_in_any_order(whole):
    with ThreadPoolExecutor(3) as pool:
        np.testing.assert_allclose(tune(pool=pool).error, whole.error, rtol=1e-6)


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


@pytest.mark.slow
def test_processes_give_the_same(whole):
    with executor(2) as pool:
        np.testing.assert_allclose(tune(pool=pool).error, whole.error, rtol=1e-6)


def _slowly(plant, gains):
    """A part that takes long enough to be interrupted, and leaves a mark."""
    time.sleep(0.4)
    return np.full((len(gains), len(protocol.PIPS)), gains.sum(), np.float32)


@pytest.mark.slow
@pytest.mark.filterwarnings("default")  # of Dask's own, about ports and closing
def test_a_dask_worker_that_is_killed_loses_nothing_and_counts_nothing_twice(tmp_path):
    distributed = pytest.importorskip("distributed", reason="the extra ventbench[dask] is missing")
    started = distributed.LocalCluster(
        n_workers=3, threads_per_worker=1, processes=True, dashboard_address=None,
        host="127.0.0.1", local_directory=str(tmp_path),
    )  # fmt: skip
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


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_dask_gives_the_same_grid(whole, tmp_path):
    distributed = pytest.importorskip("distributed", reason="the extra ventbench[dask] is missing")
    started = distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None,
        host="127.0.0.1", local_directory=str(tmp_path),
    )  # fmt: skip
    with started as cluster, executor(0, cluster.scheduler_address) as pool:
        found = tune(pool=pool, folder=tmp_path / "parts")
    np.testing.assert_allclose(found.error, whole.error, rtol=1e-6)
    assert len(list((tmp_path / "parts").glob("*.npy"))) == 9


def test_the_table_is_the_grid(whole, tmp_path):
    pid_tuning.write(tmp_path / "grid.parquet", whole)
    found = pid_tuning.read(tmp_path / "grid.parquet")
    assert (found.lungs, found.pips) == (whole.lungs, whole.pips)
    np.testing.assert_array_equal(found.gains, whole.gains)
    np.testing.assert_array_equal(found.error, whole.error)


def test_another_table_is_refused(tmp_path):
    path = tmp_path / "x.parquet"
    path.write_bytes(b"PAR1")
    with pytest.raises(InputError, match=r"x\.parquet is not a table of `ventbench tune pid`"):
        pid_tuning.read(path)


def test_the_summary_names_the_least_errors():
    error = np.array([[[1.0, 5.0], [2.0, 2.0]], [[1.0, 1.0], [1.5, 1.5]]], np.float32)
    gains = np.array([(1.0, 2.0, 3.0), (4.0, 5.0, 6.0)])
    found = pid_tuning.summary(Grid(("R5C10", "R5C20"), (10.0, 15.0), gains, error))
    assert found["lungs"]["R5C10"] == {"gains": [4.0, 5.0, 6.0], "error": 2.0}
    assert found["lungs"]["R5C20"] == {"gains": [1.0, 2.0, 3.0], "error": 1.0}
    assert found["single"] == {
        "gains": [4.0, 5.0, 6.0], "error": 1.75, "lungs": {"R5C10": 2.0, "R5C20": 1.5},
    }  # fmt: skip
    assert found["trajectories"] == 8


def test_the_picture_has_a_row_a_lung_and_one_for_all(whole):
    pytest.importorskip("matplotlib", reason="the extra ventbench[view] is missing")
    from matplotlib.image import imread

    from ventbench.views import gain_map

    pictures = [gain_map.png(whole), gain_map.png(whole), gain_map.png(whole, each=False)]
    assert pictures[0] == pictures[1]
    heights = [imread(io.BytesIO(picture)).shape[0] for picture in pictures]
    assert heights[0] > 2 * heights[2]


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr(pid_grid, "gains", lambda: GAINS)


def test_the_command_writes_table_plot_and_result(small, tmp_path):
    run = CliRunner().invoke(app, ["tune", "pid", "--all", "--out", str(tmp_path), "--json", "-"])
    assert run.exit_code == 0, run.output
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["best.json", "grid.parquet", "grid.png"]
    result = json.loads((tmp_path / "best.json").read_text())
    assert tuple(result["lungs"]) == LUNG_IDS
    table = pid_tuning.read(tmp_path / "grid.parquet")
    gains, error = pid_tuning.best_gains(table)
    assert result["single"]["gains"] == list(gains)
    assert result["single"]["error"] == pytest.approx(error)
    assert result["simulators"]["version"] == 1


def test_the_command_for_one_lung(small, tmp_path):
    arguments = ["tune", "pid", "--lung", "R20C50", "--out", str(tmp_path)]
    assert CliRunner().invoke(app, arguments).exit_code == 0
    result = json.loads((tmp_path / "best.json").read_text())
    assert tuple(result["lungs"]) == ("R20C50",)
    assert "single" not in result


@pytest.mark.parametrize("which", [[], ["--all", "--robust"], ["--lung", "R5C10", "--all"]])
def test_the_command_wants_to_know_which_lungs(which):
    run = CliRunner().invoke(app, ["tune", "pid", *which])
    assert isinstance(run.exception, InputError)
    assert "one of them" in str(run.exception)
