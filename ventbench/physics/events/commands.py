"""Commands that do not reach the valve, or not in time.

Which ones, no parameter says: models follow the commands that reached the valve
(:mod:`ventbench.diagnosis.command_path` finds them).
"""

from __future__ import annotations

from ventbench.physics.mechanism import Description, Mechanism
from ventbench.physics.parameters import Parameter

_SOURCE = (
    "Messages on a bus are lost, or come late and are overtaken (J. Nilsson, Real-Time "
    "Control Systems with Delays, Lund 1998)."
)


class LostCommands(Mechanism):
    """Commands that never come: the valve keeps the one before."""

    description = Description(
        name="lost_commands",
        title="commands that never reach the valve",
        site="command",
        equation="u_k = u_(k-1) where command k is lost",
        parameters=(
            Parameter("share", "1", "of the commands", 0.0, 1.0, 0.0, 0.06, 0.15, share=True),
        ),
        source=_SOURCE,
        signature="At single edges of the command, pressure answers a sample late.",
        confusable=("late_commands", "valve_delay"),
    )  # fmt: skip


class LateCommands(Mechanism):
    """Commands that come late, and act only if no later one has come before."""

    description = Description(
        name="late_commands",
        title="commands that reach the valve late",
        site="command",
        equation="command k comes at t_k + delay, and is dropped if a later one has come",
        parameters=(
            Parameter("share", "1", "of the commands", 0.0, 1.0, 0.0, 0.12, 0.3, share=True),
            Parameter("delay", "s", "of these commands", 0.0, 1.0, 0.1, 0.1, 0.1),
        ),
        source=_SOURCE,
        signature="As of lost commands; where several follow each other, an old one comes at last.",
        confusable=("lost_commands", "valve_delay"),
    )  # fmt: skip


MECHANISMS = (LostCommands(), LateCommands())
