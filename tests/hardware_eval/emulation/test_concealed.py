"""Concealed lungs: words determine everything."""

from __future__ import annotations

import pytest

from hardware_eval.emulation.cases import LIBRARY
from hardware_eval.emulation.simulated import _LEFT_OUT, conceal
from ventbench.base.errors import InputError
from ventbench.plants.corrected import Corrected


def test_the_words_make_the_lung() -> None:
    first, again, other = (conceal(words) for words in ("blue sky", "blue sky", "grey sky"))
    assert (first.lung, first.effect) == (again.lung, again.effect)
    assert first.effect != other.effect
    assert first.effect.strength == "strong"
    assert isinstance(first.plant, Corrected)
    physics = first.plant.with_mechanisms
    for name, value in first.effect.parameters.items():
        assert float(physics.get(f"{first.effect.name}.{name}")) == pytest.approx(value)


def test_many_words_conceal_many_things() -> None:
    drawn = {conceal(f"words {k}", "single_compartment").effect.name for k in range(60)}
    assert drawn <= set(LIBRARY) - set(_LEFT_OUT)
    assert len(drawn) >= 9


def test_no_words() -> None:
    with pytest.raises(InputError, match="words"):
        conceal(" ")
