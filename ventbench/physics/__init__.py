"""Model of a lung on its ventilator: base model, mechanisms and nonparametric components."""

from ventbench.physics.catalogue import library, mechanism, parameter, paths, strength_path
from ventbench.physics.dead_time import resolution, resolution_of
from ventbench.physics.mechanism import Description, Mechanism, Parameter
from ventbench.physics.model import Physics, PhysicsState, physics

__all__ = [
    "Description",
    "Mechanism",
    "Parameter",
    "Physics",
    "PhysicsState",
    "library",
    "mechanism",
    "parameter",
    "paths",
    "physics",
    "resolution",
    "resolution_of",
    "strength_path",
]
