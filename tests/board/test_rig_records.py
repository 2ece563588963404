"""Rigs, normalised scores, shared ranks, stress, and who vouches for what has a rank."""

import dataclasses
import json
import shutil

import msgspec
import numpy as np
import pytest

from ventbench.base.errors import InputError
from ventbench.base.text import number
from ventbench.board import (
    attestation,
    build,
    canonical,
    comparison,
    create,
    frames,
    pages,
    replay,
    rounds,
    store,
    verify,
)
from ventbench.board.ranking import Place, stressed_runs
from ventbench.board.replay import run_of
from ventbench.entries import reference as references
from ventbench.entries.runs import DRAWS, pip_columns
from ventbench.entries.scoring import runs_of
from ventbench.task import draws as draw_tables
from ventbench.task import environment, protocol
from ventbench.task.stressors import conditions

from .conftest import KEY, ROUND, accept, derived, opened, put

#: What the tests of the board do without, see `conftest.py`.
WITNESS, SECOND = references.witness_errors, references.second_errors


@pytest.fixture(scope="module")
def score(scores):
    return scores["pid_robust"]


@pytest.fixture(scope="module")
def stressed():
    """Run an entry under missing physics: in each cell its commands of the draw, times a factor."""

    def make(what, requested, factor):
        cells, steps = what.stressed, requested.shape[-2:]
        ranked = 1 + np.flatnonzero(what.drawn.ranked)[:DRAWS]
        own = requested[np.arange(6)[:, None], ranked, pip_columns(6, DRAWS)]
        commands = np.broadcast_to(own, (len(cells.conditions), *own.shape)).copy()
        commands[1:] *= factor
        run = run_of(cells, environment.resolved(commands)[:, :, :, None])
        runs = runs_of(run, cells)
        return dataclasses.replace(runs, requested=commands.reshape(*runs.error.shape, *steps))

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
        own = None if stress is None else lambda what, asked: stressed(what, asked, stress)
        return draft(name, "pid_robust", change=change, stress=own)

    return {
        "pid_robust": made("pid_robust", stress=1.0),
        "soft": made("soft", uneasy, stress=1.02),
        "uneven": made("uneven", scaled(0.97, slice(1, 11)), stress=1.0),
        "zero": made("zero", scaled(0.0)),
    }


@pytest.fixture(scope="module")
def own(entered, reference):
    """The round of the records."""
    return rounds.load(entered, ROUND)


@pytest.fixture(scope="module")
def board(drafts, simulators, entered, tmp_path_factory):
    folder = shutil.copytree(entered, tmp_path_factory.mktemp("rigs") / "leaderboard")
    for made in drafts.values():
        put(folder, made, simulators)
    return folder


@pytest.fixture(scope="module")
def built(board, simulators, tmp_path_factory):
    pytest.importorskip("jinja2", reason="needs the extra ventbench[view]")
    out = tmp_path_factory.mktemp("built")
    build.build(board, out, lambda: simulators)
    return out


def test_figures_have_rigs_and_normalised_scores(drafts, score, simulators, own):
    record = derived(drafts["pid_robust"], simulators, own)
    assert record.header.draws.season == ROUND
    np.testing.assert_array_equal(record.figures.rig, score.rig_draws.rig)
    # It is the PID by which the scale was made, to the step of the valve.
    # That may move a reading by a step of the converter, and so a cell by some hundredths of cmH2O.
    assert record.figures.normalised.mean() == pytest.approx(100.0, abs=0.5)
    assert record.figures.ranked_values.shape == (6, draw_tables.COUNT)


def test_stressed_commands_give_the_figures_again(board, drafts, simulators, own):
    """And to the bit those of the same draws where there is no stressor."""
    record = derived(drafts["soft"], simulators, own)
    figures, runs = record.figures, record.figures.stressed
    assert runs is not None
    assert runs.complete
    ranked = np.flatnonzero(figures.ranked)[:DRAWS]
    at = ranked, np.arange(6)[:, None], pip_columns(6, DRAWS)
    np.testing.assert_allclose(runs.error[0], figures.drawn[at], rtol=0, atol=1e-9)
    (track, _) = frames.load_tracks(board, track="robustness")
    row = next(row for row in track.stress if row.record.name == "soft")
    np.testing.assert_array_equal(stressed_runs(row).error, runs.error)


def test_without_stressed_commands_there_is_no_stress_rank(board, drafts, simulators, tmp_path):
    folder = shutil.copytree(board, tmp_path / "leaderboard")
    record = opened(drafts["soft"])
    assert record.header.stress is not None
    store.commands_path(record.header.stress.commands, folder / "records").unlink()
    report = verify.verify(folder, lambda: simulators)
    assert report.problems == []
    (note,) = report.notes
    assert record.sha256 in note
    assert record.header.stress.commands.sha256 in note
    assert "are not at hand" in note
    (track, _) = frames.load_tracks(folder, track="robustness")
    assert "soft" in [row.record.name for row in track.listed]
    assert "soft" not in [row.record.name for row in track.stress]


def test_ranks_follow_from_paired_tests(board):
    (track, _) = frames.load_tracks(board, track="robustness")
    assert track.listed[-1].record.name == "zero"
    assert track.listed[-1].place == Place(3, 3, 3), "the PID and its copy count once"
    rows = {row.record.name: row for row in track.listed}
    own = rows["pid_robust"].normalised
    assert own is not None
    assert own.value == pytest.approx(100.0, abs=0.5)
    assert rows["uneven"].source == "pid_robust", "its commands are nearly the PID's"
    assert rows["soft"].source == ""


def test_stress_is_ranked_and_shown(board, built):
    (track, _) = frames.load_tracks(board, track="robustness")
    rows = track.stress
    assert {row.record.name for row in rows} == {"soft", "uneven", "pid_robust"}
    assert rows[0].stress_place is not None
    assert rows[0].stress_place.rank == 1
    scores = [stressed_runs(row).score for row in rows]
    assert scores == sorted(scores)
    assert rows[0].stress is not None
    whole = stressed_runs(rows[0]).by_lung_and_draw
    assert rows[0].stress.value == pytest.approx(whole.mean())
    groups = pages.stress_chart(rows)
    fields = [field for group in groups for row in group["rows"] for field in row["fields"]]
    assert sum(field is not None for field in fields) == 3 * (len(conditions()) - 1)
    page = (built / "index.html").read_text()
    assert "Stressor by severity" in page
    for row in rows:
        assert row.stress is not None
        own = (built / f"entries/{ROUND}/robustness/{row.record.name}.html").read_text()
        assert f"{row.stress.value:.2f}" in own
        assert f"{row.stress.value:.2f}" in page
    assert "Stressor" not in (built / f"entries/{ROUND}/robustness/zero.html").read_text()
    table = frames.load_board(board, track="robustness").set_index("name")
    assert table.stress_cmH2O["soft"] == pytest.approx(
        next(stressed_runs(row).score for row in rows if row.record.name == "soft")
    )
    assert np.isnan(table.stress_cmH2O["zero"])


def test_an_entry_shows_what_it_fails_under(board, built):
    """By runs and cells alone: errors of a condition less those of the same cells without one."""
    track = next(x for x in frames.load_tracks(board) if x.stress)
    row = next(row for row in track.stress if row.record.name == "soft")
    runs = stressed_runs(row)
    adds = {
        c.id: np.mean(runs.error[k] - runs.error[0]) for k, c in enumerate(runs.conditions) if k
    }
    wanted = sorted(adds, key=adds.__getitem__, reverse=True)[: pages.WORST]
    shown = pages.stress_order(row)
    assert [line["title"] for line in shown] == [pages.title_of(name) for name in wanted]
    assert [line["rise"] for line in shown] == [number(adds[name], 2, sign=True) for name in wanted]
    page = (built / pages.address(row.record)).read_text()
    assert shown[0]["small"] in page
    assert "Which physics it fails under" in page


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda v: v.update(track="performance"), "key track: the submission|stress"),
        (lambda v: v["stress"]["commands"]["shape"].reverse(), r"stress\.commands\.shape: is not"),
        (lambda v: v["draws"].pop("season"), "missing required field `season`"),
    ],
)
def test_schema_names_what_is_wrong(drafts, change, message):
    value = json.loads(drafts["soft"].content)
    change(value)
    made = dataclasses.replace(drafts["soft"], content=canonical.canonical(value))
    with pytest.raises(InputError, match=message):
        opened(made)


def test_a_record_needs_all_stressors_or_none(board, simulators, score):
    (track, _) = frames.load_tracks(board, track="robustness")
    whole = stressed_runs(track.stress[0])
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
    path = own / rounds.RESULT
    result = json.loads(path.read_bytes()) | {"bounds": sha256}
    path.write_bytes(canonical.canonical(result))
    attestation.sign(folder, path, KEY)
    problems = verify.verify(folder, lambda: simulators).problems
    assert any("its commands or PIDs do not attain its errors" in text for text in problems)


def bounded(board, simulators, tmp_path, reference, change):
    """Verify the board with other bounds, signed by whoever has the key."""
    folder = shutil.copytree(board, tmp_path / "leaderboard")
    figures = [x.figures for x in replay.load(board, lambda: simulators).scores]
    attained = np.stack([x.controllable.swapaxes(0, 1) for x in figures])
    least = change(reference.attainable.copy(), attained.min(axis=0))
    forged = dataclasses.replace(reference, attainable=least)
    own = folder / "rounds" / ROUND
    result = json.loads((own / rounds.RESULT).read_bytes())
    result["bounds"] = forged.save(own / rounds.BOUNDS)
    (own / rounds.RESULT).write_bytes(canonical.canonical(result))
    attestation.sign(folder, own / rounds.RESULT, KEY)
    return verify.verify(folder, lambda: simulators, recomputed=2).problems


def test_no_commands_bound_nothing_where_a_rival_leads(board, simulators, reference, tmp_path):
    """In three cells the witness is "no commands", and attains its error."""
    rigs = simulators.scored()
    plants, cells = rigs.cells(rounds.load(board, ROUND).draws(rigs), protocol.PIPS)
    nothing = np.zeros((*reference.pid.shape, 2, 33))
    rest = WITNESS(dataclasses.replace(reference, commands=nothing), plants, cells)
    where = [(1, 4, 0), (1, 9, 0), (3, 9, 5)]

    def change(attainable, _):
        for at in where:
            attainable[at] = rest[at]
        return attainable

    problems = bounded(board, simulators, tmp_path, reference, change)
    assert len(problems) == 3, "all but the entry that gives none itself"
    for problem in problems:
        assert "less than the bound of a cell" in problem
        assert problem.endswith(tuple(verify._cell(*at) for at in where))


@pytest.mark.slow
def test_the_commands_of_the_best_entry_bound_nothing(
    board, simulators, reference, monkeypatch, tmp_path
):
    """No entry is below such a bound, and the second optimiser is in whatever cell it looks at."""
    monkeypatch.setattr(references, "second_errors", SECOND)
    problems = bounded(board, simulators, tmp_path / "a", reference, lambda *x: x[1])
    assert len(problems) == 2
    assert all("and a second optimiser attains" in x for x in problems)
    assert problems[0] != problems[1]
    low = bounded(board, simulators, tmp_path / "b", reference, lambda x, _: 0.0 * x)
    assert low == [], "control"


def test_the_beacon_and_the_bounds_choose_the_cells(simulators, own, reference, monkeypatch):
    chosen = []

    def second(plants, cells, some):
        chosen.append(some.tolist())
        return np.full(len(some), np.inf)

    monkeypatch.setattr(references, "second_errors", second)
    other = dataclasses.replace(own, frozen_sha256="1" * 64)
    result = msgspec.structs.replace(own.result, bounds="2" * 64)
    monkeypatch.setattr(rounds.Round, "bounds", lambda _: reference)
    for one in (own, own, other, dataclasses.replace(own, result=result)):
        verify._recompute(one, simulators, 40, verify.Report(), {})
    first, again, *others = chosen
    assert first == again
    assert len(set(first)) == 40
    # The twenty farthest above the lower bound, which is zero here, and twenty others.
    far = {*np.argsort(-reference.attainable, axis=None)[:20].tolist()}
    assert all(far < {*x} for x in chosen)
    assert all({*x} - far != {*first} - far for x in others)
    assert max(first) > 500, "all of the table"


def test_pages_show_both_scores(built):
    index = (built / "index.html").read_text("utf-8")
    assert "Normalised" in index
    assert "Rehearsal, never official" in index
    page = (built / f"entries/{ROUND}/robustness/soft.html").read_text("utf-8")
    assert f"Normalised score over the {draw_tables.COUNT} draws that rank" in page
    assert "--protocol" not in page


def test_a_frame_of_the_board(board):
    frame = frames.load_board(board)
    row = frame[frame["name"] == "pid_robust"].iloc[0]
    assert row["normalised"] == pytest.approx(100.0, abs=0.5)
    assert row["normalised_R20C50"] == pytest.approx(100.0, abs=0.5)
    assert row["draws"] == ROUND


def test_accepting_is_what_ranks(board, tmp_path):
    folder = shutil.copytree(board, tmp_path / "leaderboard")
    for path in (folder / canonical.ATTESTATIONS, *folder.rglob("*.sig")):
        path.unlink()
    assert not frames.load_tracks(folder)[1].listed
    accept(folder)
    assert len(frames.load_tracks(folder)[1].listed) == 4


def test_clusters_of_stress_are_the_rigs_that_ran(board, monkeypatch):
    used, ranks = [], comparison.ranks

    def spied(values, rig, *others, **options):
        used.append(rig)
        return ranks(values, rig, *others, **options)

    monkeypatch.setattr(comparison, "ranks", spied)
    track = next(x for x in frames.load_tracks(board) if x.stress)
    tables, own = stressed_runs(track.stress[0]), track.stress[0].record.figures
    np.testing.assert_array_equal(tables.rig, own.rig[:, own.ranked][:, :DRAWS])
    assert sum(np.array_equal(rig, tables.rig) for rig in used) == 1


def test_an_entry_below_its_bounds_is_named(board, simulators):
    """Bounds without a witness worth the name: whoever leads there attains less."""
    leaderboard = replay.load(board, lambda: simulators)
    assert verify._below_bounds(leaderboard) == []
    record = next(x for x in leaderboard.scores if x.name == "pid_robust")
    for lead, found in ((0.09, 0), (0.11, 1)):
        higher = record.figures.controllable + lead
        figures = dataclasses.replace(record.figures, attainable=higher)
        below = dataclasses.replace(record, derived=figures)
        problems = verify._below_bounds(dataclasses.replace(leaderboard, records=(below,)))
        assert len(problems) == found
        assert all("less than the bound of a cell" in text for text in problems)
