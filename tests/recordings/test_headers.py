"""Headers by a grammar: any quantity, unit and style give the same breaths, or are asked for."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from ventbench.base.errors import InputError
from ventbench.recordings.foreign import import_recording
from ventbench.recordings.foreign.tables import Table, named
from ventbench.recordings.headers import UNITS, read_header

#: Names of columns by quantity, as words.
NAMES = {
    "time": ["Time", "t", "elapsed time", "timestamp", "Zeit", "rel time"],
    "pressure": ["Paw", "pressure", "airway pressure", "P aw", "patient pressure", "Druck"],
    "flow": ["Flow", "flow rate", "airway flow", "V'", "Q", "patient flow"],
}

#: Spellings of units by their usual one.
SPELLINGS = {
    "time": {"s": ["s", "sec"], "ms": ["ms", "millis"], "us": ["us", "µs"], "min": ["minutes"]},
    "pressure": {
        "cmH2O": ["cmH2O", "cmH₂O", "CMH2O", "cm H2O"],
        "mbar": ["mbar"],
        "hPa": ["hPa"],
        "kPa": ["kPa"],
        "Pa": ["Pa"],
        "mmHg": ["mmHg"],
    },
    "flow": {
        "L/min": ["L/min", "lpm", "L_min", "l·min⁻¹", "slpm", "L per min"],
        "L/s": ["L/s", "LPS", "L s-1"],
        "mL/s": ["mL/s", "mL_s", "ml s-1", "ccps"],
        "mL/min": ["mL/min"],
    },
}


def camel(name: str) -> str:
    first, *others = name.split()
    return first + "".join(word.capitalize() for word in others)


#: How a name and a unit make a header.
STYLES = [
    lambda name, unit: f"{name} [{unit}]",
    lambda name, unit: f"{name} ({unit})",
    lambda name, unit: f"{name}({unit})",
    lambda name, unit: f"{name}, {unit}",
    lambda name, unit: f"{name} {unit}",
    lambda name, unit: f"{name} <{unit}>",
    lambda name, unit: f"{name}_{unit}".replace(" ", "_"),
    lambda name, unit: f"{name}.{unit}".replace(" ", "."),
    lambda name, unit: f"{camel(name)}_{unit}",
    lambda name, unit: f"{name.upper()}_{unit}",
    lambda name, unit: f"Monitor7/{name} [{unit}]",
    lambda name, unit: f"1 {name} {{{unit}}}",
]


def combinations() -> dict[str, list[tuple[str, str]]]:
    """Every header of each quantity, with its usual unit."""
    return {
        quantity: [
            (style(name, spelled), unit)
            for unit, spellings in SPELLINGS[quantity].items()
            for spelled, name, style in product(spellings, names, STYLES)
        ]
        for quantity, names in NAMES.items()
    }


def lung(cycles: float = 3.5) -> dict[str, np.ndarray]:
    time = np.arange(0.0, cycles * 3.0, 0.02)
    phase = time % 3.0
    decay = 700.0 * np.exp(-np.maximum(phase - 1.0, 0.0))
    flow = np.where(phase < 1.0, 500.0, -decay) * (phase > 0.05)
    return {"time": time, "pressure": 5.0 + 10.0 * (phase < 1.0) + flow / 100.0, "flow": flow}


def test_every_quantity_unit_and_style_gives_the_same_breaths():
    made = lung()
    plain = import_recording(Table("plain", made), lung="R20C50").breaths
    headers = combinations()
    assert sum(map(len, headers.values())) > 2000
    rng = np.random.default_rng(0)
    most = max(map(len, headers.values()))
    order = {quantity: rng.permutation(most) % len(every) for quantity, every in headers.items()}
    for k in range(most):
        drawn = {quantity: every[order[quantity][k]] for quantity, every in headers.items()}
        names = named([header for header, _ in drawn.values()])
        columns = {
            name: made[quantity] / float(UNITS[quantity][unit])
            for name, (quantity, (_, unit)) in zip(names, drawn.items(), strict=True)
        }
        table = Table("any", columns, headers=names)
        imported = import_recording(table, lung="R20C50")
        assert list(imported.columns.values()) == list(headers), drawn
        for name in ("time", "pressure", "flow"):
            own, wanted = getattr(imported.breaths, name), getattr(plain, name)
            np.testing.assert_allclose(own, wanted, atol=1e-9, err_msg=str(drawn))


@pytest.mark.parametrize(
    ("header", "role", "unit"),
    [
        ("V'", "flow", None),
        ("V̇ (L/min)", "flow", "L/min"),
        ("dV/dt [L/s]", "flow", "L/s"),
        ("V", "volume", None),
        ("V (L/s)", "flow", "L/s"),
        ("Total Volume (L)", "volume", "L"),
        ("Primus/AWP", "pressure", None),
        ("Press.40ms", "pressure", None),
        ("Airway_Flow", "flow", None),
        ("cmH₂O", "pressure", "cmH2O"),
        ("millis", "time", "ms"),
        ("pressureCmH2O", "pressure", "cmH2O"),
        ("breath_id", "breath", None),
        ("u_in_%", "u_in", "%"),
        ("exp valve", "u_out", None),
        ("AWF [L/min]", "flow", "L/min"),
        ("AWV (mL)", "volume", "mL"),
    ],
)
def test_headers_of_real_files(header, role, unit):
    read = read_header(header)
    assert (read.role, read.unit, read.certain) == (role, unit, True)


@pytest.mark.parametrize(
    "header",
    [
        *(
            "Volume (L/min)",
            "Paw_min",
            "P0.1 [cmH2O]",
            "PEEP",
            "Pes",
            "Pmean",
            "foo_pressure",
            "tidal volume",
        ),
        *(
            "Muscle Pressure [cmH2O]",
            "flow temperature",
            "FLOW_O2",
            "pressure flow",
            "Tinsp",
            "min",
        ),
    ],
)
def test_what_is_ambiguous_or_something_else_is_never_guessed(header):
    assert not read_header(header).certain


@pytest.mark.parametrize(
    ("names", "said"),
    [
        (
            ("time", "foo_pressure", "flow"),
            "no column is the pressure.*--map foo_pressure=pressure",
        ),
        (("clock7b", "Paw", "flow"), r"no column is the time.*--map clock7b=time.*--rate HZ"),
        (
            ("time", "Paw", "F 1 x"),
            "--map 'F 1 x'=flow; or, if none of them is, --map 'F 1 x'=unused",
        ),
        (("time", "Paw", "Volume (L/min)"), r"--map Volume=volume"),
    ],
)
def test_what_is_needed_is_asked_for_by_the_option_that_mends_it(names, said):
    columns = dict(zip(named(names), lung().values(), strict=True))
    with pytest.raises(InputError, match=said):
        import_recording(Table("lab.csv", columns, headers=named(names)), lung="R20C50")
