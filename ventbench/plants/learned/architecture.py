"""Shape and normalisation of a learned plant."""

from __future__ import annotations

from dataclasses import dataclass

from ventbench.plants.mlp import ACTIVATIONS


@dataclass(frozen=True)
class Architecture:
    """Shape of a learned plant; the defaults are the paper's for R5C10.

    Attributes:
        pressures: length of the pressure window, H_p.
        controls: length of the control window, H_c; the command now is its last entry.
        width: of each hidden layer.
        depth: number of matrices, the output's included (the authors' count).
        boundaries: N_B, one-hidden-layer networks for the first steps of an inspiration.
        boundary_width: their hidden width (authors' code: 100).
        activation: ``"tanh"`` or ``"selu"``, of the general network; boundary ones are tanh.
    """

    pressures: int = 5
    controls: int = 10
    width: int = 150
    depth: int = 9
    boundaries: int = 1
    boundary_width: int = 100
    activation: str = "tanh"

    def __post_init__(self) -> None:
        """Refuse impossible shapes.

        Raises:
            ValueError: naming the field and its value.
        """
        for name in ("pressures", "controls", "width", "depth", "boundary_width"):
            if getattr(self, name) < 1:
                raise ValueError(f"learned plant: {name} = {getattr(self, name)} must be >= 1")
        if self.boundaries < 0:
            raise ValueError(f"learned plant: boundaries = {self.boundaries} must be >= 0")
        if self.activation not in ACTIVATIONS:
            raise ValueError(
                f"learned plant: activation {self.activation!r} is not one of "
                f"{', '.join(ACTIVATIONS)}"
            )


@dataclass(frozen=True)
class Normalisation:
    """Constants of a learned plant, see :class:`~ventbench.plants.learned.Learned` for units."""

    pressure_mean: float = 16.0
    pressure_scale: float = 9.0
    control_mean: float = 13.0
    control_scale: float = 16.0
    jump_scale: float = 2.0
    rate_scale: float = 2.0
    tau: float = 0.2

    def __post_init__(self) -> None:
        """Refuse scales that are not positive.

        Raises:
            ValueError: naming the constant and its value.
        """
        for name in ("pressure_scale", "control_scale", "jump_scale", "rate_scale", "tau"):
            if not getattr(self, name) > 0:
                raise ValueError(f"learned plant: {name} = {getattr(self, name)} must be positive")
