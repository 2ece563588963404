"""Layouts that are known by name: which column is what, and in which unit."""

from __future__ import annotations

from dataclasses import dataclass, field

#: What a column may stand for.
ROLES = (
    "time", "pressure", "flow", "volume", "u_in", "u_out", "R", "C", "breath", "group", "target",
    "unused",
)  # fmt: skip


@dataclass(frozen=True)
class Layout:
    """Columns of a known kind of file.

    Attributes:
        name: name on the command line.
        about: what writes such files.
        columns: role of each column.
        units: units by role, where they are not those of the schema.
        required: columns by which a file is recognised.
        lead: time before the number of a breath changes at which its samples begin, s.
    """

    name: str
    about: str
    columns: dict[str, str]
    units: dict[str, str] = field(default_factory=dict)
    required: tuple[str, ...] = ()
    lead: float = 0.0


LAYOUTS: dict[str, Layout] = {
    layout.name: layout
    for layout in (
        Layout(
            "kaggle",
            "the public data of the Google Brain competition, which is ventbench's own schema",
            {
                "time_step": "time", "breath_id": "breath", "R": "R", "C": "C", "u_in": "u_in",
                "u_out": "u_out", "pressure": "pressure", "flow": "flow", "volume": "volume",
            },
            required=("breath_id", "R", "C", "time_step", "u_in", "u_out"),
        ),
        Layout(
            "respiraworks",
            "RespiraWorks test data as one table, a run and a test a recording; its valve commands "
            "are those of another ventilator and are left out",
            {
                "time_step": "time", "run": "group", "test": "group", "breath": "breath", "R": "R",
                "C": "C", "pressure": "pressure", "flow": "flow", "volume": "volume",
                "target": "target",
            },
            required=("run", "test", "breath", "cmd_inh_valve"),
            lead=0.25,
        ),
        Layout(
            "pvp",
            "logs of the People's Ventilator Project (`waveforms` of log2csv or log2mat); the flow "
            "out of the patient is no flow into the lung and is left out",
            {
                "timestamp": "time", "pressure": "pressure", "control_in": "u_in",
                "control_out": "u_out", "cycle_number": "breath",
            },
            required=("timestamp", "pressure", "control_in", "control_out", "cycle_number"),
        ),
    )
}  # fmt: skip

_NAMES: dict[str, str] = {
    "time": "time timestep timestamp t zeit tempo temps tiempo clock datetime elapsed elapsedtime "
    "relativetime seconds",
    "pressure": "pressure paw airwaypressure p pao pvent pmouth pcircuit druck pressione pression "
    "presion",
    "flow": "flow flowrate airflow q vdot fluss flusso debit flujo",
    "volume": "volume vol v volumen",
    "u_in": "uin", "u_out": "uout", "R": "r", "C": "c",
    "breath": "breath breathid cyclenumber breathnumber",
}  # fmt: skip

#: Roles of columns that are understood without a map, by the stem of their names.
USUAL: dict[str, str] = {name: role for role, names in _NAMES.items() for name in names.split()}


def recognise(names: tuple[str, ...]) -> Layout | None:
    """Return the layout whose required columns a file has, or None."""
    for layout in LAYOUTS.values():
        if set(layout.required) <= set(names):
            return layout
    return None
