"""Mechanisms that are off need not be computed: what a fit saves where few of many act."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import Array

from ventbench.physics.mechanism import Mechanism, Values

Before = TypeVar("Before")


def acts(item: Mechanism, values: Values) -> Array:
    """Whether any parameter is not neutral in any element, ``()``.

    A slot's strength is several coefficients, so that the first parameter alone does not tell.
    """
    moved = [jnp.any(values[p.name] != p.neutral) for p in item.description.parameters]
    return jnp.any(jnp.stack(moved))


def unless_idle(acting: Array | None, change: Callable[[Before], Before], before: Before) -> Before:
    """``change(before)``, or ``before`` if the mechanism is idle.

    Only those leaves that the change replaces pass through the branch, as others would be copied.

    Args:
        acting: from :func:`acts`; None computes the change always.
        change: keeps the shapes of the leaves; a leaf that it does not change it hands on itself.
        before: any pytree.
    """
    if acting is None:
        return change(before)
    leaves, tree = jax.tree.flatten(before)
    traced = jax.make_jaxpr(change)(before).jaxpr
    ends = zip(traced.invars, traced.outvars, strict=True)
    replaced = [k for k, (old, new) in enumerate(ends) if new is not old]
    if not replaced:
        return before

    def changed(*given: Array) -> tuple[Array, ...]:
        there = list(leaves)
        for k, leaf in zip(replaced, given, strict=True):
            there[k] = leaf
        found = jax.tree.leaves(change(jax.tree.unflatten(tree, there)))
        return tuple(found[k] for k in replaced)

    given = [leaves[k] for k in replaced]
    for k, leaf in zip(replaced, jax.lax.cond(acting, changed, _same, *given), strict=True):
        leaves[k] = leaf
    return jax.tree.unflatten(tree, leaves)


def _same(*given: Array) -> tuple[Array, ...]:
    return given
