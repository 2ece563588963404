from __future__ import annotations

import json
import re
import shutil
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from proofs.__main__ import app
from proofs.challenge import reveal as reveal_module
from proofs.challenge.answer import answer
from proofs.challenge.first.rig import record
from proofs.challenge.folder import ChallengeFolder
from proofs.challenge.make import make, record_within_limits
from proofs.challenge.reveal import reveal
from proofs.challenge.run import Diagnoser, Limits, find, run
from proofs.challenge.seal import commitment, unseal
from ventbench.base.errors import InputError
from ventbench.recordings import load

SECRET = "for the test"
HERE = "tests.proofs.challenge.truths"
QUICK = Limits(60.0, 8.0)

# These tests are about files and rounds, not about the accuracy of the integration.
coarsely = partial(record, steps=8)


def who(function: str) -> Diagnoser:
    return Diagnoser(function, f"{HERE}:{function}")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    out = tmp_path_factory.mktemp("challenge") / "c"
    promised = make(SECRET, out, "masked", 2, record=coarsely)
    return out, promised


@pytest.fixture(scope="module")
def answered(made):
    """All answered by one who is not sure."""
    folder = ChallengeFolder(made[0])
    assert answer(folder, who("unsure"), limits=QUICK) == {}
    return folder


def test_public_files_tell_nothing(made):
    out, promised = made
    assert (out / "commitment.txt").read_text() == promised + "\n"
    entries = json.loads((out / "cases.json").read_text())["cases"]
    assert [sorted(entry) for entry in entries] == [["file", "lung", "sha256", "withheld"]] * 2
    header = (out / "recordings" / "case_0001.csv").read_text().splitlines()[0]
    assert header == "id,breath_id,R,C,time_step,u_in,u_out,pressure"
    everything = b"".join(path.read_bytes() for path in out.rglob("*") if path.is_file())
    assert b"valve" not in everything
    assert SECRET.encode() not in everything


def test_the_same_secret_makes_the_same_files(tmp_path):
    first, again, other = (tmp_path / name for name in "abc")
    assert make(SECRET, first, "null", 1, record=coarsely) == make(
        SECRET, again, "null", 1, record=coarsely
    )
    for path in (p for p in first.rglob("*") if p.is_file()):
        assert (again / path.relative_to(first)).read_bytes() == path.read_bytes()
    make("another", other, "null", 1, record=coarsely)
    assert (other / "cases.json").read_bytes() != (first / "cases.json").read_bytes()


def test_a_challenge_is_not_overwritten(made):
    with pytest.raises(InputError, match="already"):
        make("other", made[0], "null", 1)


def test_two_processes_make_and_answer_the_same(made, tmp_path):
    folder = ChallengeFolder(tmp_path / "c")
    assert make(SECRET, folder.path, "masked", 2, workers=2, record=coarsely) == made[1]
    assert answer(folder, who("sees_nothing"), limits=QUICK, workers=2) == {}
    assert sorted(folder.answers("sees_nothing")) == sorted(folder.cases())


def test_an_answer_to_another_recording_is_refused(answered):
    path = answered.answer("case_0002", "unsure")
    kept = path.read_text()
    path.write_text(json.dumps(json.loads(kept) | {"recording_sha256": "0"}))
    with pytest.raises(InputError, match="another recording"):
        reveal([answered], [SECRET], "unsure")
    path.write_text(kept)


def test_a_changed_recording_is_refused(answered):
    path = answered.recording("case_0002")
    kept = path.read_text()
    path.write_text(kept.replace("\n1,", "\n1 ,", 1))
    with pytest.raises(InputError, match="not the recording that the challenge was made with"):
        reveal([answered], [SECRET], "unsure")
    path.write_text(kept)


def test_commands(answered):
    done = CliRunner().invoke(
        app,
        [
            "challenge",
            "reveal",
            str(answered.path),
            "--seed",
            SECRET,
            "--json",
            "-",
            "--diagnoser",
            "unsure",
        ],
    )
    assert done.exit_code in (0, 1)
    value = json.loads(done.stdout)
    published = (answered.path / "commitment.txt").read_text().strip()
    draw = {"seed": SECRET, "commitment": published, "total": 2, "answered": 2}
    assert value["draws"] == [draw]
    assert len(value["cases"]) == 2
    helped = CliRunner().invoke(app, ["challenge", "--help"])
    assert all(name in helped.stdout for name in ("make", "answer", "record", "reveal", "board"))


def test_a_draw_counts_once_and_generators_apart(answered, tmp_path, monkeypatch):
    with pytest.raises(InputError, match="given twice"):
        reveal([answered, answered], [SECRET, SECRET], "unsure")
    other = ChallengeFolder(tmp_path / "c")
    make("other words", other.path, "null", 1, record=coarsely)
    names = iter(("first", "stranger"))
    monkeypatch.setattr(reveal_module, "generator_name", lambda *of: next(names))
    with pytest.raises(InputError, match="first and stranger have figures of their own"):
        reveal([answered, other], [SECRET, "other words"], "unsure")


def test_command_with_another_seed(answered):
    with pytest.raises(InputError, match="was published"):
        CliRunner().invoke(
            app,
            ["challenge", "reveal", str(answered.path), "--seed", "x"],
            catch_exceptions=False,
        )


def test_withheld_pressures_are_nowhere_to_be_read(made):
    folder = ChallengeFolder(made[0])
    for drawn, _ in folder.truth(SECRET):
        name = drawn.case.name
        full = record_within_limits(SECRET, drawn, record=coarsely)
        seen, ids = load(folder.recording(name)), folder.cases()[name]["withheld"]
        apart = np.isin(seen.breath_id, ids)
        assert 2 <= apart.sum() <= len(apart) // 4
        assert not apart[[0, -1]].any()
        assert np.isnan(seen.pressure[apart]).all()
        np.testing.assert_array_equal(seen.pressure[~apart], full.pressure[~apart])
        np.testing.assert_array_equal(seen.u_in, full.u_in)
        kept = folder.open(name, SECRET)
        np.testing.assert_array_equal([kept.pressures[b] for b in ids], full.pressure[apart])
        with pytest.raises(InputError, match="another seed"):
            folder.open(name, "other words")


def test_draws_of_earlier_days_can_be_made_again(tmp_path):
    """The SHA-256 was published before breaths were withheld."""
    published = make("regression", tmp_path / "c", "null", 1, record=coarsely)
    folder = ChallengeFolder(tmp_path / "c")
    text = unseal(folder.sealed.read_bytes(), "regression", folder.public.read_bytes(), published)
    now = json.loads(text)
    cases = [{"kind": x["kind"], "nats": [], "case": x["case"]} for x in now["cases"]]
    then = now | {"format": "ventbench-challenge-1", "cases": cases}  # with the nats of no effect
    assert (
        commitment((json.dumps(then, indent=1) + "\n").encode())
        == "f723ff02e7111ecf4e394ea4866c829bf712a9bb539e214b0511726dd016e2cb"
    )


@pytest.mark.parametrize(
    ("function", "why"),
    [
        ("fails", "ValueError: no idea"),
        ("answers_text", "not an answer: Expected `object`"),
        ("missing", "has no attribute 'missing'"),
        ("never_ends", "took more than 2 s of processor time"),
        ("eats_memory", "MemoryError"),
        ("kills_itself", "ended by signal 6"),
    ],
)
def test_who_fails_loses_the_case_and_no_more(made, tmp_path, function, why):
    folder = ChallengeFolder(tmp_path / "c")
    shutil.copytree(made[0], folder.path, ignore=shutil.ignore_patterns("answers", "answers_2"))
    limits = Limits(2.0 if function == "never_ends" else 60.0, 8.0)
    lost = answer(folder, who(function), limits=limits, only=("case_0001",))
    assert why in lost["case_0001"]
    (case,) = reveal([folder], [SECRET], function).cases.values()
    assert case.problem == lost["case_0001"]
    assert case.belief == 0.0


def test_a_case_that_the_challenge_has_not_is_refused(made):
    folder = ChallengeFolder(made[0])
    with pytest.raises(InputError, match="has no case 001, but case_0001 to case_0002"):
        answer(folder, who("sees_nothing"), only=("case_0001", "001"))


def test_answers_go_on_where_they_stopped(made, tmp_path):
    folder = ChallengeFolder(tmp_path / "c")
    shutil.copytree(made[0], folder.path, ignore=shutil.ignore_patterns("answers", "answers_2"))
    told = []
    assert answer(folder, who("sees_nothing"), limits=QUICK, only=("case_0002",)) == {}
    answer(folder, who("sees_nothing"), limits=QUICK, progress=lambda *done: told.append(done))
    assert told == [(1, 2), (2, 2)]


def test_a_file_that_was_changed_into_no_answer_is_a_lost_case(answered, tmp_path):
    folder = ChallengeFolder(tmp_path / "c")
    shutil.copytree(answered.path, folder.path)
    path = folder.answer("case_0001", "unsure")
    given = json.loads(path.read_text())
    given["answer"]["hypotheses"][0]["probability"] = 7.0
    path.write_text(json.dumps(given))
    assert "probability is 7" in reveal([folder], [SECRET], "unsure").cases[0, "case_0001"].problem


def test_a_stranger_reads_and_writes_nothing_else(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)  # what PYTHONPATH adds is not theirs to read
    kept = tmp_path / "secret.txt"
    kept.write_text("seed")
    mine, case = tmp_path / "mine", tmp_path / "case"
    mine.mkdir()
    case.mkdir()
    (mine / "diagnoser.toml").write_text('name = "mine"\nfunction = "spy:diagnose"\n')
    for wanted in (kept, Path(__file__).parents[3] / "README.md"):
        (mine / "spy.py").write_text(
            "def diagnose(folder):\n"
            "    import ventbench.task.lungs\n"
            f"    return open({str(wanted)!r}).read()\n"
        )
        outcome = run(find(str(mine)), case, QUICK)
        assert "PermissionError" in outcome.problem
        assert "landlock" in outcome.layers
    (mine / "data").symlink_to(kept)
    with pytest.raises(InputError, match="data is a link, a cache or compiled code"):
        find(str(mine))
    (mine / "data").unlink()
    for name in ("../up", "v\u0435ntbench", "Mine"):  # one letter of the second is Cyrillic
        (mine / "diagnoser.toml").write_text(f'name = "{name}"\nfunction = "spy:diagnose"\n')
        with pytest.raises(InputError, match="must be lower-case letters, digits and underscores"):
            find(str(mine))
    (mine / "diagnoser.toml").write_text('name = "mine"\n')
    with pytest.raises(InputError, match=r"diagnoser\.toml: .*function"):
        find(str(mine))


#: What strangers write where the answer belongs, or try to take, and what comes of it.
ATTACKS = {
    "rubbish": ("import os\nos.write(4, b'{]\\xff' * 9)\nos._exit(0)", "wrote what is no answer"),
    "layers": (
        "import os\nos.write(3, b'[\"namespaces\"]')",
        "OSError: [Errno 9] Bad file descriptor",
    ),
    "flood": ("import os\nwhile True: os.write(4, b'+' * 1_000_000)", "is longer than"),
    "text": ("raise ValueError('a\u202eb\x1b[31m' * 90)", "ValueError: a"),
    "secret": (
        "import os\nraise ValueError(os.environ.get('VENTBENCH_SIGNING_KEY', 'nothing'))",
        "ValueError: nothing",
    ),
}


@pytest.mark.parametrize("attack", ATTACKS)
def test_a_stranger_deceives_no_judge(tmp_path, monkeypatch, attack):
    monkeypatch.setenv("VENTBENCH_SIGNING_KEY", "5" * 64)
    code, expected = ATTACKS[attack]
    mine, case = tmp_path / "mine", tmp_path / "case"
    mine.mkdir()
    case.mkdir()
    (mine / "diagnoser.toml").write_text('name = "mine"\nfunction = "spy:diagnose"\n')
    body = "".join(f"    {line}\n" for line in code.splitlines())
    (mine / "spy.py").write_text(f"def diagnose(folder):\n{body}", "utf-8")
    outcome = run(find(str(mine)), case, QUICK)
    assert expected in outcome.problem
    assert outcome.problem.isprintable()
    assert outcome.answer == b""
    assert "seccomp" in outcome.layers
    assert "namespaces" not in outcome.layers


def test_who_is_nobody():
    with pytest.raises(InputError, match=r"no diagnoser 'nobody'.*refit, .*ventbench"):
        find("nobody")


def test_draws_and_diagnosers_are_scored_together(answered, tmp_path):
    other = ChallengeFolder(tmp_path / "c")
    make("other words", other.path, "null", 2, record=coarsely)
    for function in ("sees_nothing", "unsure"):
        answer(other, who(function), limits=QUICK, only=("case_0001",))
    together = reveal([answered, other], [SECRET, "other words"], "unsure")
    assert [(draw.total, draw.answered) for draw in together.draws] == [(2, 2), (2, 1)]
    assert together.unanswered == ("case_0002",)
    assert [case["draw"] for case in together.as_dict()["cases"]] == [0, 0, 1]
    folders, seeds = (str(answered.path), str(other.path)), ("--seed", SECRET)
    page = tmp_path / "page.md"
    arguments = [*folders, *seeds, "--seed", "other words"]
    done = CliRunner().invoke(app, ["challenge", "reveal", *arguments, "--diagnoser", "unsure"])
    assert done.exit_code in (0, 1)
    assert "answered 2 of 2, 1 of 2 of `first`:" in done.stdout
    missing = CliRunner().invoke(app, ["challenge", "reveal", *folders, *seeds])
    assert missing.exit_code == 2
    assert "2 folders and 1 seeds" in missing.output
    own = [*arguments, "--against", "sees_nothing", "--page", str(page)]
    done = CliRunner().invoke(app, ["challenge", "board", *own])
    assert done.exit_code == 0
    text = page.read_text()
    assert re.search(r"\n\| `first` \| unsure \| \S+ \| 3 \|", text)
    assert re.search(r"\n\| `first` \| sees_nothing \| \S+ \| 1 \|", text)
    assert "`sees_nothing` minus the other, case by case" in text
    assert f"| `{SECRET}` | `{answered.commitment.read_text().strip()}` |" in text
