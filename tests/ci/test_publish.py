"""Pages: what is published, and that nothing published before is lost."""

import hashlib
import os
import subprocess
import sys
from pathlib import Path

import pytest

from ci import publish
from ci.git import Git
from ventbench.board import store
from ventbench.errors import InputError

RECORD, OTHER = "a" * 64, "b" * 64


def chain(*records):
    """A chain of records without commands."""

    class Added:
        def __init__(self, sha256):
            self.sha256 = sha256

    lines, head = [], store.CHAIN_START
    for index, sha256 in enumerate(records):
        line = store.chain_line(index, Added(sha256), head)  # type: ignore[arg-type]
        lines.append(line)
        head = hashlib.sha256(line).hexdigest()
    return b"".join(lines)


def files(*records, **others):
    return {
        "leaderboard/index.html": b"1",
        "leaderboard/chain.jsonl": chain(*records),
        **{f"leaderboard/records/{sha256}.json": b"{}" for sha256 in records},
        **{f"leaderboard/{name}": content for name, content in others.items()},
    }


def test_pages_hold_plain_files_only(repository):
    git = Git(repository.folder)
    with pytest.raises(InputError, match="holds no leaderboard/"):
        publish.pages(git, repository.base)
    empty = repository.commit({"leaderboard/chain.jsonl": b""}, repository.base)
    with pytest.raises(InputError, match=r"index\.html is missing"):
        publish.pages(git, empty)
    link = "leaderboard/entries"
    linked = repository.commit(files() | {link: b"/etc"}, repository.base, modes={link: "120000"})
    with pytest.raises(InputError, match="entries is no plain file"):
        publish.pages(git, linked)


@pytest.mark.parametrize(
    "name",
    [
        "phish.html",
        "CNAME",
        "_config.yml",
        "records/index.html",
        f"records/{OTHER}.json",
        "entries/v1/x/a.js",
        "entries/v1/performance/a.js",
        "entries/v1/performance/a/b.html",
        "entries/v1/performance/a.html.html",
        "version-x.html",
        "sw.js",
        "404.html",
        ".well-known/security.txt",
    ],
)
def test_a_stray_file_is_not_published(repository, name):
    commit = repository.commit(files(RECORD, **{name: b"x"}), repository.base)
    with pytest.raises(InputError, match="is no part of a leaderboard") as refused:
        publish.pages(Git(repository.folder), commit)
    assert name in str(refused.value)


def test_what_was_built_is_published(repository):
    built = {
        "leaderboard.csv": b"",
        "version-1.html": b"",
        "entries/v2/robustness/a_1.html": b"",
        f"records/{RECORD}.sig": b"",
        "keys.toml": b"",
        "accepted.toml": b"",
    }
    commit = repository.commit(files(RECORD, **built), repository.base)
    made = publish.pages(Git(repository.folder), commit)
    assert made is not None
    listed = repository.git("ls-tree", "-r", "--name-only", made).splitlines()
    fixed = ["index.html", "chain.jsonl", f"records/{RECORD}.json", ".nojekyll"]
    assert sorted(listed) == sorted([*built, *fixed])


def test_pages_grow_upon_those_before(repository):
    git = Git(repository.folder)
    one = repository.commit(files(RECORD), repository.base)
    first = publish.pages(git, one)
    two = repository.commit(files(RECORD, OTHER), one)
    second = publish.pages(git, two, first)
    assert second is not None
    assert repository.git("rev-parse", f"{second}^") == first
    assert repository.git("show", f"{second}:records/{OTHER}.json") == "{}"


@pytest.mark.parametrize(
    "after", [(OTHER,), (OTHER, RECORD), (), (RECORD,)], ids=["dropped", "turned", "all", "cut"]
)
def test_published_records_stay(repository, after):
    """The chain is consistent in itself each time: its owner wrote it anew."""
    git = Git(repository.folder)
    before = repository.commit(files(RECORD, OTHER), repository.base)
    first = publish.pages(git, before)
    commit = repository.commit(files(*after), repository.base)
    assert publish.pages(git, commit) is not None, "control: without the published chain it passes"
    with pytest.raises(InputError, match="does not begin with the published chain"):
        publish.pages(git, commit, first)


def test_the_published_head_is_for_verify(repository):
    git = Git(repository.folder)
    assert publish.head(git, None) == store.CHAIN_START
    assert publish.head(git, repository.base) == store.CHAIN_START, "a branch of other origin"
    first = publish.pages(git, repository.commit(files(RECORD, OTHER), repository.base))
    assert publish.head(git, first) == store.parse_chain(chain(RECORD, OTHER))[-1].sha256


def test_publish_main(repository, monkeypatch, tmp_path, capsys):
    commit = repository.commit(files(RECORD), repository.base)
    monkeypatch.chdir(repository.folder)
    monkeypatch.setattr(sys, "argv", ["publish"])
    monkeypatch.setenv("GITHUB_OUTPUT", str(tmp_path / "output"))
    monkeypatch.setenv("COMMIT", commit)
    assert publish.main() == 0
    made = (tmp_path / "output").read_text().strip().removeprefix("commit=")
    assert repository.git("cat-file", "-t", made) == "commit"
    repository.git("update-ref", "refs/remotes/origin/gh-pages", made)
    assert publish.main() == 0
    assert (tmp_path / "output").read_text().endswith("commit=\n")
    monkeypatch.setattr(sys, "argv", ["publish", "head"])
    assert publish.main() == 0
    head = hashlib.sha256(chain(RECORD)).hexdigest()
    assert (tmp_path / "output").read_text().endswith(f"head={head}\n")
    monkeypatch.setattr(sys, "argv", ["publish"])
    monkeypatch.setenv("COMMIT", "HEAD")
    with pytest.raises(InputError, match="not the full name"):
        publish.main()
    assert "up to date" in capsys.readouterr().out


def test_the_standard_library_is_enough():
    """The job that may write installs nothing."""
    root = Path(publish.__file__).parents[1]
    code = "import sys; sys.path.insert(0, '.'); import ci.publish"
    subprocess.run(
        [sys.executable, "-S", "-c", code], check=True, cwd=root, env={"PATH": os.environ["PATH"]}
    )


SEASON = b'id = "spring"\nprotocol = 2\ncommitment = "%s"\n' % (b"a" * 64)


def test_a_published_season_stays(repository):
    git, name = Git(repository.folder), "seasons/spring.toml"
    first = publish.pages(git, repository.commit(files(RECORD, **{name: SEASON}), repository.base))
    for content, message in (
        (None, "was published and is missing"),
        (SEASON.replace(b"aaaa", b"bbbb"), "is not the one that was published"),
        (SEASON + b"more = 1\n", "is not the one that was published"),
        (b"\xff", "is not the one that was published"),
    ):
        changed = files(RECORD, **({} if content is None else {name: content}))
        commit = repository.commit(changed, repository.base)
        assert publish.pages(git, commit) is not None, "control: nothing was published before"
        with pytest.raises(InputError, match=message):
            publish.pages(git, commit, first)
    seed = SEASON + b'seed = "00"\n'
    revealed = publish.pages(
        git, repository.commit(files(RECORD, **{name: seed}), repository.base), first
    )
    assert revealed is not None
    for content in (SEASON, seed.replace(b"00", b"01")):
        commit = repository.commit(files(RECORD, **{name: content}), repository.base)
        with pytest.raises(InputError, match="is not the one that was published"):
            publish.pages(git, commit, revealed)
