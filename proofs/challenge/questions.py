"""Questions of a challenge: their kinds, and the effects that an answer may mistake."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from hardware_eval.emulation.cases import Case

Kind = Literal["single", "null", "pair", "four", "outside", "form", "masked"]
KINDS: tuple[Kind, ...] = get_args(Kind)

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
