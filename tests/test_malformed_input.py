"""Every command names what is wrong with a file, where, and what to do; exit code 2, no traceback.

The commands run in this process; what needs a simulator is refused before one is loaded.
"""

from __future__ import annotations

import gzip
from pathlib import Path

import pytest
from typer.testing import CliRunner

from ventbench.base.errors import InputError
from ventbench.base.files import example
from ventbench.cli import app

RUN = CliRunner()
SOUND = str(example("sound.csv"))
HEADER = "id,breath_id,R,C,time_step,u_in,u_out,pressure\n"
ROW = "{},1,20,50,{},5,{},{}\n"


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of wrong files, which is the working directory."""
    monkeypatch.chdir(tmp_path)
    for name in ("folder", "run", "board"):
        (tmp_path / name).mkdir()
    noise = bytes((246 - k) % 256 for k in range(2048))
    binary = ("noise.csv", "noise.json", "noise.parquet", "noise.mat", "run/trajectories.npz")
    for name in binary:
        (tmp_path / name).write_bytes(noise)
    texts = {
        "file": "hello\n",
        "empty.csv": "",
        "empty.json": "",
        "other.json": '{"plants": 3}\n',
        "semicolons.csv": "a;b\n1;2\n",
        "header.csv": HEADER,
        "nan.csv": HEADER + "".join(ROW.format(k, 0.03 * k, 0, "nan") for k in range(1, 4)),
        "back.csv": HEADER + ROW.format(1, 0.03, 0, 5) + ROW.format(2, 0.0, 0, 5),
        "huge.csv": "u_in,u_out\n5,0\n1e400,0\n",
        "word.csv": "u_in,u_out\n5,0\nopen,0\n",
        "over.csv": "u_in,u_out\n5,0\n140,0\n",
        "run/score.json": "{",
        "board/attestations.toml": "keys = 3",
    }
    for name, text in texts.items():
        (tmp_path / name).write_text(text)
    (tmp_path / "cut16.csv").write_bytes(b"\xff\xfe" + noise[:99])
    (tmp_path / "packed.csv").write_bytes(gzip.compress(HEADER.encode()))
    return tmp_path


CASES = {
    "score nosuch": "no such folder and no bundled submission",
    "score folder": "submission.toml is missing",
    "score file": "file is a file; give the folder that holds controller.py",
    "score pid_best --json folder": "--json folder is a folder; name a file",
    "score pid_best --json file/x.json": "file is a file, not a folder",
    "score pid_best --out file": "--out file is a file, not a folder",
    "score pid_best --simulator nosuch": "there is no such file, nor a simulator of that name",
    "score pid_best --simulator noise.json": "it is no text",
    "score pid_best --simulator empty.json": "empty.json is not a file of plants",
    "score pid_best --simulator other.json": "give a corrected.json",
    "score pid_best --record r": "give --draws 20",
    "score pid_best --report": "--report needs --out DIR",
    "check file": "give the folder that holds controller.py",
    "new Bad_Name": "must be lower-case letters",
    "data check folder": "this is a folder. Name one file in it",
    "data check empty.csv": "the file is empty",
    "data check header.csv": "Write at least one breath",
    "data check nan.csv": "pressures are blank. Fill in the pressure",
    "data check semicolons.csv": "`ventbench data import` reads others",
    "data check noise.csv": "is not UTF-8. Save the file as UTF-8 text",
    "data check packed.csv": "packed.csv",
    "data check noise.parquet": "this is not a Parquet file",
    "data check nosuch.csv": "nosuch.csv",
    "data import noise.mat": "export it as CSV",
    "data import cut16.csv": "begins like UTF-16 text and is none",
    "data import nan.csv --out o.parquet --map Nope=pressure": "has no column 'Nope'; it has",
    "simulate --lung R20C50 --controls semicolons.csv": "column u_in",
    "simulate --lung R20C50 --controls huge.csv": "line 3, column u_in: '1e400'",
    "simulate --lung R20C50 --controls word.csv": "line 3, column u_in: 'open'",
    "simulate --lung R20C50 --controls over.csv": "over.csv",
    "data open-loop nan.csv": "all pressures are blank; fill them in",
    "mechanics back.csv": "back.csv",
    "mechanics empty.csv": "the file is empty",
    "diagnose semicolons.csv --out out": "separated by commas",
    f"diagnose {SOUND} --out file": "--out file is a file",
    f"diagnose {SOUND} --out out --drive maybe": "choose auto, valve or flow",
    "view folder": "contains no scored run; make one with",
    "view run --out x.html": "it is no .npz archive; score the submission again",
    "board show --folder folder": "holds no record; add one with",
    "board show --folder board": "attestations.toml",
    "view nosuch": "nosuch contains no scored run; make one with",
    "board show --folder nosuch": "nosuch: there is no such folder; the published leaderboard",
    "board add noise.json --folder folder": "noise.json is not JSON of a record",
    "board add other.json --folder folder": "other.json",
    "board withdraw 123 --reason x --folder folder": "holds no single record",
    "board headroom --check noise.json": "not a file of reference errors: it is no .npz archive",
    "train pid --lung R1": "R1",
}


@pytest.mark.parametrize("command", CASES)
def test_says_what_is_wrong(command: str, files: Path) -> None:
    before = {path for path in files.rglob("*")}
    ended = RUN.invoke(app, command.split())
    said = ended.output
    if isinstance(ended.exception, InputError | OSError):  # main() prints it and exits with 2
        said += str(ended.exception)
    else:
        assert ended.exit_code == 2, said
        assert isinstance(ended.exception, SystemExit), repr(ended.exception)
    assert " ".join(CASES[command].split()) in " ".join(said.split())
    assert "pickle" not in said, "nobody is advised to unpickle"
    assert {path for path in files.rglob("*")} == before, "nothing is left behind"
