"""Layouts of files that are known by the names of their columns: ``layouts.toml``."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field

from ventbench.base.arrays import Texts
from ventbench.base.files import data_beside

#: What a column may stand for.
ROLES = (
    *("time", "pressure", "flow", "flow_in", "flow_out", "volume", "u_in", "u_out", "R", "C"),
    *("breath", "group", "target", "unused"),
)


@dataclass(frozen=True)
class Layout:
    """Columns of a known kind of file; of any other, none."""

    about: str = ""  #: what writes such files.
    columns: Texts = field(default_factory=dict)  #: role of each column.
    required: tuple[str, ...] = ()  #: columns by which a file is recognised.
    #: units by role, where they are not those of the schema.
    units: Texts = field(default_factory=dict)
    words: dict[str, float] = field(default_factory=dict)  #: numbers that words stand for.
    lead: float = 0.0  #: time before the number of a breath changes at which its samples begin, s.


LAYOUTS: dict[str, Layout] = {
    name: Layout(**layout) for name, layout in data_beside(__file__, "layouts.toml").items()
}


def recognise(names: Collection[str]) -> str | None:
    """Return the name of the layout whose required columns a file has, or None."""
    return next((name for name, x in LAYOUTS.items() if set(x.required) <= set(names)), None)
