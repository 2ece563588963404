"""Official scores of several entries by one worker and by two: speed-up, and what 10,000 cost.

Every entry is scored in the sandbox as ``ventbench score --workers N`` and
``--scheduler ADDRESS`` do it. Workers are warm: each has scored once before the clock starts.

Usage:

    python benchmarks/executor_scaling.py [--entries 4] [--draws 20] [--stress] [--cluster]

``--cluster`` uses a Dask cluster on this machine in place of plain processes. Processor times
include the sandboxed processes; on a busy machine only they mean something.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from typing import Any

import typer

from ventbench.base.executor import executor, in_order
from ventbench.entries.runs import DRAWS
from ventbench.entries.scoring import score

#: Entry that is scored again and again, and entries of the cost that is worked out.
ENTRY, MANY = "pid_robust", 10_000


def processor_seconds() -> float:
    """Processor time of this process and of its children that have ended."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in used)


def scored(draws: int, stress: bool) -> float:
    """Score one entry; returns the processor time that it took, s."""
    begun = processor_seconds()
    score(ENTRY, draws=draws, stress=stress * (DRAWS if draws else 1))
    return processor_seconds() - begun


@contextmanager
def opened(workers: int, cluster: bool) -> Iterator[Executor]:
    """Open processes, or a cluster of one thread each."""
    if not cluster:
        with executor(workers) as pool:
            yield pool
        return
    import distributed

    local: Any = distributed.LocalCluster
    with (
        local(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            dashboard_address=None,
            host="127.0.0.1",
        ) as started,
        executor(0, started.scheduler_address) as pool,
    ):
        yield pool


def main(entries: int = 4, draws: int = 20, stress: bool = False, cluster: bool = False) -> None:
    """Official scores of several entries by one worker and by two: speed-up, and what 10,000 cost.

    --stress: the stress track too.
    """
    walls, used = {}, []
    for workers in (1, 2):
        with opened(workers, cluster) as pool:
            in_order(pool, scored, [(0, stress)] * workers)
            begun = time.perf_counter()
            used += in_order(pool, scored, [(draws, stress)] * entries)
            walls[workers] = time.perf_counter() - begun
        print(
            f"{entries} entries, {workers} worker{'s' * (workers > 1)}: "
            f"{walls[workers]:.1f} s wall-clock, {sum(used[-entries:]):.1f} s processor",
            flush=True,
        )
    print(f"speed-up from 1 to 2 workers: {walls[1] / walls[2]:.2f}")
    each = sum(used) / len(used)
    print(
        f"an entry takes {each:.1f} s of processor time; {MANY:,} take {MANY * each / 3600:.0f} "
        f"core-hours: {MANY * each / 3600 / 16:.1f} h on 16 cores"
    )


if __name__ == "__main__":
    typer.run(main)
