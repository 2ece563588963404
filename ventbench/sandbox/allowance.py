"""How much a submission may use and how long it may take."""

from __future__ import annotations

from dataclasses import dataclass

MIB, GIB = 1 << 20, 1 << 30


@dataclass(frozen=True)
class Allowance:
    """Limits of a session; the processor is shared by all its cells, hence patience, not a pace.

    Attributes:
        memory: bytes of one cell beyond the interpreter with its libraries.
        cpu_s: seconds of processor time of one cell: import, reset and three breaths.
        start_patience_s: while controllers are imported and reset, cells time out when none of
            them has answered for this long.
        patience_s: likewise in one step.
        total_s: of a session; then all cells time out.
    """

    memory: int = 512 * MIB
    cpu_s: int = 60
    start_patience_s: float = 20.0
    patience_s: float = 5.0
    total_s: float = 900.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not value > 0:
                raise ValueError(f"allowance {name} is {value}, it must be positive")
