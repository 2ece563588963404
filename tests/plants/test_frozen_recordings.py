"""The official simulators and the public recordings: what they learned, and how far they err."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from proofs.studies.networks import MEASURED, RECONSTRUCTED
from ventbench import simulation
from ventbench.base.compilation import float64
from ventbench.plants import frozen
from ventbench.plants.frozen import BY_NONE
from ventbench.plants.single_compartment import single_compartment
from ventbench.plants.stacking import nominal_plants
from ventbench.plants.two_balloon import two_balloon
from ventbench.recordings import load
from ventbench.recordings.identity import fingerprints
from ventbench.task.lungs import LUNG_IDS
from ventbench.train.rigs.data import load_rig_recordings

single_compartments = partial(nominal_plants, single_compartment)
two_balloons = partial(nominal_plants, two_balloon)


@pytest.fixture(scope="module")
def official():
    return frozen.load()


def agree(found, stored, allowed):
    assert set(found) == set(stored)
    for name, value in found.items():
        assert value == pytest.approx(stored[name], abs=allowed + 1e-6), name


@pytest.fixture(scope="module")
def measured(public_recordings):
    return load(public_recordings / MEASURED)


@pytest.fixture(scope="module")
def reconstructed(public_recordings):
    return load(public_recordings / RECONSTRUCTED)


@pytest.fixture(scope="module")
def trained_on(official, public_recordings):
    split = official.manifest["split"]
    return load_rig_recordings(public_recordings, folds=split["folds"], seed=split["seed"])


def test_are_those_of_the_training(official, trained_on):
    assert official.manifest["recordings"] == trained_on.sources
    assert official.manifest["skipped"] == list(trained_on.skipped)
    stored, again = official.training_breaths.prints, fingerprints(trained_on.breaths)
    order = np.argsort(again.commands[:, 0])
    np.testing.assert_array_equal(stored.commands, again.commands[order])
    np.testing.assert_array_equal(stored.pressures, again.pressures[order])


def test_each_measured_breath_is_judged_by_the_member_without_it(official, trained_on):
    measured, member = trained_on.measured_breaths, trained_on.fold + 1
    np.testing.assert_array_equal(official.training_breaths.folds(measured), member)
    assert official.held_out(measured).all()
    assert not official.unseen(measured).any()  # member 0 is fitted to all
    at = official.sessions.assign(measured)
    with float64():
        judges = official.cross_fitted(measured)
    np.testing.assert_array_equal(judges.E, official.members.E[member, at])


def test_a_changed_command_makes_a_breath_new(official, measured):
    u_in = measured.u_in.copy()
    u_in[7, 3] += 0.06
    other = replace(measured, u_in=u_in)
    assert official.training_breaths.folds(other)[7] == BY_NONE
    assert official.held_out(other).all()
    assert official.unseen(other)[7]
    with float64():
        assert official.cross_fitted(other).E[7] == official.for_breaths(other).E[7]


def test_reconstructed_breaths_have_been_seen_by_all(official, reconstructed):
    assert not official.held_out(reconstructed).any()
    assert not official.unseen(reconstructed).any()


def test_the_errors_of_the_manifest_are_reproduced(official, measured):
    error = simulation.open_loop_errors(official.cross_fitted, measured)
    at = official.sessions.assign(measured)
    for lung, about in official.lungs().items():
        index = measured.by_lung_index[lung]
        figures = {
            **simulation.error_summary("held_out_", error[index]),
            **simulation.error_summary("own_rig_", error[index[np.isin(at[index], about["rigs"])]]),
        }
        agree(figures, {name: about[name] for name in figures}, 1e-6)


def test_the_hybrid_is_better_than_physics_from_labels(official, measured):
    """On breaths that its judge has not seen, over the six lungs."""
    scored = measured.select(np.flatnonzero(np.isin(measured.lung_ids, LUNG_IDS)))
    finders = (official.cross_fitted, single_compartments, two_balloons)
    hybrid, rc, balloons = (simulation.open_loop_errors(x, scored).mean() for x in finders)
    assert 1.5 * hybrid < min(rc, balloons)
