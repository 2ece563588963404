"""The families of plants: one line each adds a family to files, ``--plant`` and contract tests."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from ventbench.physics.model import Physics
from ventbench.plants.corrected import Corrected
from ventbench.plants.hybrid import Hybrid
from ventbench.plants.learned import MLP, Boundary, Learned
from ventbench.plants.single_compartment import SingleCompartment, single_compartment
from ventbench.plants.two_balloon import TwoBalloon, two_balloon
from ventbench.task.interfaces import Plant
from ventbench.task.lungs import Lung


@dataclass(frozen=True)
class PlantFamily:
    """One kind of plant.

    Attributes:
        plant: class of the plants; files name it by the class's name, so that a class that is
            renamed needs a line in :data:`RENAMED`.
        for_lung: makes the plant of a lung at its label, if labels are all it needs. The family
            then has a name for ``--plant`` and goes through the contract tests of physics plants.
        parts: further classes in its files.
    """

    plant: type
    for_lung: Callable[[Lung], Plant] | None = None
    parts: tuple[type, ...] = ()


#: By the name that ``--plant`` takes. ``physics`` and the learned ones are more than one line, see
#: :mod:`ventbench.plants.catalog`.
FAMILIES: dict[str, PlantFamily] = {
    "single_compartment": PlantFamily(SingleCompartment, single_compartment),
    "two_balloon": PlantFamily(TwoBalloon, two_balloon),
    "physics": PlantFamily(Physics),
    "corrected": PlantFamily(Corrected),
    "hybrid": PlantFamily(Hybrid),
    "learned": PlantFamily(Learned, parts=(Boundary, MLP)),
}

#: Today's class name by the name that older files have.
RENAMED: dict[str, str] = {}

#: Names of fields in plant files, by class and field, where they differ from the attribute's.
FIELDS_IN_FILES: dict[str, dict[str, str]] = {
    "Corrected": {"with_mechanisms": "wanted", "without_mechanisms": "had"},
}


def stored_type(name: str) -> type:
    """Return the class that a plant file names.

    Raises:
        KeyError: if there is no plant family with such a class.
    """
    types = {
        kind.__name__: kind
        for family in FAMILIES.values()
        for kind in (family.plant, *family.parts)
    }
    return types[RENAMED.get(name, name)]
