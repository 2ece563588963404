"""Records of hidden draws: what they publish, what opens them, and by which rules they count."""

from __future__ import annotations

import dataclasses
import json
import re
import shutil
from collections.abc import Callable
from datetime import UTC, date, datetime
from pathlib import Path

import pytest

from ventbench import seasons
from ventbench.board import (
    attestation,
    build,
    canonical,
    create,
    frames,
    layout,
    ranking,
    record,
    sealed,
    store,
)
from ventbench.board.verify import verify
from ventbench.cli import app
from ventbench.errors import InputError
from ventbench.seasons import Season

from ..textbook import Textbook
from .conftest import put

SECRET = "01" * 32


@dataclasses.dataclass(frozen=True)
class Opening:
    """A leaderboard with a season that is open; protocol 1, whose draws are public, has replays."""

    folder: Path
    season: Season
    seed: bytes

    def add(self, made: create.Draft, **options) -> record.Sealed:
        """Seal a record, add it and sign it."""
        draft = sealed.seal(made.content, made.commands, self.season, self.seed)
        path = draft.save(self.folder.parent / "drafts")
        added = store.add_sealed(self.folder, path, **options)
        attestation.sign(self.folder, added.sha256, SECRET)
        return added


@pytest.fixture
def opening(tmp_path: Path) -> Opening:
    folder = tmp_path / "leaderboard"
    season, seed = seasons.new_season(
        id="spring",
        protocol=1,
        draws=20,
        opens=date(2026, 11, 1),
        closes=date(2026, 11, 30),
        runs_per_week=2,
    )
    seasons.write_season(store.season_path(folder, "spring"), season)
    public = attestation._private(SECRET).public_key().public_bytes_raw()
    (folder / layout.KEYS).write_text(
        f'[[keys]]\nid = "{attestation.key_id(public)}"\npublic = "{public.hex()}"\n'
        'added = 2026-11-23\nholder = "a test"\n'
    )
    return Opening(folder, season, seed)


Load = Callable[[int], Textbook]


@pytest.fixture
def load(simulators: Textbook) -> Load:
    return lambda version: simulators


def at(made: create.Draft, day: int, **changes) -> create.Draft:
    """The same record, scored at noon of a day in November 2026."""
    created = datetime(2026, 11, day, 12, tzinfo=UTC)
    values = json.loads(made.content) | {"created": record.timestamp(created)} | changes
    return create.Draft(canonical.canonical(values), made.commands)


def test_a_season_from_its_opening_to_its_end(
    opening: Opening, drafts, simulators: Textbook, load: Load
) -> None:
    folder, seed = opening.folder, opening.seed
    best = opening.add(drafts["pid_best"], seed=seed, simulators=simulators)
    robust = opening.add(drafts["pid_robust"])
    broken = opening.add(drafts["broken"])
    build.build(folder)
    text = (folder / "index.html").read_text()
    assert "Hidden draws" in text
    assert opening.season.commitment in text

    report = verify(folder, load)
    assert report.problems == []
    assert (report.records, report.unsealed, report.replayed) == (3, 0, 0)
    assert report.notes == [
        "3 sealed records cannot be looked into before their season is revealed"
    ]
    report = verify(folder, load, seed=seed)
    assert (report.problems, report.notes, report.unsealed, report.replayed) == ([], [], 3, 3)
    assert verify(folder, load, seed=bytes(32)).unsealed == 0

    (performance,) = [t for t in ranking.boards(*ranked(folder))[1] if t.name == "performance"]
    states = {entry.record.name: (entry.official, entry.reasons) for entry in performance.sealed}
    assert states["pid_best"] == (True, ())
    assert states["broken"] == (True, ("a cell failed; its message is sealed",))
    assert not performance.rows

    opened = store.reveal(folder, "spring", seed, simulators).opened
    assert [score.name for score in opened] == ["pid_best", "pid_robust", "broken"]
    assert [score.sha256 for score in opened] == [
        entry.content.record for entry in (best, robust, broken)
    ]
    assert store.reveal(folder, "spring", seed, simulators).opened == ()
    build.build(folder)
    report = verify(folder, load)
    assert (report.problems, report.notes) == ([], [])
    assert (report.records, report.unsealed, report.replayed) == (6, 3, 3)
    (performance,) = frames.load_tracks(folder, track="performance")
    assert [(row.rank, row.record.name) for row in performance.ranked] == [(1, "pid_best")]
    assert [row.record.name for row in performance.unranked] == ["broken"]
    assert not performance.sealed
    assert seed.hex() in (folder / "index.html").read_text()


def ranked(folder: Path):
    board = store.load(folder)
    return board.records, board.attested, board.breaches


def test_what_is_public_of_a_sealed_record(opening: Opening, drafts) -> None:
    added = opening.add(drafts["broken"])
    values = json.loads((opening.folder / "records" / f"{added.sha256}.json").read_text())
    inside = json.loads(drafts["broken"].content)
    assert set(inside) - set(values) == {
        *("actions", "clipped", "draws", "errors", "failed_cells", "failures", "lungs"),
        *("peak_pressure_cmH2O", "pips", "safety", "simulators", "spread", "timing", "trace"),
    }
    assert values["scores"] == {"score_cmh2o": round(record_of(drafts["broken"]).by_draw.mean(), 2)}
    published = b"".join(p.read_bytes() for p in opening.folder.rglob("*") if p.is_file())
    inside_bytes = drafts["broken"].content + drafts["broken"].commands
    for secret in (
        b"onerror=alert(1)> {{ 7*7 }} \\u202eevil at step",
        inside["actions"]["sha256"].encode(),
        drafts["broken"].commands[100:140],
    ):
        assert secret in inside_bytes
        assert secret not in published
    assert opening.seed not in published
    assert opening.seed.hex().encode() not in published


def record_of(made: create.Draft) -> record.Record:
    found = record.from_bytes(made.content, "draft")
    assert isinstance(found, record.Record)
    return found


def test_lengths_say_next_to_nothing(opening: Opening, drafts) -> None:
    sizes = {
        len(sealed.seal(made.content, made.commands, opening.season, opening.seed).ciphertext)
        for made in drafts.values()
    }
    assert all((size - 32) % 65536 == 0 for size in sizes)


def test_the_same_record_is_sealed_otherwise_each_time(opening: Opening, drafts) -> None:
    made = drafts["pid_best"]
    one, other = (
        sealed.seal(made.content, made.commands, opening.season, opening.seed).ciphertext
        for _ in range(2)
    )
    assert one[:16] != other[:16]
    assert one[16:48] != other[16:48]


def test_another_seed_opens_and_reveals_nothing(opening: Opening, drafts) -> None:
    opening.add(drafts["pid_best"])
    before = store.season_path(opening.folder, "spring").read_bytes()
    with pytest.raises(InputError, match="not the one of its commitment"):
        store.reveal(opening.folder, "spring", bytes(32))
    with pytest.raises(InputError, match=r"autumn\.toml is missing"):
        store.reveal(opening.folder, "autumn", opening.seed)
    assert store.season_path(opening.folder, "spring").read_bytes() == before


def forge(opening: Opening, made: create.Draft, **changes) -> Path:
    """A sealed record that says something else than is inside."""
    draft = sealed.seal(made.content, made.commands, opening.season, opening.seed)
    values = json.loads(draft.content) | changes
    forged = sealed.SealedDraft(canonical.canonical(values), draft.ciphertext)
    return forged.save(opening.folder.parent / "forged")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"scores": {"score_cmh2o": 0.01}}, "key scores is not what the record inside says"),
        ({"official": False}, "key official is not"),
        ({"record": "a" * 64}, "key record is not"),
        ({"created": "2026-11-02T00:00:00Z"}, "key created is not"),
        ({"safe": False}, "key safe is not"),
    ],
)
def test_what_is_sealed_must_be_what_is_said(
    opening: Opening, drafts, load: Load, changes: dict, message: str
) -> None:
    path = forge(opening, drafts["pid_best"], **changes)
    with pytest.raises(InputError, match=message):
        store.add_sealed(opening.folder, path, seed=opening.seed)
    # Without the seed it gets in. It stops no reveal, and is void.
    forged = store.add_sealed(opening.folder, path)
    honest = opening.add(drafts["pid_robust"])
    revealed = store.reveal(opening.folder, "spring", opening.seed)
    assert [score.sha256 for score in revealed.opened] == [honest.content.record]
    assert re.search(message, revealed.void[forged.sha256])
    build.build(opening.folder)
    report = verify(opening.folder, load)
    assert report.problems == []
    assert any(re.search(message, note) for note in report.notes)
    board = store.load(opening.folder)
    assert forged.sha256 not in board.attested
    assert "does not hold" in board.breaches[forged.sha256]
    # Where it is signed, somebody who should know better has vouched for it.
    attestation.sign(opening.folder, forged.sha256, SECRET)
    assert any(re.search(message, problem) for problem in verify(opening.folder, load).problems)


def test_a_ciphertext_that_was_changed_is_seen(opening: Opening, drafts, load: Load) -> None:
    added = opening.add(drafts["pid_best"])
    path = sealed.path_of(added, opening.folder / "records")
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)
    build.build(opening.folder)
    (problem,) = verify(opening.folder, load).problems
    assert "has been changed" in problem
    with pytest.raises(InputError, match="of season spring does not open with this seed"):
        sealed.unseal(added, bytes(content), opening.season, opening.seed)
    path.unlink()
    (problem,) = verify(opening.folder, load).problems
    assert "is missing" in problem


def test_no_other_file_has_the_name_of_a_ciphertext(opening: Opening, drafts, load: Load) -> None:
    added = opening.add(drafts["pid_best"])
    build.build(opening.folder)
    assert verify(opening.folder, load).problems == []
    path = sealed.path_of(added, opening.folder / "records")
    shutil.copy(path, path.with_suffix(layout.ACTIONS_SUFFIX))
    (problem,) = verify(opening.folder, load).problems
    assert "is not named by chain" in problem


def test_a_season_file_that_was_changed_is_seen(opening: Opening, drafts, load: Load) -> None:
    opening.add(drafts["pid_best"])
    build.build(opening.folder)
    path = store.season_path(opening.folder, "spring")
    other, _ = seasons.new_season(
        id="spring", protocol=1, draws=20, opens=date(2026, 11, 1), closes=date(2026, 11, 30),
        runs_per_week=2,
    )  # fmt: skip
    text = path.read_text()
    path.write_text(text.replace(opening.season.commitment, other.commitment))
    assert any("key season.commitment is" in p for p in verify(opening.folder, load).problems)
    path.write_text(text + f'seed = "{bytes(32).hex()}"\n')
    assert any("not the one of its commitment" in p for p in verify(opening.folder, load).problems)
    path.unlink()
    assert any("spring.toml is missing" in p for p in verify(opening.folder, load).problems)


def test_a_revealed_season_takes_no_more_records(opening: Opening, drafts) -> None:
    store.reveal(opening.folder, "spring", opening.seed)
    with pytest.raises(InputError, match="its seed is public"):
        opening.add(drafts["pid_best"])


def test_a_revealed_record_that_is_not_opened_is_a_problem(
    opening: Opening, drafts, load: Load
) -> None:
    opening.add(drafts["pid_best"])
    path = store.season_path(opening.folder, "spring")
    seasons.write_season(path, seasons.reveal(opening.season, opening.seed))
    assert any("still sealed" in problem for problem in verify(opening.folder, load).problems)


def test_runs_of_a_week_are_limited(opening: Opening, draft, drafts, load: Load) -> None:
    """Two are allowed; authors count, not names, however they are written."""
    manifest = json.loads(drafts["pid_best"].content)["submission"]["manifest"]

    def by(made: create.Draft, day: int, author: str) -> record.Sealed:
        submission = json.loads(made.content)["submission"]
        submission["manifest"]["authors"] = [author]
        return opening.add(at(made, day, submission=submission))

    assert manifest["authors"]
    first = by(drafts["pid_best"], 16, "Ann Author")
    second = by(draft("second", factor=0.99), 17, "ANN  auth\u200bor")
    other = by(draft("other", factor=0.98), 18, "Bob")
    third = by(draft("third", factor=0.97), 22, "Ann Author")
    later = by(draft("later", factor=0.96), 23, "Ann Author")
    outside = by(draft("outside", factor=0.95), 30, "Bob")
    before = json.loads(draft("early", factor=0.94).content)
    early = opening.add(
        create.Draft(
            canonical.canonical(before | {"created": "2026-10-31T23:59:59Z"}),
            draft("early", factor=0.94).commands,
        )
    )
    board = store.load(opening.folder)
    assert {first.sha256, second.sha256, other.sha256, later.sha256, outside.sha256} == {
        entry.sha256 for entry in board.sealed if entry.sha256 in board.attested
    }
    assert board.breaches[third.sha256] == (
        "not official: run 3 of its authors in week 47 of 2026; season spring allows 2"
    )
    assert "outside the season" in board.breaches[early.sha256]

    store.reveal(opening.folder, "spring", opening.seed)
    build.build(opening.folder)
    (track,) = frames.load_tracks(opening.folder, track="performance")
    names = {row.record.name for row in track.ranked}
    assert names == {"pid_best", "second", "other", "later", "outside"}
    (row,) = [row for row in track.unofficial if row.record.name == "third"]
    assert "run 3 of its authors" in row.entry.reasons[0]
    assert verify(opening.folder, load).problems == []


def test_unsigned_runs_count_for_nobody(opening: Opening, drafts, draft) -> None:
    names = {}
    for name in ("a_one", "b_two", "c_three"):
        made = draft(name)
        path = sealed.seal(made.content, made.commands, opening.season, opening.seed).save(
            opening.folder.parent / "drafts"
        )
        names[name] = store.add_sealed(opening.folder, path)
    attestation.sign(opening.folder, names["c_three"].sha256, SECRET)
    board = store.load(opening.folder)
    assert not board.breaches
    (track, _) = ranking.boards(*ranked(opening.folder))[1]
    assert {entry.record.name: entry.official for entry in track.sealed} == {
        "a_one": False,
        "b_two": False,
        "c_three": True,
    }


def test_names_belong_to_their_authors_and_newer_records_name_the_older(
    opening: Opening, drafts, draft
) -> None:
    first = opening.add(drafts["pid_best"])
    with pytest.raises(InputError, match="already"):
        opening.add(drafts["pid_best"])
    with pytest.raises(InputError, match="a new one must name it"):
        opening.add(draft("pid_best", factor=0.99))
    made = draft("pid_best", factor=0.99)
    path = sealed.seal(made.content, made.commands, opening.season, opening.seed).save(
        opening.folder.parent / "drafts"
    )
    second = store.add_sealed(
        opening.folder, create.amend(path, supersedes=first.sha256, reason="again")
    )
    opened = store.reveal(opening.folder, "spring", opening.seed).opened
    assert opened[1].sha256 == second.content.record
    submission = json.loads(drafts["pid_best"].content)["submission"]
    submission["manifest"]["authors"] = ["Mallory"]
    values = json.loads(drafts["pid_best"].content) | {"submission": submission}
    with pytest.raises(InputError, match="the name belongs to"):
        put(opening.folder, create.Draft(canonical.canonical(values), drafts["pid_best"].commands))


def test_withdrawing_a_sealed_record_lasts(opening: Opening, drafts) -> None:
    added = opening.add(drafts["pid_best"])
    store.withdraw(opening.folder, added.sha256[:12], "a bug")
    store.reveal(opening.folder, "spring", opening.seed)
    (track,) = frames.load_tracks(opening.folder, track="performance")
    (row,) = track.unranked
    assert row.entry.reasons == ("withdrawn: a bug",)


def test_only_scores_of_the_season_are_sealed(opening: Opening, drafts) -> None:
    made = drafts["pid_best"]
    other, seed = seasons.new_season(
        id="other", protocol=2, draws=19, opens=date(2026, 11, 1), closes=date(2026, 11, 2),
        runs_per_week=1,
    )  # fmt: skip
    with pytest.raises(
        InputError, match=r"protocol is 1, .* 2; it has 20 draws, the season 19; its"
    ):
        sealed.seal(made.content, made.commands, other, seed)
    withdrawal = record.withdrawal("a" * 64, "x")
    with pytest.raises(InputError, match="only the record of a score"):
        sealed.seal(withdrawal, b"", opening.season, opening.seed)


def test_commands_open_a_season_and_reveal_it(tmp_path: Path, monkeypatch) -> None:
    from typer.testing import CliRunner

    monkeypatch.chdir(tmp_path)
    runner = CliRunner()
    dates = ["--opens", "2026-11-01", "--closes", "2026-11-02"]
    inside = ["board", "new-season", "spring", "--seed", "leaderboard/seed", *dates]
    result = runner.invoke(app, inside)
    assert isinstance(result.exception, InputError)
    assert "which is published" in str(result.exception)
    made = runner.invoke(app, ["board", "new-season", "spring", "--seed", "seed", *dates])
    assert made.exit_code == 0, made.output
    path = tmp_path / "leaderboard" / "seasons" / "spring.toml"
    season, seed = seasons.read_season(path), seasons.read_seed(tmp_path / "seed")
    assert season.commitment == seasons.commitment(seed)
    assert season.commitment in made.output
    assert seed.hex() not in made.output + path.read_text()
    again = runner.invoke(app, ["board", "new-season", "spring", "--seed", "seed2", *dates])
    assert "opened once" in str(again.exception)
    revealed = runner.invoke(app, ["board", "reveal", "spring", "--seed", "seed"])
    if revealed.exit_code:  # the clock of this machine is before the season's end
        assert "is open until" in str(revealed.exception)
    else:
        assert seasons.read_season(path).revealed == seed


def test_an_open_season_is_not_revealed(tmp_path: Path, monkeypatch) -> None:
    from typer.testing import CliRunner

    monkeypatch.chdir(tmp_path)
    dates = ["--opens", "2026-11-01", "--closes", "9999-01-01"]
    CliRunner().invoke(app, ["board", "new-season", "spring", "--seed", "seed", *dates])
    result = CliRunner().invoke(app, ["board", "reveal", "spring", "--seed", "seed"])
    assert "is open until 9999-01-01" in str(result.exception)


def test_runs_of_nobody_are_limited_too(opening: Opening, drafts, draft) -> None:
    for factor, authors in ((0.99, []), (0.98, [" "]), (0.97, ["\u200b"])):
        made = draft(f"entry{round(100 * factor)}", factor=factor)
        submission = json.loads(made.content)["submission"]
        submission["manifest"]["authors"] = authors
        last = opening.add(at(made, 17, submission=submission))
    assert list(store.load(opening.folder).breaches) == [last.sha256, last.content.record]
