"""What the tests of naming share: one recording without any effect, fitted once."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import pytest

from ventbench.diagnosis.bench import Bench
from ventbench.diagnosis.hypothesis import Hypothesis
from ventbench.diagnosis.solved import Solved
from ventbench.diagnosis.steps import settle

from . import small


class Plain(NamedTuple):
    """A recording in which nothing is missing."""

    bench: Bench
    null: Solved


@pytest.fixture(scope="session", autouse=True)
def one_size() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        small.one_size(patch)
        yield


@pytest.fixture(scope="session")
def plain() -> Plain:
    bench = small.split(small.made())
    return Plain(bench, settle(bench, Hypothesis()))


@pytest.fixture
def few_slots(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave a few slots to choose from, since all of them take a minute to compile."""
    small.limit_slots(monkeypatch)
