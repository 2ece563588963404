"""The residual controller: against its submission, its gradient, its training, its script."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from submissions.residual_mlp.train import (
    CHUNK,
    ResidualConfig,
    fit,
    main,
    objective,
    run,
    train,
    valve,
)
from ventbench.base import compilation
from ventbench.base.errors import InputError
from ventbench.controllers.pid import PID
from ventbench.controllers.residual import (
    Residual,
    inputs,
    save_weights,
    untrained,
)
from ventbench.entries.cells import InProcessRunner, protocol_of
from ventbench.entries.folder import open_submission
from ventbench.entries.scoring import run_protocol
from ventbench.plants.rigs import Rigs
from ventbench.plants.single_compartment import single_compartment
from ventbench.plants.stacking import stack, take
from ventbench.task import draws, protocol, rollouts
from ventbench.task.environment import nominal_scenario
from ventbench.task.lungs import LUNG_IDS, LUNGS
from ventbench.task.metrics.score import run_error
from ventbench.train import pid_search
from ventbench.train.pid_search import tune_pid
from ventbench.train.plants import ALL, plants_to_train_on

GAINS = (2.0, 4.0, 0.3)
SMALL = ResidualConfig(updates=CHUNK, copies=2, widths=(8,), ahead=3, members=2)
#: The second chunk is not a whole one; shared, so that it is compiled once.
PARTIAL = replace(SMALL, updates=2 * CHUNK - 10)


def controller(seed: int, **fields) -> Any:
    """A network that corrects a lot: all layers random."""
    like = Residual(PID(*GAINS), (), **fields)
    made: Any = untrained(jax.random.key(seed), like, (8, 5))
    last = 0.3 * jax.random.normal(jax.random.key(seed + 1), (5, 1))
    return made.replace(layers=(*made.layers[:-1], (last, jnp.full(1, 0.05))))


def lungs(count: int, scale: float = 1.0):
    made = stack([single_compartment(lung) for lung in LUNGS[:count]])
    return made.vary(jnp.full(count, scale), jnp.ones(count))


@pytest.fixture(scope="module")
def ensemble():
    """Two members of two lungs."""
    return stack([lungs(2), lungs(2, 1.2)])


def test_a_new_network_leaves_the_pid_alone():
    like = Residual(PID(*GAINS), ())
    made = untrained(jax.random.key(0), like, (8, 8))
    assert made.layers[0][0].shape == (inputs(like), 8)
    cells = nominal_scenario(np.array(protocol.PIPS))
    found, _ = rollouts.closed_loop(take(lungs(2), 1), made, cells)
    expected, _ = rollouts.closed_loop(take(lungs(2), 1), PID(*GAINS), cells)
    np.testing.assert_allclose(found.u_in, expected.u_in, atol=1e-3)


def test_it_remembers_the_breath_before():
    one = controller(3)
    cells = nominal_scenario(np.array([20.0]))
    found, _ = rollouts.closed_loop(take(lungs(2), 1), one, cells)
    u_in = np.asarray(found.u_in[0])
    assert np.abs(u_in[0] - u_in[1]).max() > 0.1
    forgetful, _ = rollouts.closed_loop(take(lungs(2), 1), controller(3, ahead=0), cells)
    u_in = np.asarray(forgetful.u_in[0])
    assert np.abs(u_in[1] - u_in[2]).max() < 1e-3


@pytest.mark.parametrize(
    "fields", [{}, {"ahead": 0, "pressures": 0, "commands": 1}, {"ahead": 40, "pressures": 40}]
)
def test_the_submission_is_the_pure_controller(fields, tmp_path):
    """With nominal cells and draws, on every lung; one network a lung and one for all."""
    names = (*LUNG_IDS[:2], ALL)
    folder = tmp_path / "residual_mlp"
    bundled = open_submission("residual_mlp").folder
    shutil.copytree(bundled, folder, ignore=shutil.ignore_patterns("__pycache__"))
    made = {name: controller(k, **fields) for k, name in enumerate(names)}
    save_weights(folder / "weights.npz", made)
    with compilation.float64():
        plants = stack([single_compartment(lung) for lung in LUNGS[:3]])
        pure = {
            name: jax.tree.map(lambda x: jnp.asarray(np.asarray(x), float), one)
            for name, one in made.items()
        }
        rigs = Rigs(LUNGS[:3], plants)
        _, every = rigs.cells(rigs.draws(2, (10.0, 35.0)), (10.0, 35.0))
        errors = []
        for k in range(3):
            cells = jax.tree.map(lambda x, k=k: jnp.asarray(x[k]), every)
            one = pure[LUNG_IDS[k] if k < 2 else ALL]
            found, _ = rollouts.closed_loop(take(plants, k), one, cells)
            errors.append(run_error(found.pressure, np.asarray(cells.pip)[..., None, None]))
    result = run_protocol(
        open_submission(str(folder)),
        protocol_of(rigs, draws=2, pips=(10, 35)),
        runner=InProcessRunner(),
    )
    assert not result.failures
    expected = np.stack(errors)
    # The environment rounds a submission's commands to 0.001 %.
    np.testing.assert_allclose(result.nominal, expected[:, 0], rtol=0, atol=1e-4)
    np.testing.assert_allclose(result.drawn, np.moveaxis(expected[:, 1:], 1, 0), rtol=0, atol=1e-4)


def test_both_submissions_have_the_same_controller():
    one, other = (open_submission(name).folder for name in ("residual_mlp", "residual_mlp_all"))
    assert (one / "controller.py").read_bytes() == (other / "controller.py").read_bytes()


@pytest.mark.parametrize(
    ("u_in", "gradient", "expected"),
    [(50.0, 1.0, 1.0), (120.0, -1.0, 0.0), (120.0, 1.0, 1.0), (-5.0, 1.0, 0.0), (-5.0, -1.0, -1.0)],
)
def test_beyond_the_valve_only_the_way_back_has_a_derivative(u_in, gradient, expected):
    value, backward = jax.vjp(valve, jnp.asarray(u_in))
    assert float(value) == np.clip(u_in, 0.0, 100.0)
    assert float(backward(jnp.asarray(gradient))[0]) == expected


def test_the_run_is_that_of_the_scorer():
    one = controller(5)
    with compilation.float64():
        cells = draws.build([[0]], 1, n=1).cells
        cells = jax.tree.map(lambda x: jnp.asarray(x[0, 0]), cells).replace(quantum=jnp.zeros(6))
        plant = single_compartment(LUNGS[3])
        one = jax.tree.map(lambda x: jnp.asarray(x, float), one)
        found = jax.vmap(run, (None, None, 0))(one, plant, cells)
        expected, _ = rollouts.closed_loop(plant, one, cells)
    np.testing.assert_allclose(found.pressure, expected.pressure, atol=1e-9)
    np.testing.assert_allclose(found.u_in, expected.u_in, atol=1e-9)


def test_the_gradient_is_that_of_finite_differences():
    """Where the valve never reaches an end, so that nothing is left out."""
    with compilation.float64():
        one = controller(7, limit=3.0).replace(pid=PID(0.5, 1.0, 0.0))
        one = jax.tree.map(lambda x: jnp.asarray(x, float), one)
        plants = stack([single_compartment(LUNGS[5])])
        cells = nominal_scenario(np.array([20.0]))

        def value(shift):
            *hidden, (last, bias) = one.layers
            moved = one.replace(layers=(*hidden, (last + shift, bias)))
            return objective(moved, plants, cells, 0.25, 0.01)

        value = jax.jit(value)
        zero, h = jnp.asarray(0.0), 1e-6
        u_in = np.asarray(jax.vmap(run, (None, 0, 0))(one, plants, cells).u_in)
        found = float(jax.grad(value)(zero))
        expected = float((value(zero + h) - value(zero - h)) / (2 * h))
    assert 0.0 < u_in.min() < u_in.max() < 100.0
    assert abs(expected) > 1e-3
    assert found == pytest.approx(expected, rel=1e-4)


def test_benches_deviate_as_the_draws_do_but_are_none_of_them():
    n = 4000
    pip = jnp.full(n, 20.0)
    normal = jnp.arange(n) % 2 == 0
    found = draws.random_scenarios(jax.random.key(0), pip, spread=1.0 * ~normal, smooth=True)
    calm = jax.tree.map(lambda x: np.asarray(x)[::2], found)
    expected = jax.tree.map(np.asarray, nominal_scenario(np.full(n // 2, 20.0)))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6), calm, expected)
    wild = jax.tree.map(lambda x: np.asarray(x)[1::2], found)
    values = {
        "pip_shift": wild.pip - 20.0,
        "peep_shift": wild.peep - protocol.PEEP,
        "start_shift": wild.start - wild.peep,
        "dt_scale": wild.dt / protocol.DT,
        "r_scale": wild.r_scale,
        "c_scale": wild.c_scale,
        "delay": wild.delay,
    }
    for name, (low, high) in draws.RANGES.items():
        width = high - low
        assert low - 1e-5 <= values[name].min() < low + 0.01 * width, name
        assert high - 0.01 * width < values[name].max() <= high + 1e-5, name
    width = np.sqrt(np.mean(np.square(draws.NOISE_SD)) + draws.QUANTUM**2 / 12)
    assert wild.noise.std() == pytest.approx(width, rel=0.02)
    wider = draws.random_scenarios(jax.random.key(0), pip, spread=2.0 * ~normal, smooth=True)
    assert np.ptp(wider.r_scale) == pytest.approx(2 * 0.38, rel=0.01)
    assert np.asarray(wider.delay).max() < 1.0


@pytest.mark.slow
def test_training_lowers_the_error(ensemble):
    told = []
    trained = fit(ensemble, GAINS, config=PARTIAL, progress=lambda done, *_: told.append(done))
    assert told == [CHUNK, PARTIAL.updates]
    cells = nominal_scenario(np.array(protocol.PIPS))

    def error(one) -> float:
        pressure = [
            rollouts.closed_loop(take(ensemble, 0, lung), one, cells)[0].pressure for lung in (0, 1)
        ]
        return float(
            np.mean([run_error(p, np.asarray(cells.pip)[:, None, None]) for p in pressure])
        )

    assert error(trained) < 0.95 * error(PID(*GAINS))


@pytest.mark.slow
def test_same_seed_same_bits_also_after_ctrl_c(ensemble, tmp_path):
    config = PARTIAL
    whole = fit(ensemble, GAINS, config=config, seed=1)

    def stop(*progress):
        raise KeyboardInterrupt

    path = tmp_path / "checkpoint.npz"
    with pytest.raises(KeyboardInterrupt):
        fit(ensemble, GAINS, config=config, seed=1, checkpoint=path, progress=stop)
    with pytest.raises(InputError, match=r"work with other settings \(seed\)"):
        fit(ensemble, GAINS, config=config, seed=2, checkpoint=path)
    again = fit(ensemble, GAINS, config=config, seed=1, checkpoint=path)
    assert not path.exists()
    for a, b in zip(jax.tree.leaves(whole), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(a, b)
    other = fit(ensemble, GAINS, config=config, seed=2)
    assert not np.array_equal(whole.layers[0][0], other.layers[0][0])


def test_lambda_is_the_weight_of_the_mean_correction(ensemble):
    plants = jax.tree.map(lambda leaf: leaf[0], ensemble)
    cells = nominal_scenario(np.array([20.0, 30.0]))
    trained = controller(3)
    value = jax.jit(lambda lam: objective(trained, plants, cells, 0.0, lam))
    found = float(value(jnp.asarray(10.0)) - value(jnp.asarray(0.0)))
    correction = np.abs(jax.jit(jax.vmap(run, (None, 0, 0)))(trained, plants, cells).correction)
    assert found == pytest.approx(10.0 * correction[:, protocol.SCORED_BREATHS].mean(), rel=1e-4)


@pytest.mark.parametrize(
    ("field", "value"), [("updates", 0), ("lam", -1.0), ("spread", 5.0), ("copies", 0)]
)
def test_settings_that_cannot_work_are_refused(field, value):
    with pytest.raises(ValueError, match=field):
        ResidualConfig(**{field: value})


def test_weights_are_read_as_they_were_written(tmp_path):
    one = controller(1, ahead=2, limit=30.0)
    save_weights(tmp_path / "w.npz", {"R5C10": one, ALL: controller(2)})
    found = np.load(tmp_path / "w.npz")
    assert {name.partition(".")[0] for name in found} == {"R5C10", ALL}
    assert (found["R5C10.windows"][2], found["R5C10.limit"]) == (2, 30.0)
    np.testing.assert_allclose(found["R5C10.gains"], [one.pid.P, one.pid.I, one.pid.D])
    for k, (weights, biases) in enumerate(one.layers):
        np.testing.assert_allclose(found[f"R5C10.w{k}"], weights, rtol=1e-6)
        np.testing.assert_allclose(found[f"R5C10.b{k}"], biases, rtol=1e-6)


#: A grid of two PIDs.
PIDS = np.array([(2.0, 4.0, 0.0), (5.0, 5.0, 0.0)])


@pytest.mark.slow
def test_the_script_trains_and_tells(monkeypatch, tmp_path):
    monkeypatch.setattr(pid_search, "paper_gains", lambda: PIDS)
    asked = f"train.py --lung R20C50 --updates 3 --members 1 --out {tmp_path}"
    monkeypatch.setattr("sys.argv", asked.split())
    main()
    result = json.loads((tmp_path / "training.json").read_text())
    (one,) = result["networks"].values()
    assert one["gains"] == [5.0, 5.0, 0.0]
    assert set(one["error"]) == {"R20C50"}
    assert result["recipe"]["updates"] == 3
    assert {name.partition(".")[0] for name in np.load(tmp_path / "weights.npz")} == {"R20C50"}
    assert not list((tmp_path / "parts").iterdir())


@pytest.mark.parametrize(
    ("asked", "said"),
    [("--lung R20C50 --all", "not allowed with argument"), ("--lung R50C10", "not a scored lung")],
)
def test_the_script_takes_one_lung_or_all(asked, said, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr("sys.argv", ["train.py", *asked.split(), "--out", str(tmp_path)])
    with pytest.raises(SystemExit):
        main()
    assert said in capsys.readouterr().err


@pytest.mark.slow
def test_an_interrupted_training_continues_to_the_same_bytes(tmp_path):
    config = replace(SMALL, updates=2 * CHUNK)
    names = ("R5C10", ALL)

    def go(folder, report=None):
        return train(
            names,
            folder,
            config=config,
            gains=PIDS,
            simulator="single_compartment",
            progress=report,
        )

    whole = go(tmp_path / "whole")

    def stop(what, progress):
        if progress and what == f"network {ALL}" and progress[0] == CHUNK:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        go(tmp_path / "half", stop)
    assert not (tmp_path / "half" / "weights.npz").exists()
    again = go(tmp_path / "half")
    assert again.report["weights_sha256"] == whole.report["weights_sha256"]
    assert tuple(whole.report["networks"][ALL]["error"]) == LUNG_IDS


@pytest.mark.slow
def test_a_short_training_on_the_frozen_simulators_beats_their_best_pid():
    """On the reference rig, of which the training sees one plant among many."""
    index = LUNG_IDS.index("R20C20")
    given = plants_to_train_on()
    _, tuned = tune_pid(["R20C20"], gains=PIDS)
    gains = tuned["lungs"]["R20C20"]["gains"]
    own = jax.tree.map(lambda leaf: leaf[:, [index]], given.plants)
    one = fit(own, gains, config=ResidualConfig(updates=200), weights=given.weights[[index]])
    cells = nominal_scenario(np.array(protocol.PIPS))
    plant = jax.tree.map(lambda leaf: jnp.asarray(leaf[index], jnp.float32), given.nominal)
    errors = []
    for controller_ in (one, PID(*gains)):
        pressure = rollouts.closed_loop(plant, controller_, cells)[0].pressure
        errors.append(run_error(pressure, np.asarray(cells.pip)[:, None, None]).mean())
    assert errors[0] < 0.95 * errors[1]
