"""git with limits."""

import pytest

from ci.git import Git, GitError


def test_output_has_an_end(repository):
    git = Git(repository.folder)
    assert git.text("cat-file", "-t", repository.base) == "commit"
    assert git.output("cat-file", "--batch", given=repository.base.encode(), limit=1000)
    with pytest.raises(GitError, match="git cat-file lists more than 10 bytes"):
        git.output("cat-file", "-p", repository.base, limit=10)


def test_time_has_an_end(repository):
    wait = ("-c", "alias.wait=!sleep 20", "wait")
    with pytest.raises(GitError, match=r"took over 0\.2 s"):
        Git(repository.folder, timeout_s=0.2).output(*wait)


def test_what_git_says_is_told(repository):
    with pytest.raises(GitError, match="git cat-file failed: fatal: Not a valid object name x"):
        Git(repository.folder).output("cat-file", "-p", "x")
