"""Time to build and to verify a leaderboard of many records.

The entries are synthetic: the commands of ``pid_best`` times a few factors, replayed, under new
names. Verification runs on a part of the records; its time is scaled to all of them. Usage:

    python benchmarks/board_speed.py [--records 1000] [--verified 100]
"""

from __future__ import annotations

import dataclasses
import json
import os
import tempfile
import time
from pathlib import Path

import typer

from ventbench.board import build, canonical, create, record, store
from ventbench.board.replay import ReplayPlants, run_of
from ventbench.board.verify import verify
from ventbench.entries.cells import protocol_of
from ventbench.entries.folder import open_submission
from ventbench.entries.scoring import run_protocol, runs_of
from ventbench.plants import frozen
from ventbench.plants.rigs import rigs_of
from ventbench.task import draws as draw_tables
from ventbench.task import environment

SANDBOX = {"layers": ["landlock", "seccomp"], "official": True}
FACTORS = (1.0, 0.99, 0.98, 0.97, 0.96, 0.95, 0.94, 0.93)


def drafts(plants: ReplayPlants) -> list[create.Draft]:
    """Return real records whose commands are those of the PID times a factor."""
    result = run_protocol(
        open_submission("pid_best"), protocol_of(rigs_of(plants), draws=draw_tables.COUNT)
    )
    made = []
    for factor in FACTORS:
        cells, requested = result.protocol.cells, result.requested * factor
        runs = runs_of(run_of(cells, environment.resolved(requested)[None]), cells)
        commands = requested.reshape(*runs.error.shape, *requested.shape[3:])
        runs = dataclasses.replace(runs, requested=commands)
        varied = dataclasses.replace(result, runs=runs, sandbox=SANDBOX)
        made.append(create.create(varied, plants))
    return made


def fill(folder: Path, made: list[create.Draft], count: int) -> None:
    """Write a leaderboard of ``count`` entries; the first keeps the name of the PID."""
    second_runs = ""
    for draft in made:
        draft.save(folder / store.RECORDS).unlink()
    for index in range(count):
        values = json.loads(made[index % len(made)].content)
        if index:
            values["submission"]["manifest"]["name"] = f"entry{index}"
        content = canonical.canonical(values)
        added = record.from_bytes(content, "synthetic")
        (folder / store.RECORDS / f"{added.sha256}{record.SUFFIX}").write_bytes(content)
        named = f'record = "{added.sha256}"\nreason = "x"\ndate = 2026-01-01\n'
        second_runs += f"[[second_runs]]\n{named}"
    (folder / canonical.ATTESTATIONS).write_text(second_runs)


def main(records: int = 1000, verified: int = 100) -> None:
    """Time to build and to verify a leaderboard of many records."""
    plants = frozen.load()
    made = drafts(plants)
    print(f"{records} records on {os.cpu_count()} cores")
    sizes = [len(x.content) + sum(map(len, x.commands)) for x in made]
    print(f"largest record with its commands: {max(sizes) / 1e3:.0f} kB")
    with tempfile.TemporaryDirectory() as temporary:
        folder, part = Path(temporary) / "large", Path(temporary) / "part"
        fill(folder, made, records)
        for what in ("first build", "second build"):
            begun = time.perf_counter()
            build.build(folder, Path(temporary) / "site")
            print(f"{what:44}{time.perf_counter() - begun:8.1f} s")
        fill(part, made, min(verified, records))
        begun = time.perf_counter()
        found = verify(part, lambda: plants)
        seconds = time.perf_counter() - begun
        if found.problems:
            raise SystemExit("\n".join(found.problems[:5]))
        what = f"verify ({found.replayed} took {seconds:.1f} s)"
        print(f"{what:44}{seconds * records / found.records:8.1f} s")


if __name__ == "__main__":
    typer.run(main)
