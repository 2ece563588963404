"""A round on a Dask cluster, as ``docs/scale.md`` sets it up; a worker is killed in the middle."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from ventbench.board import rounds

ROOT = Path(__file__).resolve().parents[2]

#: Entries that are scored again: they cost least.
ENTRIES = ("pid_best", "pid_robust")


@contextlib.contextmanager
def process(*command: str, log: Path) -> Iterator[subprocess.Popen[bytes]]:
    environ = {**os.environ, "JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT)}
    with log.open("wb") as said:
        running = subprocess.Popen(command, cwd=ROOT, env=environ, stdout=said, stderr=said)
        try:
            yield running
        finally:
            running.kill()
            running.wait()


def commands_of(folder: Path, names: list[str]) -> dict[str, list[str]]:
    """Hashes of the commands of records: nominal and drawn, and stressed."""
    records = [json.loads((folder / f"{name}.json").read_bytes()) for name in names]
    return {
        f"{record['submission']['manifest']['name']} ({record['track']})": [
            part["commands"]["sha256"] for part in (record, record["stress"]) if part
        ]
        for record in records
    }


@pytest.mark.slow
@pytest.mark.filterwarnings("default")  # of Dask's own, about ports and closing
def test_a_worker_that_is_killed_in_a_round_costs_no_entry(tmp_path: Path) -> None:
    """The entries give the commands of the published records to the bit."""
    distributed = pytest.importorskip("distributed", reason="the extra ventbench[dask] is missing")
    board, place = tmp_path / "leaderboard", tmp_path / "cluster.json"
    shutil.copytree(ROOT / "leaderboard", board)
    published = max(rounds.load_all(board), key=lambda own: own.opened.closes)
    assert published.result is not None
    (published.folder / rounds.RESULT).unlink()

    dask = (sys.executable, "-m", "dask")
    start = (*dask, "scheduler", "--port", "0", "--host", "127.0.0.1", "--no-dashboard")
    worker = (*dask, "worker", "--nthreads", "1", "--no-nanny", "--no-dashboard")
    at = ("--scheduler-file", str(place))
    with contextlib.ExitStack() as stack:
        stack.enter_context(process(*start, *at, log=tmp_path / "scheduler"))
        while not place.exists() or not place.read_text().endswith("}"):
            time.sleep(0.05)
        workers = {
            stack.enter_context(
                process(
                    *worker,
                    *at,
                    *("--local-directory", str(tmp_path / f"worker-{k}")),
                    log=tmp_path / f"worker-{k}.log",
                )
            )
            for k in range(2)
        }
        client = stack.enter_context(distributed.Client(scheduler_file=str(place)))
        client.wait_for_workers(2)
        pids = client.run(os.getpid)
        only = [x for entry in ENTRIES for x in ("--only", entry)]
        scored = stack.enter_context(
            process(
                *(sys.executable, "-m", "ventbench", "round", "score", published.name, *only),
                *("--scheduler", client.scheduler.address, "--folder", str(board)),
                *("--out", str(tmp_path / "work")),
                log=tmp_path / "score",
            )
        )
        while not (busy := [x for x, tasks in client.processing().items() if tasks]):
            assert scored.poll() is None, (tmp_path / "score").read_text()
            time.sleep(0.05)
        killed = next(x for x in workers if x.pid == pids[busy[0]])
        killed.kill()
        assert scored.wait() == 0, (tmp_path / "score").read_text()
        assert len(client.scheduler_info()["workers"]) == 1, "one worker did all that was left"

    expected = commands_of(
        board / "records",
        [sha256 for key, sha256 in published.result.records.items() if key.split()[0] in ENTRIES],
    )
    again: dict[str, list[str]] = {}
    for entry in ENTRIES:
        folder = tmp_path / "work" / published.name / f"entry-{entry}"
        left = json.loads((folder / rounds.RESULT).read_bytes())
        assert left["failed"] == {}
        again |= commands_of(folder, list(left["records"].values()))
    assert again == expected
    assert len(expected) == 3, "pid_best has one track, pid_robust two"
