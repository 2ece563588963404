"""What a record holds, and that its commands give its numbers again."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ventbench.base import compilation, files
from ventbench.base.errors import InputError
from ventbench.board import create, gate, record, rounds, schema, store
from ventbench.board.record import Record
from ventbench.task import draws as draw_tables
from ventbench.task import environment, protocol

from ..textbook_rigs import TextbookRigs
from .conftest import ROUND, SANDBOX, derived


@pytest.fixture
def own(entered: Path, reference) -> rounds.Round:
    """The round of the records."""
    return rounds.load(entered, ROUND)


def test_a_record_says_where_it_comes_from(drafts, scores, drawn) -> None:
    content = json.loads(drafts["pid_best"].content)
    assert (content["format"], content["protocol"]) == (schema.FORMAT, schema.PROTOCOL)
    assert content["official"] is True
    assert content["sandbox"] == SANDBOX
    assert content["draws"] == {
        "version": 2,
        "sha256": drawn.commitment,
        "count": 20,
        "season": ROUND,
    }
    assert content["simulators"]["manifest_sha256"] == "2" * 64
    root = Path(draw_tables.__file__).parents[2]
    assert content["versions"]["requirements.lock"] == files.sha256(root / "requirements.lock")
    assert {"python", "jax", "numpy"} <= content["versions"].keys()
    machine = content["machine"]
    assert {"cpu", "isa", "system", "kernel", "architecture", "cores"} <= machine.keys()
    hashes = content["submission"]["files"]
    assert create.combined_hash(hashes) == content["submission"]["sha256"]
    assert content["commands"]["shape"] == [6, 21, 6, 3, 34]


def test_a_record_is_its_inputs_and_small(drafts) -> None:
    for made in drafts.values():
        assert len(made.content) < 6_000
        assert sum(map(len, made.commands)) < 300_000


def test_commands_come_back_to_the_step_of_the_valve(drafts, scores, tmp_path: Path) -> None:
    item = record.load(drafts["pid_best"].save(tmp_path))
    assert isinstance(item, Record)
    found = store.load_commands(item.header.commands, tmp_path)
    applied = environment.resolved(scores["pid_best"].requested)
    assert found.tobytes() == applied.tobytes()
    assert store.encode(found) == drafts["pid_best"].commands[0]


@given(arrays(np.float64, (2, 7), elements=st.floats(-1e9, 1e9)))
def test_any_commands_come_back(commands: np.ndarray) -> None:
    found = store.decode(store.encode(commands), (2, 7), "it")
    assert found.tobytes() == environment.resolved(commands).tobytes()
    assert np.all(np.abs(found - np.clip(commands, 0, 100)) <= 0.5001 * protocol.RESOLUTION)


def test_replay_agrees_with_the_scorer(drafts, scores, simulators, own) -> None:
    figures = derived(drafts["pid_best"], simulators, own).figures
    assert figures.nominal == pytest.approx(scores["pid_best"].nominal, abs=1e-9)
    assert figures.drawn == pytest.approx(scores["pid_best"].drawn, abs=1e-9)
    assert figures.safe.tolist() == scores["pid_best"].safe.tolist()
    assert figures.peak.max(axis=(0, 2)) == pytest.approx(scores["pid_best"].peak, abs=1e-9)


def test_spread_is_the_deviation_of_the_ensemble(
    drafts, scores, simulators: TextbookRigs, own
) -> None:
    from ventbench.entries.cells import as_float64
    from ventbench.plants.stacking import take
    from ventbench.task.rollouts import Script, closed_loop

    pressures = []
    with compilation.float64():
        for member in range(2):
            plants = as_float64(take(simulators.ensemble, member), 6)
            plants = jax.tree.map(lambda leaf: leaf[:, None], plants)
            cells, _, _ = draw_tables.with_nominal(None, [0] * 6, protocol.PIPS)
            cells = jax.tree.map(lambda leaf: leaf[:, 0], cells)
            commands = environment.resolved(scores["pid_best"].requested[:, 0]).reshape(6, 6, -1)
            run = jax.vmap(lambda plant, cell, u: closed_loop(plant, Script(u), cell)[0])
            inspired = run(plants, cells, commands)
            pressures.append(np.asarray(inspired.pressure)[:, :, protocol.SCORED_BREATHS, :])
    expected = np.std(pressures, axis=0, ddof=1).mean(axis=(-2, -1))
    figures = derived(drafts["pid_best"], simulators, own).figures
    assert figures.spread == pytest.approx(expected, abs=1e-9)
    assert figures.exploitation == pytest.approx(expected.mean(), abs=1e-9)
    assert figures.exploitation > 0


def test_every_failure_is_there(draft, simulators, own) -> None:
    item = derived(draft("weak", failed=30, texts="x" * 3000), simulators, own)
    assert len(item.header.failures) == 30
    assert np.isnan(item.figures.nominal).sum() == 30
    assert np.isnan(item.figures.exploitation)
    (first, *_) = gate.unfit(item, store.Store(Path(), (), frozenset()))
    assert first.startswith("30 of 756 cells failed, the first: weak: xxx")
    assert len(first) < 400


def test_an_incomplete_score_makes_no_record(scores, simulators: TextbookRigs) -> None:
    whole = scores["pid_best"]
    drawn = whole.rig_draws.first(3)
    score = dataclasses.replace(whole, protocol=dataclasses.replace(whole.protocol, drawn=drawn))
    with pytest.raises(InputError, match="--draws 20"):
        create.create(score, simulators)


def test_a_wrong_score_makes_no_record(scores, simulators: TextbookRigs) -> None:
    whole = scores["pid_best"]
    lower = dataclasses.replace(whole.runs, error=whole.runs.error * 0.999)
    score = dataclasses.replace(whole, runs=lower)
    with pytest.raises(InputError, match="does not replay: its errors differ by up to"):
        create.create(score, simulators)
