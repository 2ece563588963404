"""Records come alone, and requests are the platform's word."""

from __future__ import annotations

from pathlib import Path

import pytest

from ci import apart
from ci.requests import requests
from ventbench.base.errors import InputError

ROOT = Path(apart.__file__).parents[1]

RECORD = f"leaderboard/records/{'1' * 64}.json"


@pytest.mark.parametrize(
    "path",
    [
        "leaderboard/attestations.toml",
        "leaderboard/rounds/2027-1/round.toml",
        "leaderboard/rounds/2027-1/frozen.toml",
        "leaderboard/rounds/2027-1/protocol.json",
        "leaderboard/rounds/2027-1/beacon.json",
        "ventbench/board/beacon.py",
        "ventbench/task/metrics/score.py",
        "ventbench/sandbox/runner.py",
        "ventbench/plants/rigs.py",
        "data/simulators/v2/manifest.json",
        "requirements.lock",
        ".github/workflows/test.yml",
        "ci/apart.py",
    ],
)
def test_records_do_not_come_with_what_vouches_for_them(path: str) -> None:
    (problem,) = apart.problems([RECORD, "README.md", path])
    assert path in problem
    assert apart.problems([path, "README.md"]) == []


def test_owners_review_what_decides_and_where_submissions_lie_nobody_must() -> None:
    lines = (ROOT / ".github/CODEOWNERS").read_text().splitlines()
    owned = tuple(line.split()[0].lstrip("/") for line in lines if line[:1] == "/")
    assert {f"{apart.LEADERBOARD}/", *apart.JUDGES} <= set(owned)
    assert not "submissions/mine/controller.py".startswith(owned)
    assert all((ROOT / path).exists() for path in owned)


def test_bounds_and_result_come_with_the_records_of_their_round() -> None:
    own = ["leaderboard/rounds/2027-1/bounds.npz", "leaderboard/rounds/2027-1/result.json"]
    assert apart.problems([RECORD, *own]) == []


def test_the_job_reads_what_a_branch_changes(repository, monkeypatch, capsys) -> None:
    alone = repository.commit({RECORD: b"{}"}, repository.base)
    both = repository.commit({RECORD: b"{}", "leaderboard/attestations.toml": b""}, repository.base)
    monkeypatch.chdir(repository.folder)
    monkeypatch.setenv("BASE", repository.base)
    for commit, code in ((alone, 0), (both, 1)):
        monkeypatch.setenv("COMMIT", commit)
        assert apart.main() == code
    assert "propose it by itself first" in capsys.readouterr().out


def test_requests_are_of_accounts() -> None:
    merged = [
        {
            "author": {"login": "eve"},
            "mergedAt": "2027-01-02T00:00:00Z",
            "files": [
                {"path": "submissions/one/controller.py"},
                {"path": "submissions/one/a/b.py"},
            ],
        },
        {
            "author": {"login": "ada"},
            "mergedAt": "2027-01-01T00:00:00Z",
            "files": [{"path": "submissions/README.md"}, {"path": "submissions/two/x.py"}],
        },
    ]
    assert requests(merged) == [
        {"name": "two", "account": "ada", "asked": "2027-01-01T00:00:00Z"},
        {"name": "one", "account": "eve", "asked": "2027-01-02T00:00:00Z"},
    ]
    with pytest.raises(InputError):
        requests([{"author": None}])
