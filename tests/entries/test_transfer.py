"""The table of an entry away from where it was tuned."""

import dataclasses
import json

import numpy as np
import pytest

from ventbench.base.errors import InputError
from ventbench.entries.cells import InProcessRunner
from ventbench.entries.folder import open_submission
from ventbench.entries.scoring import GROUPS, by_group, run_protocol, transfer
from ventbench.plants.rigs import load_rigs

from ..textbook_rigs import TextbookRigs


@pytest.fixture(scope="module")
def rigs():
    # The first lung has no rig set aside: its other rig is one like all others.
    made = TextbookRigs()
    return dataclasses.replace(made.scored(), held_out=((), *made.held_out_rigs[1:]))


@pytest.fixture(scope="module")
def result(rigs):
    return by_group(transfer(open_submission("pid_robust"), rigs, runner=InProcessRunner()), rigs)


def errors(result, group):
    return np.array(list(result[group]["lungs"].values()), float)


def test_reference_rig_is_the_nominal_score(rigs, result):
    score = run_protocol(open_submission("pid_robust"), rigs, runner=InProcessRunner())
    np.testing.assert_allclose(errors(result, "reference rig"), score.nominal.mean(axis=1))
    assert result["reference rig"]["error_cmH2O"] == pytest.approx(score.score)


def test_plants_fall_into_groups(result):
    assert [result[group]["plants"] for group in GROUPS] == [6, 6, 1, 5]
    assert result["held-out rigs"]["lungs"]["R5C10"] is None
    assert result["other rigs"]["error_cmH2O"] == result["other rigs"]["lungs"]["R5C10"]
    assert list(result["other rigs"]["lungs"].values())[1:] == [None] * 5


def test_other_rigs_give_other_errors(result):
    assert np.all(errors(result, "other members") != errors(result, "reference rig"))
    assert np.all(errors(result, "held-out rigs")[1:] != errors(result, "reference rig")[1:])


def test_json_has_null_where_there_is_no_plant(result):
    json.dumps(result, allow_nan=False)


def test_simulators_with_one_rig_have_nothing_to_transfer_to():
    with pytest.raises(InputError, match="one rig a lung"):
        transfer(open_submission("pid_robust"), load_rigs("physics"), runner=InProcessRunner())
