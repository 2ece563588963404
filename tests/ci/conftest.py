"""A real repository with a base, and commits upon it as strangers make them."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Mapping
from pathlib import Path

import pytest

from ventbench.entries.scaffold import contents

from ..textbook_rigs import TextbookRigs

IDENTITY = {
    "GIT_AUTHOR_NAME": "A. Name",
    "GIT_AUTHOR_EMAIL": "a@example.org",
    "GIT_COMMITTER_NAME": "A. Name",
    "GIT_COMMITTER_EMAIL": "a@example.org",
    "GIT_CONFIG_GLOBAL": os.devnull,
    "GIT_CONFIG_NOSYSTEM": "1",
}
PATH = "submissions/demo"


class Repository:
    """Commits are made with plumbing alone, so that trees may hold what `git add` refuses."""

    def __init__(self, folder: Path, base: str | None = None):
        self.folder = folder
        self.base = base or self._begin()

    def _begin(self) -> str:
        self.git("init", "--quiet", "--bare", "--initial-branch=main", "--template=")
        self.git("config", "uploadpack.allowFilter", "true")
        self.git("config", "uploadpack.allowAnySHA1InWant", "true")
        base = self.commit({"README.md": b"the benchmark", "ventbench/a.py": b"x = 1\n"})
        self.git("update-ref", "refs/heads/main", base)
        return base

    @property
    def url(self) -> str:
        return f"file://{self.folder}"

    def git(self, *arguments: str, given: bytes = b"", **environ: str) -> str:
        run = subprocess.run(
            ["git", "-C", str(self.folder), *arguments],
            input=given,
            capture_output=True,
            check=True,
            env={**os.environ, **IDENTITY, **environ},
        )
        return run.stdout.decode().strip()

    def blob(self, content: bytes) -> str:
        return self.git("hash-object", "-w", "--stdin", given=content)

    def tree(self, entries: list[tuple[str, str, str]]) -> str:
        """Tree of (mode, name, object), which may be wrong in any way."""
        ordered = sorted(entries, key=lambda e: e[1] + ("/" if e[0] == "40000" else ""))
        data = b"".join(f"{m} {n}\0".encode() + bytes.fromhex(o) for m, n, o in ordered)
        return self.git("hash-object", "-t", "tree", "-w", "--literally", "--stdin", given=data)

    def commit_tree(self, tree: str, parent: str | None = None) -> str:
        parents = ["-p", parent] if parent else []
        return self.git("commit-tree", tree, *parents, "-m", "x")

    def commit(
        self, files: Mapping[str, bytes], parent: str | None = None, **modes: Mapping[str, str]
    ) -> str:
        """Commit that adds files to those of its parent.

        Args:
            files: content by path.
            parent: commit; none for a new history.
            modes: `modes=` by path, where not 100644.
        """
        index = str(self.folder / "index.tmp")
        if parent:
            self.git("read-tree", parent, GIT_INDEX_FILE=index)
        chosen = modes.get("modes", {})
        lines = [f"{chosen.get(p, '100644')} {self.blob(c)}\t{p}" for p, c in files.items()]
        lines_in = "".join(f"{line}\n" for line in lines).encode()
        self.git("update-index", "--add", "--index-info", given=lines_in, GIT_INDEX_FILE=index)
        tree = self.git("write-tree", GIT_INDEX_FILE=index)
        os.unlink(index)
        return self.commit_tree(tree, parent)


@pytest.fixture(scope="session")
def begun(tmp_path_factory: pytest.TempPathFactory) -> Repository:
    """What every test begins with a copy of."""
    if shutil.which("git") is None:
        pytest.skip("no git here")
    return Repository(tmp_path_factory.mktemp("begun"))


@pytest.fixture
def repository(begun: Repository, tmp_path: Path) -> Repository:
    return Repository(shutil.copytree(begun.folder, tmp_path / "repository.git"), begun.base)


@pytest.fixture
def demo() -> dict[str, bytes]:
    """Files of a good submission, by path in the repository."""
    return {f"{PATH}/{name}": content for name, content in contents("demo", "ppo").items()}


@pytest.fixture(scope="session")
def simulators() -> TextbookRigs:
    return TextbookRigs()
