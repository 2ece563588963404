"""Where compiled functions are kept."""

from __future__ import annotations

from types import SimpleNamespace

import jax
import pytest
from threadpoolctl import threadpool_info
from typer.testing import CliRunner

from ventbench.base import compilation
from ventbench.cli import app


@pytest.fixture
def setting():
    before = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    yield
    jax.config.update("jax_compilation_cache_dir", before)


def test_the_folder_is_one_of_the_user_and_of_the_processor(monkeypatch, tmp_path):
    monkeypatch.delenv("VENTBENCH_CACHE", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    found = compilation.folder()
    assert found.is_relative_to(tmp_path / "ventbench")
    assert found == compilation.folder()


def test_it_is_made_and_used(monkeypatch, tmp_path, setting):
    monkeypatch.setenv("VENTBENCH_CACHE", str(tmp_path / "a" / "b"))
    compilation.keep()
    assert (tmp_path / "a" / "b").is_dir()
    assert jax.config.jax_compilation_cache_dir == str(tmp_path / "a" / "b")  # type: ignore[attr-defined]


def test_a_folder_that_jax_was_told_stays(monkeypatch, tmp_path, setting):
    monkeypatch.delenv("VENTBENCH_CACHE", raising=False)
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    compilation.keep()
    assert jax.config.jax_compilation_cache_dir == str(tmp_path)  # type: ignore[attr-defined]


def test_linear_algebra_takes_one_thread_where_it_is_asked_to():
    def threads() -> set[int]:
        return {each["num_threads"] for each in threadpool_info() if each["user_api"] == "blas"}

    before = threads()
    with compilation.one_blas_thread():
        assert threads() == {1}
    assert threads() == before


def test_a_score_keeps_what_it_compiles(monkeypatch, tmp_path, setting):
    monkeypatch.setenv("VENTBENCH_CACHE", str(tmp_path / "kept"))
    words = ["score", "pid_best", "--simulator", "physics", "--in-process"]
    assert CliRunner().invoke(app, words).exit_code == 0
    assert jax.config.jax_compilation_cache_dir == str(tmp_path / "kept")  # type: ignore[attr-defined]


def test_an_empty_name_keeps_nothing(monkeypatch, setting):
    monkeypatch.setenv("VENTBENCH_CACHE", "")
    before = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    compilation.keep()
    assert jax.config.jax_compilation_cache_dir == before  # type: ignore[attr-defined]


def test_a_folder_that_cannot_be_made_is_no_reason_to_fail(monkeypatch, tmp_path, setting):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("VENTBENCH_CACHE", str(tmp_path / "file" / "below"))
    before = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    compilation.keep()
    assert jax.config.jax_compilation_cache_dir == before  # type: ignore[attr-defined]


class Library:
    """What a C library answers, and what it was asked."""

    def __init__(self):
        self.asked = []

    def mallopt(self, option, value):
        self.asked.append(("mallopt", option, value))

    def malloc_trim(self, pad):
        self.asked.append(("malloc_trim", pad))


@pytest.fixture
def anew():
    compilation._hand_back.cache_clear()
    yield
    compilation._hand_back.cache_clear()


def test_memory_goes_back_after_each_long_compilation(monkeypatch, anew):
    library = Library()
    monkeypatch.setattr(compilation.ctypes, "CDLL", lambda name: library)
    monkeypatch.setenv("VENTBENCH_CACHE", "")
    compilation.keep()
    compilation.keep()
    assert [name for name, *_ in library.asked] == ["mallopt"]
    for event, seconds in ((compilation._COMPILED, 3.0), (compilation._COMPILED, 0.1), ("/x", 3.0)):
        jax.monitoring.record_event_duration_secs(event, seconds)
    assert library.asked[1:] == [("malloc_trim", 0)]


def test_jax_still_tells_when_it_has_compiled():
    told = []
    jax.monitoring.register_event_duration_secs_listener(lambda event, *_, **__: told.append(event))
    jax.jit(lambda x: 3.25 * x)(1.0)
    assert compilation._COMPILED in told


def test_another_c_library_is_left_alone(monkeypatch, anew):
    asked = []
    library = SimpleNamespace(mallopt=lambda *given: asked.append(given))  # and no malloc_trim
    monkeypatch.setattr(compilation.ctypes, "CDLL", lambda name: library)
    monkeypatch.setenv("VENTBENCH_CACHE", "")
    compilation.keep()
    assert asked == []
