"""Simulated pressures in a table beside the recorded ones."""

from __future__ import annotations

import dataclasses

import numpy as np
import pandas as pd
import pytest

import ventbench
from ventbench.base.errors import InputError
from ventbench.plants.catalog import load_simulators
from ventbench.plants.simulators import SimulatedPressures
from ventbench.recordings import load


@pytest.fixture(scope="module")
def table() -> pd.DataFrame:
    """The example with a column of simulated pressures."""
    return pd.read_csv(ventbench.example("concealed")).assign(
        simulated=lambda t: t.pressure + 0.01 * np.arange(len(t))
    )


def test_the_recording_itself_with_one_more_column(table, tmp_path):
    recorded = load(ventbench.example("concealed"))
    for name in ("both.csv", "both.parquet"):
        path = tmp_path / name
        table.to_csv(path, index=False) if name.endswith("csv") else table.to_parquet(path)
        expected = table.simulated.to_numpy().reshape(recorded.pressure.shape)
        found = load_simulators(path)
        assert (type(found), found.name) == (SimulatedPressures, name)
        np.testing.assert_allclose(found.pressures(recorded), expected)
        some = recorded.select([3, 1])
        np.testing.assert_allclose(found.pressures(some), expected[[3, 1]])


def test_another_sampling_is_interpolated_in_time(tmp_path):
    recorded = load(ventbench.example("concealed")).select([0, 1])
    fine = np.arange(0.0, recorded.time.max() + 0.01, 0.005)
    rows = [(i, t, 5.0 + 3.0 * t + i) for i in recorded.breath_id for t in fine]
    path = tmp_path / "fine.csv"
    pd.DataFrame(rows, columns=["breath_id", "time_step", "pressure"]).to_csv(path, index=False)
    answers = load_simulators(path).pressures(recorded)
    np.testing.assert_allclose(answers, 5.0 + 3.0 * recorded.time + recorded.breath_id[:, None])


def test_a_short_breath_takes_its_own_rows(table, tmp_path):
    recorded = load(ventbench.example("concealed"))
    valid = recorded.valid.copy()
    valid[0, -5:] = False
    drop = table.index[table.breath_id == recorded.breath_id[0]][-5:]
    path = tmp_path / "short.csv"
    table.drop(drop).to_csv(path, index=False)
    answers = load_simulators(path).pressures(dataclasses.replace(recorded, valid=valid))
    assert np.all(answers[0, -5:] == answers[0, -6])


def test_messages(table, tmp_path):
    recorded = load(ventbench.example("concealed"))
    path = tmp_path / "bad.csv"

    def refused(frame: pd.DataFrame, message: str) -> None:
        frame.to_csv(path, index=False)
        with pytest.raises(InputError, match=message):
            load_simulators(path).pressures(recorded)

    refused(table[["breath_id", "u_in"]], "columns breath_id and simulated are needed")
    refused(table[table.breath_id != 3], "no breath 3 of the recording")
    refused(table.assign(simulated=np.nan), "breath 1 has a blank or infinite simulated")
    refused(table.assign(simulated="high"), "not all are numbers")
    refused(table.drop(columns="time_step").iloc[1:], "add a column time_step")
    refused(table[table.time_step < 1.0], "simulate the whole breath")
    refused(table.assign(R=5), "breath 1 is of R 5, in the recording of lung R20C50")
    refused(table.assign(u_in=table.u_in + 1.0), "another command than the recording")
    with pytest.raises(InputError, match="is the recording itself"):
        load_simulators(ventbench.example("concealed")).pressures(recorded)
