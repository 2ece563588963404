"""The stressors: one entry of a table each, ``stressors.toml``.

A stressor changes parameters of the physics in ``with - without`` (see ``plants/stressed.py``).
Most are mechanisms of the library at a strength; some are events, some are other settings of the
test lung, some change from breath to breath. A new mechanism of the library becomes a stress test
by an entry of it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from ventbench.base.errors import InputError
from ventbench.base.files import data_beside
from ventbench.task import protocol

#: Version of the table: stressors, strengths and pairs. Stress scores of two versions are not
#: compared.
VERSION = 1

Severity = Literal["mild", "strong"]
SEVERITIES: tuple[Severity, ...] = ("mild", "strong")

#: Where a stressor sits, in the order of tables and charts, and that in words.
Category = Literal["valve", "circuit", "sensor", "lung", "patient", "setting"]
CATEGORIES: dict[Category, str] = {
    "valve": "valve and supply",
    "circuit": "circuit",
    "sensor": "sensor",
    "lung": "airway and lung",
    "patient": "patient",
    "setting": "other lungs",
}

#: How a strength acts on what the reference physics has: it is added to it, it multiplies it, or it
#: is a label, in whose proportion to the lung's own label R or C changes.
Rule = Literal["add", "scale", "label"]

#: A number for all breaths, or one for each.
ByBreath = float | tuple[float, ...]

_ALWAYS = (1.0,) * protocol.BREATHS


@dataclass(frozen=True)
class Stressor:
    """One stressor at two severities."""

    name: str  #: public name.
    category: Category  #: where it sits.
    title: str  #: the stressor in a clinician's words.
    #: path of the parameter that it changes, ``mechanism.parameter`` or ``R``, ``C``.
    strength: str
    #: strength of the mild severity, in the parameter's unit; a factor for ``scale``, a label for
    #: ``label``.
    mild: float
    strong: float  #: strength of the strong severity.
    reason: str  #: where the two strengths come from.
    rule: Rule = "add"  #: how the strength acts.
    breaths: tuple[float, ...] = _ALWAYS  #: share of the strength in each breath of a run.
    #: further parameters, the same for both severities, by path.
    fixed: Mapping[str, ByBreath] = field(default_factory=dict)
    #: further parameters that differ, ``{path: (mild, strong)}``.
    by_severity: Mapping[str, tuple[ByBreath, ByBreath]] = field(default_factory=dict)

    def at(self, severity: Severity) -> float:
        """Strength of a severity."""
        return self.mild if severity == "mild" else self.strong

    def settings(self, severity: Severity) -> dict[str, ByBreath]:
        """Further parameters of a severity, by path."""
        index = SEVERITIES.index(severity)
        return {**self.fixed, **{path: both[index] for path, both in self.by_severity.items()}}


@dataclass(frozen=True)
class Condition:
    """What a run is stressed with: nothing, a stressor, or a pair."""

    stressors: tuple[str, ...] = ()  #: none, one or two names; more where :attr:`shares` are given.
    severity: Severity | None = None  #: of all of them; None without a stressor.
    #: share of the strength of each, 0..1, on a logarithmic scale where the strength is a factor or
    #: a label; empty for all of it.
    shares: tuple[float, ...] = ()

    @property
    def id(self) -> str:
        """Name in tables and JSON, such as ``leak:mild`` or ``leak+sensor_lag:mild``."""
        return f"{'+'.join(self.stressors)}:{self.severity}" if self.stressors else "none"


_TABLE = data_beside(__file__, "stressors.toml")

#: The table, ``stressors.toml``.
STRESSORS: tuple[Stressor, ...] = tuple(
    Stressor(name, **line) for name, line in _TABLE["stressors"].items()
)

#: Pairs that occur together, both mild.
PAIRS: tuple[tuple[str, str], ...] = _TABLE["pairs"]["mild"]

#: Weights of conditions in the score; 1 for the others. A tube that comes off costs so much more
#: than anything else that it alone was 8 to 13 % of what stress adds to the errors of the bundled
#: entries: with this weight no condition is more than a tenth of it.
WEIGHTS = {"disconnection:strong": 0.5}


def held_out() -> frozenset[str]:
    """Stressors under which nothing may be tuned: a third, by the hash of their names."""
    names = sorted((s.name for s in STRESSORS), key=lambda x: hashlib.sha256(x.encode()).digest())
    return frozenset(names[: -(-len(names) // 3)])


#: Mechanisms of the library without a line, and why.
NOT_STRESSED: dict[str, str] = _TABLE["not_stressed"]


def stressor(name: str) -> Stressor:
    """A stressor by its name.

    Raises:
        InputError: if there is none.
    """
    for candidate in STRESSORS:
        if candidate.name == name:
            return candidate
    raise InputError(f"no stressor {name!r}; choose of {', '.join(s.name for s in STRESSORS)}")


def conditions() -> tuple[Condition, ...]:
    """All conditions of the track: nothing first, then each stressor twice, then the pairs."""
    single = [Condition((s.name,), severity) for s in STRESSORS for severity in SEVERITIES]
    return (Condition(), *single, *(Condition(pair, "mild") for pair in PAIRS))
