"""``ventbench new``: a submission that scores at once, to be changed into one's own."""

from __future__ import annotations

import difflib
import io
import os
import re
import shutil
import tempfile
import unicodedata
from importlib import resources
from pathlib import Path
from string import Template

import numpy as np
from numpy.typing import NDArray

from ventbench.base.errors import InputError
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
between them, where layer k does `x @ wk + bk`. From a trained flax model, for instance:

```python
layers = [params["Dense_0"], params["Dense_1"], params["Dense_2"]]
arrays = {f"{n}{k}": layer[key] for k, layer in enumerate(layers)
          for n, key in (("w", "kernel"), ("b", "bias"))}
numpy.savez("weights.npz", **{name: numpy.asarray(a, "float32") for name, a in arrays.items()})
```

PyTorch's `Linear.weight` is the transpose: save `layer.weight.detach().numpy().T`. Train with the
inputs that `Features` makes, or change `Features`; the number of layers and units is free.
"""

# Units of each hidden layer; inputs as in templates/network.py; the PI that ppo and dqn start as.
_HIDDEN, _INPUTS, _P, _I = 16, 6, 1.0, 10.0


def create(name: str, family: str = "pid", out: Path | str = ".") -> Path:
    """Write a new submission.

    Args:
        name: what the entry and its folder are called.
        family: one of :data:`~ventbench.entries.manifest.FAMILIES`.
        out: folder to write it into; created if missing.

    Returns:
        The new folder, ``out/name``.

    Raises:
        InputError: if the name or family is not allowed, or the folder exists.
        OSError: if it cannot be written.
    """
    _check_name(name)
    if family not in FAMILIES:
        close = difflib.get_close_matches(family, FAMILIES, n=1)
        hint = f"; did you mean {close[0]}?" if close else ""
        raise InputError(f"family {family!r} is not one of {', '.join(FAMILIES)}{hint}")
    folder = Path(out) / name
    if os.path.lexists(folder):
        raise InputError(f"{folder} exists; choose another name or --dir DIR; nothing was changed")
    folder.parent.mkdir(parents=True, exist_ok=True)
    draft = Path(tempfile.mkdtemp(dir=folder.parent, prefix=f".{name}."))
    try:
        for file, content in contents(name, family).items():
            (draft / file).write_bytes(content)
        draft.chmod(0o777 & ~_umask())
        draft.rename(folder)  # all of it or nothing
    except BaseException:
        shutil.rmtree(draft, ignore_errors=True)
        raise
    return folder


def contents(name: str, family: str) -> dict[str, bytes]:
    """Files of a new submission, by name.

    Args:
        name: what the entry is called; allowed.
        family: the entry's family; known.
    """
    known = (_TEMPLATES / f"{family}.py").is_file()
    controller = _template(f"{family if known else 'pid'}.py")
    files = {CONTROLLER: controller.encode()}
    network = "from network import" in controller
    if network:
        files["network.py"] = _template("network.py").encode()
        files[WEIGHTS] = _npz(initial_weights(family))
    values = {
        "name": name,
        "author": AUTHOR,
        "family": family,
        "api_version": API_VERSION,
        "description": FAMILIES[family],
        "weights": _EXPORT if network else "",
    }
    files[MANIFEST] = Template(_template(MANIFEST)).substitute(values).encode()
    values["files"] = "\n".join(f"| `{k}` | {v} |" for k, v in _FILES.items() if k in files)
    files["README.md"] = Template(_template("README.md")).substitute(values).encode()
    return files


def initial_weights(family: str) -> dict[str, NDArray[np.float32]]:
    """Weights that a network starts from: it controls at once.

    The first four units of each hidden layer carry the positive and negative parts of error and
    averaged error; the last layer makes of them zero (residual), the action of a PI controller
    (ppo), or values of commands that are highest near its command (dqn). The other units are small
    and random, for training to use.

    Args:
        family: ``"residual"``, ``"ppo"`` or ``"dqn"``.

    Returns:
        ``w0``, ``b0``, ``w1``, ``b1``, ``w2``, ``b2``.
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
        plain = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode().lower()
        better = re.sub(r"[^a-z0-9]+", "_", plain).strip("_")[:40]
        hint = f"; how about {better}?" if NAME.fullmatch(better) else ""
        raise InputError(f"name {name!r} {NAME_RULE}{hint}")
    if name in bundled():
        raise InputError(f"name {name!r} belongs to a submission of ventbench; choose another one")


def _template(name: str) -> str:
    return (_TEMPLATES / name).read_text()


def _npz(arrays: dict[str, NDArray[np.float32]]) -> bytes:
    file = io.BytesIO()
    np.savez(file, **arrays)  # pyright: ignore[reportArgumentType]
    return file.getvalue()


def _umask() -> int:
    umask = os.umask(0)
    os.umask(umask)
    return umask
