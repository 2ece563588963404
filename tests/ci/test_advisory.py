"""What the author of a pull request is told."""

import re
import tomllib

import pytest

import ventbench
from ci import advisory
from ventbench.base.text import number
from ventbench.entries.cells import InProcessRunner
from ventbench.plants.rigs import load_rigs
from ventbench.sandbox.runner import SandboxRunner

from .conftest import PATH


@pytest.fixture
def advise(repository, simulators):
    def run(commit, runner=None):
        pull = repository.url, repository.base, commit
        runner = runner or SandboxRunner()
        return advisory.advise(*pull, "demo", simulators.scored(), runner, draws=0)

    return run


def test_a_good_one_is_scored_in_the_sandbox(repository, demo, advise):
    ready, lines = advise(repository.commit(demo, repository.base))
    assert ready
    text = "\n".join(lines)
    assert "demo: no problems; ready to submit" in text
    assert "demo: robustness: " in text
    assert re.search(r"demo: performance: \d\.\d{3} cmH2O nominal", text)
    assert "/tmp" not in text


def test_problems_of_the_folder_and_of_the_code(repository, demo, advise):
    outside = demo | {"ventbench/task/protocol.py": b"PIPS = ()"}
    ready, lines = advise(repository.commit(outside, repository.base))
    assert not ready
    assert "ventbench is changed as well" in lines[0]
    broken = demo | {f"{PATH}/controller.py": b"import torch\n", f"{PATH}/README.md": b""}
    ready, lines = advise(repository.commit(broken, repository.base))
    assert not ready
    assert any("imports torch" in line for line in lines)
    assert any("README.md: is empty" in line for line in lines)
    assert not any("cmH2O" in line for line in lines)


def test_another_name_is_refused(repository, demo, advise):
    manifest = f"{PATH}/submission.toml"
    renamed = demo | {manifest: demo[manifest].replace(b'"demo"', b'"other"')}
    ready, lines = advise(repository.commit(renamed, repository.base), InProcessRunner())
    assert not ready
    assert lines[-1] == "demo: submission.toml calls it other"


def test_the_job_shows_it_on_the_pull_request(
    repository, demo, simulators, monkeypatch, tmp_path, capsys
):
    """The whole job on its variables, without a sandbox; what it shows needs no right to write."""
    monkeypatch.setattr("ventbench.plants.rigs.load_rigs", simulators.scored)
    monkeypatch.setattr("ventbench.sandbox.runner.SandboxRunner", lambda **_: InProcessRunner())
    monkeypatch.setattr(advisory, "COUNT", 1)
    commit = repository.commit(demo, repository.base)
    page = tmp_path / "summary"
    for name, value in {
        "SOURCE": repository.url,
        "BASE": repository.base,
        "COMMIT": commit,
        "GITHUB_ACTIONS": "true",
        "GITHUB_STEP_SUMMARY": str(page),
    }.items():
        monkeypatch.setenv(name, value)
    assert advisory.main() == 0
    (shown,) = [x for x in capsys.readouterr().out.splitlines() if x.startswith("::")]
    assert shown.startswith(
        f"::notice file={PATH}/submission.toml,line=1,title=Advisory score (not official)::"
    )
    assert "%0Ademo: performance: " in shown
    assert "cmH2O over 1 draws" in page.read_text("utf-8")


@pytest.mark.slow
def test_the_score_that_ranks_is_the_one_shown(repository, demo):
    """As a score of the same files by hand."""
    rigs, runner = load_rigs(), InProcessRunner()
    pull = repository.url, repository.base, repository.commit(demo, repository.base)
    ready, lines = advisory.advise(*pull, "demo", rigs, runner, 20)
    assert ready
    track = tomllib.loads(demo[f"{PATH}/submission.toml"].decode())["tracks"][0]
    folder = repository.folder / "demo"
    folder.mkdir()
    for path, content in demo.items():
        (folder / path.removeprefix(f"{PATH}/")).write_bytes(content)
    score = ventbench.score(str(folder), draws=20, track=track, sandbox=False)
    assert score.normalised is not None
    ranked = score.normalised[:, 1:][:, score.ranked].mean()
    assert f"demo: {track}: normalised {number(ranked, 1)} [" in "\n".join(lines)
