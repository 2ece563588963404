"""Several plants as one: stacked on a leading axis, run side by side, made for every breath."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ventbench.base import compilation
from ventbench.base.arrays import Floats, batches
from ventbench.base.errors import InputError
from ventbench.physics.model import Physics
from ventbench.recordings.breaths import Breaths
from ventbench.task.interfaces import Plant, Signals
from ventbench.task.lungs import Lung
from ventbench.task.rollouts import open_loop

PlantT = TypeVar("PlantT")

#: Gives the plants of some breaths: parameters of shape ``(n, ...)``.
PlantsFor = Callable[[Breaths], Plant]

# Breaths simulated together: bounds memory.
_BATCH = 4096


def stack(plants: Sequence[PlantT]) -> PlantT:
    """Stack plants of equal structure along a new leading axis.

    Raises:
        ValueError: if there is none, or their structures differ.
    """
    if not plants:
        raise ValueError("no plants to stack")
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *plants)


def take(plants: PlantT, *index: int) -> PlantT:
    """Return one plant of a stack, by its index on each of the leading axes."""
    return jax.tree.map(lambda leaf: leaf[index], plants)


def nominal_plants(make: Callable[[Lung], Plant], breaths: Breaths) -> Plant:
    """Plants of n recorded breaths at what their labels say, leaves ``(n, ...)``."""
    labels = list(zip(breaths.R.tolist(), breaths.C.tolist(), strict=True))
    different = list(dict.fromkeys(labels))
    plants = stack([make(Lung(*label)) for label in different])
    at = np.array([different.index(label) for label in labels])
    return jax.tree.map(lambda leaf: leaf[at], plants)


def stack_heterogeneous(plants: Sequence[Plant]) -> Plant:
    """Stack plants along a new leading axis, also where their physics name different parameters.

    They keep their precision. A mechanism that only some have is neutral in the others, and so
    changes nothing there.

    Raises:
        InputError: if they are of different kinds or sizes.
    """
    similar = _with_equal_parameters(list(plants))
    try:
        return jax.tree.map(
            lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), *similar
        )
    except ValueError as error:
        raise InputError(
            "the plants of the file's lungs have different structures and cannot be run together; "
            "make a file for each lung"
        ) from error


def _with_equal_parameters(plants: list[Any]) -> list[Any]:
    """Name the union of the parameters at every place where there are physics."""
    first = plants[0]
    same_type = all(type(plant) is type(first) for plant in plants)
    if not dataclasses.is_dataclass(first) or not same_type:
        return plants
    if isinstance(first, Physics):
        return _physics_with_equal_parameters(plants)
    for field in dataclasses.fields(first):
        parts = [getattr(plant, field.name) for plant in plants]
        if dataclasses.is_dataclass(parts[0]):
            plants = [
                dataclasses.replace(plant, **{field.name: part})
                for plant, part in zip(plants, _with_equal_parameters(parts), strict=True)
            ]
    return plants


def _physics_with_equal_parameters(plants: list[Physics]) -> list[Physics]:
    names = list(dict.fromkeys(name for plant in plants for name in plant.names))
    sizes = {
        name: max(getattr(plant, name) for plant in plants)
        for name in ("substeps", "memory", "divisions")
    }
    completed = []
    for plant in plants:
        missing = {name: plant.get(name) for name in names if name not in plant.names}
        if "PEEP" in missing:  # it takes the pressure that it starts from
            missing["PEEP"] = jnp.asarray(jnp.nan)
        with compilation.float64():
            full = plant.having(**missing)
        values = tuple(np.asarray(value) for value in full.values)
        completed.append(dataclasses.replace(full, values=values, **sizes))
    return completed


@flax.struct.dataclass
class VmappedPlant:
    """A stack of n plants as one plant, for kinds whose parameters cannot broadcast.

    Every argument has shape ``(n,)``.
    """

    plants: Any  #: every leaf ``(n, ...)``.

    def init(self, pressure: Array, peep: Array | None = None) -> tuple[Any, Signals]:
        """Lungs at rest; see :class:`~ventbench.task.interfaces.Plant`."""
        behind = pressure if peep is None else peep
        return jax.vmap(lambda plant, *x: plant.init(*x))(self.plants, pressure, behind)

    def step(self, state: Any, u_in: Array, u_out: Array, dt: Array) -> tuple[Any, Signals]:
        """Hold one command each."""
        return jax.vmap(lambda plant, *x: plant.step(*x))(self.plants, state, u_in, u_out, dt)

    def vary(self, r_scale: Array, c_scale: Array, gain: Array | float = 1.0) -> VmappedPlant:
        """Return the same lungs with other resistances, compliances and gains."""
        scales = (r_scale, c_scale, jnp.broadcast_to(gain, jnp.shape(r_scale)))
        return VmappedPlant(jax.vmap(lambda plant, *x: plant.vary(*x))(self.plants, *scales))

    def parameters(self) -> None:
        """Nothing is known of its physics; see :class:`~ventbench.task.interfaces.Plant`."""


def open_loop_breaths(
    plants_for: PlantsFor, breaths: Breaths, progress: Callable[[int], object] = lambda count: None
) -> Floats:
    """Pressures that plants answer to the commands of recorded breaths with, in batches.

    Each breath starts at its first recorded pressure. ``progress`` is called with the number of
    breaths of each batch, as it is done. cmH2O, ``(n, T)``; NaN where the first pressure is blank.
    """
    out = np.empty(breaths.pressure.shape)
    with compilation.float64():
        for index in batches(len(breaths), min(_BATCH, len(breaths))):
            part = breaths.select(index)
            columns = (part.pressure[:, 0], part.u_in, part.u_out, part.dt)
            start, *commands = (jnp.asarray(x, float) for x in columns)
            out[index] = open_loop(plants_for(part), start, *commands)
            progress(len(np.unique(index)))
    return out
