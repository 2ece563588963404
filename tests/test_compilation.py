"""Where compiled functions are kept."""

from __future__ import annotations

import jax
import pytest

from ventbench import compilation


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
