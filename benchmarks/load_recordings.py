"""Time and memory to read recordings, each in a process of its own, imports included.

- as large as the public ones: 75,450 breaths of 80 rows in the public schema, loaded, checked, and
  read by a plain ``pyarrow.csv.read_csv``;
- of another laboratory: 900,000 rows of time, pressure and flow, imported.

Usage:

    python benchmarks/load_recordings.py [--breaths 75450] [--rows 900000] [--folder DIR]
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import typer

BARS = {"check": (10.0, 400.0), "import": (2.0, 300.0)}
"""Most processor seconds and MB of a check and of an import."""

LOAD = """
from ventbench.recordings import load
n = load(path).pressure.size
"""
CHECK = """
from ventbench.recordings import check
report = check(path)
assert report.ok, report.lines()
n = report.rows
"""
IMPORT = """
from ventbench.recordings.foreign import import_recording
imported = import_recording(path, lung="R20C50")
n = len(imported.breaths)
"""
PLAIN = """
from pyarrow import csv
n = csv.read_csv(path).num_rows
"""
FRAME = """
import json, resource, sys
path = sys.argv[1]
{body}
use = resource.getrusage(resource.RUSAGE_SELF)
# The peak of this program, not of the one that started it.
peak = next(line for line in open("/proc/self/status") if line.startswith("VmHWM"))
print(json.dumps([n, use.ru_utime + use.ru_stime, int(peak.split()[1]) * 1024 / 1e6]))
"""


def lung(rng: np.random.Generator, time: np.ndarray, u_in: np.ndarray) -> tuple[np.ndarray, ...]:
    """Pressure, cmH2O, and flow, mL/s, of R20C50 at times and commands ``(n, T)``, with noise."""
    inside, phase = time < 1.0, np.maximum(time - 1.0, 0.0)
    dt = np.diff(time, prepend=0.0, axis=1)
    volume = np.cumsum(22.8 * u_in * dt * inside, axis=1)
    volume = np.where(inside, volume, volume.max(axis=1, keepdims=True) * np.exp(-phase))
    flow = np.where(inside, 22.8 * u_in, -volume)
    pressure = 5.0 + volume / 50.0 + np.where(inside, 0.02 * flow, 0.0)
    return pressure + rng.normal(0.0, 0.1, time.shape), flow + rng.normal(0.0, 3.0, time.shape)


def write_schema(path: Path, breaths: int) -> None:
    """Breaths of 80 rows in the public schema."""
    from ventbench.recordings import make_breaths, write

    rng = np.random.default_rng(0)
    shape = (breaths, 80)
    interval = rng.choice([0.0319, 0.0340], (breaths, 1))
    time = np.cumsum(interval * rng.uniform(0.99, 1.01, shape), axis=1)
    time = np.round(time - time[:, :1], 6)
    u_in = np.round(np.where(time < 1.0, rng.uniform(5.0, 25.0, (breaths, 1)), 0.0), 3)
    pressure, _ = lung(rng, time, u_in)
    labels = np.full(breaths, 20.0), np.full(breaths, 50.0)
    ids = np.arange(1, breaths + 1)
    write(make_breaths(ids, *labels, time, u_in, time >= 1.0, np.round(pressure, 4)), path)


def write_foreign(path: Path, rows: int) -> None:
    """Rows of a clock, a pressure and a flow at 100 Hz."""
    rng = np.random.default_rng(0)
    time = np.arange(rows) * 0.01
    phase = (time % 3.0).reshape(-1, 300)
    pressure, flow = lung(rng, phase, np.where(phase < 1.0, 15.0, 0.0))
    columns = (time, pressure.ravel(), 0.06 * flow.ravel())
    lines = zip(*(values.tolist() for values in columns), strict=True)
    text = "\n".join(f"{t:.2f},{p:.3f},{q:.3f}" for t, p, q in lines)
    path.write_text("Time (s),Paw (cmH2O),Flow (L/min)\n" + text + "\n")


def measure(body: str, path: Path) -> tuple[int, float, float]:
    """Return a count, processor seconds and peak MB of a fresh process."""
    command = [sys.executable, "-c", FRAME.format(body=body), str(path)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    count, seconds, peak = json.loads(done.stdout)
    return count, seconds, peak


def main(breaths: int = 75_450, rows: int = 900_000, folder: str | None = None) -> None:
    """Time and memory to read recordings, each in a process of its own, imports included.

    --folder: folder of the temporary files.
    """
    good = True
    with tempfile.TemporaryDirectory(dir=folder) as place:
        schema, foreign = Path(place) / "schema.csv", Path(place) / "foreign.csv"
        write_schema(schema, breaths)
        write_foreign(foreign, rows)
        for name, body, path in (
            ("plain pyarrow", PLAIN, schema),
            ("load", LOAD, schema),
            ("check", CHECK, schema),
            ("import", IMPORT, foreign),
        ):
            count, seconds, peak = measure(body, path)
            said = f"{name:14} {count:9d}  {seconds:6.2f} processor seconds  peak {peak:6.0f} MB"
            if name in BARS:
                holds = seconds <= BARS[name][0] and peak <= BARS[name][1]
                good &= holds
                said += "  within {:g} s and {:g} MB: ".format(*BARS[name]) + (
                    "yes" if holds else "NO"
                )
            print(said)
    raise typer.Exit(not good)


if __name__ == "__main__":
    typer.run(main)
