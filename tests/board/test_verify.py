"""One wrong byte anywhere is found, and named."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ventbench.base.errors import InputError
from ventbench.board import canonical, record, store
from ventbench.board.verify import Report, verify

from ..textbook_rigs import TextbookRigs


@pytest.fixture
def check(simulators: TextbookRigs):
    """Verify with the textbook lungs."""
    return lambda folder, **options: verify(folder, lambda: simulators, **options)


def test_all_is_well(full: Path, check) -> None:
    told: list[tuple[int, int]] = []
    report: Report = check(full, progress=lambda *x: told.append(x))
    assert report.problems == []
    assert report.notes == []
    assert (report.records, report.replayed) == (8, 8)
    assert told[-1] == (8, 8)


def flip(path: Path, index: int, bit: int = 0) -> None:
    content = bytearray(path.read_bytes())
    content[index] ^= 1 << bit
    path.write_bytes(content)


def _sound(folder: Path, only: str) -> list[str]:
    """Quick part of a verification: hashes of one record or of its commands, without replay."""
    wrong = []
    for path in store.record_paths(folder):
        try:
            item = store.read_record(path) if path.stem == only else record.load(path)
            for commands in item.commands if isinstance(item, record.Record) else ():
                if commands.sha256 == only:
                    store.load_commands(commands, folder / store.RECORDS)
        except InputError as error:
            wrong.append(str(error))
    return wrong


@pytest.mark.parametrize("suffix", [record.SUFFIX, canonical.ACTIONS_SUFFIX])
def test_every_flipped_byte_of_a_record_is_found(leaderboard: Path, suffix: str) -> None:
    random = np.random.default_rng(7)
    paths = sorted((leaderboard / store.RECORDS).glob(f"*{suffix}"))
    assert len(paths) >= 7
    for path in paths:
        content = path.read_bytes()
        places = {0, len(content) - 1, *random.integers(0, len(content), 25).tolist()}
        for place in places:
            flip(path, place, int(random.integers(8)))
            wrong = _sound(leaderboard, path.stem)
            assert wrong, f"byte {place} of {path}"
            assert all(path.name in text for text in wrong)
            path.write_bytes(content)
        assert _sound(leaderboard, path.stem) == []


def test_a_flipped_record_and_its_replay_are_named(leaderboard: Path, check) -> None:
    path = sorted((leaderboard / store.RECORDS).glob("*.json"))[3]
    flip(path, path.read_bytes().index(b'"authors":') + 1)
    report = check(leaderboard)
    assert len(report.problems) == 1
    assert str(path) in report.problems[0]
    assert "key submission.manifest: Object contains unknown field" in report.problems[0]
    assert report.replayed == 7


def test_a_file_of_gigabytes_is_not_read(leaderboard: Path, check) -> None:
    path = sorted((leaderboard / store.RECORDS).glob("*.json"))[3]
    with open(path, "r+b") as file:
        file.truncate(50 * 2**30)  # sparse: it takes no disk
    (problem,) = check(leaderboard).problems
    assert f"{path} has {50 * 2**30} bytes, and may have" in problem


def test_flipped_commands_are_named(leaderboard: Path, check) -> None:
    path = sorted((leaderboard / store.RECORDS).glob("*.actions"))[2]
    flip(path, 500, 3)
    report = check(leaderboard)
    assert [str(path) in text for text in report.problems] == [True] * len(report.problems)
    assert 1 <= len(report.problems) <= 2  # two records may share commands
    assert report.replayed == 8 - len(report.problems)


STRAY = [
    "phish.html",
    "CNAME",
    "entries/r1/performance/A.html",
    "records/x.json",
]


def test_stray_files_and_links_are_refused(leaderboard: Path, check) -> None:
    for name in STRAY:
        (leaderboard / name).parent.mkdir(exist_ok=True, parents=True)
        (leaderboard / name).write_text("x")
    (leaderboard / "records/link.json").symlink_to("/etc/passwd")
    (leaderboard / "linked").symlink_to("/etc")
    orphans = [f"records/{'0' * 64}{suffix}" for suffix in (".actions", ".sig")]
    for name in orphans:
        (leaderboard / name).write_text("x")
    problems = "\n".join(check(leaderboard).problems)
    for name in STRAY:
        assert f"{leaderboard / name} is no part of a leaderboard; remove it" in problems
    for name in ("records/link.json", "linked"):
        assert f"{leaderboard / name} is no plain file or folder" in problems
    for name in orphans:
        assert f"{leaderboard / name} belongs to no record; remove it" in problems
    assert problems.count("\n") == len(STRAY) + 4 - 1


def test_missing_commands_are_named(leaderboard: Path, check) -> None:
    score = store.load(leaderboard).scores[0]
    path = store.commands_path(score.header.commands, leaderboard / store.RECORDS)
    path.unlink()
    assert f"{path} is missing: the commands of a record" in "".join(check(leaderboard).problems)


def test_a_record_that_another_one_names_is_missed(leaderboard: Path, check) -> None:
    score = next(x for x in store.load(leaderboard).scores if x.name == "softer")
    store.withdraw(leaderboard, score.sha256, "a bug")
    (leaderboard / store.RECORDS / f"{score.sha256}.json").unlink()
    assert any(
        f"withdraws {score.sha256[:12]}, which is not there" in x
        for x in check(leaderboard).problems
    )


def test_changed_simulators_are_named(leaderboard: Path, simulators: TextbookRigs) -> None:
    def broken() -> Any:
        raise InputError("data/simulators/hybrid.npz has SHA-256 ...; it is damaged")

    assert "hybrid.npz" in verify(leaderboard, broken).problems[0]

    class Other(TextbookRigs):
        def about(self) -> dict[str, Any]:
            return {**simulators.about(), "manifest_sha256": "1" * 64}

    problems = verify(leaderboard, lambda: Other()).problems
    assert sum("manifest_sha256 differ" in problem for problem in problems) == 8
    assert all("imulators" in problem or "reference errors" in problem for problem in problems)


def test_no_leaderboard_is_an_error(tmp_path: Path, check) -> None:
    with pytest.raises(InputError, match="holds no leaderboard"):
        check(tmp_path)
