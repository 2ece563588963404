"""The submissions' controllers in numpy are the policies in JAX."""

from __future__ import annotations

import shutil
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ventbench.base import compilation
from ventbench.controllers.residual import (
    CHOICES,
    GaussianPolicy,
    GreedyPolicy,
    TanhNetwork,
    init_parameters,
    save_policies,
)
from ventbench.entries.cells import InProcessRunner, protocol_of
from ventbench.entries.folder import open_submission
from ventbench.entries.scoring import run_protocol
from ventbench.plants.rigs import Rigs
from ventbench.plants.single_compartment import single_compartment
from ventbench.plants.stacking import stack
from ventbench.task import environment, rollouts
from ventbench.task.lungs import LUNG_IDS, LUNGS
from ventbench.task.protocol import PIPS

from ..valve import Stepped

HERE = Path(__file__).parents[2] / "submissions"
KINDS = {"ppo": (GaussianPolicy, 1), "dqn": (GreedyPolicy, len(CHOICES))}
NAMES = (*LUNG_IDS, "all")


def make(name: str) -> dict[str, GaussianPolicy | GreedyPolicy]:
    """Policies with random weights, none of them zero."""
    kind, outputs = KINDS[name]
    network = TanhNetwork((8, 8), outputs, first=0.2)
    keys = jax.random.split(jax.random.key(5), len(NAMES))
    made = {}
    for key, lung in zip(keys, NAMES, strict=True):
        start, bias = jax.random.split(key)
        parameters = jax.tree.map(
            lambda x, bias=bias: x + 0.05 * jax.random.normal(bias, x.shape),
            init_parameters(network, start),
        )
        made[lung] = kind(parameters, network)
    return made


@pytest.mark.parametrize(
    ("name", "track"),
    [
        ("ppo", "performance"),
        ("ppo", "robustness"),
        ("dqn", "performance"),
        ("dqn", "robustness"),
    ],
)
def test_numpy_and_jax_act_alike(name, track, tmp_path):
    folder = tmp_path / name
    shutil.copytree(HERE / name, folder, ignore=shutil.ignore_patterns("__pycache__"))
    # The policy alone, without what keeps the submission safe.
    controller = folder / "controller.py"
    controller.write_text(
        controller.read_text().replace("ABOVE, SHARE = 8.0", "ABOVE, SHARE = 1e9")
    )
    made = make(name)
    save_policies(folder / "weights.npz", made)
    with compilation.float64():
        plants = stack([single_compartment(lung) for lung in LUNGS])
        rigs = Rigs(LUNGS, plants)
        found = run_protocol(
            open_submission(str(folder)),
            protocol_of(rigs, draws=1),
            track=track,
            runner=InProcessRunner(),
        )
        _, every = rigs.cells(rigs.draws(1), PIPS)
        for i, lung in enumerate(LUNG_IDS):
            policy = made[lung if track == "performance" else "all"]
            policy = jax.tree.map(lambda x: jnp.asarray(np.asarray(x), float), policy)
            plant = jax.tree.map(lambda x, i=i: x[i], plants)
            cells = jax.tree.map(lambda x, i=i: jnp.asarray(x[i]), every)
            wanted, _ = rollouts.closed_loop(plant, Stepped(policy), cells)
            assert np.ptp(wanted.requested) > 20.0
            applied = environment.resolved(found.requested[i])
            np.testing.assert_allclose(applied, wanted.requested, rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", ["ppo", "dqn"])
def test_the_submission_has_the_settings_of_the_training(name):
    with np.load(HERE / name / "weights.npz", allow_pickle=False) as file:
        arrays = dict(file)
    assert {key.split(".")[0] for key in arrays} == set(NAMES)
    assert all(array.dtype == np.float32 for array in arrays.values())
    last = max(key for key in arrays if key.startswith("all.b"))
    assert arrays[last].shape == (KINDS[name][1],)
