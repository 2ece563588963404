from __future__ import annotations

import dataclasses
import json
import os
import shutil
from contextlib import contextmanager
from functools import partial

import numpy as np
import pytest
from typer.testing import CliRunner

from proofs.__main__ import app
from proofs.challenge import requests
from proofs.challenge import reveal as reveal_module
from proofs.challenge.answer import answer
from proofs.challenge.first.rig import record
from proofs.challenge.folder import ChallengeFolder
from proofs.challenge.make import make
from proofs.challenge.reveal import pool, reveal
from ventbench.base.errors import InputError
from ventbench.base.executor import InProcess
from ventbench.recordings import load

from .truths import GivenDiagnosis, mechanism, request, sees_nothing
from .truths import answer as made_up

SECRET = "for the test"

# These tests are about files and rounds, not about the accuracy of the integration.
coarsely = partial(record, steps=8)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    out = tmp_path_factory.mktemp("challenge") / "c"
    promised = make(SECRET, out, "masked", 3, record=coarsely)
    return out, promised


@pytest.fixture(scope="module")
def answered(made):
    """All answered by one who knows the truth, but is not sure and asks for more."""
    folder = ChallengeFolder(made[0])
    names = {
        load(folder.recording(drawn.case.name)).sha256: [e.name for e in drawn.case.effects]
        for drawn, _ in folder.truth(SECRET)
    }

    def knows(breaths, lung):
        assert set(breaths.lung_ids) == {lung}
        named = [mechanism(name, "inertance") for name in names[breaths.sha256]]
        return GivenDiagnosis(made_up("named", *named)["diagnosis"], request())

    assert answer(folder, jobs=0, diagnose=knows) == {}
    return folder


def test_public_files_tell_nothing(made):
    out, promised = made
    assert (out / "commitment.txt").read_text() == promised + "\n"
    entries = json.loads((out / "cases.json").read_text())["cases"]
    assert [sorted(entry) for entry in entries] == [["file", "lung", "sha256"]] * 3
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


def test_answers_go_on_where_they_stopped(made):
    folder, seen = ChallengeFolder(made[0], 1), []

    def fails(breaths, lung):
        seen.append(lung)
        raise ValueError("no idea")

    problems = answer(folder, jobs=0, diagnose=fails)
    waiting = 3 - len(folder.answers())
    assert len(seen) == len(problems) == waiting
    assert all(text == "ValueError: no idea" for text in problems.values())


def test_processes_make_room_for_new_ones(made, tmp_path):
    folder = ChallengeFolder(tmp_path / "c")
    shutil.copytree(made[0], folder.path, ignore=shutil.ignore_patterns("answers", "requests"))
    told = []
    failed = answer(
        folder, jobs=1, diagnose=sees_nothing, cases_per_process=2,
        progress=lambda *done: told.append(done),
    )  # fmt: skip
    assert failed == {}
    assert told == [(0, 3), (1, 3), (2, 3), (3, 3)]
    firsts = [value["first_in_process"] for value in folder.answers().values()]
    assert firsts == [True, False, True]


@pytest.mark.slow
@pytest.mark.filterwarnings("default")  # of Dask's own, about ports and closing
def test_a_cluster_that_loses_a_worker_makes_and_answers_all(made, tmp_path):
    distributed = pytest.importorskip("distributed", reason="the extra ventbench[dask] is missing")
    folder = ChallengeFolder(tmp_path / "c")
    killed = []

    def lose_one(done, total):
        if done == 1:
            worker = next(iter(cluster.workers.values()))
            os.kill(worker.pid, 9)
            killed.append(worker.pid)

    started = distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None,
        host="127.0.0.1", local_directory=str(tmp_path),
    )  # fmt: skip
    with started as cluster:
        address = cluster.scheduler_address
        promised = make(SECRET, folder.path, "masked", 3, scheduler=address, record=coarsely)
        failed = answer(folder, scheduler=address, diagnose=sees_nothing, progress=lose_one)
    assert promised == made[1]
    assert failed == {}
    assert len(killed) == 1
    assert sorted(folder.answers()) == sorted(folder.cases())


def test_a_recording_that_cannot_be_read_does_not_stop_the_others(tmp_path):
    folder = ChallengeFolder(tmp_path / "c")
    make(SECRET, folder.path, "null", 2, record=coarsely)
    text = folder.recording("case_0001").read_text().splitlines()
    text[5] = text[5].rpartition(",")[0] + ",259.2"
    folder.recording("case_0001").write_text("\n".join(text) + "\n")
    problems = answer(folder, jobs=0, diagnose=lambda breaths, lung: GivenDiagnosis({"ok": True}))
    assert list(problems) == ["case_0001"]
    assert "column pressure: 259.2 is outside -20..120 cmH2O" in problems["case_0001"]
    assert list(folder.answers()) == ["case_0002"]


def test_the_one_who_knows_is_right(answered):
    done = []

    def unneeded(breaths, lung):
        done.append(lung)
        return GivenDiagnosis({})

    assert answer(answered, jobs=0, diagnose=unneeded) == {}
    assert not done  # nothing was left
    found = reveal(answered, SECRET)
    masked = next(f for f in found.figures if f.what.startswith("masked: right"))
    assert masked.value in (1.0, None)
    assert all(case.named == case.library for case in found.cases)
    assert found.unanswered == ()
    assert sum(sum(row.values()) for row in found.confusion.values()) == 3


def test_fits_that_know_the_truth_run_where_they_are_told(answered, monkeypatch):
    asked = []

    @contextmanager
    def cluster(*where):
        asked.append(where)
        yield InProcess()

    monkeypatch.setattr(reveal_module, "executor", cluster)
    monkeypatch.setattr(reveal_module, "oracle_rmse_of_file", lambda path, held_out, names: 0.5)
    found = reveal(answered, SECRET, with_oracle=True, scheduler="tcp://elsewhere:8786")
    assert asked == [(0, "tcp://elsewhere:8786")]
    ratio = next(f for f in found.figures if f.what.endswith("oracle's, median"))
    assert ratio.value == np.median([case.after / 0.5 for case in found.cases])


def test_more_breaths_resolve(answered):
    names = requests.record(answered, SECRET)
    assert len(names) == 3
    second = ChallengeFolder(answered.path, 2)
    first, longer = load(answered.recording(names[0])), load(second.recording(names[0]))
    assert len(longer) == len(first) + 2
    np.testing.assert_array_equal(longer.pressure[:-2], first.pressure)
    np.testing.assert_allclose(longer.u_in[-1, :20], 8.0)
    assert longer.breath_id[-1] == first.breath_id[-1] + 2
    assert longer.pressure[-1].max() > longer.pressure[-1, 0] + 2
    truths = {d.case.name: d.case for d, _ in answered.truth(SECRET)}
    calls = iter(names)

    def knows(breaths, lung):
        named = [mechanism(e.name) for e in truths[next(calls)].effects]
        return GivenDiagnosis(made_up("named", *named)["diagnosis"])

    assert answer(second, jobs=0, diagnose=knows) == {}
    found = reveal(second, SECRET)
    resolved = next(f for f in found.figures if f.what.startswith("confusable"))
    assert (resolved.value, resolved.count) == (1.0, 3)
    assert found.unanswered == ()
    second.answer(names[0]).unlink()
    assert reveal(second, SECRET).unanswered == (names[0],)
    answered.request(names[0]).unlink()  # as if it had asked for nothing
    assert reveal(second, SECRET).unanswered == ()


def test_an_answer_to_another_recording_is_refused(answered):
    path = answered.answer("case_0002")
    kept = path.read_text()
    path.write_text(json.dumps(json.loads(kept) | {"recording_sha256": "0"}))
    with pytest.raises(InputError, match="another recording"):
        reveal(answered, SECRET)
    path.write_text(kept)


def test_a_changed_recording_is_refused(answered):
    path = answered.recording("case_0003")
    kept = path.read_text()
    path.write_text(kept.replace("\n1,", "\n1 ,", 1))
    with pytest.raises(InputError, match="not the recording that the challenge was made with"):
        reveal(answered, SECRET)
    path.write_text(kept)


def test_a_request_must_be_one(tmp_path):
    path = tmp_path / "r.csv"
    requests.write(path, request(), 61)
    back = requests.read(path)
    np.testing.assert_allclose(back.u_in, request().u_in)
    np.testing.assert_allclose(np.diff(back.time), 0.033, atol=1e-6)
    path.write_text("a,b\n1,2\n")
    with pytest.raises(InputError, match="columns must be"):
        requests.read(path)
    path.write_text("breath_id,time_step,u_in,u_out\n1,0,120,0\n1,1,0,0\n")
    with pytest.raises(InputError, match=r"0\.\.100"):
        requests.read(path)
    path.write_text("breath_id,time_step,u_in,u_out\n1,0,x,0\n")
    with pytest.raises(InputError, match="not a table"):
        requests.read(path)


def test_commands(answered):
    done = CliRunner().invoke(
        app, ["challenge", "reveal", str(answered.path), "--seed", SECRET, "--json", "-"]
    )
    assert done.exit_code in (0, 1)
    value = json.loads(done.stdout)
    published = (answered.path / "commitment.txt").read_text().strip()
    assert value["draws"] == [{"commitment": published, "total": 3, "answered": 3}]
    assert len(value["cases"]) == 3
    helped = CliRunner().invoke(app, ["challenge", "--help"])
    assert all(name in helped.stdout for name in ("make", "answer", "record", "reveal"))


def test_draws_are_scored_together(answered, tmp_path):
    other = ChallengeFolder(tmp_path / "c")
    make("other words", other.path, "null", 2, record=coarsely)
    assert answer(other, jobs=0, diagnose=sees_nothing) == {}
    other.answer("case_0002").unlink()
    together = pool([reveal(answered, SECRET), reveal(other, "other words")])
    assert [(draw.total, draw.answered) for draw in together.draws] == [(3, 3), (2, 1)]
    assert together.unanswered == ("case_0002",)
    assert [case.kind for case in together.cases] == ["masked"] * 3 + ["null"]
    assert [case["draw"] for case in together.as_dict()["cases"]] == [0, 0, 0, 1]
    shares = {figure.what: figure for figure in together.figures}
    visible = [case for case in together.cases if case.kind == "masked" and case.visible]
    assert shares["masked: right name and nothing else"].count == len(visible) > 0
    assert shares["nothing missing: said so"].count == 1
    folders, seeds = (str(answered.path), str(other.path)), ("--seed", SECRET)
    page = tmp_path / "page.md"
    done = CliRunner().invoke(
        app,
        ["challenge", "reveal", *folders, *seeds, "--seed", "other words", "--page", str(page)],
    )
    assert done.exit_code in (0, 1)
    assert "| 3 of 3 |" in page.read_text()
    assert "| 1 of 2 |" in page.read_text()
    missing = CliRunner().invoke(app, ["challenge", "reveal", *folders, *seeds])
    assert missing.exit_code == 2
    assert "2 folders and 1 seeds" in missing.output


def test_a_draw_counts_once_and_generators_apart(answered):
    opened = reveal(answered, SECRET)
    with pytest.raises(InputError, match="given twice"):
        pool([opened, opened])
    foreign = dataclasses.replace(
        opened, draws=(dataclasses.replace(opened.draws[0], commitment="0"),), generator="stranger"
    )
    with pytest.raises(InputError, match="first and stranger have figures of their own"):
        pool([opened, foreign])


def test_command_with_another_seed(answered):
    with pytest.raises(InputError, match="was published"):
        CliRunner().invoke(
            app,
            ["challenge", "reveal", str(answered.path), "--seed", "x"],
            catch_exceptions=False,
        )
