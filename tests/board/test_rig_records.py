"""Rigs, normalised scores, shared ranks, stress, and who vouches for what has a rank."""

import dataclasses
import json
import shutil

import numpy as np
import pytest

from ventbench.base.errors import InputError
from ventbench.board import (
    build,
    canonical,
    create,
    frames,
    official_runs,
    pages,
    rounds,
    store,
    verify,
)
from ventbench.board.replay import differences, replay
from ventbench.entries.cells import InProcessRunner
from ventbench.entries.runs import DRAWS, Runs, pip_columns
from ventbench.task import draws as draw_tables
from ventbench.task import protocol
from ventbench.task.stressors import conditions

from .conftest import ROUND, accept, opened, put


@pytest.fixture(scope="module")
def score(scores):
    return scores["pid_robust"]


@pytest.fixture(scope="module")
def stressed():
    """Make a stress score of a submission: errors of a level, and noise that all share."""

    def make(score, level, noise=0.0):
        chosen, drawn = conditions(), score.rig_draws
        shape = (len(chosen), 6, DRAWS)
        random = np.random.default_rng(4)
        error = level + random.uniform(0.0, 1.0, shape)
        apart = np.random.default_rng(5).normal(size=shape[1:])
        error += noise * (apart - apart.mean())
        # Without a stressor they are runs of the draws.
        at = np.arange(6)[:, None], np.arange(DRAWS), pip_columns(6, DRAWS)
        error[0] = np.moveaxis(score.drawn, 0, 1)[at]
        peak = 30.0 + error
        peak[0] = score.runs.peak.reshape(6, -1, 6)[:, 1:][at]
        commands = np.full((*shape, protocol.BREATHS, protocol.INSPIRATION_STEPS), level)
        return Runs(
            conditions=chosen,
            lungs=score.lungs,
            pips=np.array(protocol.PIPS)[pip_columns(6, DRAWS)],
            rig=drawn.rig[:, :DRAWS],
            member=drawn.member[:, :DRAWS],
            error=error,
            safe=np.ones(shape, bool),
            survived=error < 1.8,
            alarm_s=0.1 * error,
            peak=peak,
            volume=400.0 + error,
            draw=np.arange(1, DRAWS + 1),
            requested=commands,
        )

    return make


@pytest.fixture(scope="module")
def drafts(draft, stressed):
    """The PID, one that is better, one that is better in some draws only, and none at all."""

    def scaled(factor, draws=slice(None)):
        def change(requested):
            requested[:, draws] *= factor

        return change

    def uneasy(requested):
        requested[..., ::2] *= 1.4

    def made(name, change=None, stress=None):
        own = None if stress is None else lambda score: stressed(score, *stress)
        return draft(name, "pid_robust", change=change, stress=own)

    return {
        "pid_robust": made("pid_robust", stress=(2.0,)),
        "soft": made("soft", uneasy, stress=(1.0,)),
        "uneven": made("uneven", scaled(0.97, slice(1, 11)), stress=(1.02, 0.2)),
        "zero": made("zero", scaled(0.0)),
    }


@pytest.fixture(scope="module")
def board(drafts, simulators, entered, tmp_path_factory):
    folder = shutil.copytree(entered, tmp_path_factory.mktemp("rigs") / "leaderboard")
    for made in drafts.values():
        put(folder, made, simulators)
    return folder


@pytest.fixture(scope="module")
def built(board, tmp_path_factory):
    pytest.importorskip("jinja2", reason="needs the extra ventbench[view]")
    out = tmp_path_factory.mktemp("built")
    build.build(board, out)
    return out


def test_a_record_holds_rigs_and_normalised_scores(drafts, score):
    record = opened(drafts["pid_robust"])
    assert record.header.draws.season == ROUND
    np.testing.assert_array_equal(record.headroom.session, score.rig_draws.rig)
    # It is the PID by which the scale was made.
    np.testing.assert_allclose(record.headroom.normalised, 100.0, atol=1e-6)
    assert record.ranked_values.shape == (6, draw_tables.COUNT)


def test_replay_finds_changed_errors_and_rigs(drafts, simulators, score):
    record = opened(drafts["pid_robust"])
    (found,) = replay(simulators, record.pips, [score.requested], score.rig_draws)
    assert differences(record, found) == []
    rigs = record.headroom
    for key, better in (
        ("headroom.error", dataclasses.replace(rigs, error=rigs.error - 1e-6)),
        ("rigs.session", dataclasses.replace(rigs, session=np.zeros_like(rigs.session))),
        ("rigs.member", dataclasses.replace(rigs, member=rigs.member + 1)),
    ):
        changed = dataclasses.replace(record, headroom=better)
        assert [key in text for text in differences(changed, found)] == [True], key


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda v: v.pop("rigs"), "missing required field `rigs`"),
        (lambda v: v.pop("headroom"), "missing required field `headroom`"),
        (lambda v: v["rigs"]["session"].pop(), "key rigs.session: does not have the shape"),
        (lambda v: v["headroom"]["pid"].pop(), "key headroom.pid: does not have the shape"),
        (lambda v: v["draws"].pop("season"), "missing required field `season`"),
    ],
)
def test_schema_names_what_is_wrong(drafts, change, message):
    value = json.loads(drafts["soft"].content)
    change(value)
    made = dataclasses.replace(drafts["soft"], content=canonical.canonical(value))
    with pytest.raises(InputError, match=message):
        opened(made)


def test_ranks_follow_from_paired_tests(board):
    (track, _) = frames.load_tracks(board, track="robustness")
    assert track.ranked[-1].record.name == "zero"
    assert track.ranked[-1].ranks == (3, 3), "the PID and its copy count once"
    rows = {row.record.name: row for row in track.ranked}
    own = rows["pid_robust"].normalised
    assert own is not None
    assert own.score.value == pytest.approx(100.0)
    assert rows["uneven"].entry.source == "pid_robust", "its commands are nearly the PID's"
    assert rows["soft"].entry.source == ""


def test_stress_is_ranked_and_shown(board, built):
    (track, _) = frames.load_tracks(board, track="robustness")
    rows = track.stress
    assert [row.name for row in rows] == ["soft", "uneven", "pid_robust"]
    # Two differ by one number in all runs, the third only in noise.
    assert [row.ranks for row in rows] == [(1, 2), (1, 2), (2, 2)]
    assert rows[0].score is not None
    assert rows[0].score.value == pytest.approx(rows[0].tables.by_lung_and_draw.mean())
    groups = pages.stress_chart(rows)
    fields = [field for group in groups for row in group["rows"] for field in row["fields"]]
    assert sum(field is not None for field in fields) == 3 * (len(conditions()) - 1)
    page = (built / "index.html").read_text()
    assert "Stressor by severity" in page
    for row in rows:
        assert row.score is not None
        own = (built / f"entries/{ROUND}/robustness/{row.name}.html").read_text()
        assert f"{row.score.value:.2f}" in own
        assert f"{row.score.value:.2f}" in page
    assert "Stressor" not in (built / f"entries/{ROUND}/robustness/zero.html").read_text()
    table = frames.load_board(board, track="robustness").set_index("name")
    assert table.stress_cmH2O["soft"] == pytest.approx(rows[0].score.value)
    assert np.isnan(table.stress_cmH2O["zero"])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda v: v.update(track="performance"),
            "key track: the submission does not enter|stress",
        ),
        (lambda v: v["stress"]["conditions"].pop(), "key stress.errors: does not have the shape"),
        (lambda v: v["stress"]["conditions"].reverse(), "conditions: must begin with none"),
        (lambda v: v["stress"]["conditions"].__setitem__(3, "flood:mild"), "no condition of the"),
        (lambda v: v["stress"]["pips"][0].reverse(), "does not have all conditions and draws"),
        (lambda v: v["stress"]["volume_mL"][0].pop(), "key stress.volume_mL: does not have"),
        (lambda v: v["stress"]["safe"][1][0].__setitem__(0, False), "was not safe has survived"),
    ],
)
def test_stress_tables_are_checked(drafts, change, message):
    value = json.loads(drafts["soft"].content)
    change(value)
    made = dataclasses.replace(drafts["soft"], content=canonical.canonical(value))
    with pytest.raises(InputError, match=message):
        opened(made)


@pytest.fixture
def again(drafts, stressed, score):
    """What an honest second run of `pid_robust` gives: more digits than its record has."""
    stress = opened(drafts["pid_robust"]).stress
    assert stress is not None
    recorded, made = stress.tables, stressed(score, 2.0)
    made.error[0], made.peak[0] = recorded.error[0], recorded.peak[0]
    return dataclasses.replace(made, volume=recorded.volume + 0.4, alarm_s=recorded.alarm_s)


def test_a_second_stress_run_is_compared(drafts, again):
    recorded = opened(drafts["pid_robust"]).stress
    assert recorded is not None
    assert official_runs.stress_difference(recorded, again) == ""
    for key, text in (("error", "key stress.errors["), ("volume", "key stress.volume_mL[")):
        moved = dataclasses.replace(again, **{key: getattr(again, key) + 2.0})
        assert official_runs.stress_difference(recorded, moved).startswith(text)
    newer = dataclasses.replace(recorded, stressors=recorded.stressors + 1)
    assert "stressors are version" in official_runs.stress_difference(newer, again)


def forge(board, draft, where, folder):
    """A leaderboard in which one stress figure of a record is a little lower."""
    values = json.loads(draft.content)
    condition, lung, draw = where
    values["stress"]["errors"][condition][lung][draw] -= 0.01
    content = canonical.canonical(values)
    shutil.copytree(board, folder)
    for path in (folder / "records").glob(f"{opened(draft).sha256}.*"):
        if path.suffix == ".json":
            path.unlink()
    (folder / "records" / f"{canonical.digest(content)}.json").write_bytes(content)
    accept(folder)  # whoever forges also vouches
    return folder, canonical.digest(content)


def test_a_forged_stress_figure_is_found(
    board, drafts, again, score, simulators, tmp_path, monkeypatch
):
    """Without a stressor by the replay of the same draws, with one by the second run."""
    monkeypatch.setattr(
        official_runs, "run_protocol", lambda *_, **__: dataclasses.replace(score, stressed=again)
    )

    def second(folder, sha256):
        (outcome,) = official_runs.rerun(
            folder, records=[sha256], load=lambda: simulators, runner=InProcessRunner
        )
        return outcome

    honest = second(board, opened(drafts["pid_robust"]).sha256)
    assert honest.state == official_runs.REPRODUCED, honest
    for name, where in (("without", (0, 2, 3)), ("with", (40, 2, 3))):
        folder, sha256 = forge(board, drafts["pid_robust"], where, tmp_path / name)
        outcome = second(folder, sha256)
        assert outcome.state == official_runs.DIFFERENT
        assert outcome.detail.startswith("key stress.errors[")
        text = "the same draws without a stressor give"
        found = [x for x in verify.verify(folder, lambda: simulators).problems if text in x]
        assert len(found) == (name == "without")


def test_a_record_needs_all_stressors_or_none(simulators, score, stressed):
    whole = stressed(score, 1.0)
    few = dataclasses.replace(whole, conditions=whole.conditions[:5], error=whole.error[:5])
    with pytest.raises(InputError, match="all stressors on 6 draws, or none"):
        create.create(dataclasses.replace(score, stressed=few), simulators)


def test_everything_verifies(board, simulators):
    report = verify.verify(board, lambda: simulators)
    assert report.problems == []
    assert report.replayed == 4


def test_a_lowered_bound_is_found(board, simulators, reference, tmp_path):
    folder = shutil.copytree(board, tmp_path / "leaderboard")
    own = folder / "rounds" / ROUND
    lower = dataclasses.replace(reference, pid=reference.pid + 1e-6)
    sha256 = lower.save(own / rounds.BOUNDS)
    problems = verify.verify(folder, lambda: simulators).problems
    assert any("bounds.npz has been changed" in text for text in problems)
    result = canonical.canonical({"bounds": sha256, "records": {}, "failed": {}})
    (own / rounds.RESULT).write_bytes(result)
    problems = verify.verify(folder, lambda: simulators).problems
    assert any("its commands or PIDs do not attain its errors" in text for text in problems)
    assert sum("headroom.pid: not the reference errors" in text for text in problems) == 4


def test_references_must_be_common(board, drafts, tmp_path):
    folder = shutil.copytree(board, tmp_path / "leaderboard")
    value = json.loads(drafts["soft"].content)
    value["headroom"]["attainable"][0][0][0] += 0.001
    value["submission"]["manifest"]["name"] = "other"
    made = dataclasses.replace(drafts["soft"], content=canonical.canonical(value))
    with pytest.raises(InputError, match="key headroom: differs from record"):
        store.add(folder, made.save(tmp_path / "drafts"))


def test_pages_show_both_scores(built):
    index = (built / "index.html").read_text("utf-8")
    assert "Normalised" in index
    assert "Rehearsal, never official" in index
    page = (built / f"entries/{ROUND}/robustness/soft.html").read_text("utf-8")
    assert "Normalised score over the draws" in page
    assert "--protocol" not in page


def test_a_frame_of_the_board(board):
    frame = frames.load_board(board)
    row = frame[frame["name"] == "pid_robust"].iloc[0]
    assert row["normalised"] == pytest.approx(100.0)
    assert row["normalised_R20C50"] == pytest.approx(100.0)
    assert row["draws"] == ROUND


def test_accepting_is_what_ranks(board, tmp_path):
    folder = shutil.copytree(board, tmp_path / "leaderboard")
    (folder / canonical.ATTESTATIONS).unlink()
    assert not frames.load_tracks(folder)[1].ranked
    accept(folder)
    assert len(frames.load_tracks(folder)[1].ranked) == 4


def test_an_entry_below_its_bounds_is_named(board, drafts):
    """Bounds without a witness worth the name: whoever leads there attains less."""
    record, own = opened(drafts["pid_robust"]), rounds.load(board, ROUND)
    assert verify._wrong_reference([record], own) == []
    rigs = record.headroom
    for lead, found in ((0.09, 0), (0.11, 1)):
        lower = dataclasses.replace(rigs, error=rigs.attainable - lead)
        problems = verify._wrong_reference([dataclasses.replace(record, headroom=lower)], own)
        assert len(problems) == found
        assert all("less than the least error of any commands" in text for text in problems)
