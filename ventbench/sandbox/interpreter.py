"""How a fresh interpreter of the sandbox is started: its options, its environment, its folders."""

from __future__ import annotations

from pathlib import Path

import numpy as np

#: The folder that holds ``ventbench``, and the one of installed packages.
ROOT = str(Path(__file__).resolve().parents[2])
SITE = str(Path(np.__file__).resolve().parents[1])

#: Not -I, which would make it ignore the fixed hash seed: the environment holds nothing but this.
OPTIONS = ("-P", "-s", "-S", "-B")
ENVIRONMENT = {
    "PYTHONHASHSEED": "0",
    "LC_ALL": "C.UTF-8",
    "TZ": "UTC",
    "HOME": "/nonexistent",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "VECLIB_MAXIMUM_THREADS": "1",
    "JAX_PLATFORMS": "cpu",
}
