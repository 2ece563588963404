"""What every test may ask for."""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from ventbench.recordings.read import VARIABLE, recordings_dir

#: Set by `.ci/run` where the recordings are: then no test may skip for want of them.
REQUIRED = "VENTBENCH_REQUIRE_RECORDINGS"

#: Seconds of compiling from which the result is kept for other workers and later runs.
KEPT_FROM_S = 0.2


@pytest.fixture(scope="session", autouse=True)
def _compiled_once(pytestconfig: pytest.Config) -> None:
    """Share compiled functions between workers, and between runs, in pytest's cache folder."""
    import jax

    folder = pytestconfig.rootpath / ".pytest_cache" / "compiled"
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", KEPT_FROM_S)


@pytest.fixture(scope="module", autouse=True)
def _memory_given_back() -> Iterator[None]:
    """Forget what a file's tests compiled: all files together would need several GiB."""
    yield
    if "jax" in sys.modules:
        sys.modules["jax"].clear_caches()
    gc.collect()


@pytest.fixture(scope="session")
def public_recordings() -> Path:
    """Folder of the public recordings; the test is skipped where they are not."""
    folder = recordings_dir()
    if folder is None:
        missing = f"no public recordings: set {VARIABLE} to their folder"
        if os.environ.get(REQUIRED):
            pytest.fail(f"{missing} ({REQUIRED} is set)")
        pytest.skip(missing)
    return folder
