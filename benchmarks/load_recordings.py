"""Time and memory to load a file as large as the public recordings.

Writes 75,450 synthetic breaths of 80 rows to a temporary folder, loads them in a separate process
and compares with a plain ``pyarrow.csv.read_csv`` of the same file in another process. Usage:

    python benchmarks/load_recordings.py [--breaths 75450] [--folder DIR]
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

SECONDS, GIB = 15.0, 3.0
"""Largest time and memory of a load."""

LOAD = """
from ventbench.recordings import load
n = load(path).pressure.size
"""
CHECK = """
from ventbench.recordings import check
n = check(path).rows
"""
PLAIN = """
from pyarrow import csv
n = csv.read_csv(path).num_rows
"""
FRAME = """
import json, resource, sys, time
path = sys.argv[1]
start = time.perf_counter()
{body}
seconds = time.perf_counter() - start
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
print(json.dumps([n, seconds, peak]))
"""


def write_synthetic(path: Path, breaths: int) -> None:
    from ventbench.recordings import make_breaths, write

    rng = np.random.default_rng(0)
    shape = (breaths, 80)
    interval = rng.choice([0.0319, 0.0340], (breaths, 1))
    time = np.cumsum(interval * rng.uniform(0.99, 1.01, shape), axis=1)
    time -= time[:, :1]
    write(
        make_breaths(
            np.arange(1, breaths + 1),
            rng.choice([5.0, 20.0, 50.0], breaths),
            rng.choice([10.0, 20.0, 50.0], breaths),
            time,
            rng.uniform(0.0, 100.0, shape),
            time >= 1.0,
            rng.uniform(5.0, 40.0, shape),
        ),
        path,
    )


def measure(body: str, path: Path) -> tuple[int, float, float]:
    """Return rows, seconds and peak GiB of a fresh process, imports included."""
    command = [sys.executable, "-c", FRAME.format(body=body), str(path)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    rows, seconds, peak = json.loads(done.stdout)
    return rows, seconds, peak


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--breaths", type=int, default=75_450)
    parser.add_argument("--folder", default=None, help="folder of the temporary file")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        path = Path(folder) / "synthetic.csv"
        start = time.perf_counter()
        write_synthetic(path, options.breaths)
        print(f"wrote {path.stat().st_size / 1e6:.0f} MB in {time.perf_counter() - start:.1f} s")
        bodies = {"plain pyarrow": PLAIN, "load": LOAD, "check": CHECK}
        results = {name: measure(body, path) for name, body in bodies.items()}
    plain = results["plain pyarrow"][1]
    for name, (rows, seconds, peak) in results.items():
        assert rows == 80 * options.breaths, (name, rows)
        print(
            f"{name:14} {rows} rows  {seconds:6.2f} s  peak {peak:5.2f} GiB  "
            f"{seconds / plain:4.1f} x plain pyarrow"
        )
    _, seconds, peak = results["load"]
    good = seconds <= SECONDS and peak <= GIB
    print(f"load within {SECONDS:g} s and {GIB:g} GiB: {'yes' if good else 'NO'}")
    return 0 if good else 1


if __name__ == "__main__":
    raise SystemExit(main())
