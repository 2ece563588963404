"""Names that only trim the form of another one.

Where the recording's leak is linear and the library's is a root, a second mechanism may bend one
into the other, and held-out breaths believe it. An element of a slot of the first name's own kind
then does as well or better, and with it the second name is not needed any more. A mechanism that
acts passes the test: no element of another's kind explains it away.
"""

from __future__ import annotations

from operator import itemgetter

from ventbench.diagnosis import places
from ventbench.diagnosis.bench import Bench
from ventbench.diagnosis.gate import GATE, believed
from ventbench.diagnosis.hypothesis import Hypothesis
from ventbench.diagnosis.search import Progress
from ventbench.diagnosis.solved import Solved
from ventbench.diagnosis.steps import settle
from ventbench.system_id.data import Floats
from ventbench.system_id.together import each

#: Share of all that is explained up to which a name may be a trimming.
_TRIMMING = 0.5

#: Share of a name's gain, and nats, that an element may fall short by; and share of the gain that
#: the name may still have beside it.
_SHORT, _NATS, _LEFT = 0.05, 3.0 * GATE, 0.1

#: Share of a name's gain that an element must promise to first order to be fitted.
_PROMISE = 0.4


def without_trimmings(bench: Bench, wide: Bench, named: Solved, tell: Progress) -> Solved:
    """Drop the names that an element of another name's own kind explains away.

    Args:
        bench: with the library's parameters.
        wide: with those of all slots too.
        named: the names, fitted.
        tell: is told what is done.
    """
    while len(named.hypothesis.names) > 1:
        tell("looking for names that trim others")
        trimming = _first(wide, named)
        if trimming is None:
            break
        named = settle(bench, named.hypothesis.without(trimming), named)
    return named


def _first(wide: Bench, named: Solved) -> str | None:
    """The least of the names that trim another one."""
    null = wide.solve(Hypothesis(), named.noise)
    here = wide.likelihood(named)
    whole = max(here - null.log_likelihood, 1e-9)
    base = wide.judged(named)
    lefts = each(
        lambda name: wide.solve(named.hypothesis.without(name), named.noise, named),
        named.hypothesis.names,
    )
    lost = [here - wide.likelihood(left) for left in lefts]
    for name, left, nats in sorted(zip(named.names, lefts, lost, strict=True), key=itemgetter(2)):
        if nats < _TRIMMING * whole and _explained_away(wide, named, left, name, nats, base):
            return name
    return None


def _explained_away(
    wide: Bench, named: Solved, left: Solved, name: str, nats: float, base: Floats
) -> bool:
    gained = float((base - wide.judged(left)).sum())
    for candidate in places.scan(left):
        element = candidate.name
        kin = places.holds(element)
        if not set(kin) & set(left.hypothesis.names):
            continue
        if max(candidate.nats, candidate.white) < _PROMISE * nats:
            continue
        instead = wide.solve(left.hypothesis.plus(Hypothesis((element,))), left.noise, left)
        ahead = wide.judged(instead) - base
        # An element that holds both can always stand for one: only if both have another form.
        short = -min(_SHORT * gained, _NATS)
        if not believed(ahead) if name in kin else ahead.sum() < short:
            continue
        both = wide.solve(named.hypothesis.plus(Hypothesis((element,))), named.noise, instead)
        if float((wide.judged(both) - wide.judged(instead)).sum()) < _LEFT * gained:
            return True
    return False
