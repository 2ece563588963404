"""Questions of a challenge: kinds, the draw of cases, the effects that an answer may mistake."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from hardware_eval.emulation.cases import Case
from ventbench.base.errors import InputError

Kind = Literal["single", "null", "pair", "four", "outside", "form", "masked"]

#: Classes of effects that the pressure of a single lung may not tell apart.
CLASSES: tuple[frozenset[str], ...] = (
    frozenset({"valve_lag", "sensor_lag", "circuit_compliance"}),
    frozenset({"leak", "valve_dead_band", "command_rounding", "viscoelasticity"}),
)


@dataclass(frozen=True)
class DrawnCase:
    """A case and the kind of question that it belongs to."""

    kind: Kind
    case: Case


def drawn(
    shares: Mapping[Kind, float], of_kind: Callable[[Any, int, Any], Iterator[Case]],
    kind: Kind | Literal["all"], count: int, rng: np.random.Generator,
) -> list[DrawnCase]:  # fmt: skip
    """Draw cases of one kind or of all kinds, in random order.

    Args:
        shares: share of each kind that the generator has, that of single effects among them.
        of_kind: draws cases of a kind.
        kind: kind of the cases.
        count: number of cases.
        rng: source of random numbers.

    Raises:
        InputError: if the generator has no such kind, or there are fewer cases than kinds.
    """
    if kind != "all" and kind not in shares:
        raise InputError(f"this generator has no kind {kind}; choose {', '.join(shares)}")
    if count < (len(shares) if kind == "all" else 1):
        raise InputError(f"{count} cases are too few; ask for at least {len(shares)}")
    sizes: dict[Any, int] = {kind: count}
    if kind == "all":
        sizes = {each: max(1, int(share * count)) for each, share in shares.items()}
        sizes["single"] += count - sum(sizes.values())
    cases = [DrawnCase(each, case) for each, n in sizes.items() for case in of_kind(each, n, rng)]
    return [cases[i] for i in rng.permutation(len(cases))]


def coloured_noise(
    case: Case, correlation: float, rng: np.random.Generator, shape: tuple[int, ...]
) -> NDArray[np.float64]:
    """Noise of a sensor, cmH2O: white, and a share that is correlated from sample to sample."""
    white, slow = rng.standard_normal(shape), rng.standard_normal(shape)
    for k in range(1, shape[1]):
        slow[:, k] *= np.sqrt(1.0 - correlation**2)
        slow[:, k] += correlation * slow[:, k - 1]
    return case.noise * (np.sqrt(1.0 - case.coloured) * white + np.sqrt(case.coloured) * slow)
