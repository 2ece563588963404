"""Concealed lungs: words determine everything, and a seal tells nothing before it is opened."""

from __future__ import annotations

from pathlib import Path

import pytest

from hardware_eval.emulation.cases import LIBRARY
from hardware_eval.emulation.simulated import _LEFT_OUT, conceal, reveal
from ventbench.base.errors import InputError
from ventbench.plants.corrected import Corrected


def test_the_words_make_the_lung_and_open_the_seal(tmp_path: Path) -> None:
    first, again, other = (conceal(words) for words in ("blue sky", "blue sky", "grey sky"))
    assert first.seal == again.seal
    assert first.seal["commitment"] != other.seal["commitment"]
    first.write(tmp_path / "seal.json")
    lung, effect = reveal(tmp_path / "seal.json", "blue sky")
    assert lung == first.lung
    assert effect.strength == "strong"
    assert isinstance(first.plant, Corrected)
    physics = first.plant.with_mechanisms
    for name, value in effect.parameters.items():
        assert float(physics.get(f"{effect.name}.{name}")) == pytest.approx(value)
    with pytest.raises(InputError, match="seed"):
        reveal(tmp_path / "seal.json", "grey sky")


def test_the_seal_does_not_name_what_it_hides() -> None:
    text = str(conceal("some words").seal)
    assert not [name for name in LIBRARY if name in text]


def test_many_words_conceal_many_things(tmp_path: Path) -> None:
    drawn = set()
    for k in range(60):
        path = tmp_path / f"{k}.json"
        concealed = conceal(f"words {k}", "single_compartment")
        concealed.write(path)
        drawn.add(reveal(path, f"words {k}")[1].name)
    assert drawn <= set(LIBRARY) - set(_LEFT_OUT)
    assert len(drawn) >= 9


def test_no_words_and_no_seal(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="words"):
        conceal(" ")
    (tmp_path / "x.json").write_text("{}")
    with pytest.raises(InputError, match="no seal"):
        reveal(tmp_path / "x.json", "words")
