"""EDF and WFDB: files that the formats' own libraries write come back."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest

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
    pytest.importorskip("pyedflib", reason="pyedflib has no wheel for this Python")
    from pyedflib import highlevel

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
            "lab",
            fs=RATE,
            units=["cmH2O", "L/min"],
            sig_name=["Paw", "Flow"],
            p_signal=np.stack(waveforms(), axis=1),
            fmt=["16", "16"],
            write_dir=str(folder),
        )
    return folder / "lab.hea"


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
            (breaths.pressure, pressure, 1.0),
            (breaths.flow, flow, 1000.0 / 60.0),
        ):
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


def test_a_file_cut_short_is_refused_in_one_line(tmp_path: Path) -> None:
    path = edf(tmp_path)
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(InputError, match="as EDF"):
        read_table(path)


def test_a_record_without_its_signals_is_refused(tmp_path: Path) -> None:
    path = record(tmp_path)
    (tmp_path / "lab.dat").unlink()
    with pytest.raises(InputError, match="must lie beside it"):
        read_table(path)
