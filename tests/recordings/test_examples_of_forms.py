"""One small file of every form, as a stranger would export it: the same lung comes out of each.

Made for this project: R 20 cmH2O/(L/s), C 50 mL/cmH2O, pressure control of 14 above 6 cmH2O, cycles
of 3 s at 50 Hz, noise of 0.05 cmH2O and 3 mL/s.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from ventbench.base.errors import InputError
from ventbench.cli.data import app
from ventbench.recordings import load
from ventbench.recordings.foreign import Imported, import_recording
from ventbench.recordings.foreign.formats import read_table
from ventbench.recordings.foreign.layouts import LAYOUTS
from ventbench.recordings.foreign.tables import _TEXTS as TEXTS
from ventbench.recordings.read import simulated_pressures
from ventbench.recordings.sources import _REFUSED as REFUSED

FORMS = Path(__file__).parent / "forms"

#: What is said of each, and those that have no flow into the lung.
SAID = {
    "biopac.txt.gz": "cells separated by ','",
    "cp1251.csv.gz": "Text (cp1251)",
    "cp1254.csv.gz": "Text (cp1254)",
    "gb18030.csv.gz": "Text (gb18030)",
    "influx.csv.gz": "A row a measurement",
    "kaggle.csv.gz": "Layout kaggle",
    "labchart.txt.gz": "Names stand in a line of titles",
    "labview.lvm.gz": "first row in line 16",
    "lung_simulator.txt.gz": "by the column that numbers them",
    "log.txt.gz": "readings behind names (3 other lines)",
    "markdown.md.gz": "cells separated by '|'",
    "mvm.json.gz": "Layout mvm",
    "names_and_units_in_rows.csv.gz": "Text (Latin-1)",
    "nested_records.json.gz": "ts counts ms since 1970",
    "one_way_flows.csv.gz": "where flow turns inwards",
    "puritan_bennett.csv.gz": "breaths between BS and BE (Puritan Bennett 840 and 980)",
    "pvp.csv.gz": "Layout pvp",
    "respiraworks.parquet": "Layout respiraworks",
    "ros_bag": "ROS bag with",
    "rows_as_columns.csv.gz": "cells of rows",
    "serial_monitor.log.gz": "Sampling interval 20 ms (median)",
    "servo.txt.gz": "Layout servo",
    "session.mcap": "Layout session",
    "signals_and_rate.json.gz": "Sampling rate 50 Hz, of the file",
    "units_in_cells.csv.gz": "cells separated by ';', decimal ','",
    "valve_words.csv.gz": "open is 1 (open) and closed is 0",
}
NO_FLOW = ("kaggle.csv.gz", "pvp.csv.gz")


def lung(imported: Imported) -> np.ndarray:
    """R, C and PEEP by least squares: pressure is R flow + volume / C + PEEP."""
    rows = []
    breaths = imported.breaths
    for k, valid in enumerate(breaths.valid):
        flow = 1e-3 * np.asarray(breaths.flow)[k][valid]
        steps = np.diff(breaths.time[k][valid])
        volume = np.append(0.0, np.cumsum((flow[1:] + flow[:-1]) / 2 * steps))
        columns = (flow, 1e3 * volume, np.ones_like(flow), breaths.pressure[k][valid])
        rows.append(np.stack(columns, axis=1))
    *inputs, output = np.concatenate(rows).T
    r, elastance, peep = np.linalg.lstsq(np.stack(inputs, axis=1), output, rcond=None)[0]
    return np.array([r, 1.0 / elastance, peep])


def test_every_form_has_its_example() -> None:
    there = {path.name for path in FORMS.iterdir()}
    assert there == {*SAID, "submission.csv.gz"}
    examples = {name.partition(".")[0] for name in there}
    assert {*LAYOUTS, *TEXTS["below"], *TEXTS["between"]} <= examples


@pytest.mark.parametrize("name", SAID)
def test_the_lung_comes_out(name: str) -> None:
    if name == "ros_bag":
        pytest.importorskip("rosbags")
    if name == "session.mcap":
        pytest.importorskip("mcap")
    imported = import_recording(FORMS / name, lung="R20C50")
    assert SAID[name] in " ".join(imported.understood)
    assert len(imported.breaths) >= 3
    inside = imported.breaths.valid[:, 1:] & imported.breaths.valid[:, :-1]
    np.testing.assert_allclose(np.diff(imported.breaths.time)[inside], 0.02, atol=1e-6)
    assert imported.warnings == ()
    if name in NO_FLOW:
        assert imported.breaths.flow is None
        top = np.nanquantile(imported.breaths.pressure, [0.02, 0.98])
        np.testing.assert_allclose(top, [6.0, 20.0], atol=0.3)
    else:
        # A breath that a number or a lead cuts off its onset begins with some volume already.
        np.testing.assert_allclose(lung(imported), [20.0, 50.0, 6.0], rtol=0.1)


def test_a_submission_is_sent_to_its_recording() -> None:
    with pytest.raises(InputError, match=r"diagnose the recording with --simulator .*submission"):
        import_recording(FORMS / "submission.csv.gz", lung="R20C50")
    recorded = load(FORMS / "kaggle.csv.gz")
    table = read_table(FORMS / "submission.csv.gz").columns
    answers = simulated_pressures(table, "submission.csv.gz", recorded)
    np.testing.assert_array_equal(answers[recorded.valid], recorded.pressure[recorded.valid])


@pytest.mark.parametrize("name", sorted({*SAID} - {"kaggle.csv.gz"}))
def test_what_reads_only_the_schema_names_the_import(name: str) -> None:
    with pytest.raises(InputError, match=r"`ventbench data\s+import"):
        load(FORMS / name)


def text(tmp_path: Path, content: str, encoding: str = "utf-8") -> Path:
    path = tmp_path / "lab.txt"
    path.write_bytes(content.encode(encoding))
    return path


def waves() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time, s, pressure, cmH2O, and flow, L/min, of the examples."""
    columns = read_table(FORMS / "gb18030.csv.gz").columns.values()
    time, pressure, flow = (np.asarray(values) for values in columns)
    return time, pressure, flow


def lines(form: str) -> str:
    """Rows of the examples, each in a form."""
    return "\n".join(form.format(*row) for row in zip(*waves(), strict=True))


@pytest.mark.parametrize(
    ("above", "form"),
    [
        ("% by a program\n%   time[s]   paw[cmH2O]   flow[L/min]\n", "{:9.2f} {:9.3f} {:9.3f}"),
        ("Time (sec)  Airway Pressure (cmH2O)  Air Flow (L/min)\n", "{}  {}  {}"),
        ("Temps;Pression voies aériennes;Débit\n(s);(cmH2O);(L/min)\n", "{};{};{}"),
        ("Tiempo (s);Presión vía aérea (cmH2O);Flujo (L/min)\n", "{};{};{}"),
        ("Tempo (s);Pressão nas vias aéreas (cmH2O);Fluxo (L/min)\n", "{};{};{}"),
        ("Tijd (s);Luchtwegdruk (cmH2O);Flow (L/min)\n", "{};{};{}"),
        ("시간(s),압력(cmH2O),유량(L/min)\n", "{},{},{}"),
        ("t,paw,paw_unit,flow,flow_unit\n", "{},{},cmH2O,{},L/min"),
        ("", "time_s={} paw={} flow_lpm={}"),
        ("", "INFO:vent: t={} paw={} flow_lpm={} ok"),
        ("", "t: {} s, paw: {} cmH2O, flow: {} L/min (ok)"),
        ("", "[vent] t[s]={}; paw[cmH2O]={}; flow[L/min]={}"),
        ("t paw flow\n", "{}s {}cmH2O {}L/min"),
        ("t,paw,flow\n", '"{} s","{} cmH2O","{} L/min"'),
        (" t | paw | flow_lpm \n---+-----+----------\n", " {} | {} | {}"),
        ("+--+--+--+\n| t | paw | flow_lpm |\n+==+==+==+\n", "| {} | {} | {} |\n+--+--+--+"),
        ("ZAMAN (sn);BASINÇ (cmH2O);AKIŞ (L/dk)\n", "{};{};{}"),
    ],
)
def test_headers_of_further_kinds(tmp_path: Path, above: str, form: str) -> None:
    imported = import_recording(text(tmp_path, above + lines(form)), lung="R20C50")
    np.testing.assert_allclose(lung(imported), [20.0, 50.0, 6.0], rtol=0.05)


def test_flow_in_cubic_metres(tmp_path: Path) -> None:
    time, pressure, flow = waves()
    rows = zip(time, 98.0665 * pressure, flow / 60_000.0, strict=True)
    content = "time (s),airway pressure (Pa),flow (m3/s)\n" + "\n".join(
        f"{t:.2f},{p:.1f},{q:.9f}" for t, p, q in rows
    )
    imported = import_recording(text(tmp_path, content), lung="R20C50")
    np.testing.assert_allclose(lung(imported), [20.0, 50.0, 6.0], rtol=0.05)


def test_messages_of_a_broker(tmp_path: Path) -> None:
    rows = ('{{"topic": "vent/paw", "ts": {0}, "payload": {1}}}', '{{"topic": "vent/flow_lpm", ')
    form = rows[0] + "\n" + rows[1] + '"ts": {0}, "payload": {2}}}'
    imported = import_recording(text(tmp_path, lines(form)), lung="R20C50")
    np.testing.assert_allclose(lung(imported), [20.0, 50.0, 6.0], rtol=0.05)


@pytest.mark.parametrize(
    ("content", "options"),
    [
        ("", ["2=pressure", "1=time", "3=flow"]),
        ("{} words that stand above some columns of numbers\n", ["2=pressure", "1=time", "3=flow"]),
    ],
)
def test_columns_without_names_are_asked_for_by_what_they_hold(
    tmp_path: Path, content: str, options: list[str]
) -> None:
    """Each refusal names an option; with all of them the file is read."""
    path, columns = text(tmp_path, content + lines("{} {} {}")), dict[str, str]()
    for option in options:
        with pytest.raises(InputError, match=rf"--map {option}\b") as refused:
            import_recording(path, lung="R20C50", columns=columns)
        assert len(str(refused.value).splitlines()) == 1
        name, role = option.split("=")
        columns[name] = role
    imported = import_recording(path, lung="R20C50", columns=columns, units={"flow": "L/min"})
    np.testing.assert_allclose(lung(imported), [20.0, 50.0, 6.0], rtol=0.05)


def test_stamps_of_a_serial_monitor(tmp_path: Path) -> None:
    time, pressure, flow = waves()
    content = "\n".join(
        f"10:{int(t // 60):02}:{t % 60:06.3f} -> {p:.3f},{q:.3f}"
        for t, p, q in zip(time, pressure, flow, strict=True)
    )
    columns = {"1": "time", "2": "pressure", "3": "flow"}
    path, units = text(tmp_path, content), {"flow": "L/min"}
    imported = import_recording(path, lung="R20C50", columns=columns, units=units)
    np.testing.assert_allclose(lung(imported), [20.0, 50.0, 6.0], rtol=0.05)


@pytest.mark.parametrize("orient", ["columns", "index", "records", "split"])
def test_json_as_pandas_writes_it(tmp_path: Path, orient: Any) -> None:
    names = ("t", "paw", "flow_lpm")
    path = tmp_path / "lab.json"
    pd.DataFrame(dict(zip(names, waves(), strict=True))).to_json(path, orient=orient)
    imported = import_recording(path, lung="R20C50")
    np.testing.assert_allclose(lung(imported), [20.0, 50.0, 6.0], rtol=0.05)


def test_text_of_korea_that_is_not_utf_8(tmp_path: Path) -> None:
    content = "시간(s),압력(cmH2O),유량(L/min)\n" + lines("{},{},{}")
    imported = import_recording(text(tmp_path, content, "cp949"), lung="R20C50")
    assert "Text (cp949)" in imported.understood[0]
    np.testing.assert_allclose(lung(imported), [20.0, 50.0, 6.0], rtol=0.05)


def test_decimal_commas_between_commas_are_refused(tmp_path: Path) -> None:
    content = "Time,Paw,Flow\n" + lines("{},{},{}").replace(",", ";").replace(".", ",")
    with pytest.raises(InputError, match=r"6 cells stand below 3 names.*semicolons"):
        import_recording(text(tmp_path, content.replace(";", ",")), lung="R20C50")


@pytest.mark.parametrize("form", ["{:.2f} paw={} flow_lpm={}", "vent {} paw={} flow_lpm={}"])
def test_a_log_without_a_clock_asks_for_it(tmp_path: Path, form: str) -> None:
    path = text(tmp_path, lines(form))
    with pytest.raises(InputError, match=r"--map (row|NAME)=time, or .* --rate HZ"):
        import_recording(path, lung="R20C50")
    imported = import_recording(path, lung="R20C50", rate=50.0)
    np.testing.assert_allclose(lung(imported), [20.0, 50.0, 6.0], rtol=0.05)


@pytest.mark.parametrize("header", ["t,paw (cmH2O),flow (L/min)", "t,paw,flow"])
def test_units_that_contradict_each_other_are_refused(tmp_path: Path, header: str) -> None:
    content = f"{header}\n" + lines("{} s,{} mbar,{} L/min").replace("mbar", "kPa", 3)
    with pytest.raises(InputError, match=r"paw is in .*kPa, mbar; save it in one unit"):
        import_recording(text(tmp_path, content), lung="R20C50")


@pytest.mark.parametrize("begins", REFUSED)
def test_what_holds_no_table_is_refused_in_one_line(tmp_path: Path, begins: str) -> None:
    path = tmp_path / "lab.dat"
    path.write_bytes(begins.encode("latin-1") + bytes(range(256)))
    for read in (import_recording, load):
        with pytest.raises(InputError, match=r"this is .*\. (Save|Export|Unpack) ") as refused:
            read(path)
        assert len(str(refused.value).splitlines()) == 1


def test_markup_is_no_table(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"XML or HTML\. Save the table in it as CSV"):
        import_recording(text(tmp_path, "<?xml version='1.0'?><s t='0' p='1'/>"), lung="R20C50")


def test_many_columns_are_counted(tmp_path: Path) -> None:
    content = "\n".join(",".join(str(k + row) for k in range(300)) for row in range(50))
    with pytest.raises(InputError, match=r"19, 20 and 280 more\. Say which"):
        import_recording(text(tmp_path, content), lung="R20C50")


def test_an_example_is_imported_by_the_command(tmp_path: Path) -> None:
    out = tmp_path / "out.csv"
    arguments = ["import", str(FORMS / "servo.txt.gz"), "--lung", "R20C50", "--out", str(out)]
    ended = CliRunner().invoke(app, arguments)
    assert ended.exit_code == 0, ended.output
    assert re.search("wrote 3 breaths", ended.output)
    assert len(load(out, pad=True)) == 3
