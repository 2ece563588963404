"""From a commit to a record, from the record to the leaderboard's branch, from there to pages."""

import json
import subprocess

import pytest

from ci import official, propose, publish, workflow
from ci.git import Git, GitError, environment
from ci.take import TakeError, take
from ventbench.base.errors import InputError
from ventbench.board import attestation, build, canonical, record, store
from ventbench.entries.runner import InProcessRunner
from ventbench.entries.scaffold import contents
from ventbench.sandbox.runner import SandboxRunner

from .conftest import PATH


def checked_out(repository, folder):
    subprocess.run(
        ["git", "clone", "--quiet", repository.url, str(folder)],
        check=True,
        capture_output=True,
        env=environment(),
    )
    return folder


@pytest.mark.parametrize(
    "runner", [InProcessRunner, pytest.param(SandboxRunner, marks=pytest.mark.slow)]
)
def test_from_a_commit_to_the_pages(repository, simulators, reference, tmp_path, runner):
    """Everything in one, as scoring takes its time."""
    files = {f"{PATH}/{name}": content for name, content in contents("demo", "pid").items()}
    commit = repository.commit(files, repository.base)
    taken = take(repository.url, repository.base, commit, "demo", tmp_path / "taken")
    out, wanted = tmp_path / "records", "robustness"
    given = (taken, repository.url, wanted, simulators, runner(), out)
    lines = official.score_taken(*given, reference)
    path = check_record(repository, commit, out, lines)

    leaderboard = checked_out(repository, tmp_path / "checkout") / "leaderboard"
    with pytest.raises(InputError, match="does not replay"):
        propose.add(forged(path, tmp_path / "forged"), leaderboard, simulators)
    assert not (leaderboard / "records").exists()
    added = propose.add(out, leaderboard, simulators)
    assert [record.name for record in store.load(leaderboard).scores] == ["demo"]
    check_branch_and_pages(leaderboard.parent, added)
    with pytest.raises(InputError, match="already"):
        propose.add(out, leaderboard, simulators)  # a second time
    check_scored_again(path, tmp_path / "again", leaderboard, simulators, added)


def check_record(repository, commit, out, lines):
    (path,) = propose.records(out)
    found = record.load(path)
    assert isinstance(found, record.Record)
    assert (found.name, found.track) == ("demo", "robustness")
    assert not found.official, "its simulators are textbook lungs, not the frozen ones"
    assert found.header.provenance == {
        "repository": repository.url,
        "commit": commit,
        "tree": repository.git("rev-parse", f"{commit}:{PATH}"),
    }
    assert path.name in lines[-2]
    assert "not official: " in lines[-1]
    assert "not on the frozen simulators" in lines[-1]
    assert not any("/tmp" in line for line in lines)
    return path


def check_scored_again(path, folder, leaderboard, simulators, added):
    """A second run of the same commit, an hour later."""
    values = json.loads(path.read_text()) | {"created": "2030-01-01T00:00:00Z"}
    content = canonical.canonical(values)
    folder.mkdir()
    (folder / f"{canonical.digest(content)}.json").write_bytes(content)
    for other in set(path.parent.iterdir()) - {path}:
        (folder / other.name).write_bytes(other.read_bytes())
    secret = "01" * 32
    public = attestation._private(secret).public_key().public_bytes_raw()
    (leaderboard / "attestations.toml").write_text(
        f'[[keys]]\nid = "{attestation.key_id(public)}"\npublic = "{public.hex()}"\n'
        'added = 2026-11-23\nholder = "a test"\n'
    )
    (new,) = propose.add(folder, leaderboard, simulators, secret)
    assert attestation.attested(leaderboard, [new.sha256, added[0].sha256]) == ({new.sha256}, [])
    assert isinstance(new, record.Record)
    assert new.header.supersedes == added[0].sha256
    assert new.header.reason == propose.SCORED_AGAIN


def forged(path, folder):
    """The same record with a better score, under the name that its content now has."""
    content = json.loads(path.read_text())
    content["errors"]["nominal"][0][0] *= 0.5
    changed = canonical.canonical(content)
    folder.mkdir()
    (folder / f"{canonical.digest(changed)}.json").write_bytes(changed)
    for other in set(path.parent.iterdir()) - {path}:
        (folder / other.name).write_bytes(other.read_bytes())
    return folder


def check_branch_and_pages(checkout, added):
    branch = propose.commit(checkout, added)
    assert branch == f"record/demo-{added[0].sha256[:12]}"
    git = Git(checkout)
    assert git.text("rev-parse", "--abbrev-ref", "HEAD") == branch
    changed = git.text("diff-tree", "-r", "--name-only", "origin/main", "HEAD").splitlines()
    assert changed
    assert all(path.startswith("leaderboard/") for path in changed)
    assert git.text("status", "--porcelain") == ""
    head = git.text("rev-parse", "HEAD")
    site = checkout.parent / "site"
    build.build(checkout / "leaderboard", site)
    pages = publish.pages(git, head, site)
    assert pages is not None
    listed = set(git.text("ls-tree", "-r", "--name-only", pages).splitlines())
    built = {"index.html", "leaderboard.csv", "entries/robustness/demo.html", ".nojekyll"}
    assert listed == {path.removeprefix("leaderboard/") for path in changed} | built
    assert publish.pages(git, head, site, pages) is None, "nothing new"


def test_downloads_that_are_no_records(tmp_path):
    folder = tmp_path / "records"
    folder.mkdir()
    with pytest.raises(InputError, match="holds 0 records"):
        propose.records(folder)
    for k in range(3):
        (folder / f"{k}{'0' * 63}.json").write_text("{}")
    with pytest.raises(InputError, match="holds 3 records"):
        propose.records(folder)
    (folder / "link").symlink_to("/etc/passwd")
    with pytest.raises(InputError, match="link is no plain file"):
        propose.records(folder)


@pytest.fixture
def score_demo(repository, simulators, tmp_path):
    def run(files, wanted="all"):
        commit = repository.commit(files, repository.base)
        taken = take(repository.url, repository.base, commit, "demo", tmp_path / "taken")
        out = tmp_path / "out"
        try:
            runner = InProcessRunner()
            return official.score_taken(taken, "url", wanted, simulators, runner, out)
        finally:
            assert not out.exists()

    return run


def test_what_is_not_ready_is_not_scored(demo, score_demo):
    with pytest.raises(TakeError, match="imports torch"):
        score_demo(demo | {f"{PATH}/controller.py": b"import torch\n"})


class Unsteady(InProcessRunner):
    """Answers a little differently in each run of the whole protocol."""

    runs = 0

    def start(self, submission, tasks):
        session = super().start(submission, tasks)
        if len(tasks) == 6 * 21 * 6:
            self.runs += 1
            answers, shift = session.answers, 1e-12 * self.runs

            def shifted():
                cells, commands = answers()
                return cells, commands + shift

            session.answers = shifted  # type: ignore[method-assign]
        return session


def test_what_two_runs_do_not_agree_on_is_not_scored(repository, simulators, tmp_path):
    files = {f"{PATH}/{name}": content for name, content in contents("demo", "pid").items()}
    commit = repository.commit(files, repository.base)
    taken = take(repository.url, repository.base, commit, "demo", tmp_path / "taken")
    runner, out = Unsteady(), tmp_path / "out"
    with pytest.raises(TakeError, match="a second run gave other commands in 756 cells"):
        official.score_taken(taken, "url", "robustness", simulators, runner, out)
    assert runner.runs == 2
    assert not out.exists()


def test_another_name_is_not_scored(demo, score_demo):
    manifest = f"{PATH}/submission.toml"
    with pytest.raises(TakeError, match="calls it other, not demo"):
        score_demo(demo | {manifest: demo[manifest].replace(b'"demo"', b'"other"')})


def test_tracks():
    assert official.tracks("all", ("robustness", "performance")) == ["robustness", "performance"]
    assert official.tracks("robustness", ("robustness",)) == ["robustness"]
    for wanted in ("performance", "x; id", ""):
        with pytest.raises(InputError, match="the submission enters robustness"):
            official.tracks(wanted, ("robustness",))


def test_main_reads_the_environment(repository, demo, simulators, tmp_path, monkeypatch, capsys):
    """As the workflow calls it, with a commit that is refused."""
    commit = repository.commit(demo | {"ventbench/x.py": b""}, repository.base)
    given = {
        "SOURCE": repository.url,
        "BASE": repository.base,
        "COMMIT": commit,
        "NAME": "demo",
        "TRACK": "all",
        "OUT": str(tmp_path / "out"),
    }
    for key, value in given.items():
        monkeypatch.setenv(key, value)
    assert workflow.run(official.TITLE, official.main) == 2
    assert "| stopped: ventbench is changed as well" in capsys.readouterr().out
    assert not (tmp_path / "out").exists()


def test_a_branch_is_not_overwritten(repository, tmp_path):
    checkout = checked_out(repository, tmp_path / "checkout")

    class One:
        name, sha256, track = "demo", "a" * 64, "robustness"

    (checkout / "leaderboard").mkdir()
    (checkout / "leaderboard" / "x").write_text("x")
    propose.commit(checkout, [One()])  # type: ignore[list-item]
    with pytest.raises(GitError, match="already exists"):
        propose.commit(checkout, [One()])  # type: ignore[list-item]
