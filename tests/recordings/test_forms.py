"""Forms of files beside plain tables: logs, exports with header blocks, MCAP, bags, clocks."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import ventbench
from ventbench.base.errors import InputError
from ventbench.cli.data import app
from ventbench.recordings import load
from ventbench.recordings.foreign import Imported, import_recording

RATE, PERIOD, CYCLES = 50.0, 3.0, 4


def lung() -> dict[str, np.ndarray]:
    """Time, s, pressure, cmH2O, flow, mL/s, and whether the expiratory valve is open."""
    time = np.arange(0.0, (CYCLES + 0.5) * PERIOD, 1.0 / RATE)
    phase = time % PERIOD
    out = phase >= 1.0
    flow = np.where(out, -700.0 * np.exp(-(phase - 1.0) / 0.4), 500.0) * (phase >= 0.1)
    pressure = 5.0 + np.where(out, 18.0 * np.exp(-(phase - 1.0) / 0.4), 10.0 + 8.0 * phase)
    noise = np.random.default_rng(0).normal(size=(2, len(time)))
    flow = flow + 2.0 * noise[1]
    return {"time": time, "pressure": pressure + 0.05 * noise[0], "flow": flow, "out": out}


MADE = lung()


def same(imported: Imported, cycles: int = CYCLES, atol: float = 1e-3) -> None:
    """The breaths are those of the lung."""
    breaths = imported.breaths
    assert len(breaths) == cycles, imported.understood
    assert breaths.flow is not None
    for k in range(cycles):
        valid = breaths.valid[k]
        at = int(np.argmin(np.abs(MADE["pressure"] - breaths.pressure[k, 10]))) - 10
        some = slice(at, at + int(valid.sum()))
        np.testing.assert_allclose(breaths.pressure[k][valid], MADE["pressure"][some], atol=atol)
        np.testing.assert_allclose(breaths.flow[k][valid], MADE["flow"][some], atol=30 * atol)
        np.testing.assert_allclose(breaths.time[k][valid], MADE["time"][: valid.sum()], atol=1e-6)


def rows(*columns: np.ndarray) -> list[list[float]]:
    return np.stack(columns, axis=1).tolist()


def text(path: Path, above: str, *columns: np.ndarray, separator: str = "\t") -> Path:
    lines = [separator.join(f"{x:.6f}" for x in row) for row in rows(*columns)]
    path.write_text(above + "\n".join(lines) + "\n")
    return path


TIME, PRESSURE, FLOW = MADE["time"], MADE["pressure"], MADE["flow"]
WORDS = np.where(MADE["out"], "OPEN", "HELD").tolist()
NAMED = {
    "t_ms": (1000 * TIME).tolist(),
    "paw": PRESSURE.tolist(),
    "flow_lpm": (0.06 * FLOW).tolist(),
}


@pytest.mark.parametrize(
    "content",
    [
        {"meta": {"device": "X", "rates": [1, 2, 3]}, "data": NAMED},
        [dict(zip(NAMED, row, strict=True)) for row in zip(*NAMED.values(), strict=True)],
        {
            "log": {
                "fields": list(NAMED),
                "rows": list(map(list, zip(*NAMED.values(), strict=True))),
            }
        },
        [
            {"t_ms": t, "sensors": {"paw": p, "flow_lpm": q}}
            for t, p, q in zip(*NAMED.values(), strict=True)
        ],
    ],
    ids=["columns", "records", "rows", "nested"],
)
def test_json_of_every_shape(tmp_path, content):
    path = tmp_path / "log.json"
    path.write_text(json.dumps(content))
    same(import_recording(path, lung="R20C50"))
    if isinstance(content, list):
        path.write_text("\n".join(map(json.dumps, content)))
        same(import_recording(path, lung="R20C50"))


def test_json_without_a_table_is_refused(tmp_path):
    path = tmp_path / "log.json"
    path.write_text('{"a": 1, "b": [1, 2, 3]}')
    with pytest.raises(InputError, match="JSON without a table"):
        import_recording(path, lung="R20C50")


def test_words_of_a_valve_are_mapped_or_asked_for(tmp_path):
    path = tmp_path / "log.json"
    path.write_text(json.dumps(NAMED | {"exp valve": WORDS}))
    with pytest.raises(InputError, match="--map-values OPEN=1,HELD=0"):
        import_recording(path, lung="R20C50")
    imported = import_recording(path, lung="R20C50", words={"open": 1, "held": 0})
    same(imported, CYCLES - 1)  # the first begins with the recording, perhaps later than its valve
    np.testing.assert_array_equal(imported.breaths.u_out[0], TIME[:150] >= 1.0)
    asked = ["import", str(path), "--lung", "R20C50", "--map-values", "open=1,held=0"]
    assert CliRunner().invoke(app, asked).exit_code == 0


BLOCKS = {
    "titles in a row": "Interval=\t0.02 s\nExcelDateTime=\t4.4e4\nChannelTitle=\tPaw\tFlow\n"
    "Range=\t100\t10\nUnitName=\tcmH2O\tmL/s\n",
    "a block of settings": "Device\tX7\nSerial no.\t12\nPEEP\t5\tcmH2O\nRate\t20\t1/min\n\n"
    "Time (s)\tPaw (cmH2O)\tFlow (mL/s)\n",
    "names and units in two rows": "Export 7\nTime\tAirway Pressure\tFlow\ns\tcmH2O\tmL/s\n",
    "comments": "# made by X\n# fs = 50\nTime_s\tPaw_cmH2O\tFlow_mL_s\n",
    "a lung simulator": "Breath file 3\nTime [s]\tAirway Pressure [cmH2O]\tTotal Flow [mL/s]\n",
}


@pytest.mark.parametrize("block", BLOCKS)
def test_text_below_a_block_of_header_lines(tmp_path, block):
    path = text(tmp_path / "a.txt", BLOCKS[block], TIME, PRESSURE, FLOW)
    same(import_recording(path, lung="R20C50"))


def test_two_one_way_flows_are_one(tmp_path):
    inward, outward = np.maximum(FLOW, 0.0), np.maximum(-FLOW, 0.0)
    for sign in (1.0, -1.0):
        columns = (TIME, PRESSURE, 0.06 * inward, sign * 0.06 * outward)
        names = "time,paw,flow_insp_lpm,flow_exp_lpm\n"
        same(
            import_recording(
                text(tmp_path / "a.csv", names, *columns, separator=","), lung="R20C50"
            )
        )
    path = text(tmp_path / "b.csv", "time,paw,flow_insp_lpm\n", *columns[:3], separator=",")
    with pytest.raises(InputError, match="--map flow_insp_lpm=flow"):
        import_recording(path, lung="R20C50")


def test_mcap(tmp_path):
    """Messages in JSON, a topic of both or one each."""
    from mcap.writer import Writer

    for topics in ({"/breath": ("pressure", "flow")}, {"/airway": ("pressure",), "/v": ("flow",)}):
        path = tmp_path / "a.mcap"
        with open(path, "wb") as stream:
            writer = Writer(stream)
            writer.start()
            schema = writer.register_schema("sample", "jsonschema", b"{}")
            channels = {topic: writer.register_channel(topic, "json", schema) for topic in topics}
            for k, time in enumerate(TIME):
                for topic, names in topics.items():
                    data = json.dumps({name: MADE[name][k] for name in names}).encode()
                    at = round(1e9 * time)
                    writer.add_message(channels[topic], at, data, at)
            writer.finish()
        same(import_recording(path, lung="R20C50"))


def test_a_bag_of_ros(tmp_path):
    pytest.importorskip("rosbags")
    from rosbags.rosbag2 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.LATEST)
    kind = store.types["std_msgs/msg/Float64"]
    with Writer(tmp_path / "bag", version=9) as writer:
        topics = {"/airway/pressure": PRESSURE, "/airway/flow": FLOW}
        opened = {t: writer.add_connection(t, kind.__msgtype__, typestore=store) for t in topics}
        for k, time in enumerate(TIME):
            for topic, values in topics.items():
                data = store.serialize_cdr(kind(data=float(values[k])), kind.__msgtype__)
                writer.write(opened[topic], round(1e9 * time), data)
    same(import_recording(tmp_path / "bag", lung="R20C50"))


def test_clocks_that_wrap_or_begin_anew(tmp_path):
    ms = np.round(1000 * TIME) + 60_000
    path = text(tmp_path / "a.csv", "millis,paw,flow\n", ms % 65536, PRESSURE, FLOW, separator=",")
    imported = import_recording(path, lung="R20C50")
    same(imported)
    assert "The clock wraps in line 279 (at 65536)" in " ".join(imported.understood)
    anew = np.where(TIME < 6.5, ms, ms - ms[np.searchsorted(TIME, 6.5)])
    path = text(tmp_path / "b.csv", "millis,paw,flow\n", anew, PRESSURE, FLOW, separator=",")
    imported = import_recording(path, lung="R20C50")
    assert len(imported.breaths) == CYCLES - 1
    assert "The clock begins anew in line 327" in " ".join(imported.understood)


def test_a_rounded_clock_tells_no_rate(tmp_path):
    path = text(
        tmp_path / "a.csv", "time,paw,flow\n", np.floor(TIME), PRESSURE, FLOW, separator=","
    )
    with pytest.raises(InputError, match="which such a clock does not tell"):
        import_recording(path, lung="R20C50")


@pytest.mark.parametrize("clock", [True, False])
def test_rows_that_are_there_twice(tmp_path, clock):
    at = np.sort(np.append(np.arange(len(TIME)), np.random.default_rng(1).permutation(600)[:20]))
    names = "time,paw,flow\n" if clock else "paw,flow\n"
    columns = (TIME[at], PRESSURE[at], FLOW[at])[0 if clock else 1 :]
    path = text(tmp_path / "a.csv", names, *columns, separator=",")
    imported = import_recording(path, lung="R20C50", rate=None if clock else RATE)
    same(imported)
    assert "20 rows that repeat the row before" in " ".join(imported.understood)


def test_a_missing_value_by_name(tmp_path):
    pressure = PRESSURE.copy()
    pressure[[100, 101, 102, 103, 104]] = 17.0
    path = text(tmp_path / "a.csv", "time,paw,flow\n", TIME, pressure, FLOW, separator=",")
    imported = import_recording(path, lung="R20C50", missing=[17.0])
    assert int(np.isnan(imported.breaths.pressure[imported.breaths.valid]).sum()) == 5
    assert "are 17, which stands for a missing value: lines 102, 103" in imported.warnings[0]


def test_a_submission_of_the_competition_is_joined_by_row():
    recorded = load(ventbench.example("concealed"))
    made = recorded.to_frame()[["id", "pressure"]].sample(frac=1.0, random_state=0)
    from ventbench.recordings.read import simulated_pressures

    table = {name: np.asarray(made[name]) for name in made}
    answers = simulated_pressures(table, "submission.csv", recorded)
    np.testing.assert_array_equal(answers[recorded.valid], recorded.pressure[recorded.valid])
    with pytest.raises(InputError, match="rows of the recording"):
        simulated_pressures({k: x[:-1] for k, x in table.items()}, "submission.csv", recorded)
