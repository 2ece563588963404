"""What a recording holds: the columns, their units, ranges and types.

One row is one sample. The rows of a breath follow one another, in time order. The header is
`id,breath_id,R,C,time_step,u_in,u_out,pressure`, and `flow` or `volume` may be added. Parquet files
have columns of the same names.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Column:
    """One column of a recording.

    Attributes:
        name: name in the header.
        unit: unit of every value, as it is printed.
        low: smallest value that is accepted, in `unit`.
        high: largest value that is accepted, in `unit`.
        blank: whether a cell may be blank (read as NaN).
        whole: whether the column holds whole numbers (64 bit).
        positive: whether `low` itself is refused.
        advice: what to do about a value outside the range.
    """

    name: str
    unit: str
    low: float = float("-inf")
    high: float = float("inf")
    blank: bool = False
    whole: bool = False
    positive: bool = False
    advice: str = "Fix the row."

    @property
    def span(self) -> str:
        """The accepted range in words, such as `0..100 %`."""
        if self.positive:
            return f"the range above {self.low:g} and up to {self.high:g} {self.unit}"
        return f"{self.low:g}..{self.high:g} {self.unit}".rstrip()


COLUMNS: dict[str, Column] = {
    column.name: column
    for column in (
        Column("id", "", blank=True, whole=True),
        Column("breath_id", "", whole=True),
        Column(
            "R",
            "cmH2O/(L/s)",
            0.0,
            500.0,
            positive=True,
            advice="Write the resistance of the test lung in cmH2O/(L/s).",
        ),
        Column(
            "C",
            "mL/cmH2O",
            0.0,
            500.0,
            positive=True,
            advice="Write the compliance of the test lung in mL/cmH2O.",
        ),
        Column("time_step", "s", blank=True),
        Column("u_in", "%", 0.0, 100.0, advice="Fix the row or pass --clip."),
        Column("u_out", "", 0.0, 1.0, advice="Write 1 while the expiratory valve is open, else 0."),
        Column(
            "pressure",
            "cmH2O",
            -20.0,
            120.0,
            blank=True,
            advice="Write the pressure in cmH2O, or leave the cell blank.",
        ),
        Column(
            "flow",
            "mL/s",
            -10_000.0,
            10_000.0,
            blank=True,
            advice="Write the flow in mL/s, or leave the cell blank.",
        ),
        Column(
            "volume",
            "mL",
            -20_000.0,
            20_000.0,
            blank=True,
            advice="Write the volume in mL, or leave the cell blank.",
        ),
    )
}

OPTIONAL: tuple[str, ...] = ("flow", "volume")
REQUIRED: tuple[str, ...] = tuple(name for name in COLUMNS if name not in OPTIONAL)
HEADER: str = ",".join(REQUIRED) + "[,flow][,volume]"
