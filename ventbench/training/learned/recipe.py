"""How a learned plant is trained, and what is told while it is."""

from __future__ import annotations

import dataclasses


@dataclasses.dataclass(frozen=True)
class Recipe:
    """How a learned plant is trained.

    Attributes:
        steps: updates; the schedules stretch over them.
        batch: breaths an update, drawn with replacement.
        learning_rate: peak of the cosine schedule.
        weight_decay: of AdamW.
        one_step: share of the updates with one-step loss.
        whole: share of the updates, at the end, with open-loop runs over the whole inspiration;
            between the two the horizon grows geometrically.
        softness: error below which the loss turns from absolute to square, cmH2O.
        noise: standard deviation added to measured windows, cmH2O. The sensor's own 0.2 lowered the
            error on recordings by 4 % but made other intervals four times worse on synthetic
            breaths: the network then trusts the commands, which do not tell the time.
        rising: weight of the penalty on steps at which pressure falls as the valve opens; 0 for
            the paper's training, see :func:`~ventbench.plants.sensitivity.control_sensitivity`.
    """

    steps: int = 1500
    batch: int = 32
    learning_rate: float = 3e-3
    weight_decay: float = 1e-3
    one_step: float = 0.2
    whole: float = 0.4
    softness: float = 0.2
    noise: float = 0.0
    rising: float = 0.0

    def __post_init__(self) -> None:
        """Refuse numbers that cannot work.

        Raises:
            ValueError: naming the field and its value.
        """
        for name in ("steps", "batch", "learning_rate", "softness"):
            if not getattr(self, name) > 0:
                raise ValueError(f"training: {name} = {getattr(self, name)} must be positive")
        for name in ("weight_decay", "noise", "rising", "one_step", "whole"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"training: {name} = {getattr(self, name)} must not be negative")
        if self.one_step + self.whole > 1:
            raise ValueError(
                f"training: one_step + whole = {self.one_step + self.whole} must not exceed 1"
            )


@dataclasses.dataclass(frozen=True)
class Progress:
    """What a progress callback is told.

    Attributes:
        step: updates done.
        steps: updates in all.
        loss: mean loss of the updates since the last report, cmH2O.
    """

    step: int
    steps: int
    loss: float
