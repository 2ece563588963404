"""Base model of a lung on its ventilator, the mechanisms that may be missing, and their fits."""

from ventbench.physics.catalogue import library, mechanism, parameter, paths, strength_path
from ventbench.physics.mechanism import Description, Mechanism
from ventbench.physics.model import Physics, PhysicsState, physics
from ventbench.physics.parameters import Parameter
from ventbench.physics.times import resolution

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
    "strength_path",
]
