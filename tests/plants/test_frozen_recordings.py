"""The official simulators and the public recordings: what they learned, and how far they err."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from ventbench import open_loop_report
from ventbench.lungs import LUNG_IDS
from ventbench.plants import frozen
from ventbench.plants.frozen import BY_NONE, fingerprints
from ventbench.plants.single_compartment import single_compartment
from ventbench.plants.stacking import nominal_plants
from ventbench.plants.two_balloon import two_balloon
from ventbench.precision import float64
from ventbench.recordings import join, load
from ventbench.training.simulator import MEASURED, RECONSTRUCTED

single_compartments = partial(nominal_plants, single_compartment)
two_balloons = partial(nominal_plants, two_balloon)


@pytest.fixture(scope="module")
def official():
    return frozen.load()


@pytest.fixture(scope="module")
def networks():
    return frozen.load_learned()


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


def test_are_those_of_the_training(official, measured, reconstructed):
    sources = official.manifest["recordings"]
    assert sources[MEASURED] == {"sha256": measured.sha256, "breaths": len(measured)}
    assert sources[RECONSTRUCTED] == {
        "sha256": reconstructed.sha256,
        "breaths": len(reconstructed),
    }
    both = join([measured, reconstructed])
    assert set(official.seen.key.tolist()) == set(fingerprints(both).tolist())


def test_each_measured_breath_is_judged_by_the_member_without_it(official, measured):
    split = official.manifest["split"]["held_out"]
    assert sorted(np.concatenate(split)) == sorted(measured.breath_id)
    fold = official.seen.folds(measured)
    for member, ids in enumerate(split):
        assert sorted(measured.breath_id[fold == member].tolist()) == ids
    assert official.held_out(measured).all()
    np.testing.assert_array_equal(official.unseen(measured), fold == 0)
    at = official.sessions.assign(measured)
    with float64():
        judges = official.cross_fitted(measured)
    np.testing.assert_array_equal(judges.E, official.members.E[fold, at])


def test_a_changed_command_makes_a_breath_new(official, measured):
    u_in = measured.u_in.copy()
    u_in[7, 3] += 0.01
    other = replace(measured, u_in=u_in)
    assert official.seen.folds(other)[7] == BY_NONE
    assert official.held_out(other).all()
    assert official.unseen(other)[7]
    with float64():
        assert official.cross_fitted(other).E[7] == official.for_breaths(other).E[7]


def test_reconstructed_breaths_have_been_seen_by_all(official, reconstructed):
    assert not official.held_out(reconstructed).any()
    assert not official.unseen(reconstructed).any()


def test_the_errors_of_the_manifest_are_reproduced(official, networks, measured):
    kinds = {
        "hybrid": official.cross_fitted,
        "learned": networks.cross_fitted,
        "single_compartment": single_compartments,
        "two_balloon": two_balloons,
    }
    comparison = official.manifest["comparison"]
    assert set(comparison) == set(kinds)
    errors = {kind: open_loop_report.errors(find, measured) for kind, find in kinds.items()}
    for kind, error in errors.items():
        # Networks are float32, and another machine adds in another order.
        allowed = 1e-3 if kind == "learned" else 1e-6
        for lung, index in measured.by_lung_index.items():
            agree(open_loop_report.summary("", error[index]), comparison[kind][lung], allowed)
    error = open_loop_report.errors(official.for_breaths, measured)
    new = official.unseen(measured)
    for lung, about in official.lungs().items():
        index = measured.by_lung_index[lung]
        figures = {
            **open_loop_report.summary("held_out_", errors["hybrid"][index]),
            **open_loop_report.summary("official_", error[index][new[index]]),
            **open_loop_report.summary("training_", error[index][~new[index]]),
        }
        agree(figures, {name: about[name] for name in figures}, 1e-6)
        assert about["training_mae"] < about["held_out_mae"]


def test_the_hybrid_is_the_better_of_the_two_that_learn(official):
    comparison = official.manifest["comparison"]
    mean = {
        kind: np.mean([comparison[kind][lung]["mae"] for lung in LUNG_IDS]) for kind in comparison
    }
    assert mean["hybrid"] < 0.65 * mean["learned"] < mean["single_compartment"]
