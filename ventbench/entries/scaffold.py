"""``ventbench new``: a submission that scores at once, to be changed into one's own.

A network that another library trained becomes one as it is: its dense layers are found in a
safetensors file by name and shape, and the copy in numpy must give the actions that the library
itself gave for some inputs, which lie in the file as ``check.input`` and ``check.output``.
"""

from __future__ import annotations

import io
import os
import re
from collections.abc import Callable
from importlib import resources
from itertools import product
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ventbench.base.errors import InputError, require
from ventbench.base.text import suggestion
from ventbench.entries.folder import CONTROLLER, bundled
from ventbench.entries.manifest import AUTHOR, FAMILIES, MANIFEST, NAME, NAME_RULE
from ventbench.task.interfaces import API_VERSION

_TEMPLATES = resources.files("ventbench.entries") / "templates"

#: File of the weights that the network families start from.
WEIGHTS = "weights.npz"

_FILES = {
    CONTROLLER: "class `Controller` with `reset(task)` and `act(observation)`",
    "network.py": "inputs and layers of the network",
    WEIGHTS: "weights w0, b0, w1, b1, ... as float32",
    MANIFEST: "name, authors, licence, tracks, training",
}
_EXPORT = """
## Your own weights

`network.py` reads `weights.npz`: arrays `w0`, `b0`, `w1`, `b1`, ... of dense layers with ReLU
between them, where layer k does `x @ wk + bk` (`Dense` of flax; the transpose of PyTorch's
`Linear`). Train with the inputs that `Features` makes, or change `Features`; the number of layers
and units is free. `ventbench new NAME --network FILE` copies a network that was trained on the
Gymnasium environment.
"""

_EXPORTED = """
## The network

`weights.npz` and `network.py` give the {count} actions of `{file}` to {off:.0e}.
"""

#: What may stand between layers, and behind the last one: as a function, and as numpy says it.
ACTIVATIONS: dict[str, tuple[Callable[[Any], Any], str]] = {
    "tanh": (np.tanh, "np.tanh(x)"),
    "relu": (lambda x: np.maximum(x, 0.0), "np.maximum(x, 0.0)"),
    "elu": (
        lambda x: np.where(x > 0.0, x, np.expm1(np.minimum(x, 0.0))),
        "np.where(x > 0.0, x, np.expm1(np.minimum(x, 0.0)))",
    ),
    "leaky relu": (lambda x: np.maximum(x, 0.01 * x), "np.maximum(x, 0.01 * x)"),
    "silu": (lambda x: x / (1.0 + np.exp(-x)), "x / (1.0 + np.exp(-x))"),
    "sigmoid": (lambda x: 1.0 / (1.0 + np.exp(-x)), "1.0 / (1.0 + np.exp(-x))"),
}
OUTPUTS: dict[str, tuple[Callable[[Any], Any], str]] = {
    "nothing": (lambda x: x, "x"),
    "tanh": (np.tanh, "np.tanh(x)"),
    "clip": (lambda x: np.clip(x, -1.0, 1.0), "np.clip(x, -1.0, 1.0)"),
}

#: Numbers of an observation of ``ventbench/Ventilator-v1``; largest deviation of the copy.
_OBSERVED, _TOLERANCE = 15, 1e-6

_LAYER = re.compile(r"(.*?)\.?(weight|kernel)")
_NO_ACTOR = re.compile(r"(^|[._])(value|critic|vf|qf|q_net|target|log_std)")

_GYMNASIUM = '''"""What the network is shown, and the network: a few dense layers in numpy."""

from pathlib import Path

import numpy as np


class Features:
    """Observations as of ventbench/Ventilator-v1, the newest last; zeros before the first."""

    def __init__(self):
        """Begin a run."""
        self.seen = np.zeros(({frames}, 15))

    def __call__(self, observation):
        """Return the inputs: pressures in 40 cmH2O, the command in -1..1, time, control step."""
        now = [
            observation.pressure / 40,
            observation.target / 40,
            *(target / 40 for target in observation.targets_ahead),
            observation.previous_u_in / 50 - 1,
            observation.time,
            observation.dt / 0.03,
        ]
        self.seen = np.vstack([self.seen[1:], now])
        return self.seen.ravel()


'''

# Units of each hidden layer; inputs as in templates/network.py; the PI that ppo and dqn start as.
_HIDDEN, _INPUTS, _P, _I = 16, 6, 1.0, 10.0


def create(
    name: str, family: str = "pid", out: Path | str = ".", network: Path | str | None = None
) -> Path:
    """Write a new submission.

    Args:
        name: what the entry and its folder are called.
        family: one of :data:`~ventbench.entries.manifest.FAMILIES`.
        out: folder to write it into; created if missing.
        network: safetensors file of a trained network, see :func:`exported`.

    Returns:
        The new folder, ``out/name``.

    Raises:
        InputError: if the name or family is not allowed, the folder exists, or the network cannot
            be copied.
        OSError: if it cannot be written.
    """
    _check_name(name)
    if family not in FAMILIES:
        hint = suggestion(family, FAMILIES)
        raise InputError(f"family {family!r} is not one of {', '.join(FAMILIES)}{hint}")
    folder = Path(out) / name
    if os.path.lexists(folder):
        raise InputError(f"{folder} exists; choose another name or --out DIR; nothing was changed")
    written = contents(name, family, network)
    folder.mkdir(parents=True)
    for file, content in written.items():
        (folder / file).write_bytes(content)
    return folder


def contents(name: str, family: str, exported_from: Path | str | None = None) -> dict[str, bytes]:
    """Files of a new submission of an allowed name and a known family, by name.

    What a safetensors file of a network gives is no ``"pid"`` but ``"other"``.
    """
    if exported_from is not None:
        return _exported_files(name, "other" if family == "pid" else family, Path(exported_from))
    has_template = (_TEMPLATES / f"{family}.py").is_file()
    controller = _template(f"{family if has_template else 'pid'}.py")
    files = {CONTROLLER: controller.encode()}
    network = "from network import" in controller
    if network:
        files["network.py"] = _template("network.py").encode()
        files[WEIGHTS] = _npz(initial_weights(family))
    data = "none yet: this is what ventbench new wrote"
    return _described(files, name, family, FAMILIES[family], data, _EXPORT if network else "")


def _described(
    files: dict[str, bytes], name: str, family: str, description: str, data: str, weights: str
) -> dict[str, bytes]:
    """Add manifest and README."""
    values = {
        "name": name,
        "author": AUTHOR,
        "family": family,
        "api_version": API_VERSION,
        "description": description,
        "data": data,
        "weights": weights,
    }
    files[MANIFEST] = Template(_template(MANIFEST)).substitute(values).encode()
    values["files"] = "\n".join(f"| `{k}` | {v} |" for k, v in _FILES.items() if k in files)
    files["README.md"] = Template(_template("README.md")).substitute(values).encode()
    return files


def _exported_files(name: str, family: str, path: Path) -> dict[str, bytes]:
    arrays, source, deviation, count = exported(path)
    files = {
        CONTROLLER: _template("ppo.py").replace("; it starts as a PI controller", "").encode(),
        "network.py": source.encode(),
        WEIGHTS: _npz(arrays),
    }
    layers = len(arrays) // 2
    description = f"A network of {layers} dense layers that another library trained."
    data = "not said yet: what the network was trained on"
    section = _EXPORTED.format(count=count, file=path.name, off=deviation)
    return _described(files, name, family, description, data, section)


def exported(path: Path) -> tuple[dict[str, NDArray[np.floating]], str, float, int]:
    """Copy a trained network of dense layers.

    Its inputs are those of ``ventbench/Ventilator-v1``, once or several times, the newest last; its
    one output is the action, which is clipped to -1..1. Layers are matrices called ``weight``
    (outputs, inputs), as of PyTorch, or ``kernel`` (inputs, outputs), as of flax; those of critics
    are left out. What stands between them is found out by the check.

    Args:
        path: safetensors file with ``check.input``, ``(n, inputs)``, and ``check.output``,
            ``(n,)`` or ``(n, 1)``, beside the layers.

    Returns:
        Weights ``w0``, ``b0``, ..., the module that computes actions by them, its largest deviation
        from ``check.output``, relative where that is above 1, and n.

    Raises:
        InputError: if the file is none of such a network, or the copy deviates by more than 1e-6.
    """
    require("safetensors", extra="gym", what="networks of others")
    from safetensors import SafetensorError
    from safetensors.numpy import load_file

    try:
        tensors = load_file(path)
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such file") from None
    except (SafetensorError, KeyError, TypeError) as error:
        raise InputError(
            f"{path}: no safetensors file of numpy's types ({error}); write it by save_file"
        ) from None
    arrays = _layers(tensors, path)
    inputs, depth = len(arrays["w0"]), len(arrays) // 2
    if inputs % _OBSERVED:
        raise InputError(
            f"{path}: the network has {inputs} inputs; an observation of Ventilator-v1 has "
            f"{_OBSERVED}. Use `ventbench new --family ppo` and write your own Features"
        )
    if not {"check.input", "check.output"} <= set(tensors):
        raise InputError(
            f"{path}: check.input and check.output are missing; save some inputs (n, {inputs}) and "
            "the actions that the network gives for them beside its weights"
        )
    check_input, check_output = (
        tensors["check.input"].astype(float),
        tensors["check.output"].astype(float).ravel(),
    )
    if check_input.shape != (len(check_output), inputs) or not np.isfinite(check_input).all():
        raise InputError(
            f"{path}: check.input is {check_input.shape}, not finite numbers (n, {inputs})"
        )
    deviation, between, behind = np.inf, "", ""
    for hidden, last in product(ACTIVATIONS, OUTPUTS):
        x = check_input
        with np.errstate(over="ignore"):
            for k in range(depth):
                activate, _ = ACTIVATIONS[hidden] if k < depth - 1 else OUTPUTS[last]
                x = activate(x @ arrays[f"w{k}"] + arrays[f"b{k}"])
        error = np.max(np.abs(x[:, 0] - check_output) / np.maximum(1.0, np.abs(check_output)))
        if error < deviation:
            deviation, between, behind = float(error), hidden, last
    if not deviation <= _TOLERANCE:
        raise InputError(
            f"{path}: no copy gives check.output to {_TOLERANCE:g}; the nearest, with {between} "
            f"between layers and {behind} behind, is {deviation:.1e} off. Known are "
            f"{', '.join(ACTIVATIONS)}; float64 tells rounding from another network"
        )
    code = _template("network.py").partition("def activation")
    code = code[1] + code[2].replace(ACTIVATIONS["relu"][1], ACTIVATIONS[between][1])
    code = code.replace("return x @ w + b", f"x = x @ w + b\n        return {OUTPUTS[behind][1]}")
    return (
        arrays,
        _GYMNASIUM.format(frames=inputs // _OBSERVED) + code,
        deviation,
        len(check_output),
    )


def _layers(tensors: dict[str, NDArray[Any]], path: Path) -> dict[str, NDArray[np.floating]]:
    """Weights ``w0``, ``b0``, ... from the input to the one output."""

    def order(name: str) -> list[Any]:
        return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", name)]

    layers = []
    for name in sorted(tensors, key=order):
        layer = _LAYER.fullmatch(name)
        if layer is None or _NO_ACTOR.search(name):
            continue
        weight = tensors[name]
        weight = weight.T if layer[2] == "weight" else weight
        bias = tensors.get(f"{layer[1]}.bias".lstrip("."), np.zeros(weight.shape[-1], weight.dtype))
        finite = np.isfinite(weight).all() and np.isfinite(bias).all()
        if weight.ndim != 2 or bias.shape != weight.shape[1:] or not finite:
            raise InputError(f"{path}: {name} of shape {weight.shape} is no finite dense layer")
        layers.append((weight, bias))
    layers.sort(key=lambda layer: layer[0].shape[1] == 1)  # heads have names of their own
    widths = [len(weight) for weight, _ in layers]
    if not layers or [*widths[1:], 1] != [weight.shape[1] for weight, _ in layers]:
        shapes = ", ".join(str(weight.shape) for weight, _ in layers) or "none"
        raise InputError(
            f"{path}: dense layers (inputs, outputs) are {shapes}: no chain that ends in one "
            "action; save the layers of the policy alone"
        )
    return {
        f"{letter}{k}": np.ascontiguousarray(array)
        for k, layer in enumerate(layers)
        for letter, array in zip("wb", layer, strict=True)
    }


def initial_weights(family: str) -> dict[str, NDArray[np.float32]]:
    """Weights ``w0``, ``b0``, ... that a network of a family starts from: it controls at once.

    The first four units of each hidden layer carry the positive and negative parts of error and
    averaged error; the last layer makes of them zero (residual), the action of a PI controller
    (ppo), or values of commands that are highest near its command (dqn). The other units are small
    and random, for training to use.
    """
    random = np.random.default_rng(0)
    w0 = 0.3 * random.standard_normal((_INPUTS, _HIDDEN))
    w1 = 0.3 * random.standard_normal((_HIDDEN, _HIDDEN))
    w0[:, :4], w1[:, :4] = 0.0, np.eye(_HIDDEN)[:, :4]
    w0[0, :2] = w0[1, 2:4] = 1.0, -1.0
    pi = np.zeros((_HIDDEN, 1))  # command / 100 %, from error / 10 and averaged error / 10
    pi[:4, 0] = np.array([_P, -_P, _I, -_I]) * 10 / 100
    if family == "ppo":
        w2, b2 = 2 * pi, np.array([-1.0])
    elif family == "dqn":
        commands = np.linspace(0.0, 1.0, 51)
        w2, b2 = 2 * pi * commands, -(commands**2)  # -(command - pi)**2 but for what all share
    else:
        w2, b2 = np.zeros((_HIDDEN, 1)), np.zeros(1)
    zero = np.zeros(_HIDDEN)
    arrays = {"w0": w0, "b0": zero, "w1": w1, "b1": zero, "w2": w2, "b2": b2}
    return {key: value.astype(np.float32) for key, value in arrays.items()}


def _check_name(name: str) -> None:
    if not NAME.fullmatch(name):
        raise InputError(f"name {name!r} {NAME_RULE}")
    if name in bundled():
        raise InputError(f"name {name!r} belongs to a submission of ventbench; choose another one")


def _template(name: str) -> str:
    return (_TEMPLATES / name).read_text()


def _npz(arrays: dict[str, NDArray[Any]]) -> bytes:
    file = io.BytesIO()
    np.savez(file, **arrays)  # pyright: ignore[reportArgumentType]
    return file.getvalue()
