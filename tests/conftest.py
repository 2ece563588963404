"""What every test may ask for."""

from __future__ import annotations

import ctypes
import gc
import os
import sys
import textwrap
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

from ventbench.recordings.read import VARIABLE, recordings_dir

#: Set by `.ci/run` and the workflows: a test that skips has then failed, whatever it lacks; but for
#: those that need the public recordings, which not every machine may have, or a package that has no
#: wheel for the newest Python, from which on `pyproject.toml` leaves it out.
REQUIRED = "VENTBENCH_REQUIRE_ALL"
NO_RECORDINGS = "no public recordings"
NO_WHEEL, WITHOUT_WHEEL = "has no wheel for this Python", (3, 13)

#: ``submission.toml`` of the submissions that tests write.
MANIFEST = """\
name = "mine"
authors = ["A. Name"]
licence = "Apache-2.0"
api_version = 1
family = "other"
tracks = ["robustness", "performance"]
description = "A test."
"""

Make = Callable[..., Path]

#: Compiler options where slow tests are left out: the others run most functions once, so that
#: optimising costs four times what it saves. The slow tests compile as users do; `XLA_FLAGS` of
#: one's own come first.
QUICK_COMPILER = (
    "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true "
    "--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1"
)

#: Objects that are made before Python looks for garbage, and how seldom it looks at older ones.
#: Tracing makes many, and what collection has imported need not be gone through each time.
GARBAGE_THRESHOLDS = (50_000, 20, 50)

#: Seconds of compiling from which the result is kept for other workers and later runs.
KEPT_FROM_S = 0.1

#: Memory of a worker, MiB, from which it forgets what it compiled: two of them shall fit in 2 GiB.
FORGOTTEN_FROM_MIB = 850.0


def pytest_addoption(parser: pytest.Parser) -> None:
    """Measure what tests cost, to find those that belong into ``slow.txt``."""
    parser.addoption("--cost", metavar="FILE", help="append processor seconds of each test to FILE")


def pytest_configure(config: pytest.Config) -> None:
    """Compile quickly where slow tests are left out; before JAX reads its options.

    A machine that stands still for a second is no failure of a property.
    """
    settings.register_profile(
        "any load", deadline=None, suppress_health_check=[HealthCheck.too_slow]
    )
    settings.load_profile("any load")
    if "not slow" in config.option.markexpr.split(" and "):
        os.environ.setdefault("XLA_FLAGS", QUICK_COMPILER)


def pytest_collection_finish() -> None:
    """Leave what is imported out of the search for garbage."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(*GARBAGE_THRESHOLDS)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark what ``slow.txt`` lists, whole tests or one case of many."""
    text = (config.rootpath / "tests" / "slow.txt").read_text("utf-8")
    listed = {line.strip() for line in text.splitlines() if line.strip() and line[0] != "#"}
    for item in items:
        if item.nodeid in listed or item.nodeid.partition("[")[0] in listed:
            item.add_marker(pytest.mark.listed)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """Write processor seconds, of processes that the test started too, for ``--cost``."""
    file = item.config.getoption("--cost")
    before = sum(os.times()[:4])
    result = yield
    if file:
        with open(file, "a") as lines:
            lines.write(f"{sum(os.times()[:4]) - before:.2f}\t{item.nodeid}\n")
    return result


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Iterator[None]:
    """Report a test that skipped as failed where every test has to run."""
    return _required((yield))


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector: pytest.Collector) -> Iterator[None]:
    """Report a file that skipped as a whole as failed where every test has to run."""
    return _required((yield))


def _required(report: Any) -> Any:
    if report.skipped and os.environ.get(REQUIRED) and not hasattr(report, "wasxfail"):
        *_, reason = report.longrepr
        if NO_RECORDINGS in reason and VARIABLE not in os.environ:
            return report
        if NO_WHEEL in reason and sys.version_info >= WITHOUT_WHEEL:
            return report
        report.outcome = "failed"
        report.longrepr = f"{report.nodeid} did not run, and {REQUIRED} is set: {reason}"
    return report


@pytest.fixture(scope="session", autouse=True)
def _compiled_once() -> None:
    """Share compiled functions between workers, runs and checkouts, in the user's cache folder."""
    import jax

    from ventbench.base import compilation

    jax.config.update("jax_traceback_in_locations_limit", 0)  # a tenth of what lowering costs
    folder = compilation.folder()
    if not folder.name:
        return  # no cache is wanted
    folder = folder.with_name(f"tests-{folder.name}")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return  # of another user, as whom the exploits run once more
    if os.access(folder, os.W_OK):
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", KEPT_FROM_S)


@pytest.fixture(scope="module", autouse=True)
def _memory_given_back() -> Iterator[None]:
    """Forget what was compiled once it takes much memory: all files would need several GiB."""
    yield
    if _resident_mib() > FORGOTTEN_FROM_MIB and "jax" in sys.modules:
        sys.modules["jax"].clear_caches()
        gc.collect()
        if trim := getattr(ctypes.CDLL(None), "malloc_trim", None):
            trim(0)  # the C library keeps what the compiler has freed


def _resident_mib() -> float:
    """Memory of this process, MiB; infinite where the system does not say."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return float("inf")
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


@pytest.fixture(scope="session")
def public_recordings() -> Path:
    """Folder of the public recordings; the test is skipped where they are not."""
    folder = recordings_dir()
    if folder is None:
        pytest.skip(f"{NO_RECORDINGS}: set {VARIABLE} to their folder")
    return folder


@pytest.fixture
def make(tmp_path: Path) -> Make:
    """Write a submission; `act` is the body of a method of a Controller that does nothing else."""

    def write(
        source: str | None = None,
        *,
        act: str = "return 0.0",
        manifest: str = MANIFEST,
        name: str = "mine",
        **files: str,
    ) -> Path:
        folder = tmp_path / name
        folder.mkdir(exist_ok=True)
        if source is None:
            body = textwrap.indent(textwrap.dedent(act), " " * 8)
            source = (
                "class Controller:\n    def reset(self, task):\n        self.task = task\n"
                f"    def act(self, observation):\n{body}\n"
            )
        (folder / "controller.py").write_text(textwrap.dedent(source))
        (folder / "submission.toml").write_text(manifest)
        for stem, text in files.items():
            (folder / f"{stem}.py").write_text(textwrap.dedent(text))
        return folder

    return write
