"""How a residual controller is trained, and what is told while it is."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Recipe:
    """How a residual controller is trained; hashable, as it is part of what is compiled.

    Attributes:
        updates: of the network; the schedule stretches over them.
        copies: runs of each lung at each PIP in an update: the first on the official simulator
            without noise, the others on deviating benches.
        learning_rate: peak of the cosine schedule of Adam.
        weight_decay: of its weights.
        lam: weight of the mean absolute correction, cmH2O for each %; the paper's lambda.
        agreement: weight of the disagreement of the ensemble along the controller's own commands;
            0 to let it live on what one simulator alone says.
        first_breath: weight of the breath that is not scored; each scored one has 1.
        widths: of the network's hidden layers.
        pressures: errors of earlier steps that it sees.
        commands: earlier commands that it sees.
        ahead: steps of the breath before that it sees; 0 for none.
        limit: largest correction, %.
        members: of the ensemble of simulators, 1 (the official ones) to 5.
        spread: how far deviations reach, as a multiple of the draws' ranges; 0 for none.
        round_robin: whether each update takes one lung at one PIP, in turn, as in the paper,
            instead of all of them.
    """

    updates: int = 3000
    copies: int = 4
    learning_rate: float = 4e-3
    weight_decay: float = 1e-5
    lam: float = 0.0
    agreement: float = 1.0
    first_breath: float = 0.25
    widths: tuple[int, ...] = (64, 64)
    pressures: int = 5
    commands: int = 6
    ahead: int = 6
    limit: float = 100.0
    members: int = 5
    spread: float = 1.0
    round_robin: bool = False

    def __post_init__(self) -> None:
        """Refuse numbers that cannot work.

        Raises:
            ValueError: naming the field and its value.
        """
        for name in ("updates", "copies", "learning_rate", "limit", "members"):
            if not getattr(self, name) > 0:
                raise ValueError(f"training: {name} = {getattr(self, name)} must be positive")
        for name in (
            "weight_decay",
            "lam",
            "agreement",
            "first_breath",
            "pressures",
            "commands",
            "ahead",
        ):
            if not getattr(self, name) >= 0:
                raise ValueError(f"training: {name} = {getattr(self, name)} must not be negative")
        if not 0 <= self.spread <= 4:
            raise ValueError(f"training: spread = {self.spread} is outside 0..4")


@dataclass(frozen=True)
class Progress:
    """What a progress callback is told.

    Attributes:
        update: updates done.
        updates: in all.
        loss: mean over the updates since the last report, cmH2O.
    """

    update: int
    updates: int
    loss: float
