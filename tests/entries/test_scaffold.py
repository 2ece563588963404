"""`ventbench new`: every family can be checked and scored at once."""

import math
import os
import re
import stat
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flax import linen as nn
from safetensors.numpy import save_file

from ventbench.base import compilation
from ventbench.base.errors import InputError
from ventbench.entries import contract
from ventbench.entries.cells import InProcessRunner, protocol_of
from ventbench.entries.folder import open_submission
from ventbench.entries.manifest import FAMILIES
from ventbench.entries.scaffold import contents, create, initial_weights
from ventbench.entries.scoring import run_protocol
from ventbench.plants.rigs import Rigs
from ventbench.task.lungs import LUNGS

# Observations of a controller: time, dt, pressure, target, ahead, command before.
NETWORKS = ("residual", "ppo", "dqn")


@pytest.fixture(scope="module")
def one_lung():
    from ventbench.base import compilation
    from ventbench.plants.single_compartment import single_compartment
    from ventbench.plants.stacking import stack

    with compilation.float64():
        return stack([single_compartment(LUNGS[0])])


@pytest.mark.parametrize("family", FAMILIES)
def test_is_ready_and_scores(family, tmp_path, one_lung):
    folder = create("demo", family, tmp_path)
    report = contract.check(str(folder))
    assert report.ok, "\n".join(report.lines())
    assert report.notes[0].what == "key authors still says Your Name"
    result = run_protocol(
        open_submission(str(folder)),
        protocol_of(Rigs(LUNGS[:1], one_lung), pips=(20.0,)),
        track="robustness",
        runner=InProcessRunner(),
    )
    assert not result.failures
    # A lung that is left alone at PEEP would be 15 off.
    assert 0.1 < result.score < 5.0


def test_residual_starts_as_its_pi_controller(tmp_path, one_lung):
    def scored(folder):
        return run_protocol(
            open_submission(str(folder)),
            protocol_of(Rigs(LUNGS[:1], one_lung), pips=(20.0,)),
            track="robustness",
            runner=InProcessRunner(),
        ).requested

    residual = scored(create("residual", "residual", tmp_path))
    plain = create("plain", "pid", tmp_path)
    text = (plain / "controller.py").read_text()
    assert "(6.0, 6.0, 0.3)" in text
    (plain / "controller.py").write_text(text.replace("(6.0, 6.0, 0.3)", "(1.0, 10.0, 0.0)"))
    np.testing.assert_allclose(residual, scored(plain), rtol=0, atol=1e-9)


@pytest.mark.parametrize("family", NETWORKS)
def test_weights_are_the_same_every_time_and_small(family):
    first, second = contents("demo", family), contents("demo", family)
    assert len(first["weights.npz"]) < 10_000
    for key, value in initial_weights(family).items():
        assert value.dtype == np.float32
        np.testing.assert_array_equal(value, initial_weights(family)[key])
    assert {k: v for k, v in first.items() if k != "weights.npz"} == {
        k: v for k, v in second.items() if k != "weights.npz"
    }


@pytest.mark.parametrize("family", NETWORKS)
def test_an_untrained_network_is_not_called_trained(family):
    manifest = contents("demo", family)["submission.toml"].decode()
    assert "untrained" in manifest
    assert "none yet" in manifest


@pytest.mark.parametrize("family", FAMILIES)
def test_files_have_no_blanks_left(family):
    for name, content in contents("demo", family).items():
        if not name.endswith(".npz"):
            assert "$" not in content.decode(), name


def test_refuses_to_overwrite(tmp_path):
    folder = create("demo", "pid", tmp_path)
    (folder / "README.md").write_text("mine")
    with pytest.raises(InputError, match="exists; choose another name or --out"):
        create("demo", "dqn", tmp_path)
    assert (folder / "README.md").read_text() == "mine"
    assert not (folder / "network.py").exists()
    (tmp_path / "link").symlink_to("nowhere")
    with pytest.raises(InputError, match="exists"):
        create("link", "pid", tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["demo", "link"]


@pytest.mark.parametrize("name", ["My PID!", "Rö-2", "9lives", "", "../x", "a" * 41, "x\n"])
def test_says_what_a_name_may_be(name, tmp_path):
    with pytest.raises(InputError, match="must be lower-case letters"):
        create(name, "pid", tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_other_refusals(tmp_path):
    with pytest.raises(InputError, match="belongs to a submission of ventbench"):
        create("pid_best", "pid", tmp_path)
    with pytest.raises(InputError, match="did you mean residual"):
        create("demo", "residuals", tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match=r"file"):
        create("demo", "pid", tmp_path / "file")


@pytest.mark.skipif(sys.platform != "linux", reason="the folder is closed to root on Linux")
def test_a_closed_folder_is_said_so():
    with pytest.raises(PermissionError):
        create("demo", "pid", Path("/sys"))


def test_modes_are_those_of_any_new_file(tmp_path):
    folder = create("demo", "ppo", tmp_path / "new")
    umask = os.umask(0)
    os.umask(umask)
    assert stat.S_IMODE(folder.stat().st_mode) == 0o777 & ~umask
    assert all(stat.S_IMODE(p.stat().st_mode) == 0o666 & ~umask for p in folder.iterdir())


@pytest.mark.parametrize("family", ["ppo", "dqn"])
def test_networks_act_as_a_pi_controller(family, tmp_path, one_lung):
    """P = 1, I = 10, to the resolution of 51 commands for dqn, within 0 to 100 %."""
    from ventbench.sandbox.child.cell import controller_class

    network = controller_class(create("net", family, tmp_path))()
    network.reset(None)
    observed = open_submission(str(tmp_path / "net"))
    session = InProcessRunner().start(observed, [contract.plain(["robustness"])[0].task])
    integral, dt = 0.0, 0.03
    for step in range(30):
        pressure = 5.0 + step / 2
        error = 20.0 - pressure
        integral += dt / (dt + 0.5) * (error - integral)
        expected = min(max(error + 10 * integral, 0.0), 100.0)
        row = np.array([[step * dt, dt, pressure, 20.0, *[20.0] * 10, 5.0]])
        (command,) = session.act(row)
        tolerance = 1.01 if family == "dqn" else 1e-3
        assert math.isclose(command, expected, abs_tol=tolerance), step
    assert not session.failures


LAYERS = ((30, 16), (16, 16), (16, 1))


def trained(library: str) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Arrays as a library saves them, and the network's actions by that library or by loops."""
    rng = np.random.default_rng(0)
    seen = rng.uniform(-1.0, 1.0, (20, 30))
    weights = [(rng.normal(0, 0.3, shape), rng.normal(0, 0.1, shape[1])) for shape in LAYERS]
    if library == "flax":
        network = nn.Sequential([nn.Dense(16), nn.relu, nn.Dense(16), nn.relu, nn.Dense(1)])
        tree = {f"layers_{2 * k}": {"kernel": w, "bias": b} for k, (w, b) in enumerate(weights)}
        arrays = {f"params.{name}.{key}": x for name, d in tree.items() for key, x in d.items()}
        with compilation.float64():
            actions = np.asarray(network.apply({"params": tree}, seen))
        return arrays | {"check.input": seen, "check.output": actions}, actions
    names = ["mlp_extractor.policy_net.0", "mlp_extractor.policy_net.2", "action_net"]
    arrays = {f"{name}.weight": w.T for name, (w, _) in zip(names, weights, strict=True)}
    arrays |= {f"{name}.bias": b for name, (_, b) in zip(names, weights, strict=True)}
    arrays |= {"mlp_extractor.value_net.0.weight": np.ones((8, 30)), "log_std": np.ones(1)}
    arrays |= {"value_net.weight": np.ones((1, 8)), "value_net.bias": np.ones(1)}
    actions = []
    for x in seen.tolist():
        for k, (w, b) in enumerate(weights):
            x = [
                sum(a * c for a, c in zip(x, col, strict=True)) + d
                for col, d in zip(w.T.tolist(), b.tolist(), strict=True)
            ]
            x = [math.tanh(a) for a in x] if k < 2 else x
        actions.append(x[0])
    return arrays | {"check.input": seen, "check.output": np.array(actions)}, np.array(actions)


def saved(arrays, path):
    save_file({name: np.ascontiguousarray(x) for name, x in arrays.items()}, path)
    return path


@pytest.mark.parametrize("library", ["torch", "flax"])
def test_a_network_of_another_library_becomes_an_entry(library, tmp_path):
    """Of two observations; the entry acts as the network on what the environment would show."""
    arrays, _ = trained(library)
    folder = create("mine", "ppo", tmp_path, network=saved(arrays, tmp_path / "net.safetensors"))
    assert "give the 20 actions of `net.safetensors` to" in (folder / "README.md").read_text()
    entry = open_submission(str(folder))
    assert entry.manifest.family == "ppo"
    assert "3 dense layers" in entry.manifest.description
    written: dict[str, Any] = {"__file__": str(folder / "network.py")}
    exec((folder / "network.py").read_text(), written)
    network = written["Network"]()
    found = network(arrays["check.input"])[:, 0]
    np.testing.assert_allclose(found, arrays["check.output"].ravel(), rtol=0, atol=1e-6)
    session = InProcessRunner().start(entry, [contract.plain(["robustness"])[0].task])
    before = np.zeros(15)
    for step in range(4):
        ahead = np.linspace(20, 30, 10)
        row = np.array([[0.03 * step, 0.033, 6.0 + step, 20.0, *ahead, 5.0 * step]])
        time, dt, pressure, target, *ahead, previous = row[0]
        now = np.array([pressure, target, *ahead, 0, 0, 0]) / 40
        now[12:] = previous / 50 - 1, time, dt / 0.03
        action = network(np.concatenate([before, now]))[0]
        np.testing.assert_allclose(session.act(row), 50 + 50 * np.clip(action, -1, 1), atol=1e-9)
        before = now
    assert not session.failures


def test_what_is_no_network_of_the_task_is_refused(tmp_path):
    arrays, actions = trained("torch")
    wrong = {
        "with tanh between layers and nothing behind": {"check.output": actions + 1e-4},
        "check.input and check.output are missing": {"check.output": None},
        "the network has 31 inputs": {"mlp_extractor.policy_net.0.weight": np.ones((16, 31))},
        r"\(30, 16\), \(16, 16\): no chain that ends in one action": {"action_net.weight": None},
        "is no finite dense layer": {"action_net.weight": np.full((1, 16), np.nan)},
    }
    for said, change in wrong.items():
        changed = {k: v for k, v in {**arrays, **change}.items() if v is not None}
        with pytest.raises(InputError, match=said):
            create("mine", "ppo", tmp_path, network=saved(changed, tmp_path / "net.safetensors"))
    (tmp_path / "net.safetensors").write_text("nothing")
    for name, said in (("net.safetensors", "no safetensors file"), ("none", "there is no such")):
        with pytest.raises(InputError, match=said):
            create("mine", out=tmp_path, network=tmp_path / name)
    assert not (tmp_path / "mine").exists()


def test_readme_names_files_that_are_there(tmp_path):
    folder = create("demo", "residual", tmp_path)
    named = set(re.findall(r"^\| `([\w.]+)` \|", (folder / "README.md").read_text(), re.M))
    assert named == {path.name for path in folder.iterdir()} - {"README.md"}
