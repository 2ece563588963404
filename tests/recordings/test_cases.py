"""Files of the kinds that laboratories have, as they are: read as meant, or the way out is said.

All but those of the schema are of pressure control, 15 above 5 cmH2O, of a lung of R 12 and C 40 at
100 Hz.
"""

from __future__ import annotations

import csv
import gzip
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import ventbench
from ventbench.base.errors import InputError
from ventbench.cli import app
from ventbench.recordings import check
from ventbench.recordings.foreign import Imported, import_recording

CASES = Path(__file__).parent / "cases"

#: Files that are read; the truth of each is R 12 cmH2O/(L/s), C 40 mL/cmH2O and PEEP 5 cmH2O, of
#: those of :data:`PUBLIC` R 20, C 50 and some PEEP above 5, as they do not empty.
READ = {
    "alarm_row": ({}, "Line 3002 is no row and was left out: '30.0 5 0 ALARM high pressure'"),
    "clock_hms": ({}, "times such as '23:59:50:000' were counted in seconds"),
    "clock_iso": ({}, "times such as '2020-03-01 23:59:50.000' were counted in seconds"),
    "coarse_clock": ({"rate": 100.0}, "not used: time"),
    "comment_rate": ({"units": {"flow": "L/min"}}, "Sampling rate 100 Hz, of the file"),
    "cr_only": ({}, "cells separated by ';'"),
    "flow_sign_reversed": ({"invert": ["flow"]}, ""),
    "labels_exchanged": ({"lung": "R12C40"}, "in place of R and C of the file"),
    "names_with_units": ({}, ""),
    "thousands": ({}, "Flow: 356 cells have thousands apart"),
    "trailing_comma": ({}, ""),
    "unused_columns": ({"columns": {"paw": "pressure"}}, "not used: pressure"),
}

#: Files after public forms: breaths, interval and what is said.
PUBLIC = {
    "clock_reset": (10, 0.02, "The clock begins anew in line 902"),
    "flow_every_second_row": (9, 0.02, "rows in which only some of the measured columns"),
    "flow_mL_s": (9, 0.01, "flow_mL_s"),
    "held_values": (11, 0.01, "119 of 3600 readings of flow_lpm (3.3 %) only repeat"),
    "missing_marks_flow": (11, 0.01, "such as -99): lines 3218"),
    "nested_log": (6, 0.012, "Layout mvm"),
    "v_prime": (9, 0.01, "V'"),
}

#: Files that are refused as they are, or warned of, and what is said.
SAID = {
    "coarse_clock": "steps of 20 ms for 2 rows each; give the sampling rate, such as --rate 100",
    "flow_clipped": "flow is clipped at 550 mL/s in 14 % of the samples",
    "flow_sign_reversed": "column Flow: flow goes out while pressure is high, so it is counted "
    "from the patient. Pass --invert flow",
    "half_volume": "they differ by a factor of 2.0 (volume is 0.502 times the integrated flow)",
    "labels_exchanged": "Pass --lung R12C40",
    "u_in_fraction": "Pass --u-in-unit 1",
    "unused_columns": "columns pressure and paw may both be pressure, and differ by 3 (median)",
}

#: Files in the schema: exit code of ``data check``, and what it says.
CHECKED = {
    "adc_saturation": (1, "pressure saturate at 31 cmH2O in 4.5 % of the samples"),
    "missing_marks_pressure": (1, "12 of 2400 readings of pressure (0.5 %) are 99.99"),
    "constant": (2, "pressure stays at 5 cmH2O, so there is nothing to identify"),
    "kpa_unlabelled": (1, "PEEP 0.5 and PIP 2.13 cmH2O (medians) are no ventilator's"),
    "ms": (2, "Rates are 20 to 1000 Hz: pass --time-unit ms"),
    "twobreaths": (0, "2 breaths: enough for `ventbench data open-loop`"),
}

#: Files whose diagnosis says it; the rig is R20C20.
DIAGNOSED = {"gain_step": "the valve's gain rises by 25 % from breath 15 on"}


def file(name: str) -> Path:
    return next(CASES.glob(f"{name}.*"))


def read(name: str, **options) -> Imported:
    return import_recording(file(name), **{"lung": "R12C40", **options})


def test_every_file_is_tried():
    names = {path.name.partition(".")[0] for path in CASES.iterdir()}
    assert names == {*READ, *PUBLIC, *SAID, *CHECKED, *DIAGNOSED}


def mechanics(imported: Imported) -> np.ndarray:
    """R, C and PEEP by least squares: pressure is R flow + volume / C + PEEP."""
    rows = []
    for k, valid in enumerate(imported.breaths.valid):
        valid = valid & np.isfinite(imported.breaths.pressure[k])
        valid &= np.isfinite(np.asarray(imported.breaths.flow)[k])
        flow = np.asarray(imported.breaths.flow)[k][valid] / 1000.0
        steps = np.diff(imported.breaths.time[k][valid])
        volume = np.concatenate([[0.0], np.cumsum((flow[1:] + flow[:-1]) / 2 * steps)])
        pressure = imported.breaths.pressure[k][valid]
        rows.append(np.stack([flow, 1000.0 * volume, np.ones_like(flow), pressure], axis=1))
    *inputs, output = np.concatenate(rows).T
    r, elastance, peep = np.linalg.lstsq(np.stack(inputs, axis=1), output, rcond=None)[0]
    return np.array([r, 1.0 / elastance, peep])


@pytest.mark.parametrize("name", READ)
def test_the_lung_that_was_recorded_comes_out(name):
    options, understood = READ[name]
    imported = read(name, **options)
    assert understood.lower() in " ".join(imported.understood).lower()
    assert len(imported.breaths) == (14 if name == "labels_exchanged" else 8)
    np.testing.assert_allclose(imported.breaths.dt[imported.breaths.valid], 0.01, atol=1e-4)
    scale = 1.3 if name == "thousands" else 1.0  # of its flow, so that there are thousands
    found = mechanics(imported) * [scale, 1.0 / scale, 1.0]
    np.testing.assert_allclose(found, [12.0, 40.0, 5.0], rtol=0.05)


@pytest.mark.parametrize("name", PUBLIC)
def test_public_forms_are_read_as_meant(name):
    count, interval, said = PUBLIC[name]
    imported = read(name, lung="R20C50")
    assert said in " ".join([*imported.understood, *imported.warnings, *imported.columns])
    assert len(imported.breaths) == count
    inside = imported.breaths.valid[:, 1:] & imported.breaths.valid[:, :-1]
    assert np.median(np.diff(imported.breaths.time)[inside]) == pytest.approx(interval, abs=1e-4)
    # Flow between rows of another rate is rough where it jumps.
    found, rough = mechanics(imported), name in ("flow_every_second_row", "held_values")
    np.testing.assert_allclose(found[:2], [20.0, 50.0], rtol=0.1 if rough else 0.05)


def test_thousands_are_the_numbers_that_were_meant():
    with gzip.open(file("thousands"), "rt") as stream:
        flow = np.array([float(row["Flow"].replace(",", "")) for row in csv.DictReader(stream)])
    assert flow.max() > 1000.0
    breaths = read("thousands").breaths
    assert set(np.asarray(breaths.flow)[breaths.valid]) <= set(flow)


@pytest.mark.parametrize("name", SAID)
def test_what_is_wrong_is_said_with_the_way_out(name):
    options = {} if name != "labels_exchanged" else {"lung": None}
    try:
        said = " ".join(read(name, **options).warnings)
    except InputError as error:
        said = str(error)
    assert SAID[name] in said


@pytest.mark.parametrize("name", CHECKED)
def test_the_check_says_it(name):
    code, said = CHECKED[name]
    ended = CliRunner().invoke(app, ["data", "check", str(file(name))])
    assert said in ended.output
    assert ended.exit_code == code
    report = check(file(name))
    assert (report.ok, bool(report.suspicious)) == (code != 2, code == 1)


@pytest.mark.slow
@pytest.mark.parametrize("name", DIAGNOSED)
def test_the_diagnosis_says_it(name):
    found = ventbench.diagnose(file(name), lung="R20C20")
    assert DIAGNOSED[name] in str(found)
