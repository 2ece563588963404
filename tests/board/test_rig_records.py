"""Records and boards of protocol version 2: rigs, normalised scores, shared ranks, seasons."""

import dataclasses
import json
import shutil
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest

from ventbench import protocol, rig_draws, seasons
from ventbench.board import build, canonical, create, frames, ranking, record, store, verify
from ventbench.board.replay import differences, draws_of, replay
from ventbench.errors import InputError
from ventbench.headroom import reference as references
from ventbench.plants import frozen
from ventbench.submissions.folder import open_submission
from ventbench.submissions.rig_scoring import run_on_rigs

from ..textbook_rigs import TextbookRigs
from .conftest import NOW, SANDBOX, accept, entry_folder, opened, put


@pytest.fixture(scope="module")
def rigs():
    return TextbookRigs()


@pytest.fixture(scope="module")
def reference(rigs):
    """The PID's true errors, and a tenth of them as what is attainable."""
    own = rigs.scored()
    drawn = own.draws(rig_draws.COUNT)
    gains = np.tile([[6.0, 6.0, 0.3]], (6, 1))
    plants, cells = own.cells(drawn, protocol.PIPS)
    pid = references.pid_errors(plants, cells, gains)
    about = references.settings(own.about, drawn.about())
    zero = np.zeros((*pid.shape, 33))
    return references.Reference(about, gains, 0.1 * pid, 0.1 * pid, 0.0 * pid, pid, zero)


@pytest.fixture(scope="module")
def score(rigs, reference):
    made = run_on_rigs(
        open_submission("pid_robust"), rigs.scored(), draws=rig_draws.COUNT, reference=reference
    )
    official = frozen.load(version=2).manifest_sha256
    return dataclasses.replace(made, sandbox=SANDBOX, frozen_sha256=official)


@pytest.fixture(scope="module")
def draft(rigs, score, tmp_path_factory):
    """Make a record: the commands of the PID times a factor on some draws, under any name."""

    def make(name, factor=1.0, draws=slice(None)):
        folder = entry_folder(tmp_path_factory.mktemp("rig") / name, "pid_robust", name)
        manifest = dataclasses.replace(score.submission.manifest, name=name)
        entry = dataclasses.replace(
            score.submission, label=str(folder), folder=folder, manifest=manifest,
            sha256=create.combined_hash(create.file_hashes(folder)),
        )  # fmt: skip
        requested = score.requested.copy()
        requested[:, draws] *= factor
        (found,) = replay(rigs, score.pips, [requested], score.rig_draws)
        varied = dataclasses.replace(
            score, submission=entry, requested=requested, nominal=found.nominal,
            drawn=found.drawn, safe=found.safe, peak=found.peak.max(axis=(0, 2)),
            controllable=np.moveaxis(np.asarray(found.controllable), 0, 1),
        )  # fmt: skip
        return create.create(varied, rigs, now=NOW)

    return make


@pytest.fixture(scope="module")
def drafts(draft):
    return {
        "pid_robust": draft("pid_robust"),
        "softer": draft("softer", 0.8),
        # Better than the PID in some draws and worse in the others.
        "uneven": draft("uneven", 0.97, slice(1, 11)),
        "zero": draft("zero", 0.0),
    }


@pytest.fixture(scope="module")
def board(drafts, rigs, tmp_path_factory):
    folder = tmp_path_factory.mktemp("rigs") / "leaderboard"
    for made in drafts.values():
        put(folder, made, rigs)
    build.build(folder)
    return folder


def test_a_record_holds_rigs_and_normalised_scores(drafts, score):
    record = opened(drafts["pid_robust"])
    assert record.version == 2
    assert record.header.draws.season == "development"
    assert record.headroom is not None
    np.testing.assert_array_equal(record.headroom.session, score.rig_draws.rig)
    # It is the PID by which the scale was made.
    np.testing.assert_allclose(record.headroom.normalised, 100.0, atol=1e-6)
    assert record.ranked_values.shape == (6, rig_draws.COUNT)


def test_replay_finds_a_changed_normalised_error(drafts, rigs, score):
    record = opened(drafts["pid_robust"])
    (found,) = replay(rigs, record.pips, [score.requested], score.rig_draws)
    assert differences(record, found) == []
    assert record.headroom is not None
    better = dataclasses.replace(record.headroom, error=record.headroom.error - 1e-6)
    changed = dataclasses.replace(record, headroom=better)
    assert any("headroom.error" in text for text in differences(changed, found))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda v: v.pop("rigs"), "key rigs: belongs to protocol version 2"),
        (lambda v: v.pop("headroom"), "key headroom: belongs to protocol version 2"),
        (lambda v: v.update(protocol=1), "belongs to protocol version 2 and no other"),
        (lambda v: v["rigs"]["session"].pop(), "key rigs.session: does not have the shape"),
        (lambda v: v["headroom"]["pid"].pop(), "key headroom.pid: does not have the shape"),
        (lambda v: v["draws"].pop("season"), "key draws.season"),
    ],
)
def test_schema_names_what_is_wrong(drafts, change, message):
    value = json.loads(drafts["softer"].content)
    change(value)
    made = dataclasses.replace(drafts["softer"], content=canonical.canonical(value))
    with pytest.raises(InputError, match=message):
        opened(made)


def test_entries_that_cannot_be_told_apart_share_a_rank(board):
    (track,) = (x for x in frames.load_tracks(board, version=2) if x.name == "robustness")
    ranks = {row.record.name: row.rank for row in track.ranked}
    rows = {row.record.name: row for row in track.ranked}
    records = [row.record for row in track.ranked]
    means = ranking._resampled(records, [r.ranked_values for r in records])
    for i, one in enumerate(records):
        for j, other in enumerate(records):
            low, high = np.quantile(means[i] - means[j], (0.025, 0.975))
            if low <= 0.0 <= high:
                assert ranks[one.name] == ranks[other.name]
    assert ranks["zero"] == 4
    assert len(set(ranks.values())) > 1
    own = rows["pid_robust"].normalised
    assert own is not None
    assert own.score.value == pytest.approx(100.0)


def test_everything_verifies(board, rigs, reference, monkeypatch):
    monkeypatch.setattr(verify, "published", lambda: reference)
    report = verify.verify(board, lambda version: rigs)
    assert report.problems == []
    assert report.replayed == 4


def test_a_lowered_bound_is_found(board, rigs, reference, monkeypatch):
    lower = dataclasses.replace(reference, pid=reference.pid + 1e-6)
    monkeypatch.setattr(verify, "published", lambda: lower)
    problems = verify.verify(board, lambda version: rigs).problems
    assert sum("headroom.pid: not the published reference errors" in text for text in problems) == 4


def test_references_must_be_common(board, drafts, rigs, tmp_path):
    folder = shutil.copytree(board, tmp_path / "leaderboard")
    value = json.loads(drafts["softer"].content)
    value["headroom"]["attainable"][0][0][0] += 0.001
    value["submission"]["manifest"]["name"] = "other"
    made = dataclasses.replace(drafts["softer"], content=canonical.canonical(value))
    with pytest.raises(InputError, match="key headroom: differs from record"):
        store.add(folder, made.save(tmp_path / "drafts"))


def test_pages_show_both_scores(board):
    index = (board / "index.html").read_text("utf-8")
    assert "Normalised" in index
    assert "development draws" in index
    page = (board / "entries/v2/robustness/softer.html").read_text("utf-8")
    assert "Normalised score over the draws" in page
    assert "--protocol 2" in page


def test_frames_and_cells(board):
    frame = frames.load_board(board, version=2)
    row = frame[frame["name"] == "pid_robust"].iloc[0]
    assert row["normalised"] == pytest.approx(100.0)
    assert row["normalised_R20C50"] == pytest.approx(100.0)
    assert row["season"] == "development"
    record = frames.load_tracks(board, version=2)[1].ranked[0].record
    by_lung, by_pip = frames.cell_means(record, "all"), frames.cell_means(record, "R5C10")
    assert list(by_lung) == [*record.lungs, "mean"]
    assert by_pip["mean"] == pytest.approx(by_lung["R5C10"])
    with pytest.raises(InputError, match="--lung R1C1"):
        frames.cell_means(record, "R1C1")


def test_hidden_draws_need_the_seed_of_their_season(drafts, rigs):
    header = opened(drafts["softer"]).header
    seed = bytes(range(32))
    about = {"season": "2027", "sha256": seasons.commitment(seed), "count": 20, "version": 2}
    draws = type(header.draws)(**about)
    hidden = msgspec.structs.replace(header, draws=draws)
    with pytest.raises(InputError, match="season 2027 is not revealed"):
        draws_of(hidden, rigs)
    with pytest.raises(InputError, match="not the draws of the seed"):
        draws_of(hidden, rigs, bytes(32))
    found = draws_of(hidden, rigs, seed)
    assert found is not None
    assert found.about() == about


def test_accepting_is_what_ranks(board, tmp_path):
    folder = shutil.copytree(board, tmp_path / "leaderboard")
    (folder / "accepted.toml").unlink()
    assert not frames.load_tracks(folder, version=2)[1].ranked
    accept(folder)
    assert len(frames.load_tracks(folder, version=2)[1].ranked) == 4


def test_a_record_that_nobody_vouches_for_clears_no_board(drafts):
    """The board shows the season of the newest official record, not of whatever came last."""
    of_season, later = opened(drafts["softer"]), opened(drafts["zero"])
    draws = type(later.header.draws)(season="2027", sha256="a" * 64, count=20, version=2)
    header = msgspec.structs.replace(of_season.header, draws=draws)
    hidden = dataclasses.replace(of_season, header=header)
    inside = record.Sealed("b" * 64, SimpleNamespace(record=hidden.sha256))  # type: ignore[arg-type]

    def shown(records, attested):
        return [x.record.name for x in ranking.standings(records, attested)[2]["robustness"].ranked]

    both = {hidden.sha256, later.sha256}
    assert shown([inside, hidden, later], {hidden.sha256}) == ["softer"]
    assert shown([inside, hidden, later], both) == ["softer"], (
        "hidden draws rank, where there are some"
    )
    assert shown([later, inside, hidden], both) == ["softer"]
    assert shown([later], both) == ["zero"]
