"""The types of plant that a plant file may name; a new one is one line here."""

from __future__ import annotations

from ventbench.physics.model import Physics
from ventbench.plants.corrected import Corrected
from ventbench.plants.hybrid import Hybrid
from ventbench.plants.learned import Learned
from ventbench.plants.learned.boundary import Boundary
from ventbench.plants.mlp import MLP
from ventbench.plants.single_compartment import SingleCompartment
from ventbench.plants.two_balloon import TwoBalloon

#: By the name that stands in the files. Parts of plants are types too.
TYPES: dict[str, type] = {
    kind.__name__: kind
    for kind in (
        Boundary,
        Corrected,
        Hybrid,
        Learned,
        MLP,
        Physics,
        SingleCompartment,
        TwoBalloon,
    )
}
