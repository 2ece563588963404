"""Tables of other shapes: a row a measurement, lists of samples in cells, arrays, BIOPAC, words."""

from __future__ import annotations

import json
import zipfile

import numpy as np
import pandas as pd
import pytest

from tests.recordings.test_forms import CYCLES, FLOW, MADE, NAMED, PRESSURE, TIME, same
from ventbench.base.errors import InputError
from ventbench.recordings.foreign import Imported, import_recording, sizes

EPOCH = 1_690_000_000.0
STAMPS = [f"{x}Z" for x in (EPOCH * 1e3 + 1e3 * TIME).astype("datetime64[ms]")]


def imported(path, **options) -> Imported:
    return import_recording(path, lung="R20C50", **options)


def long_rows() -> pd.DataFrame:
    """Pressure and flow, a row each reading, one after the other in time."""
    return pd.DataFrame(
        {
            "time": np.repeat(TIME, 2),
            "signal": ["Paw", "Flow"] * len(TIME),
            "value": np.stack([PRESSURE, 0.06 * FLOW], axis=1).ravel(),
            "unit": ["cmH2O", "L/min"] * len(TIME),
        }
    )


def influx(blocks: bool) -> str:
    """Annotated CSV of a query, a table a field, each with a header or all under one."""
    annotations = (
        "#group,false,false,true,true,false,false,true,true,true\n"
        "#datatype,string,long,dateTime:RFC3339,dateTime:RFC3339,dateTime:RFC3339,double,string,"
        "string,string\n#default,_result,,,,,,,,\n"
        ",result,table,_start,_stop,_time,_value,_field,_measurement,host\n"
    )
    parts = []
    for k, (field, values) in enumerate({"flow_lpm": 0.06 * FLOW, "paw_cmH2O": PRESSURE}.items()):
        ends = "2023-07-22T04:00:00Z,2023-07-22T05:00:00Z"
        lines = [
            f",,{k},{ends},{stamp},{value:.6f},{field},ventilator,bench7"
            for stamp, value in zip(STAMPS, values, strict=True)
        ]
        parts.append("\n".join(lines))
    return annotations + ("\n\n" + annotations if blocks else "\n").join(parts) + "\n"


@pytest.mark.parametrize("blocks", [False, True])
def test_annotated_csv_of_influx(tmp_path, blocks):
    path = tmp_path / "query.csv"
    path.write_text(influx(blocks))
    found = imported(path)
    same(found)
    assert "_field names it, _value is its value" in " ".join(found.understood)


@pytest.mark.parametrize("order", ["in turn", "one after the other"])
def test_a_long_table_in_every_format(tmp_path, order):
    table = long_rows()
    if order != "in turn":
        table = table.sort_values("signal", kind="stable")
    table.to_csv(tmp_path / "long.csv", index=False)
    table.to_parquet(tmp_path / "long.parquet")
    table.to_json(tmp_path / "long.json", orient="records")
    for name in ("long.csv", "long.parquet", "long.json"):
        same(imported(tmp_path / name))
    other = table.replace({"Paw": "ch1", "Flow": "ch2"})
    other.to_csv(tmp_path / "other.csv", index=False)
    with pytest.raises(InputError, match=r"--map ch[12]=pressure"):
        imported(tmp_path / "other.csv")
    same(imported(tmp_path / "other.csv", columns={"ch1": "pressure", "ch2": "flow"}))


def chunks(size: int = 75) -> list[slice]:
    return [slice(k, k + size) for k in range(0, len(TIME), size)]


@pytest.mark.parametrize("cell", ["{} {}", "[{}, {}]", "{};{}", "{}, {}"])
@pytest.mark.parametrize("clock", ["rate", "dt_ms", "starts", "asked"])
def test_lists_of_samples_in_cells_of_text(tmp_path, cell, clock):
    def listed(values: np.ndarray) -> str:
        opening, between, closing = cell.split("{}")
        return f'"{opening}{between.join(f"{x:.4f}" for x in values)}{closing}"'

    beside = {"rate": ("fs_Hz", 50), "dt_ms": ("dt_ms", 20)}.get(clock, ("mode", 3))
    lines = [f"start,{beside[0]},paw,flow_lpm"]
    for chunk in chunks():
        start = f"{EPOCH * 1e3 + 1e3 * TIME[chunk][0]:.0f}" if clock == "starts" else ""
        lists = listed(PRESSURE[chunk]), listed(0.06 * FLOW[chunk])
        lines.append(",".join([start, str(beside[1]), *lists]))
    path = tmp_path / "packed.csv"
    path.write_text("\n".join(lines) + "\n")
    if clock == "asked":
        with pytest.raises(InputError, match="give it with --rate HZ"):
            imported(path)
    options = {"starts": {"columns": {"start": "time"}}, "asked": {"rate": 50.0}}
    same(imported(path, **options.get(clock, {})), atol=1e-3)


def test_messages_of_lists_in_lines_of_json_and_parquet(tmp_path):
    messages = [
        {"ts": int(EPOCH * 1e3 + 1e3 * TIME[x][0]), "paw": PRESSURE[x], "flow_mL_s": FLOW[x]}
        for x in chunks()
    ]
    path = tmp_path / "log.jsonl"
    dumped = [json.dumps({k: np.asarray(x).tolist() for k, x in m.items()}) for m in messages]
    path.write_text("\n".join(dumped))
    found = imported(path)
    same(found)
    assert "ts counts ms since 1970" in " ".join(found.understood)
    pd.DataFrame(messages).to_parquet(tmp_path / "log.parquet")
    same(imported(tmp_path / "log.parquet"))
    messages[1]["paw"] = messages[1]["paw"][1:]
    pd.DataFrame(messages).to_parquet(tmp_path / "odd.parquet")
    with pytest.raises(InputError, match=r"row 2: column paw lists 74 .* --map paw=unused"):
        imported(tmp_path / "odd.parquet")


@pytest.mark.parametrize("unit", ["s", "ms", "us", "ns"])
def test_the_unit_of_a_clock_since_1970_is_inferred(tmp_path, unit):
    per_second = {"s": 1, "ms": 1e3, "us": 1e6, "ns": 1e9}[unit]
    stamps = (np.round(EPOCH * per_second) + np.round(TIME * per_second)).astype(int).tolist()
    if unit == "s":
        stamps = (EPOCH + TIME).tolist()
    rows = zip(stamps, PRESSURE.tolist(), FLOW.tolist(), strict=True)
    path = tmp_path / "log.jsonl"
    lines = [json.dumps({"ts": t, "paw": p, "flow_mL_s": q}) for t, p, q in rows]
    path.write_text("\n".join(lines))
    same(imported(path))


def test_stamps_in_json(tmp_path):
    path = tmp_path / "log.json"
    path.write_text(json.dumps({"time": STAMPS, "paw": NAMED["paw"], "flow_mL_s": FLOW.tolist()}))
    same(imported(path))


def test_arrays_of_numpy(tmp_path):
    matrix = np.stack([TIME, PRESSURE, FLOW], axis=1)
    np.savez(tmp_path / "named.npz", t=TIME, paw=PRESSURE, flow=FLOW, fs=50.0)
    kinds = [("time", "<f8"), ("paw", "<f4"), ("flow", "<f8")]
    np.save(tmp_path / "fields.npy", np.array(list(map(tuple, matrix)), kinds))
    np.savez_compressed(tmp_path / "rate.npz", paw=PRESSURE, flow=FLOW, fs=50.0)
    for name in ("named.npz", "fields.npy", "rate.npz"):
        same(imported(tmp_path / name))
    for array in (matrix, matrix.T):
        np.save(tmp_path / "plain.npy", array)
        with pytest.raises(InputError, match="--map 2=pressure"):
            imported(tmp_path / "plain.npy")
        roles = {"1": "time", "2": "pressure", "3": "flow"}
        same(imported(tmp_path / "plain.npy", columns=roles))
    np.save(tmp_path / "objects.npy", np.array([{"a": 1}], object))
    with pytest.raises(InputError, match="save arrays of numbers by"):
        imported(tmp_path / "objects.npy")


@pytest.mark.parametrize("packed", [False, True])
def test_arrays_that_unpack_to_gigabytes_are_refused_by_their_headers(tmp_path, packed):
    path = tmp_path / ("big.npz" if packed else "big.npy")
    np.save(tmp_path / "small.npy", np.zeros((30, 3)))
    data = (tmp_path / "small.npy").read_bytes()
    claimed = data.replace(b"(30, 3), }" + b" " * 10, b"(300000000000, 3), }")
    assert claimed != data
    if packed:
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("paw.npy", claimed)
    else:
        path.write_bytes(claimed)
    with pytest.raises(InputError, match=rf"GB, more than the {sizes.LARGEST / 1e9:g} GB"):
        imported(path)


@pytest.mark.parametrize("clock", ["min", "sec", "milliSec", None])
@pytest.mark.parametrize("separator", [",", "\t"])
def test_text_of_biopac(tmp_path, clock, separator):
    lines = [
        *("lung.acq", "20 msec/sample", "2 channels"),
        *("Paw", "cmH2O", "Flow", "L/min"),
        separator.join([clock, "CH1", "CH2", ""] if clock else ["CH1", "CH2", ""]),
        separator.join(["", str(len(TIME)), str(len(TIME)), ""][not clock :]),
    ]
    scale = {"min": 1 / 60, "sec": 1.0, "milliSec": 1e3}.get(clock or "sec", 1.0)
    for t, p, q in zip(scale * TIME, PRESSURE, 0.06 * FLOW, strict=True):
        cells = [f"{t:.9g}", f"{p:.6f}", f"{q:.6f}", ""]
        lines.append(separator.join(cells[not clock :]))
    path = tmp_path / "biopac.txt"
    path.write_text("\n".join(lines) + "\n")
    same(imported(path))


@pytest.mark.parametrize(
    "words", ["open closed", "ON OFF", "True False", "exp insp", "E I", "Exhale Inhale"]
)
def test_a_pair_of_words_is_the_state_of_a_valve(tmp_path, words):
    one, zero = words.split()
    states = np.where(MADE["out"], one, zero).tolist()
    name = "exhalation valve" if one.lower() in ("open", "on", "true") else "phase"
    path = tmp_path / "a.json"
    path.write_text(json.dumps(NAMED | {name: states}))
    pd.DataFrame(NAMED | {name: states}).to_csv(tmp_path / "a.csv", index=False)
    for file in (path, tmp_path / "a.csv"):
        found = imported(file)
        same(found, CYCLES - 1)
        np.testing.assert_array_equal(found.breaths.u_out[0], TIME[:150] >= 1.0)
        assert f"{one} is 1 (open) and {zero} is 0" in " ".join(found.understood)


def test_an_inspiratory_valve_of_words_is_open_or_closed(tmp_path):
    path = tmp_path / "a.json"
    states = np.where(MADE["out"], "closed", "open").tolist()
    path.write_text(json.dumps(NAMED | {"u_in": states}))
    assert set(np.unique(imported(path).breaths.u_in)) == {0.0, 100.0}
