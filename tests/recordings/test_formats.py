"""EDF, WFDB, MATLAB 7.3 and PIRDS: files that the formats' own libraries write come back."""

from __future__ import annotations

import json
import warnings
from pathlib import Path

import h5py
import numpy as np
import pytest
from pyedflib import highlevel

from ventbench.base.errors import InputError
from ventbench.recordings.foreign import Imported, import_recording
from ventbench.recordings.foreign.formats import read_table

RATE, PERIOD = 50.0, 3.0


def waveforms(cycles: int = 5) -> tuple[np.ndarray, np.ndarray]:
    """Pressure, cmH2O, and flow, L/min; whole seconds, as EDF's records need."""
    phase = np.tile(np.arange(PERIOD * RATE) / RATE, cycles)
    inward, out = (phase >= 0.1) & (phase < 1.0), phase >= 1.0
    decay = np.exp(-(phase - 1.0) / 0.4)
    flow = np.where(inward, 30.0, np.where(out, -42.0 * decay, 0.0))
    ramp = 10.0 + 20.0 * (phase - 0.1)
    return 5.0 + np.where(inward, ramp, np.where(out, 18.0 * decay, 0.0)), flow


def edf(folder: Path) -> Path:
    pressure, flow = waveforms()
    headers = [
        highlevel.make_signal_header(name, unit, rate, -200.0, 200.0)
        for name, unit, rate in (("SpO2", "%", 1), ("Paw", "cmH2O", RATE), ("Flow", "L/min", RATE))
    ]
    path = folder / "lab.edf"
    highlevel.write_edf(str(path), [np.full(15, 98.0), pressure, flow], headers)
    return path


def record(folder: Path) -> Path:
    with warnings.catch_warnings(action="ignore"):  # of pandas, when wfdb is imported
        import wfdb

        wfdb.wrsamp(
            "lab", fs=RATE, units=["cmH2O", "L/min"], sig_name=["Paw", "Flow"],
            p_signal=np.stack(waveforms(), axis=1), fmt=["16", "16"], write_dir=str(folder),
        )  # fmt: skip
    return folder / "lab.hea"


def matlab(folder: Path) -> Path:
    """HDF5 behind MATLAB's header of 512 bytes, columns as MATLAB lays them: transposed."""
    path = folder / "lab.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        values = dict(zip(("Paw", "Flow_LPM"), waveforms(), strict=True)) | {"fs": np.array([RATE])}
        for name, value in values.items():
            file.create_dataset(name, data=value[None, :]).attrs["MATLAB_class"] = np.bytes_(
                "double"
            )
    header = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(116) + bytes(8) + b"\x00\x02IM"
    with open(path, "r+b") as stream:
        stream.write(header)
    return path


def pirds(folder: Path, a_line: bool = False) -> Path:
    """Tenths of a cmH2O and mL/min as integers; the ambient sensor's pressure is absolute."""
    events = [{"event": "E", "type": "M", "ms": 0, "buff": "start"}]
    for k, (pressure, flow) in enumerate(zip(*waveforms(), strict=True)):
        common = {"event": "M", "num": 0, "ms": 20 * k}
        events += [
            {**common, "type": "P", "loc": "B", "val": 10332},
            {**common, "type": "D", "loc": "A", "val": round(10.0 * pressure)},
            {**common, "type": "F", "loc": "A", "val": round(1000.0 * flow)},
        ]
    path = folder / "lab.pirds"
    lines = "\n".join(map(json.dumps, events))
    path.write_text(lines if a_line else json.dumps(events))
    return path


def _the_waveforms_come_back(imported: Imported, quantum: float) -> None:
    pressure, flow = waveforms()
    breaths = imported.breaths
    assert len(breaths) >= 4
    assert breaths.flow is not None
    for breath in range(len(breaths)):
        valid = breaths.valid[breath]
        # The onset of the flow aligns a breath with the cycle that it was cut from.
        onset = int(np.argmax(breaths.flow[breath][valid] > 100.0))
        length = min(int(valid.sum()) - onset, int(PERIOD * RATE) - 5)
        for values, expected, factor in (
            (breaths.pressure, pressure, 1.0), (breaths.flow, flow, 1000.0 / 60.0),
        ):  # fmt: skip
            np.testing.assert_allclose(
                values[breath][valid][onset : onset + length],
                factor * expected[5 : 5 + length],
                atol=quantum * factor,
            )


@pytest.mark.parametrize(
    ("write", "quantum", "said"),
    [
        (edf, 400.0 / 65535, "EDF with 2 signals at 50 Hz"),
        (record, 0.01, "WFDB with 2 signals at 50 Hz"),
        (matlab, 1e-9, "MATLAB file with 2 columns"),
        (pirds, 0.051, "pressure D of A0, flow F of A0"),
    ],
)
def test_a_file_of_each_kind_comes_back(write, quantum: float, said: str, tmp_path: Path) -> None:
    imported = import_recording(write(tmp_path), lung="R20C50")
    assert said in " ".join(imported.understood)
    _the_waveforms_come_back(imported, quantum)


def test_signals_of_other_rates_are_named(tmp_path: Path) -> None:
    table = read_table(edf(tmp_path))
    assert list(table.columns) == ["Paw", "Flow"]
    assert "left out (SpO2 (1 Hz))" in " ".join(table.notes)


def test_pirds_a_line_is_pirds_as_a_list(tmp_path: Path) -> None:
    as_list, a_line = read_table(pirds(tmp_path)), read_table(pirds(tmp_path, a_line=True))
    assert list(as_list.columns) == ["time", "pressure", "flow"]
    for name, values in as_list.columns.items():
        np.testing.assert_array_equal(values, a_line.columns[name])


def _cut(path: Path, share: float) -> Path:
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    return path


@pytest.mark.parametrize(
    ("write", "says"),
    [(edf, "as EDF"), (matlab, "MATLAB 7.3 file"), (pirds, "line 1 is no JSON event")],
)
def test_a_file_cut_short_is_refused_in_one_line(write, says: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=says):
        read_table(_cut(write(tmp_path), 0.5))


def test_a_record_without_its_signals_is_refused(tmp_path: Path) -> None:
    path = record(tmp_path)
    (tmp_path / "lab.dat").unlink()
    with pytest.raises(InputError, match="must lie beside it"):
        read_table(path)


@pytest.mark.parametrize(
    ("event", "says"),
    [
        ({"event": "M", "type": "D", "loc": "A", "num": 0, "ms": 1}, "event 1 is no PIRDS"),
        ({"event": "M", "type": "T", "loc": "A", "num": 0, "ms": 1, "val": 2}, "no measurement"),
    ],
)
def test_pirds_without_a_pressure_is_refused(event: dict, says: str, tmp_path: Path) -> None:
    path = tmp_path / "lab.json"
    path.write_text(json.dumps([event]))
    with pytest.raises(InputError, match=says):
        read_table(path)
