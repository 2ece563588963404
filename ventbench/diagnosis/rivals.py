"""Which other names the recording cannot tell from the ones that were chosen."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from ventbench.diagnosis.bench import Bench
from ventbench.diagnosis.candidates import screen
from ventbench.diagnosis.gate import believed
from ventbench.diagnosis.solved import Solved
from ventbench.diagnosis.steps import Rival, Step, step, whitened
from ventbench.system_id.together import each

#: Criterion (twice the nats) within which a name is an alternative, and most that are listed.
_CLOSE, _LISTED = 10.0, 2

#: What pressure alone can never tell from a mechanism: the same impedance under another name.
SAME = {"viscoelasticity": ("second_compartment",)}


@dataclass(frozen=True, eq=False)
class Alternatives:
    """To one name.

    Attributes:
        names: the likeliest first.
        confidence: share of the posterior of equal priors that falls on the name itself.
        rivals: fitted, of mechanisms of the library.
    """

    names: tuple[str, ...]
    confidence: float
    rivals: tuple[Rival, ...]


def alternatives(
    bench: Bench, named: Solved, steps: list[Step], *, swap: bool = True
) -> tuple[Solved, dict[str, Alternatives]]:
    """Replace each name by every other one, and keep what is better.

    Returns:
        The best set of names, and for each the alternatives.
    """
    for last in (False, False, True):
        criterion, names = bench.criterion(named), named.names
        rivals = each(partial(_rivals, bench, named, steps), names)
        better = [one[0].solved for one in rivals if one and one[0].criterion < criterion]
        if last or not swap or not better:
            break
        named, steps = better[0], []
    return named, {
        name: _close(name, others, criterion) for name, others in zip(names, rivals, strict=True)
    }


def _rivals(bench: Bench, named: Solved, steps: list[Step], name: str) -> list[Rival]:
    rest = named.hypothesis.without(name)
    known = [s for s in steps if s.before.hypothesis == rest and s.rivals[0].name == name]
    if known:
        # Those that stayed far behind were not fitted to the end.
        return _again(bench, known[-1].rivals[1:4], named)
    base = bench.solve(rest, named.noise, named)
    white = whitened(bench, base)
    candidates = [one for one in screen(base, white, bench.known) if one.name != name]
    found = step(bench, base, candidates, white)
    if found is None or not believed(found.gained):
        return []
    return _again(bench, found.rivals[:3], named)


def _again(bench: Bench, rivals: tuple[Rival, ...], named: Solved) -> list[Rival]:
    """The same at the noise of the names, the best first."""
    again = [
        Rival(one.name, one.solved, bench.criterion(one.solved, named.noise)) for one in rivals
    ]
    return sorted(again, key=lambda one: one.criterion)


def _close(name: str, rivals: list[Rival], criterion: float) -> Alternatives:
    near = [one for one in rivals if one.criterion < criterion + _CLOSE][:_LISTED]
    odds = np.exp(-0.5 * np.array([max(one.criterion - criterion, 0.0) for one in near]))
    names = tuple(one.name for one in near) + SAME.get(name, ())
    return Alternatives(names[:_LISTED], float(1.0 / (1.0 + odds.sum())), tuple(near))
