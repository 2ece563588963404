"""Recordings of other laboratories: separators, units, MATLAB, breaths, layouts, messages."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.io import savemat
from typer.testing import CliRunner

import ventbench
from ventbench.base.errors import InputError
from ventbench.cli.data import app
from ventbench.recordings import check, load, write
from ventbench.recordings.foreign import import_recording, import_runs
from ventbench.recordings.headers import UNITS, conversion

RATE, PERIOD = 50.0, 3.0


def waveforms(cycles: float = 4.5) -> dict[str, np.ndarray]:
    """Pressure (cmH2O) and flow (mL/s) of a ventilated lung; a cycle begins at 0, 3, 6, ... s."""
    t = np.arange(0.0, cycles * PERIOD, 1.0 / RATE)
    phase = t % PERIOD
    inward = (phase >= 0.1) & (phase < 1.0)
    out = phase >= 1.0
    decay = np.exp(-(phase - 1.0) / 0.4)
    flow = np.where(inward, 500.0, np.where(out, -700.0 * decay, 0.0))
    pressure = 5.0 + np.where(inward, 10.0 + 20.0 * (phase - 0.1), np.where(out, 18.0 * decay, 0.0))
    return {"t": t, "pressure": pressure, "flow": flow}


def german(path: Path) -> Path:
    """Semicolons, decimal commas, two lines above the header, units in it, milliseconds."""
    made = waveforms()
    lines = ["Messung 7", "Gerät: Labor", "Zeit [ms];Paw [mbar];Flow [L/min]"]
    for t, p, q in zip(*made.values(), strict=True):
        lines.append(f"{1e3 * t:.0f};{p / 1.019716213:.4f};{q * 0.06:.4f}".replace(".", ","))
    path.write_text("\n".join(lines) + "\n", encoding="latin-1")
    return path


def test_a_table_of_another_country(tmp_path):
    imported = import_recording(german(tmp_path / "lab.csv"), lung="R20C50")
    breaths, made = imported.breaths, waveforms()
    assert len(breaths) == 4, "the last cycle is not whole"
    assert imported.columns == {"Zeit": "time", "Paw": "pressure", "Flow": "flow"}
    assert breaths.flow is not None
    first = np.argmin(np.abs(made["t"] - 3.0))  # where the second breath begins
    start = int(np.argmax(breaths.flow[1] > 100.0))
    np.testing.assert_allclose(
        breaths.pressure[1, start : start + 100],
        made["pressure"][first + 5 : first + 105],
        atol=2e-4,
    )
    np.testing.assert_allclose(np.nanmax(breaths.flow), 500.0, rtol=1e-5)
    out = (breaths.u_out[0] == 1) & breaths.valid[0]
    inward = (breaths.u_out[0] == 0) & breaths.valid[0]
    assert np.all(breaths.flow[0][out] <= 0.0)
    assert np.all(breaths.flow[0][inward] >= 0.0)
    assert not breaths.u_in.any()
    text = " ".join(imported.understood)
    for part in ("Latin-1", "decimal ','", "20 ms", "flow turns inwards", "2 lines above"):
        assert part in text


def test_units_are_exact_both_ways():
    values = np.array([0.1, -3.7, 41.3])
    for role, units in UNITS.items():
        for unit in units:
            change = conversion(role, unit)
            back = change.apply(values) * float(1 / change.factor)
            np.testing.assert_allclose(back, values, rtol=4e-16)
    assert conversion("flow", "lpm").apply(np.array([60.0]))[0] == 1000.0
    assert conversion("pressure", "kPa").apply(np.array([0.0980665]))[0] == pytest.approx(1.0)
    assert str(conversion("flow", "L/min")) == "L/min -> mL/s, x 50/3 (back: x 3/50)"
    with pytest.raises(InputError, match="no unit of flow"):
        conversion("flow", "furlong")


@pytest.mark.parametrize("name", ["lab.npy", "lab.npz"])
def test_arrays_are_sent_to_the_import(tmp_path, name):
    path = tmp_path / name
    (np.save if name.endswith("y") else np.savez)(path, np.zeros((50, 3)))
    with pytest.raises(InputError, match=r"this is a NumPy file.*data import"):
        load(path)


def test_matlab_struct_with_its_rate(tmp_path):
    made, path = waveforms(), tmp_path / "lab.mat"
    savemat(path, {"data": {"Paw": made["pressure"], "Flow": made["flow"]}, "fs": RATE})
    imported = import_recording(path, lung="R5C20")
    assert len(imported.breaths) == 4
    assert "50 Hz, of the file" in " ".join(imported.understood)
    with pytest.raises(InputError, match="MATLAB file"):
        load(path)
    assert "data import" in check(path).problems[0].advice
    (tmp_path / "new.mat").write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(100))
    with pytest.raises(InputError, match="-v7"):
        import_recording(tmp_path / "new.mat")


def test_logs_of_a_pvp(tmp_path):
    """Quoted names with blanks, as `log2csv` writes them; the cycle numbers the breaths."""
    made = waveforms(4.0)
    cycle = np.floor(made["t"] / PERIOD)
    out = (made["t"] % PERIOD >= 1.0).astype(float)
    head = (
        "'timestamp', 'pressure', 'flow_out', 'control_in', 'control_out', 'oxygen', 'cycle_number'"
    )
    columns = [made["t"] + 1.6e9, made["pressure"], 0 * out, 20 * (1 - out), out, 0 * out, cycle]
    path = tmp_path / "waveforms.csv"
    np.savetxt(path, np.stack(columns, axis=1), delimiter=",", header=head, comments="")
    imported = import_recording(path, lung="R20C20")
    assert "Layout pvp" in " ".join(imported.understood)
    assert len(imported.breaths) == 4
    np.testing.assert_allclose(imported.breaths.time[:, 1], 0.02, atol=1e-6)
    assert imported.breaths.u_in.max() == 20.0
    assert imported.breaths.flow is None


def test_kaggle_layout_is_read_as_it_is(tmp_path):
    recorded = load(ventbench.example("concealed"))
    imported = import_recording(ventbench.example("concealed"))
    np.testing.assert_array_equal(imported.breaths.pressure, recorded.pressure)
    np.testing.assert_allclose(imported.breaths.time, recorded.time, atol=1e-12)
    np.testing.assert_array_equal(imported.breaths.u_in, recorded.u_in)


def test_respiraworks_by_run_and_test(public_recordings):
    path = public_recordings / "respiraworks_quicklung.parquet"
    imported = import_recording(path, select={"run": "2020-07-31-UFlow-Performance", "test": "4"})
    assert imported.breaths.lung_ids[0] == "R20C20"
    assert len(imported.breaths) >= 7
    assert imported.breaths.flow is not None


def test_runs_of_one_file_begin_before_their_numbers_change(tmp_path):
    time = np.arange(1000) * 0.01
    target = np.where((time % 4) < 1, 30.0, 5.0)
    one = {
        "run": "a day",
        "test": 1,
        "breath": np.repeat([0, 1, 2, 3], [30, 400, 500, 70]),
        "time_step": time,
        "R": 20,
        "C": 50,
        "pressure": time,
        "target": target,
        "flow": np.nan,
        "volume": 10.0 * time,
        "cmd_inh_valve": 0.0,
    }
    table = pd.concat([pd.DataFrame(one), pd.DataFrame(one | {"test": 2, "C": 10})])
    table.to_parquet(tmp_path / "runs.parquet")
    runs = import_runs(tmp_path / "runs.parquet")
    assert {name: breaths.lung_ids[0] for name, breaths in runs.items()} == {
        "a day 1": "R20C50",
        "a day 2": "R20C10",
    }
    breaths = runs["a day 1"]
    # Cut 0.25 s before each breath, so that the steep rise lies within; the stub is left out.
    assert breaths.valid.sum(axis=1).tolist() == [400, 500, 95]
    assert breaths.pressure[1, 0] == pytest.approx(4.05)
    assert breaths.time[:, 0].tolist() == [0.0, 0.0, 0.0]
    assert breaths.flow is None
    assert breaths.volume is not None
    np.testing.assert_array_equal(breaths.u_out[0][breaths.valid[0]], target[5:405] < 17.5)
    assert import_runs(ventbench.example("concealed")) == {}


def test_breaths_from_pressure_alone_and_from_a_rate(tmp_path):
    made = waveforms()
    path = tmp_path / "p.txt"
    path.write_text("\n".join(f"{p:.3f}\t1" for p in made["pressure"]))
    with pytest.raises(InputError, match=r"--map 2=flow; or, if none of them is, --map 2=unused"):
        import_recording(path, columns={"1": "pressure"}, rate=RATE, lung="R20C50")
    columns = {"1": "pressure", "2": "unused"}
    imported = import_recording(path, columns=columns, rate=RATE, lung="R20C50")
    assert len(imported.breaths) == 4
    assert "where pressure rises" in " ".join(imported.understood)
    with pytest.raises(InputError, match="--rate HZ"):
        import_recording(path, columns=columns, lung="R20C50")


def test_breaths_that_a_trigger_recorded_are_split_at_the_gaps(tmp_path):
    """Each begins with the inspiration itself, so that nothing turns inwards in it."""
    made = waveforms(cycles=6.0)
    kept = made["t"] % PERIOD >= 0.1  # the trigger, until which nothing is stored
    path = tmp_path / "triggered.csv"
    pd.DataFrame({name: values[kept] for name, values in made.items()}).to_csv(path, index=False)
    imported = import_recording(path, lung="R20C50", units={"flow": "mL/s"})
    assert len(imported.breaths) == 6
    assert "where the clock leaves a gap" in " ".join(imported.understood)


def test_a_device_that_paused_between_breaths_has_no_triggers(tmp_path):
    made = waveforms(cycles=8.5)
    kept = made["t"] % (2.0 * PERIOD) >= 0.5  # pieces of nearly two breaths
    path = tmp_path / "paused.csv"
    pd.DataFrame({name: values[kept] for name, values in made.items()}).to_csv(path, index=False)
    imported = import_recording(path, lung="R20C50", units={"flow": "mL/s"})
    assert "where flow turns inwards" in " ".join(imported.understood)


def test_a_table_of_one_row_is_refused_without_a_warning(tmp_path):
    path = tmp_path / "row.csv"
    path.write_text("a,b\n1,2\n")
    with pytest.raises(InputError, match="no column is the pressure"):
        import_recording(path, lung="R20C50")


def test_names_behind_the_mark_of_a_comment_as_numpy_writes_them(tmp_path):
    made, path = waveforms(), tmp_path / "savetxt.txt"
    header = "time_s pressure_cmH2O flow_mL_s"
    np.savetxt(path, np.column_stack(list(made.values())), header=header, fmt="%.4f")
    imported = import_recording(path, lung="R20C50")
    assert len(imported.breaths) == 4
    assert imported.breaths.flow is not None
    np.testing.assert_allclose(np.nanmax(imported.breaths.flow), 500.0, rtol=1e-3)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"columns": {"Pow": "pressure"}}, r"no column 'Pow'.*Perhaps 'Paw'"),
        ({"columns": {"Paw": "voltage"}}, "a column may be time"),
        ({}, "--lung R20C50"),
        ({"lung": "R20C50", "units": {"flow": "L/s"}}, r"column Flow: \d+ of \d+ values"),
        ({"lung": "R20C50", "layout": "pvp"}, "no column timestamp"),
        ({"lung": "R20C50", "layout": "none"}, "choose one of kaggle"),
        ({"lung": "R20C50", "invert": ["volume"]}, "no column is volume"),
        ({"lung": "R20C50", "select": {"run": "3"}}, "no column run"),
        ({"lung": "R20C50", "units": {"time": "s"}}, "--time-unit ms"),
    ],
)
def test_messages_say_what_to_do(tmp_path, options, message):
    with pytest.raises(InputError, match=message):
        import_recording(german(tmp_path / "lab.csv"), **options)


def test_blank_pressures_are_refused(tmp_path):
    path = tmp_path / "blank.csv"
    path.write_text("time,Paw\n" + "\n".join(f"{0.02 * k:.2f}," for k in range(200)))
    with pytest.raises(InputError, match="every pressure is blank"):
        import_recording(path, lung="R20C50")
    recorded = load(ventbench.example("concealed")).select([0, 1])
    blank = tmp_path / "public.csv"
    import dataclasses

    write(dataclasses.replace(recorded, pressure=np.full_like(recorded.pressure, np.nan)), blank)
    report = check(blank)
    assert not report.ok
    assert "all 160 pressures are blank" in report.problems[0].what


def test_one_wrong_label_is_one_problem(tmp_path):
    path = tmp_path / "wrong.csv"
    text = ventbench.example("concealed").read_text().splitlines()
    rows = [row.split(",") for row in text]
    place = rows[0].index("R")
    for row in rows[1:]:
        row[place] = "5000"
    path.write_text("\n".join(",".join(row) for row in rows))
    report = check(path)
    assert report.problem_count == 1
    assert "here and in more rows" in report.problems[0].what


def test_the_command_shows_writes_and_reports(tmp_path):
    lab, out = german(tmp_path / "lab.csv"), tmp_path / "out.csv"
    run = CliRunner()
    shown = run.invoke(app, ["import", str(lab), "--lung", "R20C50"])
    assert shown.exit_code == 0, shown.output
    assert "Flow: flow (L/min -> mL/s, x 50/3 (back: x 3/50))" in shown.output
    assert "Nothing was written" in shown.output
    plain = run.invoke(
        app, ["import", str(lab), "--lung", "R20C50", "--out", str(out), "--json", "-"]
    )
    report = json.loads(plain.stdout)
    assert report["units"]["flow"] == {
        "unit": "L/min",
        "to": "mL/s",
        "numerator": 50,
        "denominator": 3,
    }
    assert len(load(out, pad=True)) == report["breaths"] == 4
    bad = run.invoke(app, ["import", str(lab), "--map", "Paw"])
    assert "NAME=VALUE is wanted" in str(bad.exception)
