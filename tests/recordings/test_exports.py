"""Exports in the shapes of devices: R and C are those of the lung, or the option is named."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from ventbench.base.errors import InputError
from ventbench.mechanics import identify
from ventbench.recordings.foreign import import_recording
from ventbench.recordings.foreign.cycles import signed_flow

R, C, RATE = 12.0, 45.0, 100.0


def lung(cycles: int = 8) -> pd.DataFrame:
    """Time, s, pressure, cmH2O, flow, L/s, and volume, L, under two pressures in turn."""
    time = np.arange(int(3.0 * cycles * RATE)) / RATE
    pressure, volume = np.zeros_like(time), np.zeros(len(time) + 1)
    target, fine = 5.0, 50
    for k, phase in enumerate(time % 3.0):
        volume[k + 1], pressure[k] = volume[k], target
        for _ in range(fine):
            target += ((20.0 if phase < 0.995 else 5.0) - target) / (0.05 * RATE * fine)
            flow = (target - 5.0 - 1000.0 / C * volume[k + 1]) / R
            volume[k + 1] += flow / (RATE * fine)
    flow = (pressure - 5.0 - 1000.0 / C * volume[:-1]) / R
    noise = np.random.default_rng(0).normal(size=(2, len(time)))
    columns = {"time": time, "paw": pressure + 0.05 * noise[0], "flow": flow + 0.003 * noise[1]}
    return pd.DataFrame(columns | {"volume": volume[:-1]})


MADE = lung()


def csv(path: Path, columns: Mapping[str, object] | pd.DataFrame, **options: object) -> Path:
    pd.DataFrame(columns).to_csv(path, index=False, **options)  # type: ignore[call-overload]
    return path


def check(path: Path, tolerance: float = 0.04, **options: object) -> None:
    imported = import_recording(path, lung="R20C50", **options)  # type: ignore[arg-type]
    match = identify(imported.breaths)[0].match
    assert match.fitted_R == pytest.approx(R, rel=tolerance), imported.understood
    assert match.fitted_C == pytest.approx(C, rel=tolerance)


SLOW = np.repeat(60.0 * MADE.flow[::4].to_numpy(), 4)
VALVE = {"u_in": np.where(MADE.time % 3.0 < 1.0, 50.0, 0.0), "u_out": MADE.time % 3.0 >= 1.0}


@pytest.mark.parametrize("clock", [True, False], ids=["clock", "rate"])
@pytest.mark.parametrize("valve", [{}, VALVE], ids=["", "valve"])
@pytest.mark.parametrize("cells", ["held", "blank"])
def test_a_flow_sensor_that_is_slower_than_the_rows(tmp_path, clock, valve, cells):
    flow = SLOW if cells == "held" else np.where(MADE.index % 4 == 0, SLOW, np.nan)
    columns = {"time_s": MADE.time} if clock else {}
    columns |= {"paw_cmH2O": MADE.paw, "flow_lpm": flow} | valve
    check(csv(tmp_path / "lab.csv", columns), rate=None if clock else RATE)


@pytest.mark.parametrize("options", [{}, {"rate": RATE}], ids=["clock", "rate"])
def test_the_newest_row_first(tmp_path, options):
    back = MADE[::-1]
    columns = {"time_s": back.time, "paw_cmH2O": back.paw, "flow_lpm": 60.0 * back.flow}
    check(csv(tmp_path / "lab.csv", columns), **options)


@pytest.mark.parametrize(
    "stamp",
    [
        lambda time: (1_714_550_400_000_000_000 + np.round(1e9 * time)).astype(np.int64),
        lambda time: [f"{45234.5 + x / 86400.0:.10f}" for x in time],
    ],
    ids=["ns since 1970", "days of a spreadsheet"],
)
def test_clocks_by_their_size(tmp_path, stamp: Callable):
    columns = {"ts": stamp(MADE.time), "paw_cmH2O": MADE.paw, "flow_lpm": 60.0 * MADE.flow}
    check(csv(tmp_path / "lab.csv", columns))


@pytest.mark.parametrize(
    ("unit", "factor"),
    [("bar", 0.000980665), ("cmH2O", 1.0)],
)
@pytest.mark.parametrize(
    ("flow_unit", "flow_factor"), [("cfm", 2.11888), ("sccm", 6e4), ("dL/min", 600.0)]
)
def test_units_of_industry(tmp_path, unit, factor, flow_unit, flow_factor):
    columns = {"Time (s)": MADE.time, f"Paw ({unit})": factor * MADE.paw}
    check(csv(tmp_path / "lab.csv", columns | {f"Flow ({flow_unit})": flow_factor * MADE.flow}))


@pytest.mark.parametrize(
    ("columns", "options"),
    [
        ({"flow": 60.0 * MADE.flow}, {"flow": "L/min"}),
        ({"flow": MADE.flow}, {"flow": "L/s"}),
        ({"flow": 60.0 * MADE.flow, "volume": MADE.volume}, {"flow": "L/min", "volume": "L"}),
        ({"volume": MADE.volume}, {"volume": "L"}),
        ({"flow": 1000.0 * MADE.flow, "paw": 0.0980665 * MADE.paw}, {"pressure": "kPa"}),
        ({"flow (mL/s)": 60.0 * MADE.flow}, {"flow": "L/min"}),
        ({"flow (L/min)": 1000.0 * MADE.flow}, {"flow": "mL/s"}),
        ({"volume (mL)": MADE.volume}, {"volume": "L"}),
        ({"flow_lpm": 60.0 * MADE.flow, "paw (kPa)": MADE.paw}, {"pressure": "cmH2O"}),
    ],
    ids=["L/min", "L/s", "L/min and L", "L", "kPa", "mL/s", "false L/min", "mL", "false kPa"],
)
def test_a_unit_of_sizes_that_no_ventilator_has_is_asked_for(tmp_path, columns, options):
    pressure = {} if "paw (kPa)" in columns else {"paw": MADE.paw}
    path = csv(tmp_path / "lab.csv", {"time": MADE.time} | pressure | columns)
    given: dict[str, str] = {}
    for role, unit in options.items():
        with pytest.raises(
            InputError, match=f"column .*give --{role}-unit {unit} .*, or --{role}-"
        ):
            import_recording(path, lung="R20C50", units=given)
        given |= {role: unit}
    check(path, units=given)


def test_a_unit_that_is_given_is_believed(tmp_path):
    columns = {"time": MADE.time, "paw": MADE.paw, "flow (mL/s)": 60.0 * MADE.flow}
    path = csv(tmp_path / "lab.csv", columns)
    imported = import_recording(path, lung="R20C50", units={"flow": "mL/s"})
    assert any("no ventilator's" in text for text in imported.warnings)


COLUMNS = {"time_s": MADE.time.round(3), "paw_cmH2O": MADE.paw, "flow_lpm": 60.0 * MADE.flow}
UNSIGNED = {"flow_lpm": 60.0 * MADE.flow.abs()}


@pytest.mark.parametrize(
    "further",
    [{}, {"volume_L": MADE.volume}, {"u_out": VALVE["u_out"]}],
    ids=["", "volume", "valve"],
)
def test_a_flow_without_a_sign_turns_outwards_as_pressure_falls(tmp_path, further):
    check(csv(tmp_path / "lab.csv", COLUMNS | UNSIGNED | further))
    inwards = {"flow_lpm": 60.0 * MADE.flow.clip(lower=0.0)}
    one_way = import_recording(csv(tmp_path / "one.csv", COLUMNS | inwards), lung="R20C50")
    assert one_way.breaths.flow is not None
    assert np.nanmin(one_way.breaths.flow) >= 0.0


@pytest.mark.parametrize("late", [0.25, 0.5])
def test_pressure_and_flow_in_rows_of_their_own(tmp_path, late):
    """As two topics of a log or two channels of a database come: never at the same moment."""
    read_at = MADE.time + late / RATE
    rows = pd.concat(
        [
            pd.DataFrame({"time_s": MADE.time, "paw": MADE.paw}),
            pd.DataFrame({"time_s": read_at, "flow_Lps": np.interp(read_at, MADE.time, MADE.flow)}),
        ]
    ).sort_values("time_s")
    path = csv(tmp_path / "topics.csv", rows)
    check(path)
    understood = import_recording(path, lung="R20C50").understood
    assert any("short blanks in the others are interpolated" in x for x in understood)


def test_rows_out_of_order_are_sorted_by_their_times(tmp_path):
    rng, frame = np.random.default_rng(0), pd.DataFrame(COLUMNS)
    swapped = np.arange(len(frame)) + np.where(np.arange(len(frame)) % 40 == 7, 1.5, 0.0)
    check(csv(tmp_path / "swapped.csv", frame.iloc[np.argsort(swapped)]))
    order = rng.permutation(len(frame))
    check(csv(tmp_path / "shuffled.csv", frame.iloc[order]))
    breaths = frame.assign(breath=frame.time_s // 3.0, time_s=frame.time_s % 3.0)
    check(csv(tmp_path / "breaths.csv", breaths.iloc[order]))
    jittered = breaths.time_s + 1e-4 * rng.uniform(size=len(frame))
    jittered -= np.repeat(jittered[::300].to_numpy(), 300)
    anew = import_recording(
        csv(tmp_path / "anew.csv", breaths.drop(columns="breath").assign(time_s=jittered)),
        lung="R20C50",
    )
    assert not any("order of time" in text for text in anew.understood)


@pytest.mark.parametrize("title", ["{}[{}] ({})", "{}_{}_{}", "{} {} {}"])
def test_a_row_a_breath_with_a_column_a_sample(tmp_path, title):
    signals = {("Paw", "cmH2O"): MADE.paw, ("Flow", "L/min"): 60.0 * MADE.flow}
    table: dict[str, object] = {"breath": np.arange(8)}
    for (name, unit), values in signals.items():
        samples = values.to_numpy().reshape(8, 300)
        table |= {title.format(name, k, unit): samples[:, k] for k in range(300)}
    path = csv(tmp_path / "lab.csv", table)
    with pytest.raises(InputError, match="give it with --rate"):
        import_recording(path, lung="R20C50")
    check(path, rate=RATE)


def test_more_rows_of_breaths_than_columns_of_samples(tmp_path):
    table: dict[str, object] = {"breath": np.arange(80)}
    for name, values in (("Paw", MADE.paw), ("Flow", 60.0 * MADE.flow)):
        samples = np.tile(values.to_numpy().reshape(8, 300)[:, ::5], (10, 1))
        table |= {
            f"{name}_{k} [{'L/min' if name == 'Flow' else 'cmH2O'}]": x
            for k, x in enumerate(samples.T)
        }
    check(csv(tmp_path / "lab.csv", table), rate=RATE / 5)


def test_headers_of_several_lines(tmp_path):
    path = tmp_path / "lab.csv"
    rows = pd.DataFrame(COLUMNS).to_csv(index=False, header=False, sep=";", decimal=",")
    path.write_text('sep=;\n"Zeit\n[s]";"Druck\nAtemweg\n[cmH2O]";"Flow\n[L/min]"\n' + rows)
    check(path)
    assert "first row in line 7." in import_recording(path, lung="R20C50").understood[0]


def parts() -> list[list[list[float]]]:
    """Rows of time, s, pressure, cmH2O, and flow, L/min, of half a second each."""
    rows = pd.DataFrame(COLUMNS).to_numpy().tolist()
    return [rows[k : k + 50] for k in range(0, len(rows), 50)]


NAMES = list(COLUMNS)
BY_NAME = [[dict(zip(NAMES, row, strict=True)) for row in part] for part in parts()]


@pytest.mark.parametrize(
    "lines",
    [
        BY_NAME,
        [{"number": k, "samples": part} for k, part in enumerate(BY_NAME)],
        [NAMES, *(row for part in parts() for row in part)],
        [{"columns": NAMES, "rows": part} for part in parts()],
    ],
    ids=["arrays of records", "records of records", "names and rows", "tables"],
)
def test_lines_of_json_with_several_rows(tmp_path, lines):
    (tmp_path / "lab.jsonl").write_text("\n".join(map(json.dumps, lines)))
    check(tmp_path / "lab.jsonl")


def test_the_sheet_with_most_rows(tmp_path):
    with pd.ExcelWriter(tmp_path / "lab.xlsx") as book:
        pd.DataFrame({"device": ["bench"]}).to_excel(book, sheet_name="Info", index=False)
        pd.DataFrame(COLUMNS).to_excel(book, sheet_name="Data", index=False)
    check(tmp_path / "lab.xlsx")


def test_a_time_behind_readings_and_the_names_of_R(tmp_path):
    rows = list(zip(*COLUMNS.values(), strict=True))
    (tmp_path / "lab.txt").write_text(
        "\n".join(
            f"vent,bed=a paw_cmH2O={p:.3f},flow_lpm={q:.3f} {1714550400000000000 + round(1e9 * t)}"
            for t, p, q in rows
        )
    )
    check(tmp_path / "lab.txt")
    names = " ".join(f'"{name}"' for name in COLUMNS) + "\n"
    cells = "\n".join(f'"{k}" {t} {p:.3f} {q:.3f}' for k, (t, p, q) in enumerate(rows, 1))
    (tmp_path / "r.txt").write_text(names + cells)
    check(tmp_path / "r.txt")


def test_points_of_thousands_beside_decimal_commas(tmp_path):
    columns = {
        "Zeit (ms)": [f"{1000 * x:,.0f}".replace(",", ".") for x in MADE.time],
        "Druck (cmH2O)": [f"{x:.2f}".replace(".", ",") for x in MADE.paw],
        "Volumen (ml)": [f"{1000 * x:.1f}".replace(".", ",") for x in MADE.volume],
    }
    check(csv(tmp_path / "lab.csv", columns, sep=";"))


def test_times_in_the_index_of_a_table(tmp_path):
    index = pd.Timestamp("2024-05-01 10:00") + pd.to_timedelta(MADE.time, unit="s")
    frame = pd.DataFrame({"paw_cmH2O": MADE.paw, "flow_lpm": 60.0 * MADE.flow})
    frame.set_index(pd.Index(index)).to_parquet(tmp_path / "lab.parquet")
    check(tmp_path / "lab.parquet")


def test_signals_with_their_units_in_json(tmp_path):
    signals = {
        "paw": {"unit": "cmH2O", "data": MADE.paw.tolist()},
        "flow": {"unit": "L/min", "data": (60.0 * MADE.flow).tolist()},
    }
    (tmp_path / "lab.json").write_text(json.dumps({"fs": RATE, "signals": signals}))
    check(tmp_path / "lab.json")


def test_a_flow_that_is_no_flow_without_its_sign_stays_as_it_was() -> None:
    """A sensor of one direction: nothing of it may be turned, not even on the way."""
    time = np.arange(0.0, 30.0, 0.02)
    phase = time % 3.0
    pressure = 5.0 + np.where(phase < 1.0, 15.0 * phase, 15.0 * np.exp(-(phase - 1.0) / 0.3))
    inward = np.where(phase < 1.0, 500.0, 0.0)
    there_and_back = np.where(phase < 1.0, 500.0, 500.0 / 0.3 * np.exp(-(phase - 1.0) / 0.3))
    there_and_back[np.abs(phase - 1.0) < 0.015] = 0.0  # as it turns
    for flow, is_turned in ((inward, False), (there_and_back, True)):
        given = flow.copy()
        flow.setflags(write=False)
        signed = signed_flow("x.csv", time, pressure, flow)
        assert (signed is not None) is is_turned
        np.testing.assert_array_equal(flow, given)
        if signed is not None:
            np.testing.assert_array_equal(np.abs(signed), given)
            whole = time > 3.0  # the first breath may have begun before
            assert (signed[whole & (phase > 1.1) & (phase < 2.9)] < 0.0).all()
            assert (signed[whole & (phase > 0.35) & (phase < 0.95)] > 0.0).all()
