"""The table: every mechanism of the library is a stress test, at strengths that can occur."""

from __future__ import annotations

import numpy as np
import pytest

from ci import generated_tables
from ventbench.base.errors import InputError
from ventbench.physics.catalogue import events, library, parameter
from ventbench.task import protocol
from ventbench.task.stressors import (
    CATEGORIES,
    NOT_STRESSED,
    PAIRS,
    SEVERITIES,
    STRESSORS,
    Stressor,
    conditions,
    stressor,
)


def test_every_mechanism_of_the_library_has_a_line_or_a_reason() -> None:
    covered = {line.strength.rpartition(".")[0] for line in STRESSORS}
    missing = set(library()) - covered - set(NOT_STRESSED)
    assert not missing, (
        f"{sorted(missing)}: add a table to ventbench/task/stressors.toml (and raise "
        "VERSION), or a reason to NOT_STRESSED"
    )
    assert covered <= {"", *library(), *events()}
    assert not covered & set(NOT_STRESSED)


@pytest.mark.parametrize("line", STRESSORS, ids=lambda line: line.name)
def test_a_line_is_sound(line: Stressor) -> None:
    assert line.category in CATEGORIES
    assert line.reason.endswith(".")
    assert len(line.breaths) == protocol.BREATHS
    for severity in SEVERITIES:
        for path, value in line.settings(severity).items():
            assert np.size(value) in (1, protocol.BREATHS), path
            parameter(path)
    about = parameter(line.strength)
    if line.rule == "add":
        assert about.low <= line.mild <= about.high or line.strength == "leak.conductance"
        assert abs(line.mild) <= abs(line.strong)
        assert line.mild * line.strong > 0
    else:
        assert min(line.mild, line.strong) > 0
        assert line.strength in ("R", "C", "gain")


def test_conditions_are_each_alone_twice_and_pairs_once() -> None:
    every = conditions()
    assert every[0].id == "none"
    assert len(every) == len({condition.id for condition in every})
    assert len(every) == 1 + 2 * len(STRESSORS) + len(PAIRS)
    assert {name for pair in PAIRS for name in pair} <= {line.name for line in STRESSORS}


def test_an_unknown_stressor_is_said_to_be_one() -> None:
    with pytest.raises(InputError, match="no stressor 'wind'; choose of"):
        stressor("wind")


def test_the_table_has_a_row_a_stressor_and_the_pairs() -> None:
    text = generated_tables.stressors()
    for line in STRESSORS:
        assert f"| `{line.name}` | {line.title} |" in text
        assert text.count(line.reason) >= 1
    for pair in PAIRS:
        assert " + ".join(f"`{name}`" for name in pair) in text
