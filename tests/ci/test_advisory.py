"""What the author of a pull request is told."""

import pytest

from ci import advisory
from ventbench.entries.runner import InProcessRunner
from ventbench.sandbox.runner import SandboxRunner

from .conftest import PATH


@pytest.fixture
def advise(repository, simulators):
    def run(commit, runner=None):
        pull = repository.url, repository.base, commit
        return advisory.advise(*pull, "demo", simulators.scored(), runner or SandboxRunner())

    return run


def test_a_good_one_is_scored_in_the_sandbox(repository, demo, advise):
    ready, lines = advise(repository.commit(demo, repository.base))
    assert ready
    text = "\n".join(lines)
    assert "demo: no problems; ready to submit" in text
    assert "demo: robustness: " in text
    assert "demo: performance: " in text
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
