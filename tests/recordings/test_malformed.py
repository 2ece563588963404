"""Every malformed file is refused with its line, column, value and what to do."""

from __future__ import annotations

import gzip
import pickle

import pytest

from ventbench.base.errors import InputError
from ventbench.recordings import RecordingError, check, load
from ventbench.recordings.sources import BLOCK

ID, BREATH, R, C, TIME, U_IN, U_OUT, PRESSURE = range(8)
NAMES = ["id", "breath_id", "R", "C", "time_step", "u_in", "u_out", "pressure"]


def refused(path, **options) -> RecordingError:
    with pytest.raises(RecordingError) as caught:
        load(path, **options)
    report = check(path, **options)
    assert not report.ok
    assert report.problems == caught.value.problems
    assert report.problem_count == caught.value.total
    return caught.value


def has(error: RecordingError, line, column, value, text: str, advice: str) -> None:
    problem = error.problems[0]
    assert (problem.line, problem.column, problem.value) == (line, column, value)
    assert text in problem.what
    assert advice in problem.advice
    where = problem.file + (f" line {line}" if line else "")
    where += f", column {column}" if column else ""
    assert str(problem) == f"{where}: {problem.what}. {problem.advice}"
    assert str(problem) in str(error)


CELLS = [
    (U_IN, "104.2", "104.2 is outside 0..100 %", "Fix the row or pass --clip."),
    (U_IN, "-1e-3", "-1e-3 is outside 0..100 %", "--clip"),
    (U_IN, "", "blank", "Fill it in"),
    (U_IN, "nan", "blank", "Fill it in"),
    (U_IN, "inf", "inf is infinite", "Fix the row"),
    (U_IN, "twelve", "'twelve' is not a number", "Fix the cell"),
    (U_IN, "1_0", "'1_0' is not a number", "Fix the cell"),
    (U_OUT, "0.5", "0.5 is neither 0 nor 1", "Write 1 while"),
    (U_OUT, "2", "2 is neither 0 nor 1", "Write 1 while"),
    (U_OUT, "", "blank", "Fill it in"),
    (U_OUT, "True", "'True' is not a number", "Fix the cell"),
    (PRESSURE, "120.5", "120.5 is outside -20..120 cmH2O", "cmH2O"),
    (PRESSURE, "-21", "-21 is outside -20..120 cmH2O", "cmH2O"),
    (PRESSURE, "-inf", "-inf is infinite", "Fix the row"),
    (R, "0", "0 is not in the range above 0 and up to 500 cmH2O/(L/s)", "resistance"),
    (R, "-5", "-5 is not in the range", "resistance"),
    (R, "", "blank", "Fill it in"),
    (R, "five", "'five' is not a number", "Fix the cell"),
    (C, "501", "501 is not in the range above 0 and up to 500 mL/cmH2O", "compliance"),
    (C, "inf", "inf is infinite", "Fix the row"),
    (C, "", "blank", "Fill it in"),
    (BREATH, "", "blank", "Fill it in"),
    (BREATH, "2.5", "'2.5' is not a whole number", "Fix the cell"),
    (BREATH, "99999999999999999999", "is not a whole number", "Fix the cell"),
    (TIME, "inf", "inf is infinite", "Fix the row"),
    (TIME, "0.1.2", "'0.1.2' is not a number", "Fix the cell"),
    (ID, "x", "'x' is not a whole number", "Fix the cell"),
]


@pytest.mark.parametrize(("column", "cell", "text", "advice"), CELLS)
@pytest.mark.parametrize("at", [0, 8, 17])
def test_a_bad_cell(rows, write_csv, at, column, cell, text, advice):
    rows[at][column] = cell
    error = refused(write_csv(rows))
    cells = [p for p in error.problems if p.column == NAMES[column] and text in p.what]
    assert len(cells) == 1
    has(RecordingError(cells), at + 2, NAMES[column], cell, text, advice)


def test_lines_are_right_with_crlf_bom_blank_lines_and_gzip(rows, write_csv, tmp_path):
    rows[8][U_IN] = "104.2"
    header = "\ufeff" + ",".join(NAMES)
    path = write_csv([*rows[:3], [], [], *rows[3:]], header=header, end="\r\n")
    has(refused(path), 12, "u_in", "104.2", "outside", "--clip")
    packed = tmp_path / "lab.csv.gz"
    packed.write_bytes(gzip.compress(path.read_bytes()))
    has(refused(packed), 12, "u_in", "104.2", "outside", "--clip")
    rows[8][U_IN] = "x"
    path = write_csv([*rows[:3], [], [], *rows[3:]], header=header, end="\r\n")
    has(refused(path), 12, "u_in", "x", "'x' is not a number", "Fix")


def test_a_bad_cell_in_a_later_block_of_the_file(rows, write_csv):
    n = BLOCK // 40 // 6 + 2000
    many = [
        [str(6 * b + i + 1), str(b), *rows[i][2:7], f"{5 + b % 7}.1234567890123"]
        for b in range(n)
        for i in range(6)
    ]
    many[6 * (n - 3)][U_IN] = "104.2"
    path = write_csv(many)
    assert path.stat().st_size > BLOCK
    has(refused(path), 6 * (n - 3) + 2, "u_in", "104.2", "outside", "--clip")
    many[6 * (n - 3)][U_IN] = "104.2%"
    has(refused(write_csv(many)), 6 * (n - 3) + 2, "u_in", "104.2%", "not a number", "Fix")
    many[6 * (n - 3)][U_IN] = "4.2"
    many[6 * (n - 1) :] = [[*row[:1], "0", *row[2:]] for row in many[6 * (n - 1) :]]
    has(refused(write_csv(many)), 6 * (n - 1) + 2, "breath_id", "0", "already at line 2", "id")


def test_clip_takes_values_outside_but_not_infinite_ones(rows, write_csv):
    rows[8][U_IN], rows[9][U_IN] = "104.2", "-3"
    path = write_csv(rows)
    assert refused(path).total == 2
    breaths = load(path, clip=True)
    assert breaths.u_in[1, 2] == 100.0
    assert breaths.u_in[1, 3] == 0.0
    report = check(path, clip=True)
    assert report.ok
    assert [(w.line, w.value) for w in report.warnings] == [(10, "104.2"), (11, "-3")]
    assert any("line 10" in note for note in breaths.notes)
    rows[8][U_IN] = "inf"
    has(refused(write_csv(rows), clip=True), 10, "u_in", "inf", "infinite", "Fix")


@pytest.mark.parametrize("name", NAMES)
def test_a_missing_column(rows, write_csv, name):
    at = NAMES.index(name)
    left = [row[:at] + row[at + 1 :] for row in rows]
    header = ",".join(NAMES[:at] + NAMES[at + 1 :])
    has(refused(write_csv(left, header)), 1, name, None, f"missing column {name}", "The header is")


def test_missing_columns_with_a_hint(rows, write_csv):
    error = refused(write_csv(rows, ",".join(NAMES).replace("u_in", " U_In")))
    has(error, 1, "u_in", None, "missing column u_in", "rename ' U_In' to u_in")
    error = refused(write_csv([], ";".join(NAMES)))
    has(error, 1, None, None, "missing columns id, breath_id", "separated by commas")


def test_a_column_twice(rows, write_csv):
    error = refused(write_csv([[*row, "1"] for row in rows], ",".join([*NAMES, "u_in"])))
    has(error, 1, "u_in", "u_in", "names u_in 2 times", "Keep one")


def test_an_unknown_column_is_a_warning(rows, write_csv):
    path = write_csv([[*row, '"a note, quoted"'] for row in rows], ",".join([*NAMES, "who"]))
    report = check(path)
    assert report.ok
    assert "'who' is not known and is ignored" in str(report.warnings[0])
    assert any("'who'" in note for note in load(path).notes)


def test_too_few_and_too_many_cells(rows, write_csv):
    rows[4] = rows[4][:-1]
    rows[6] = [*rows[6], "1"]
    error = refused(write_csv(rows))
    has(error, 6, None, None, "the row has 7 cells, but the header has 8 columns", "Fix the row")
    assert error.problems[1].line == 8


def test_an_open_quote(rows, write_csv):
    rows[4][U_IN] = '"12'
    assert refused(write_csv(rows)).problems[0].line == 6


def test_time_that_does_not_increase(rows, write_csv):
    rows[8][TIME] = "0.1"
    has(refused(write_csv(rows)), 10, "time_step", "0.1", "goes back to 0.1 s from line 9", "Sort")


def test_the_same_time_twice(rows, write_csv):
    rows[8][TIME] = rows[7][TIME]
    text = "two rows of the breath have the time 0.25 s, the other is line 9"
    has(refused(write_csv(rows)), 10, "time_step", "0.25", text, "remove rows that are there twice")


def test_a_repeated_row(rows, write_csv):
    error = refused(write_csv([*rows[:8], rows[7], *rows[8:]]), pad=True)
    has(error, 10, "time_step", "0.25", "the row repeats line 9", "Remove one")
    for row in rows:
        row[TIME] = ""
    error = refused(write_csv([*rows[:8], rows[7], *rows[8:]]), pad=True)
    has(error, 10, "id", "8", "the row repeats line 9", "Remove one")


def test_time_order_is_checked_across_blank_times(rows, write_csv):
    rows[8][TIME], rows[9][TIME] = "", "0.2"
    has(refused(write_csv(rows)), 11, "time_step", "0.2", "from line 9", "Sort")


@pytest.mark.parametrize("name", ["R", "C"])
def test_a_lung_that_changes_within_a_breath(rows, write_csv, name):
    for row in rows[8:10]:
        row[NAMES.index(name)] = "20"
    error = refused(write_csv(rows))
    text = f"{name} changes to 20 within the breath, which starts at line 8"
    has(error, 10, name, "20", text, "own breath_id")
    assert error.total == 1


def test_a_breath_that_comes_again(rows, write_csv):
    for row in rows[12:]:
        row[BREATH] = "1"
    text = "breath 1 comes again, it is already at line 2"
    has(refused(write_csv(rows)), 14, "breath_id", "1", text, "an id of its own")


def test_breaths_of_unequal_length(rows, write_csv):
    error = refused(write_csv(rows[:11] + rows[12:]))
    text = "1 of 3 breaths have not the usual 6 samples, the first is breath 2"
    has(error, 8, "breath_id", "2", text, "pass --pad")
    error = refused(write_csv(rows[:4] + rows[6:11] + rows[12:]))
    assert "2 of 3 breaths have not the usual" in error.problems[0].what
    assert error.total == 1


def test_padding_that_would_fill_the_memory_is_refused(rows, write_csv):
    many = [[str(i), "0", "5", "10", f"{i * 0.01:.2f}", "1", "0", "5"] for i in range(4000)]
    many += [
        [str(4000 + 2 * b + i), str(b), "5", "10", str(i), "1", "0", "5"]
        for b in range(1, 4000)
        for i in range(2)
    ]
    error = refused(write_csv(many), pad=True)
    has(error, 2, "breath_id", "0", "would make 16000000 samples", "files of their own")


def test_a_breath_of_one_sample(rows, write_csv):
    for pad in (False, True):
        error = refused(write_csv(rows[:6] + rows[6:7] + rows[12:]), pad=pad)
        has(error, 8, "breath_id", "2", "breath 2 has one sample", "Remove it")


def test_blank_times_that_cannot_be_inferred(rows, write_csv):
    for row in rows:
        row[TIME], row[U_OUT] = "", "0"
    error = refused(write_csv(rows))
    has(error, 2, "time_step", "", "times of breath 1 are blank and cannot be", "Fill in time")
    assert error.total == 3


def test_not_utf8(rows, write_csv):
    path = write_csv(rows)
    path.write_bytes(path.read_bytes().replace(b"\n3,1,5,10", b"\n3,1,5,1\xe9"))
    has(refused(path), 4, "C", "1\\xe9", "byte 0xe9 is not UTF-8", "UTF-8")
    path.write_bytes(b"\xe9" + path.read_bytes())
    has(refused(path), 1, None, None, "byte 0xe9 is not UTF-8", "UTF-8")
    path.write_bytes("\n".join(NAMES).encode("utf-16"))
    has(refused(path), None, None, None, "UTF-16", "UTF-8")


def test_files_that_are_no_text(rows, write_csv, tmp_path):
    for content, text in (
        (b"", "the file is empty"),
        (b"\n", "first line is blank"),
        (b"PK\x03\x04....", "zip archive"),
        (b"\x1f\x8b\x08\x00broken", "cannot be read"),
        (b"PAR1 and no more", "the file cannot be read (Parquet"),
        ("\r".join(NAMES).encode(), "CR alone"),
        (",".join(NAMES).encode(), "a header but no rows"),
        (",".join(NAMES).encode() + b"\n\n\n", "a header but no rows"),
    ):
        path = tmp_path / "lab.csv"
        path.write_bytes(content)
        assert text in refused(path).problems[0].what
    (tmp_path / "lab.parquet").write_text("id\n")
    assert "not a Parquet file" in str(refused(tmp_path / "lab.parquet"))
    whole = gzip.compress(write_csv(rows).read_bytes())
    (tmp_path / "cut.csv.gz").write_bytes(whole[: len(whole) // 2])
    assert "cannot be read" in str(refused(tmp_path / "cut.csv.gz"))


def test_files_that_are_not_there(tmp_path, monkeypatch):
    has(refused(tmp_path / "no.csv"), None, None, None, "there is no such file", "Check the path")
    with pytest.raises(InputError, match="has no recording; name a file"):
        load(tmp_path)

    def denied(*_args, **_options):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("builtins.open", denied)
    error = refused(tmp_path / "secret.csv")
    has(error, None, None, None, "cannot be read (Permission denied)", "permissions")


def test_many_problems_are_counted_and_the_first_twenty_shown(rows, write_csv):
    many = [[str(6 * b + i), str(b), *rows[i][2:]] for b in range(20) for i in range(6)]
    for row in many[5:]:
        row[U_IN] = "101"
    many[0][R] = "900"
    error = refused(write_csv(many))
    assert error.total == 115 + 2
    assert [p.line for p in error.problems][:4] == [2, 3, 7, 8]
    assert len(error.problems) == 20
    assert str(error).splitlines()[-1] == "... and 97 more problems (117 in all)."
    first = error.problems[0]
    assert (first.line, first.column, first.value) == (2, "R", "900")
    for row in many[5:]:
        row[U_IN] = "ten"
    error = refused(write_csv(many))
    assert (error.total, len(error.problems)) == (115, 20)
    again = pickle.loads(pickle.dumps(error))
    assert (again.problems, again.total, str(again)) == (error.problems, error.total, str(error))


def test_milliseconds_are_refused(rows, write_csv):
    for row in rows:
        row[TIME] = str(1000 * float(row[TIME]))
    path = write_csv(rows)
    report = check(path)
    assert not report.ok
    assert "250 s" in report.problems[0].what
    assert "--time-unit ms" in report.problems[0].advice
    assert "--time-unit ms" in load(path).notes[0]
