"""What the recording has and the simulator lacks, in the same language."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ventbench.diagnosis import estimates
from ventbench.diagnosis.conclusion import Conclusion
from ventbench.physics.catalogue import mechanism
from ventbench.system_id import Fit

#: Times the joint reach of two 95 % intervals from which strengths differ: each name of many
#: simulators is compared, and false alarms are to be rare.
_APART = 1.4


@dataclass(frozen=True)
class Lack:
    """A mechanism that is missing, or that is another one than the simulator's."""

    name: str
    changed: bool


def lacking(
    recorded: Fit, wanted: Conclusion, simulated: Fit | None, had: Conclusion | None
) -> tuple[list[Lack], list[str]]:
    """Compare what was found in a recording with what was found in a simulator's answers.

    Args:
        recorded: final fit to the recording.
        wanted: what it needs.
        simulated: final fit to the answers, or None for the base model, which has nothing.
        had: what it has.

    Returns:
        What is missing, the most important first; and sentences about what the simulator has and
        the recording does not show.
    """
    order = sorted(wanted.names, key=lambda name: -wanted.held_out_gains.get(name, 0.0))
    if simulated is None or had is None:
        return [Lack(name, False) for name in order], []
    missing = []
    for name in order:
        if name not in had.names:
            missing.append(Lack(name, False))
        elif _differs(recorded, simulated, name):
            missing.append(Lack(name, True))
    extra = [name for name in had.names if name not in wanted.names]
    said = [
        f"The simulator has {mechanism(name).description.title}, which the recording does not show."
        for name in extra
    ]
    return missing, said


def _differs(recorded: Fit, simulated: Fit, name: str) -> bool:
    """Whether the strengths' intervals lie apart."""
    strength = mechanism(name).description.strength
    if strength.scope == "breath":
        return False
    ends = [estimates.parameters(one, name)[strength.name] for one in (recorded, simulated)]
    gap = abs(ends[0].value - ends[1].value)
    reach = [0.5 * (one.ci95[1] - one.ci95[0]) for one in ends]
    return bool(gap > _APART * np.hypot(reach[0], reach[1]))
