"""Finished parts are kept, and belong to one training."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from ventbench.errors import InputError
from ventbench.lungs import LUNGS
from ventbench.plants.single_compartment import single_compartment
from ventbench.training.parts import Parts

WHO = {"recipe": {"iterations": 20}, "packages": {"jax": "0.10"}}


def test_a_part_is_made_once(tmp_path):
    made = []

    def make():
        made.append(1)
        return single_compartment(LUNGS[len(made)])

    first = Parts(tmp_path / "parts", WHO).get("one", make)
    again = Parts(tmp_path / "parts", WHO).get("one", make)
    assert len(made) == 1
    assert first == again
    assert all(isinstance(leaf, np.ndarray) for leaf in jax.tree.leaves(first))
    other = Parts(tmp_path / "parts", WHO).get("two", make)
    assert float(other.C) == LUNGS[2].C


def test_what_breaks_off_leaves_no_part(tmp_path):
    parts = Parts(tmp_path, WHO)

    def stop():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        parts.get("one", stop)
    assert [path.name for path in tmp_path.iterdir()] == ["training.json"]
    assert parts.checkpoint("one").parent == tmp_path


@pytest.mark.parametrize("other", [{}, WHO | {"recipe": {"iterations": 40}}, WHO | {"x": 1}])
def test_parts_of_another_training_are_refused(tmp_path, other):
    Parts(tmp_path, WHO)
    before = (tmp_path / "training.json").read_bytes()
    with pytest.raises(InputError, match=r"parts of a training with other .* delete it"):
        Parts(tmp_path, other)
    assert (tmp_path / "training.json").read_bytes() == before
