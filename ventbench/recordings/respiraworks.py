"""Recordings of the RespiraWorks ventilator: another schema, 100 Hz, several breaths a run.

Its valves are not those of the ventilator that ventbench simulates: its commands are kept as they
are and not converted to u_in and u_out. Lung mechanics follow from pressure and flow.
"""

from __future__ import annotations

import os
from dataclasses import dataclass

import numpy as np

from ventbench.recordings.scan import kind_of
from ventbench.recordings.schema import fail

#: Signals of a run and their units.
SIGNALS = {"pressure": "cmH2O", "flow": "mL/s", "volume": "mL", "target": "cmH2O"} | dict.fromkeys(
    ("cmd_inh_valve", "cmd_exh_valve", "cmd_psol", "dp_inhale", "dp_exhale"), "as logged"
)
_LABELS = ("run", "test", "breath", "time_step", "R", "C", "drive")


@dataclass(frozen=True, eq=False)
class RespiraWorksRun:
    """One test of one day: consecutive breaths on one lung."""

    name: str  #: name of the test day or gas supply.
    test: int  #: number of the ISO test condition.
    drive: str  #: source of the gas, such as a blower.
    R: float  #: resistance that the operators noted, cmH2O/(L/s).
    C: float  #: compliance that the operators noted, mL/cmH2O.
    breath: np.ndarray  #: number of each sample's breath, int64, (T,).
    time: np.ndarray  #: s, float64, (T,).
    #: signals by the names of `SIGNALS`, float64, NaN where not logged, each (T,).
    signals: dict[str, np.ndarray]


def load_respiraworks(path: str | os.PathLike[str]) -> tuple[RespiraWorksRun, ...]:
    """Read the runs of a RespiraWorks Parquet file, in its order.

    Raises:
        RecordingError: if the file cannot be read, lacks a column, or its times do not increase.
    """
    import pyarrow as pa
    from pyarrow import parquet

    name = str(path)
    if kind_of(path) != "parquet":
        raise fail(name, "this is not a Parquet file", "RespiraWorks recordings are Parquet.")
    try:
        frame = parquet.read_table(name).to_pandas()
    except (pa.ArrowException, OSError) as error:
        raise fail(name, f"the Parquet file cannot be read ({error})", "Copy it again.") from None
    missing = [column for column in (*_LABELS, *SIGNALS) if column not in frame.columns]
    if missing:
        advice = "Name a RespiraWorks file; other recordings are read with load."
        raise fail(name, f"missing columns {', '.join(missing)}", advice)
    runs = []
    for (run, test), rows in frame.groupby(["run", "test"], sort=False):
        time = rows["time_step"].to_numpy(np.float64)
        if not (np.diff(time) > 0.0).all():
            what = f"time_step does not increase in run {run}, test {test}"
            raise fail(name, what, "Write the file again in time order.")
        signals = {column: rows[column].to_numpy(np.float64) for column in SIGNALS}
        first = rows.iloc[0]
        label, breath = (float(first["R"]), float(first["C"])), rows["breath"].to_numpy(np.int64)
        drive = str(first["drive"])
        runs.append(RespiraWorksRun(str(run), int(str(test)), drive, *label, breath, time, signals))
    return tuple(runs)
