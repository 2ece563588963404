"""The table of an entry away from where it was tuned."""

import dataclasses
import json

import numpy as np
import pytest

from ventbench.base.errors import InputError
from ventbench.entries.folder import open_submission
from ventbench.entries.scoring import run_protocol
from ventbench.entries.transfer import GROUPS, transfer
from ventbench.plants.rigs import load_rigs

from ..textbook_rigs import TextbookRigs


@pytest.fixture(scope="module")
def rigs():
    # The first lung has no rig set aside: its other rig is one like all others.
    made = TextbookRigs()
    return dataclasses.replace(made.scored(), held_out=(None, *made.held_out_rigs[1:]))


@pytest.fixture(scope="module")
def result(rigs):
    return transfer(open_submission("pid_robust"), rigs)


def test_reference_rig_is_the_nominal_score(rigs, result):
    score = run_protocol(open_submission("pid_robust"), rigs)
    np.testing.assert_allclose(result.errors["reference rig"], score.nominal.mean(axis=1))
    assert result.mean("reference rig") == pytest.approx(score.score)


def test_plants_fall_into_groups(result):
    counts = {group: result.plants[group].tolist() for group in GROUPS}
    assert counts == {
        "reference rig": [1] * 6,
        "other members": [1] * 6,
        "other rigs": [1, 0, 0, 0, 0, 0],
        "held-out rig": [0, 1, 1, 1, 1, 1],
    }
    assert np.isnan(result.errors["held-out rig"][0])
    assert np.isfinite(result.mean("held-out rig"))
    assert result.mean("other rigs") == result.errors["other rigs"][0]


def test_other_rigs_give_other_errors(result):
    assert np.all(result.errors["other members"] != result.errors["reference rig"])
    assert np.all(result.errors["held-out rig"][1:] != result.errors["reference rig"][1:])


def test_json_has_null_where_there_is_no_plant(result):
    value = json.loads(json.dumps(result.to_json(), allow_nan=False))
    assert value["groups"]["held-out rig"]["lungs"]["R5C10"] is None
    assert value["groups"]["held-out rig"]["plants"] == 5


def test_simulators_with_one_rig_have_nothing_to_transfer_to():
    with pytest.raises(InputError, match="one rig a lung"):
        transfer(open_submission("pid_robust"), load_rigs("physics"))
