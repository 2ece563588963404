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
from ventbench.entries.folder import open_submission
from ventbench.entries.scoring import run_protocol, runs_of
from ventbench.plants import frozen
from ventbench.plants.rigs import rigs_of
from ventbench.task import draws as draw_tables
from ventbench.task import environment

#: Largest times for 1,000 records, s.
BUILD_LIMIT_S, VERIFY_LIMIT_S = 10.0, 300.0

SANDBOX = {"layers": ["landlock", "seccomp"], "official": True}
FACTORS = (1.0, 0.99, 0.98, 0.97, 0.96, 0.95, 0.94, 0.93)


def drafts(plants: ReplayPlants) -> list[create.Draft]:
    """Return real records whose commands are those of the PID times a factor."""
    result = run_protocol(open_submission("pid_best"), rigs_of(plants), draws=draw_tables.COUNT)
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


def report(what: str, seconds: float, limit: float) -> None:
    print(f"{what:44}{seconds:8.1f} s   limit {limit:5.0f} s   ratio {seconds / limit:.2f}")


def main(records: int = 1000, verified: int = 100) -> None:
    """Time to build and to verify a leaderboard of many records."""
    plants = frozen.load()
    made = drafts(plants)
    share = records / 1000
    print(f"{records} records on {os.cpu_count()} cores")
    sizes = [len(x.content) + sum(map(len, x.commands)) for x in made]
    print(f"largest record with its commands: {max(sizes) / 1e3:.0f} kB")
    with tempfile.TemporaryDirectory() as temporary:
        folder, site = Path(temporary) / "large", Path(temporary) / "site"
        fill(folder, made, records)
        begun = time.perf_counter()
        done = build.build(folder, site)
        report("first build", time.perf_counter() - begun, BUILD_LIMIT_S * share)
        begun = time.perf_counter()
        again = build.build(folder, site)
        report("second build", time.perf_counter() - begun, BUILD_LIMIT_S * share)
        if again.changed or len(done.changed) < done.files:
            raise SystemExit("the second build changed something")
        part = Path(temporary) / "part"
        fill(part, made, min(verified, records))
        begun = time.perf_counter()
        found = verify(part, lambda: plants)
        seconds = time.perf_counter() - begun
        if found.problems:
            raise SystemExit("\n".join(found.problems[:5]))
        scaled = seconds * records / found.records
        what = f"verify ({found.replayed} took {seconds:.1f} s)"
        report(what, scaled, VERIFY_LIMIT_S * share)


if __name__ == "__main__":
    typer.run(main)
