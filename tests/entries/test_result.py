"""Whether a score is official is a property of the score; and how it shows itself."""

import dataclasses
import json
from typing import Any

import numpy as np
import pytest

from ventbench.entries.cells import protocol_of
from ventbench.entries.folder import open_submission
from ventbench.entries.scoring import run_protocol
from ventbench.plants import frozen
from ventbench.plants.rigs import Rigs, load_rigs
from ventbench.task.lungs import LUNGS
from ventbench.trajectories import load

FULL = {"layers": ["landlock", "seccomp"], "official": True}


class Pretender:
    """A runner that claims a full sandbox and asks for 3 % always."""

    sandbox = FULL

    def start(self, submission, tasks):
        self.failures = {}
        return self

    def ask(self, cells, observations):
        self.cells = cells

    def answers(self):
        return self.cells, np.full(len(self.cells), 3.0)

    def close(self):
        pass


def scored(plants, runner: Any = None, **options):
    rigs = plants if isinstance(plants, Rigs) else Rigs(LUNGS, plants, about=frozen.load().about())
    runner = runner or Pretender()
    return run_protocol(open_submission("pid_robust"), protocol_of(rigs, **options), runner=runner)


@pytest.fixture(scope="module")
def textbook(plants):
    return scored(plants, draws=2)


@pytest.fixture(scope="module")
def official(textbook):
    """As if it had been run on the frozen simulators."""
    return changed(textbook, sha256=frozen.MANIFEST_SHA256)


def changed(score, *, sha256=None, **protocol):
    """A score of another protocol."""
    rigs = score.protocol.rigs
    rigs = dataclasses.replace(rigs, sha256=sha256 or rigs.sha256)
    return dataclasses.replace(
        score, protocol=dataclasses.replace(score.protocol, rigs=rigs, **protocol)
    )


@pytest.mark.slow
def test_a_score_on_the_frozen_simulators_is_official():
    result = scored(load_rigs())
    assert result.official
    assert not dataclasses.replace(result, sandbox=None).official


def test_the_frozen_simulators_are_those_of_the_published_hash():
    assert frozen.load().manifest_sha256 == frozen.MANIFEST_SHA256


def test_official_needs_everything(official):
    assert official.official
    assert official.not_official_because == ()
    assert changed(official, reference=None).to_json()["official"] is True


@pytest.mark.parametrize(
    ("sandbox", "protocol", "reason"),
    [
        (None, {}, "no full sandbox"),
        ({**FULL, "official": False}, {}, "no full sandbox"),
        ({**FULL, "official": 1}, {}, "no full sandbox"),
        (FULL, {"sha256": "0" * 64}, "not on the frozen simulators"),
        (FULL, {"pips": (10.0,)}, "not all lungs and PIPs"),
    ],
)
def test_lacking_one_thing_it_is_not(official, sandbox, protocol, reason):
    result = changed(dataclasses.replace(official, sandbox=sandbox), **protocol)
    assert result.not_official_because == (reason,)
    assert not result.official


def test_some_lungs_alone_are_not_official(official):
    few = dataclasses.replace(official.runs, lungs=("R5C10",))
    result = dataclasses.replace(official, runs=few)
    assert result.not_official_because == ("not all lungs and PIPs",)


def test_words_of_the_caller_make_no_simulators_frozen(textbook):
    assert textbook.protocol.rigs.about == frozen.load().about()
    assert textbook.sandbox == FULL
    assert not textbook.official
    assert textbook.to_json()["official"] is False


def test_a_frame_has_every_cell(textbook):
    frame = textbook.to_frame()
    assert list(frame)[:4] == ["condition", "lung", "pip_cmH2O", "draw"]
    assert len(frame) == 6 * 6 * 3
    one = frame.query("lung == 'R20C10' and pip_cmH2O == 25 and draw == 2")
    assert one.error_cmH2O.item() == textbook.drawn[1, 3, 3]
    nominal = frame[frame.draw == 0].groupby("lung", sort=False).error_cmH2O.mean()
    np.testing.assert_allclose(nominal.to_numpy(), textbook.by_lung)


def test_summary_has_a_row_for_each_lung(textbook):
    table = textbook.summary()
    assert list(table) == ["score_cmH2O", "draws_cmH2O", "normalised", "safe", "peak_cmH2O"]
    assert list(table.index) == list(textbook.lungs)
    assert table.draws_cmH2O.mean() == pytest.approx(np.mean(textbook.drawn))


def test_it_shows_itself(textbook, official):
    assert repr(textbook).startswith("<Score of pid_robust, robustness: ")
    said = str(textbook)
    assert "(not official: not on the frozen simulators)" in said
    assert "R20C50" in said
    assert "(official)" in str(official)
    page = textbook._repr_html_()
    assert page.count("<tr") == 7
    assert "pid_robust" in page


def test_failures_are_shown_and_escaped(plants):
    class Fails(Pretender):
        def start(self, submission, tasks):
            from ventbench.sandbox.child.cell import Failure

            self.failures = {k: Failure("act", "<b>raised</b>") for k in range(6)}
            return self

    result = scored(plants, runner=Fails(), draws=2)
    assert "failed" in repr(result)
    assert str(result).count("<b>raised</b>") == 3
    assert "... 3 more" in str(result)
    assert "<b>raised" not in result._repr_html_()
    assert "failed" in result._repr_html_()


def test_save(textbook, tmp_path):
    textbook.save(tmp_path / "new")
    plain = json.loads(json.dumps(textbook.to_json()))
    assert json.loads((tmp_path / "new" / "score.json").read_text()) == plain
    kept = load(tmp_path / "new" / "trajectories.npz")
    np.testing.assert_array_equal(kept.pressure, textbook.trajectories.pressure)
