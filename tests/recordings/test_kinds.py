"""Kinds of files that laboratories have: the same breaths come out, or the way out is named."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from ventbench.base.errors import InputError
from ventbench.cli.data import app
from ventbench.mechanics import identify
from ventbench.recordings import (
    check,
    check_roles,
    find_saturation,
    load,
    make_breaths,
    require_roles,
    write,
)
from ventbench.recordings.foreign import import_recording

R, C, PEEP, RATE, PERIOD = 12.0, 40.0, 5.0, 100.0, 3.0
LABEL = "R12C40"


def lung(cycles: float = 5.5) -> dict[str, np.ndarray]:
    """Pressure control of 15 cmH2O, by the closed form of a lung of one R and one C."""
    t = np.arange(0.0, cycles * PERIOD, 1.0 / RATE)
    phase, tau = t % PERIOD, 1e-3 * R * C
    rising = 1.0 - np.exp(-np.minimum(phase, 1.0) / tau)
    inside = phase < 1.0
    falling = (1.0 - np.exp(-1.0 / tau)) * np.exp(-(phase - 1.0) / tau)
    volume = 15.0 * C * np.where(inside, rising, falling)
    airway = np.where(inside, PEEP + 15.0, PEEP)
    flow = (airway - PEEP - volume / C) / (1e-3 * R)
    rng = np.random.default_rng(0)
    return {
        "time": t,
        "pressure": airway + rng.normal(0.0, 0.05, len(t)),
        "flow": flow + rng.normal(0.0, 3.0, len(t)),
    }


def table(path: Path, names: list[str], columns: list[list[str]], **how: str) -> Path:
    """A text table."""
    separator, end = how.get("separator", ","), how.get("end", "\n")
    lines = [how["above"]] if "above" in how else []
    lines += [separator.join(names), *(separator.join(row) for row in zip(*columns, strict=True))]
    path.write_bytes((end.join(lines) + end).encode(how.get("encoding", "utf-8")))
    return path


def texts(values: np.ndarray, digits: int = 4) -> list[str]:
    return [f"{value:.{digits}f}" for value in values]


def plain(made: dict[str, np.ndarray]) -> list[list[str]]:
    return [texts(made[name]) for name in ("time", "pressure", "flow")]


def same_breaths(imported, made, cycles: int = 4, atol: float = 1e-3) -> None:
    breaths = imported.breaths
    assert len(breaths) == cycles, imported.understood
    np.testing.assert_allclose(np.diff(breaths.time[0, :100]), 1.0 / RATE, atol=1e-6)
    # The first whole breath of the recording begins within a sample of its second cycle.
    shift = int(np.argmin(np.abs(made["pressure"] - breaths.pressure[0, 20])))
    at = slice(shift - 20, shift + 200)
    np.testing.assert_allclose(breaths.pressure[0, :220], made["pressure"][at], atol=atol)
    np.testing.assert_allclose(breaths.flow[0, :220], made["flow"][at], atol=20 * atol)


NAMES = ["Time", "Paw", "Flow"]


def clocks(made, form: str) -> list[str]:
    out = []
    for t in made["time"]:
        ms = round(1000 * (t + 86390.0))  # from ten seconds before midnight
        day, ms = divmod(ms, 86_400_000)
        h, m, s, f = ms // 3600_000, ms // 60_000 % 60, ms // 1000 % 60, ms % 1000
        out.append(
            form.format(
                d=1 + day, h=h, m=m, s=s, f=f, H=(h - 1) % 12 + 1, half="AM" if h < 12 else "PM"
            )
        )
    return out


@pytest.mark.parametrize(
    "form",
    [
        "2020-03-{d:02}T{h:02}:{m:02}:{s:02}.{f:03}Z",
        "{d:02}.03.2020 {h:02}:{m:02}:{s:02}.{f:03}",
        "{h:02}:{m:02}:{s:02}:{f:03}",
        "{h}:{m:02}:{s:02}.{f:03}",
        "3/{d}/2020 {H}:{m:02}:{s:02}.{f:03} {half}",
    ],
)
def test_clocks_across_midnight(tmp_path, form):
    made = lung()
    columns = [clocks(made, form), *plain(made)[1:]]
    same_breaths(import_recording(table(tmp_path / "a.csv", NAMES, columns), lung=LABEL), made)


def test_a_coarse_clock_names_the_rate(tmp_path):
    made = lung()
    coarse = texts(np.floor(made["time"] / 0.02 + 1e-6) * 0.02)
    path = table(tmp_path / "a.csv", NAMES, [coarse, *plain(made)[1:]])
    with pytest.raises(InputError, match=r"steps of 20 ms for 2 rows each.*--rate 100$"):
        import_recording(path, lung=LABEL)
    imported = import_recording(path, lung=LABEL, rate=100.0)
    same_breaths(imported, made)
    assert "not used: Time" in " ".join(imported.understood)


def test_a_clock_of_fewer_digits_than_the_rate_names_the_rate(tmp_path):
    """At 111 Hz with two digits, one step in ten is none."""
    made = lung()
    rounded = texts(0.9 * made["time"], 2)
    path = table(tmp_path / "a.csv", NAMES, [rounded, *plain(made)[1:]])
    with pytest.raises(InputError, match=r"--rate 111\.1$"):
        import_recording(path, lung=LABEL)


def test_few_readings_that_no_airway_has_are_left_out(tmp_path):
    """Where the pressure falls at once, a spike is not far from what its neighbours span."""
    made = lung()
    at = int(np.argmin(np.diff(made["pressure"])))
    made["pressure"][at] = -24.0
    path = table(tmp_path / "a.csv", NAMES, plain(made))
    (warning,) = import_recording(path, lung=LABEL).warnings
    assert f"such as -24): lines {at + 2}; they were left out" in warning
    made["pressure"][at : at + 40] = -24.0 - np.arange(40.0)
    path = table(tmp_path / "a.csv", NAMES, plain(made))
    with pytest.raises(InputError, match=r"are outside -20..120 cmH2O.*\n.*--skip-bad-breaths"):
        import_recording(path, lung=LABEL)


@pytest.mark.parametrize(("factor", "level"), [(1.0, 0), (1.3, 1), (0.5, 2)])
def test_a_volume_that_is_not_the_integrated_flow_is_said(tmp_path, factor, level):
    made = lung()
    volume = factor * np.cumsum(made["flow"]) / RATE
    path = table(tmp_path / "a.csv", [*NAMES, "Vol"], [*plain(made), texts(volume)])
    if level == 2:
        with pytest.raises(InputError, match=r"by a factor of 2\.0 .* by --map Vol=unused\.$"):
            import_recording(path, lung=LABEL)
        return
    warnings = import_recording(path, lung=LABEL).warnings
    assert len(warnings) == level
    assert all("they differ by a factor of 1.3" in x for x in warnings)


def test_an_alarm_below_the_names_and_signs_of_type(tmp_path):
    made = lung()
    columns = [[x.replace("-", "\N{MINUS SIGN}") for x in column] for column in plain(made)]
    path = table(
        tmp_path / "a.csv",
        ["Time,Paw,Flow\nALARM", "low battery"],
        [columns[0], [f"{p},{q}" for p, q in zip(*columns[1:], strict=True)]],
    )
    same_breaths(import_recording(path, lung=LABEL), made)
    quoted = [[f'"{x}"'.replace(".", ",") for x in column] for column in plain(made)]
    same_breaths(import_recording(table(path, NAMES, quoted), lung=LABEL), made)


@pytest.mark.parametrize("row", ["15.0,5,0,ALARM high pressure", "15.0,ALARM,", "Alarm,,", NAMES])
def test_a_line_between_rows_is_named(tmp_path, row):
    made = lung()
    path = table(tmp_path / "a.csv", NAMES, plain(made))
    lines = path.read_text().splitlines()
    lines.insert(700, row if isinstance(row, str) else ",".join(row))
    path.write_text("\n".join(lines))
    imported = import_recording(path, lung=LABEL)
    same_breaths(imported, made)
    assert "Line 701 is no row" in " ".join(imported.understood)


def test_a_file_of_other_lines_is_refused(tmp_path):
    made = lung()
    path = table(tmp_path / "a.csv", NAMES, plain(made))
    lines = path.read_text().splitlines()
    lines[500:] = [line + ",1,2" for line in lines[500:]]
    path.write_text("\n".join([*lines[:490], *lines[500:530], *lines[490:500]]))
    with pytest.raises(InputError, match="line 491: 30 of"):
        import_recording(path, lung=LABEL)


def test_lines_above_and_at_the_ends(tmp_path):
    made = lung()
    pressure, flow = plain(made)[1:]
    for above in ("#samplerate,100", "Sampling rate: 100 Hz", "fs=100"):
        path = table(tmp_path / "a.csv", ["pressure", "flow"], [pressure, flow], above=above)
        same_breaths(import_recording(path, lung=LABEL), made)
    path = table(tmp_path / "b.csv", NAMES, [*plain(made)[:2], [f"{q}," for q in flow]])
    imported = import_recording(path, lung=LABEL)
    assert imported.columns == {"Time": "time", "Paw": "pressure", "Flow": "flow"}
    path = table(tmp_path / "c.csv", NAMES, plain(made), end="\r", separator=";", above="sep=;")
    same_breaths(import_recording(path, lung=LABEL), made)


def test_half_empty_columns(tmp_path):
    made = lung()
    spo2 = ["97" if k % 100 == 99 else "" for k in range(len(made["time"]))]
    path = table(
        tmp_path / "a.csv", [*NAMES, "SpO2", "Note"], [*plain(made), spo2, [""] * len(spo2)]
    )
    imported = import_recording(path, lung=LABEL)
    same_breaths(imported, made)
    assert "not used: SpO2, Note" in " ".join(imported.understood)


@pytest.mark.parametrize(
    ("separator", "thousands", "decimal"), [(",", ",", "."), (";", ".", ","), ("\t", " ", ",")]
)
def test_thousands_apart(tmp_path, separator, thousands, decimal):
    made = lung()
    swap = str.maketrans({",": thousands, ".": decimal})
    flow = [f"{q:,.1f}".translate(swap) for q in made["flow"]]
    flow = [f'"{q}"' for q in flow] if separator == "," else flow
    columns = [[x.translate(swap) for x in column] for column in plain(made)[:2]]
    path = table(tmp_path / "a.csv", NAMES, [*columns, flow], separator=separator)
    same_breaths(import_recording(path, lung=LABEL), made, atol=3e-3)


def test_two_columns_of_one_role_are_asked(tmp_path):
    made = lung()
    time, pressure, flow = plain(made)
    names = ["time", "pressure", "paw", "flow"]
    path = table(tmp_path / "a.csv", names, [time, texts(made["pressure"] + 3.0), pressure, flow])
    with pytest.raises(InputError, match=r"differ by 3 .*--map paw=pressure"):
        import_recording(path, lung=LABEL)
    imported = import_recording(path, lung=LABEL, columns={"paw": "pressure"})
    same_breaths(imported, made)
    assert "not used: pressure" in " ".join(imported.understood)


def test_breaths_between_marks(tmp_path):
    made = lung()
    lines = []
    for k in range(4):
        at = slice(round(k * PERIOD * RATE), round((k + 1) * PERIOD * RATE), 2)
        lines += ["2016-12-15-11-54-58.672431", f"BS, S:{100 + k},"]
        lines += [
            f"{0.06 * q:.2f}, {p:.2f}"
            for q, p in zip(made["flow"][at], made["pressure"][at], strict=True)
        ]
        lines += ["BE"] if k < 3 else []
    path = tmp_path / "a.csv"
    path.write_text("\n".join(lines))
    imported = import_recording(path, lung=LABEL)
    assert len(imported.breaths) == 3
    assert "1 breaths without an end" in " ".join(imported.understood)
    np.testing.assert_allclose(np.asarray(imported.breaths.flow)[0], made["flow"][:300:2], atol=0.1)
    np.testing.assert_allclose(imported.breaths.dt, 0.02, atol=1e-9)


SERVO = {
    "Italian": ("Tempo", "Fase del respiro", "Paw", "FLUSSO", "V", "insp.", "insp. pausa", "esp."),
    "German": ("Zeit", "Atemphase", "Paw", "Flow", "V", "Insp.", "Insp.-Pause", "Exsp."),
    "Polish": ("Czas", "Faza", "Pdo", "Przepływ", "Obj.", "wdech", "wdech (pauza)", "wydech"),
}


@pytest.mark.parametrize("language", SERVO)
def test_a_servo_export(tmp_path, language):
    """Sections, text cells, decimal commas and clocks with a colon before milliseconds."""
    made, swap = lung(), str.maketrans(".", ",")
    *names, inward, pause, outward = SERVO[language]
    phase = made["time"] % PERIOD
    told = np.where(phase < 0.8, inward, np.where(phase < 0.995, pause, outward))
    numbers = (made["pressure"], 0.06 * made["flow"], np.cumsum(made["flow"]) / RATE)
    columns = [
        clocks(made, "{h:02}:{m:02}:{s:02}:{f:03}"),
        list(told),
        *([x.translate(swap) for x in texts(values)] for values in numbers),
        ["Patient" if k == 40 else "" for k in range(len(told))],
    ]
    above = "[REC]\nData\t18/06/25 00:10:39\nFile\t17502.txt\nDecimal separator\tCOMMA\n"
    above += "=====\nPEEP\t5,0\tcmH2O\nConc. O2\t30\t%\nI:E\t1:2\t\n[DATA]"
    units = ("", "", " (cmH2O)", " (l/min)", " (ml)")
    names = [*(name + unit for name, unit in zip(names, units, strict=True)), "Trigger"]
    path = table(tmp_path / "a.txt", names, columns, separator="\t", above=above, encoding="utf-16")
    imported = import_recording(path, lung=LABEL)
    same_breaths(imported, made)
    assert "UTF-16" in imported.understood[0]
    assert "Layout servo" in " ".join(imported.understood)
    assert "not used" in " ".join(imported.understood)
    assert imported.breaths.volume is not None
    for u_out in imported.breaths.u_out[:, :300]:
        np.testing.assert_array_equal(u_out, np.arange(300) >= 100)


def test_what_else_a_servo_exports_is_named(tmp_path):
    for first, said in (
        ("[TRE]", "holds trends"),
        ("[REC]\nPEEP\t5", r"no line \[DATA\]; export a recording"),
    ):
        path = table(tmp_path / "a.txt", ["Time", "Ppeak"], [["1", "2"], ["3", "4"]], above=first)
        with pytest.raises(InputError, match=said):
            import_recording(path, lung=LABEL)


def test_absolute_pressure(tmp_path):
    made = lung()
    absolute = texts(made["pressure"] * 0.980665 + 1013.25)
    path = table(
        tmp_path / "a.csv",
        ["Time", "Paw [hPa]", "Flow"],
        [plain(made)[0], absolute, plain(made)[2]],
    )
    with pytest.raises(InputError, match=r"absolute.*--offset pressure=-1013\.25"):
        import_recording(path, lung=LABEL)
    same_breaths(import_recording(path, lung=LABEL, offsets={"pressure": -1013.25}), made)


def test_bad_breaths_are_named(tmp_path):
    made = lung()
    made["pressure"][700:740] = np.arange(300.0, 340.0)
    path = table(tmp_path / "a.csv", NAMES, plain(made))
    with pytest.raises(InputError, match=r"line 702 \(300\).*\n.*--skip-bad-breaths"):
        import_recording(path, lung=LABEL)
    imported = import_recording(path, lung=LABEL, skip_bad_breaths=True)
    assert len(imported.breaths) == 3
    said = " ".join(imported.understood)
    assert re.search(r"1 bad breaths were left out: line 60\d \(pressure is 300\)", said)


# The physics of roles.


def recording(**changes: np.ndarray):
    """Twelve breaths in the schema, with flow."""
    made = lung(12.0)
    shape = (12, round(PERIOD * RATE))
    columns = {name: values.reshape(shape) for name, values in made.items()}
    columns["u_in"] = np.where(columns["time"] % PERIOD < 1.0, 30.0, 0.0)
    columns["u_out"] = columns["u_in"] == 0.0
    columns["time"] = np.round(columns["time"] - columns["time"][:, :1], 6)
    columns |= {name: np.broadcast_to(values, shape) for name, values in changes.items()}
    return make_breaths(np.arange(12), np.full(12, R), np.full(12, C), **columns)


def test_sound_roles_are_not_suspected(tmp_path):
    assert check_roles(recording()) == ()
    write(recording(), tmp_path / "a.csv")
    assert CliRunner().invoke(app, ["check", str(tmp_path / "a.csv")]).exit_code == 0


BASE = recording()
FLOW = np.asarray(BASE.flow)


@pytest.mark.parametrize(
    ("changes", "code", "said"),
    [
        ({"pressure": 0.0980665 * BASE.pressure}, 1, "--pressure-unit kPa"),
        ({"time": 1000.0 * BASE.time}, 2, "--time-unit ms"),
        ({"time": 10.0 * BASE.time}, 1, "sampling interval is 0.1 s"),
        ({"pressure": np.full(1, PEEP)}, 2, "nothing to identify"),
        ({"u_in": 0.01 * BASE.u_in}, 1, "--u-in-unit 1"),
        ({"u_in": 30.0 - BASE.u_in}, 1, "--invert u_in"),
        ({"u_out": 1 - BASE.u_out}, 1, "--invert u_out"),
        ({"flow": -FLOW}, 2, "--invert flow"),
        (
            {
                name: np.roll(getattr(BASE, name), -100, axis=1)
                for name in ("pressure", "flow", "u_in", "u_out")
            },
            1,
            "--split-breaths",
        ),
        ({"u_out": np.zeros(1)}, 1, "inspiration (u_out = 0) is 100 %"),
        ({"pressure": np.minimum(BASE.pressure, 19.9)}, 1, "saturate at 19.9 cmH2O in"),
        ({"flow": np.clip(FLOW, -550.0, 550.0)}, 1, "flow is clipped at 550 mL/s in"),
    ],
)
def test_what_no_ventilator_does_is_said(tmp_path, changes, code, said):
    write(recording(**changes), tmp_path / "a.csv")
    result = CliRunner().invoke(app, ["check", str(tmp_path / "a.csv")])
    assert said in result.output
    assert result.exit_code == code


def test_exchanged_labels_and_few_breaths(tmp_path):
    exchanged = dataclasses.replace(BASE, R=BASE.C, C=BASE.R)
    assert "--lung R12C40" in str(check_roles(exchanged)[0])
    write(BASE.select([0, 1]), tmp_path / "a.csv")
    assert "2 breaths: enough for" in " ".join(load(tmp_path / "a.csv").notes)


def test_saturation_is_the_share_of_samples():
    clipped = recording(flow=np.clip(FLOW, -550.0, 550.0))
    (high, low) = find_saturation(clipped)
    assert (high.level, low.level) == (550.0, -550.0)
    assert high.share == pytest.approx(float((FLOW >= 550.0).mean()))
    square = recording(flow=np.where(BASE.u_out == 0, 400.0, FLOW))
    assert find_saturation(square) == ()  # a constant flow is no clipped one


def test_reversed_flow_is_said_everywhere(tmp_path):
    reversed_flow = recording(flow=-FLOW)
    with pytest.raises(InputError, match="--invert flow"):
        require_roles(reversed_flow)
    (lung_found,) = identify(reversed_flow.select([0, 1]))
    assert "--invert flow" in " ".join(lung_found.notes)
    write(reversed_flow, tmp_path / "a.csv")
    assert not check(tmp_path / "a.csv").ok
    with pytest.raises(InputError, match="--invert flow"):
        import_recording(tmp_path / "a.csv")
    mended = import_recording(tmp_path / "a.csv", invert=["flow"])
    np.testing.assert_allclose(np.asarray(mended.breaths.flow), FLOW)
    assert mended.warnings == ()


UNITS = {
    "pressure": {"cmH2O": 1.0, "mbar": 0.980665, "hPa": 0.980665, "kPa": 0.0980665},
    "flow": {"mL/s": 1.0, "L/min": 0.06, "LPM": 0.06, "slm": 0.06, "L/s": 1e-3},
    "time": {"s": 1.0, "ms": 1e3},
}
HEADERS = {
    "time": ["Time", "t", "Zeit", "time_step"],
    "flow": ["Flow", "flow", "Q", "Flow_rate"],
    "pressure": ["Paw", "Pressure", "P_aw", "airway pressure"],
}


FORMS = ["{} [{}]", "{}_{}", "{} ({})", "{} {}"]

#: What a table is made of besides the units; each block of tables has every one of each.
KINDS = {
    "separator": [",", ";", "\t", "|"],
    "mark": [".", ","],
    "form": FORMS,
    "above": ["", "Test 7\n", "Device: X\nSerial;7\n\n"],
    "end": ["\n", "\r\n", "\r"],
    "encoding": ["utf-8", "utf-8-sig", "utf-16", "latin-1"],
    "order": [(0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0)],
    "remark": [False, True],
    **{f"name of {role}": names for role, names in HEADERS.items()},
    **{f"unit of {role}": sorted(units) for role, units in UNITS.items()},
}


@settings(max_examples=4, derandomize=True, deadline=None)
@given(
    block=st.fixed_dictionaries(
        {kind: st.permutations(every * (6 // len(every))) for kind, every in KINDS.items()}
    )
)
def test_the_same_breaths_come_out(tmp_path_factory, block):
    """Any separator, decimal mark, header, unit, order, encoding and line end, in any company."""
    made = lung(3.5)
    for k in range(6):
        drawn = {kind: values[k % len(values)] for kind, values in block.items()}
        separator, names, columns = drawn["separator"], [], []
        mark = "." if separator == "," else drawn["mark"]
        for role in (["time", "pressure", "flow"][at] for at in drawn["order"]):
            unit = drawn[f"unit of {role}"]
            cells = texts(made[role] * UNITS[role][unit], 6)
            columns.append([cell.replace(".", mark) for cell in cells])
            names.append(drawn["form"].format(drawn[f"name of {role}"], unit))
        if drawn["remark"]:
            names.append("remark")
            columns.append([["", "a", "b"][row % 3] for row in range(len(columns[0]))])
        names[0] = drawn["above"] + names[0]
        path = table(
            tmp_path_factory.mktemp("any") / "a.csv",
            names,
            columns,
            separator=separator,
            end=drawn["end"],
            encoding=drawn["encoding"],
        )
        same_breaths(import_recording(path, lung=LABEL), made, cycles=2, atol=2e-3)
