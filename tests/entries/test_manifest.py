import re

import pytest

from ventbench.entries.manifest import Training, check_manifest, read_manifest
from ventbench.sandbox.child.cell import SubmissionError

from .conftest import MANIFEST


@pytest.fixture
def problems(tmp_path):
    def of(text):
        path = tmp_path / "submission.toml"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        with pytest.raises(SubmissionError) as caught:
            read_manifest(path, "mine/submission.toml")
        assert str(caught.value) == "\n".join(caught.value.problems)
        return list(caught.value.problems)

    return of


def test_good(tmp_path):
    path = tmp_path / "submission.toml"
    path.write_text(MANIFEST + '[training]\ndata = "none"\nseeds = [1, 2]\nper_lung = true\n')
    manifest = read_manifest(path)
    assert manifest.name == "mine"
    assert manifest.authors == ("A. Name",)
    assert manifest.tracks == ("robustness", "performance")
    assert manifest.training == Training("none", "", (1, 2), "", True)
    path.write_text(MANIFEST)
    assert read_manifest(path).training == Training()


def test_every_problem_at_once(problems):
    text = """
name = "Mine!"
authors = []
licence = 3
api_version = 2
family = "pdi"
tracks = ["robustness", "robustness"]
licens = "MIT"
[training]
seeds = [1, true]
per_lung = "yes"
datum = ""
"""
    assert problems(text) == [
        "mine/submission.toml, key name: 'Mine!' must be lower-case letters, digits and "
        "underscores, begin with a letter and have at most 40 characters",
        "mine/submission.toml, key authors: expected `array` of length >= 1",
        "mine/submission.toml, key licence: expected `str`, got `int`",
        "mine/submission.toml, key api_version: 2 is not supported; this ventbench speaks "
        "version 1",
        "mine/submission.toml, key family: 'pdi' is not one of pid, residual, ppo, dqn, other; "
        "did you mean pid?",
        "mine/submission.toml, key tracks: contains something twice",
        "mine/submission.toml, key 'licens' is not known; did you mean licence?",
        "mine/submission.toml, key description: is missing",
        "mine/submission.toml, key training.seeds: expected `int`, got `bool` - at `$[1]`",
        "mine/submission.toml, key training.per_lung: expected `bool`, got `str`",
        "mine/submission.toml, key training.'datum' is not known; did you mean data?",
    ]


@pytest.mark.parametrize("key", ["name", "authors", "licence", "api_version", "family", "tracks"])
@pytest.mark.parametrize(
    "value", ["1.5", "true", "[]", "{}", "[[]]", "[{}]", '""', "2020-01-01", '"\\u0000"', "-1"]
)
def test_any_type_anywhere(problems, key, value):
    text = re.sub(f"^{key} = .*$", lambda _: f"{key} = {value}", MANIFEST, flags=re.M)
    (problem,) = problems(text)
    assert problem.startswith(f"mine/submission.toml, key {key}: ")


@pytest.mark.parametrize("value", ["1", '"none"', "[]", "[[1]]"])
def test_training_must_be_a_table(problems, value):
    assert problems(f"{MANIFEST}training = {value}\n") == [
        "mine/submission.toml, key training: must be a table, [training]"
    ]


def test_syntax_error_names_the_line(problems):
    (problem,) = problems('name = "x"\nauthors = [\n\n')
    assert re.search(r"mine/submission.toml: not TOML: .*(line|end of document)", problem)
    (problem,) = problems("name = 'x'\nfoo bar\n")
    assert "at line 2" in problem


@pytest.mark.parametrize(
    ("content", "what"),
    [
        (b"name = '\xff'", "not UTF-8 text (byte 8)"),
        (b"a = " + b"[" * 30_000, "not TOML"),
        (b"#" * 70_000, "larger than 64 kB"),
        (b'name = "a"\nname = "b"', "not TOML"),
    ],
)
def test_hostile_files(problems, content, what):
    (problem,) = problems(content)
    assert what in problem


def test_hostile_text(problems):
    (problem,) = problems(MANIFEST.replace("A test.", "x\\u202etxt.exe"))
    assert problem.endswith("key description: contains characters that cannot be printed")
    (problem,) = problems(MANIFEST.replace("A test.", "x" * 2001))
    assert problem.endswith("is longer than 2000 characters")


def test_missing_file(tmp_path):
    with pytest.raises(SubmissionError, match="cannot be read: No such file"):
        read_manifest(tmp_path / "submission.toml")


def manifest_of(demo, text):
    (demo / "submission.toml").write_text(text)
    return check_manifest(demo)


def test_manifest_problems_have_lines(demo):
    text = MANIFEST.replace('"other"', '"pdi"').replace("licence", "license")
    findings = manifest_of(demo, f'{text}\n[training]\ndata = "x"\nseeds = 3\n"se\'ed" = 1\n')
    assert [(f.line, f.what) for f in findings] == [
        (3, "key license is not known; did you mean licence?"),
        (5, "key family 'pdi' is not one of pid, residual, ppo, dqn, other; did you mean pid?"),
        (None, "key licence is missing"),
        (11, "key training.seeds expected `array`, got `int`"),
        (12, "key training.se'ed is not known; did you mean seeds?"),
    ]
    assert findings[2].advice == 'write licence = "Apache-2.0"'


def test_broken_toml_has_line_and_column(demo):
    (finding,) = manifest_of(demo, MANIFEST + "training = = 1\n")
    assert (finding.line, finding.column) == (8, 12)
    assert finding.what == "not TOML: Invalid value"


def test_what_a_manifest_says_is_looked_at(demo):
    text = MANIFEST.replace('"Apache-2.0"', '"Apache 2"') + "[training]\nper_lung = true\n"
    findings = manifest_of(demo, text.replace('"other"', '"ppo"'))
    assert [(f.problem, f.line, f.what.split(" ")[1]) for f in findings] == [
        (True, 3, "licence"),
        (False, 1, "name"),
        (False, 9, "training.per_lung"),
        (False, None, "training.data"),
    ]
