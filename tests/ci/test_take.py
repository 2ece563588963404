"""Submissions from commits of strangers, hostile ones among them, by real git."""

import hashlib
import os

import pytest

from ci import git
from ci.take import PARENT, TakeError, changed_submissions, take
from ventbench.entries.folder import MAX_BYTES, open_submission

from .conftest import PATH


@pytest.fixture
def taken(repository, tmp_path):
    def run(commit, name="demo", base=None):
        return take(repository.url, base or repository.base, commit, name, tmp_path / "out")

    return run


@pytest.fixture
def refused(taken, tmp_path):
    """What is said of a commit; nothing of it may be written."""

    def run(commit, **options):
        with pytest.raises(TakeError) as caught:
            taken(commit, **options)
        assert not (tmp_path / "out").exists()
        return str(caught.value)

    return run


@pytest.fixture
def with_entry(repository, demo):
    """A commit of the good submission plus one entry of its tree that may be anything."""

    def make(mode, name, sha):
        good = repository.commit(demo, repository.base)
        entries = [tuple(line.split()) for line in _tree(repository, f"{good}:{PATH}")]
        folder = repository.tree([*[(m, n, o) for m, _, o, n in entries], (mode, name, sha)])
        parent = repository.tree([("40000", "demo", folder)])
        root = [tuple(line.split()) for line in _tree(repository, repository.base)]
        kept = [(m.lstrip("0"), n, o) for m, _, o, n in root]
        return repository.commit_tree(
            repository.tree([*kept, ("40000", PARENT, parent)]), repository.base
        )

    return make


def _tree(repository, name):
    return repository.git("ls-tree", name).splitlines()


def test_the_good_case(repository, demo, taken, tmp_path):
    commit = repository.commit(demo, repository.base)
    found = taken(commit)
    assert found.folder == tmp_path / "out" / "demo"
    assert found.tree == repository.git("rev-parse", f"{commit}:{PATH}")
    files = {f"{PATH}/{p.name}": p.read_bytes() for p in found.folder.iterdir()}
    assert files == demo
    assert all(not p.stat().st_mode & 0o111 for p in found.folder.iterdir())
    assert open_submission(str(found.folder)).manifest.name == "demo"


def test_subfolders_and_empty_files(repository, demo, taken):
    more = {f"{PATH}/pack/__init__.py": b"", f"{PATH}/pack/deep/a.py": b"\n\nx = 1\n\0"}
    found = taken(repository.commit(demo | more, repository.base))
    for path, content in more.items():
        assert (found.folder.parents[0] / path.removeprefix(f"{PARENT}/")).read_bytes() == content


def test_several_commits_and_a_base_that_went_on(repository, demo, taken):
    first = repository.commit({f"{PATH}/old.txt": b"x"}, repository.base)
    second = repository.commit(demo, first)
    later = repository.commit({"ventbench/a.py": b"x = 2\n"}, repository.base)
    found = taken(second, base=later)
    assert (found.folder / "old.txt").read_bytes() == b"x"


def test_a_merged_submission_can_be_scored_again(repository, demo, taken):
    merged = repository.commit(demo, repository.base)
    assert taken(merged, base=merged).commit == merged


@pytest.mark.parametrize(
    "commit",
    [
        "",
        "main",
        "HEAD",
        "abc123",
        "g" * 40,
        "A" * 40,
        "0" * 39,
        "0" * 41,
        "--upload-pack=x",
        "0" * 40 + "\n",
        "$(id)",
        "0" * 38 + "^0",
        "\u0660" * 40,
    ],
)
def test_only_full_names_of_commits(refused, commit):
    assert "is not 40 lower-case hexadecimal digits" in refused(commit)


@pytest.mark.parametrize("name", ["", "..", "demo/../x", "-x", "Demo", "a b", "$(id)", "demo\n"])
def test_only_names_of_submissions(repository, demo, refused, name):
    commit = repository.commit(demo, repository.base)
    assert "must be lower-case letters" in refused(commit, name=name)


def test_a_commit_that_is_not_there(taken, repository):
    with pytest.raises(git.GitError, match="git fetch failed"):
        taken("1" * 40)


def test_a_tag_is_not_a_commit(repository, demo, refused):
    commit = repository.commit(demo, repository.base)
    text = f"object {commit}\ntype commit\ntag x\ntagger A <a@b> 0 +0000\n\nx\n"
    tag = repository.git("mktag", given=text.encode())
    assert "is not a commit" in refused(tag)


def test_another_history(repository, demo, refused):
    assert "no history in common" in refused(repository.commit(demo))


@pytest.mark.parametrize(
    "path",
    [
        "ventbench/a.py",
        "ventbench/task/protocol.py",
        ".github/workflows/x.yml",
        ".gitattributes",
        "submissions/other/controller.py",
        "submissions/README.md",
        "submissions/demo2/x.md",
        "submissions/Demo/controller.py",
        "leaderboard/index.html",
        ".gitmodules",
    ],
)
def test_changes_outside(repository, demo, refused, path):
    said = refused(repository.commit(demo | {path: b"changed"}, repository.base))
    parts = path.split("/")
    place = "/".join(parts[:2]) if parts[0] == PARENT else parts[0]
    assert f"{place} is changed as well; a pull request changes submissions/demo/ alone" in said


def without(repository, commit, path):
    index = {"GIT_INDEX_FILE": str(repository.folder / "i")}
    repository.git("read-tree", commit, **index)
    gone = f"0 {'0' * 40}\t{path}\n".encode()
    repository.git("update-index", "--index-info", given=gone, **index)
    return repository.commit_tree(repository.git("write-tree", **index), repository.base)


def test_a_removed_file_outside_is_a_change(repository, demo, refused):
    good = repository.commit(demo, repository.base)
    assert "ventbench is changed as well" in refused(without(repository, good, "ventbench/a.py"))


def test_a_moved_file_is_seen_on_both_sides(repository, demo, refused):
    commit = repository.commit(demo | {f"{PATH}/a.py": b"x = 1\n"}, repository.base)
    assert "ventbench is changed as well" in refused(without(repository, commit, "ventbench/a.py"))


def test_links(repository, demo, refused):
    files = demo | {f"{PATH}/data.npz": b"/etc/passwd", f"{PATH}/up.py": b"../../ventbench/a.py"}
    modes = {f"{PATH}/data.npz": "120000", f"{PATH}/up.py": "120000"}
    said = refused(repository.commit(files, repository.base, modes=modes))
    assert "data.npz is a symbolic link" in said
    assert "up.py is a symbolic link" in said


def test_the_folder_itself_is_a_link(repository, refused):
    link = {PATH: b"../ventbench"}
    said = refused(repository.commit(link, repository.base, modes={PATH: "120000"}))
    assert f"{PATH} is changed as well" in said or "holds no folder" in said
    parent = {"submissions": b"ventbench"}
    said = refused(repository.commit(parent, repository.base, modes={"submissions": "120000"}))
    assert "holds no folder submissions/demo" in said


def test_submodules(with_entry, refused, repository):
    said = refused(with_entry("160000", "lib.py", repository.base))
    assert "lib.py is a submodule" in said


def test_a_submodule_in_place_of_the_folder(repository, refused):
    parent = repository.tree([("160000", "demo", repository.base)])
    commit = repository.commit_tree(repository.tree([("40000", PARENT, parent)]), repository.base)
    assert "holds no folder submissions/demo" in refused(commit)


def test_executables_and_hooks(repository, demo, refused):
    hook = f"{PATH}/hooks/post-checkout"
    files = demo | {hook: b"#!/bin/sh\ntouch pwned\n", f"{PATH}/run.py": b""}
    said = refused(
        repository.commit(
            files, repository.base, modes={hook: "100755", f"{PATH}/run.py": "100755"}
        )
    )
    assert "hooks/post-checkout is executable" in said
    assert "hooks/post-checkout is of a kind that is not accepted" in said
    assert "run.py is executable" in said


@pytest.mark.parametrize(
    "name", [".gitattributes", ".gitmodules", ".git", ".GIT", ".env", ".git\u200c"]
)
def test_hidden_files(with_entry, refused, repository, name):
    said = refused(with_entry("100644", name, repository.blob(b"* filter=evil\n")))
    assert "is a hidden file or folder" in said


def test_a_repository_within(with_entry, refused, repository):
    config = repository.blob(b"[core]\n\tfsmonitor = touch pwned\n")
    inner = repository.tree([("100644", "config", config)])
    assert ".git/config is a hidden file or folder" in refused(with_entry("40000", ".git", inner))


@pytest.mark.parametrize("name", ["..", ".", "a/b.py", "../x.py", "/etc.py"])
def test_names_that_lead_elsewhere(with_entry, refused, repository, name):
    said = refused(with_entry("100644", name, repository.blob(b"x")))
    assert any(w in said for w in ("plain path", "hidden", "a slash in it")), said


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("m\u0456ne.py", "other than ASCII"),
        ("a\x1b[2J.py", "may have only letters"),
        ("new\nline.py", "may have only letters"),
        ("-rf.py", "may have only letters"),
        ("aux.py", "cannot store"),
        ("C:\\x.py", "may have only letters"),
        ("a.pyc", "not accepted"),
        ("w.pkl", "not accepted"),
    ],
)
def test_names_that_deceive(with_entry, refused, repository, name, said):
    text = refused(with_entry("100644", name, repository.blob(b"x")))
    assert said in text
    assert "\x1b" not in text


def test_a_tree_in_place_of_a_file(with_entry, refused, repository):
    said = refused(with_entry("100644", "x.py", repository.tree([])))
    assert "x.py is a tree in place of a file" in said


def test_one_name_twice(with_entry, refused, repository):
    assert "controller.py is there twice" in refused(
        with_entry("100644", "controller.py", repository.blob(b"other"))
    )


def test_names_that_fold_together(repository, demo, refused):
    files = demo | {
        f"{PATH}/Controller.py": b"x",
        f"{PATH}/Pack/a.py": b"",
        f"{PATH}/pack/b.py": b"",
    }
    said = refused(repository.commit(files, repository.base))
    assert "Controller.py and controller.py differ only in upper and lower case" in said
    assert "Pack and pack differ only" in said


def test_odd_modes_are_those_of_plain_files(with_entry, taken, repository):
    path = taken(with_entry("100666", "odd.py", repository.blob(b"x"))).folder / "odd.py"
    assert not path.stat().st_mode & 0o111


@pytest.mark.parametrize("filtered", ["true", "false"])
def test_one_large_file(repository, demo, refused, filtered):
    """Where the server can leave it out, it is not even fetched."""
    repository.git("config", "uploadpack.allowFilter", filtered)
    large = {f"{PATH}/notes.txt": os.urandom(MAX_BYTES + 10)}
    said = refused(repository.commit(demo | large, repository.base))
    assert "notes.txt has over 5 MB" in said or "the folder has 5.0 MB" in said
    assert ("notes.txt" in said) == (filtered == "true")


def test_large_together(repository, demo, refused):
    large = {f"{PATH}/{k}.txt": os.urandom(MAX_BYTES // 3) for k in range(4)}
    said = refused(repository.commit(demo | large, repository.base))
    assert "the folder has 6.7 MB; at most 5 MB are accepted" in said


@pytest.mark.slow
def test_many_files(repository, demo, refused):
    many = {f"{PATH}/{k}.txt": b"" for k in range(1001)}
    said = refused(repository.commit(demo | many, repository.base))
    assert "at most 1000 are accepted" in said


def test_a_tree_that_never_ends(repository, refused):
    """Thirty small trees that list 10 ** 30 files."""
    entry, mode = repository.blob(b"x"), "100644"
    for _ in range(30):
        entry, mode = repository.tree([(mode, f"f{k}", entry) for k in range(10)]), "40000"
    inside = repository.tree([("40000", "demo", entry)])
    commit = repository.commit_tree(repository.tree([("40000", PARENT, inside)]), repository.base)
    assert "cannot be listed: git ls-tree lists more than" in refused(commit)


def test_nothing_of_the_commit_runs(repository, demo, taken, tmp_path, monkeypatch):
    """Neither hooks of the machine nor filters, nor configuration of whoever runs this."""
    ran = tmp_path / "ran"
    config = tmp_path / "config"
    config.write_text(
        f'[filter "evil"]\n\tsmudge = touch {ran}\n\tclean = touch {ran}\n'
        f"[core]\n\tfsmonitor = touch {ran}\n\thooksPath = {tmp_path}/hooks\n"
        f"[alias]\n\tcat-file = !touch {ran}\n[core]\n\tattributesFile = {tmp_path}/attributes\n"
    )
    (tmp_path / "attributes").write_text("* filter=evil\n")
    monkeypatch.setenv("GIT_CONFIG_GLOBAL", str(config))
    monkeypatch.setenv("GIT_SSH_COMMAND", f"touch {ran}")
    taken(repository.commit(demo, repository.base))
    assert not ran.exists()


@pytest.mark.parametrize(
    "source", ["ext::sh -c touch% pwned", "ssh://localhost/x", "--upload-pack=id"]
)
def test_no_other_way_of_fetching(repository, source, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(git.GitError, match="git fetch failed"):
        take(source, repository.base, repository.base, "demo", tmp_path / "out")
    assert not (tmp_path / "pwned").exists()


def test_replacement_objects_are_not_looked_at(repository, demo, taken):
    good = repository.commit(demo, repository.base)
    bad = repository.commit(demo | {f"{PATH}/x.py": b"evil"}, repository.base)
    repository.git("update-ref", f"refs/replace/{good}", bad)
    found = taken(good)
    assert not (found.folder / "x.py").exists()


def test_contents_are_those_that_git_hashed(repository, demo, taken):
    found = taken(repository.commit(demo, repository.base))
    for path in found.folder.iterdir():
        content = path.read_bytes()
        head = f"blob {len(content)}\0".encode()
        assert hashlib.sha1(head + content).hexdigest() == repository.blob(content)


def test_which_submissions_a_pull_request_changes(repository, demo):
    def of(commit, base=repository.base):
        return changed_submissions(repository.url, base, commit)

    good = repository.commit(demo, repository.base)
    assert of(good) == ["demo"]
    assert of(repository.commit({"submissions/README.md": b"x"}, repository.base)) == []
    assert of(repository.commit({"docs/x.md": b"x"}, good), good) == []
    both = repository.commit({"submissions/other/a.py": b"", f"{PATH}/a.py": b""}, good)
    assert of(both, good) == ["demo", "other"]
    later = repository.commit({"submissions/other/a.py": b""}, repository.base)
    assert of(good, later) == ["demo"], "what the base has got since is not theirs"
    with pytest.raises(TakeError, match="40 lower-case"):
        of("HEAD")
