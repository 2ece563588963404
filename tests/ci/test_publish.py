"""Pages: what is published, and that nothing published before is lost."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from ci import publish
from ci.git import Git
from ventbench.base.errors import InputError

RECORD, OTHER = "a" * 64, "b" * 64


def files(*records, **others):
    return {
        "leaderboard/attestations.toml": b"",
        **{f"leaderboard/records/{sha256}.json": b"{}" for sha256 in records},
        **{f"leaderboard/{name}": content for name, content in others.items()},
    }


@pytest.fixture
def site(tmp_path):
    """Pages, and a copy of a record that nobody looks at."""
    for name in ("index.html", "leaderboard.csv", "entries/r1/robustness/a_1.html"):
        (tmp_path / "site" / name).parent.mkdir(exist_ok=True, parents=True)
        (tmp_path / "site" / name).write_text(name)
    (tmp_path / "site/records").mkdir()
    (tmp_path / f"site/records/{RECORD}.json").write_text("forged")
    return tmp_path / "site"


def test_a_leaderboard_holds_plain_files_only(repository, site):
    git = Git(repository.folder)
    with pytest.raises(InputError, match="holds no leaderboard/"):
        publish.pages(git, repository.base, site)
    link = f"leaderboard/records/{OTHER}.json"
    linked = repository.commit(files() | {link: b"/etc"}, repository.base, modes={link: "120000"})
    with pytest.raises(InputError, match="is no plain file"):
        publish.pages(git, linked, site)


@pytest.mark.parametrize(
    "name",
    [
        "phish.html",
        "index.html",
        "CNAME",
        "_config.yml",
        "records/index.html",
        f"records/{OTHER}.html",
        "entries/r1/performance/a.html",
        "sw.js",
        ".well-known/security.txt",
    ],
)
def test_a_stray_file_is_not_published(repository, site, name):
    commit = repository.commit(files(RECORD, **{name: b"x"}), repository.base)
    with pytest.raises(InputError, match="is no part of a leaderboard") as refused:
        publish.pages(Git(repository.folder), commit, site)
    assert name in str(refused.value)


@pytest.mark.parametrize(
    "name",
    ["404.html", "entries/x/a.html", "entries/r1/performance/a.js", "a/a.html", "CNAME"],
)
def test_a_stray_page_is_not_published(repository, site, name):
    (site / name).parent.mkdir(exist_ok=True, parents=True)
    (site / name).write_text("x")
    commit = repository.commit(files(RECORD), repository.base)
    with pytest.raises(InputError, match="is no page of a leaderboard") as refused:
        publish.pages(Git(repository.folder), commit, site)
    assert name in str(refused.value)


def test_links_and_empty_sites_are_not_published(repository, site, tmp_path):
    git, commit = Git(repository.folder), repository.commit(files(RECORD), repository.base)
    (site / "entries/r1/performance").symlink_to("/etc")
    with pytest.raises(InputError, match="is no page of a leaderboard"):
        publish.pages(git, commit, site)
    with pytest.raises(InputError, match=r"index\.html is missing"):
        publish.pages(git, commit, tmp_path / "none")


def test_what_was_built_is_published_beside_the_records_of_the_commit(repository, site):
    signed = files(RECORD, **{f"records/{RECORD}.sig": b"", f"records/{OTHER}.actions": b"x"})
    made = publish.pages(Git(repository.folder), repository.commit(signed, repository.base), site)
    assert made is not None
    listed = repository.git("ls-tree", "-r", "--name-only", made).splitlines()
    pages = ["index.html", "leaderboard.csv", "entries/r1/robustness/a_1.html", ".nojekyll"]
    assert sorted(listed) == sorted(
        [*(name.removeprefix("leaderboard/") for name in signed), *pages]
    )
    assert repository.git("show", f"{made}:records/{RECORD}.json") == "{}", "not the site's"
    assert repository.git("show", f"{made}:index.html") == "index.html"


def test_pages_grow_upon_those_before(repository, site):
    git = Git(repository.folder)
    one = repository.commit(files(RECORD), repository.base)
    first = publish.pages(git, one, site)
    assert publish.pages(git, one, site, first) is None, "nothing new"
    second = publish.pages(git, repository.commit(files(RECORD, OTHER), one), site, first)
    assert second is not None
    assert repository.git("rev-parse", f"{second}^") == first
    assert repository.git("show", f"{second}:records/{OTHER}.json") == "{}"


def test_published_records_and_commands_stay(repository, site):
    git, commands = Git(repository.folder), f"records/{OTHER}.actions"
    before = files(RECORD, **{commands: b"x", f"records/{RECORD}.sig": b"signed"})
    first = publish.pages(git, repository.commit(before, repository.base), site)
    for after, message in (
        (files(**{commands: b"x"}), f"{RECORD}.json was published and is missing"),
        (files(RECORD), f"{OTHER}.actions was published and is missing"),
        (files(RECORD, **{commands: b"y"}), "actions is not what was published"),
    ):
        commit = repository.commit(after, repository.base)
        assert publish.pages(git, commit, site) is not None, "control: nothing was published"
        with pytest.raises(InputError, match=message):
            publish.pages(git, commit, site, first)
    # A signature goes with a key that leaked.
    unsigned = repository.commit(files(RECORD, **{commands: b"x"}), repository.base)
    assert publish.pages(git, unsigned, site, first) is not None


def test_publish_main(repository, site, monkeypatch, tmp_path, capsys):
    commit = repository.commit(files(RECORD), repository.base)
    monkeypatch.chdir(repository.folder)
    monkeypatch.setenv("GITHUB_OUTPUT", str(tmp_path / "output"))
    monkeypatch.setenv("COMMIT", commit)
    monkeypatch.setenv("SITE", str(site))
    assert publish.main() == 0
    made = (tmp_path / "output").read_text().strip().removeprefix("commit=")
    assert repository.git("cat-file", "-t", made) == "commit"
    repository.git("update-ref", "refs/remotes/origin/gh-pages", made)
    assert publish.main() == 0
    assert (tmp_path / "output").read_text().endswith("commit=\n")
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
