"""The rig and the lung as a picture: parts by their place in the physics, the guilty ones lit."""

from __future__ import annotations

from dataclasses import dataclass

from ventbench.diagnosis import report_text
from ventbench.diagnosis.findings import MissingMechanism, NonparametricTerm
from ventbench.diagnosis.latent_inputs import ALVEOLUS, MEASUREMENT, SUPPLY
from ventbench.diagnosis.result import Diagnosis
from ventbench.physics import mechanism
from ventbench.physics.nonparametric import NONPARAMETRIC_COMPONENTS

#: Names of the parts, by their place in the physics.
PARTS = {
    "supply": "supply",
    "command": "command",
    "inspiratory valve": "inspiratory valve",
    "circuit": "circuit",
    "sensor": "sensor",
    "expiratory valve": "expiratory valve",
    "airway": "airway",
    "alveolus": "lung",
}

#: Places of latent inputs.
_LATENT = {ALVEOLUS: "alveolus", SUPPLY: "supply", MEASUREMENT: "sensor"}


@dataclass(frozen=True)
class Part:
    """One part of the picture.

    Attributes:
        name: its name in the picture.
        look: class: ``"lit"`` if a named mechanism acts there, ``"suspect"`` if an effect acts
            there that the library does not have, else ``""``.
        badge: numbers of the entries of the key that act there, such as ``"1, 3"``.
    """

    name: str
    look: str = ""
    badge: str = ""


@dataclass(frozen=True)
class Entry:
    """One line of the key beside the picture.

    Attributes:
        number: number in the picture.
        title: what is missing.
        value: its strength with its interval; ``""`` if it has none.
        look: class, as in :class:`Part`.
        part: name of the part in which it acts.
    """

    number: int
    title: str
    value: str
    look: str
    part: str


def site_of_term(term: NonparametricTerm) -> str:
    """Place in the physics of a nonparametric term."""
    if term.name in _LATENT:
        return _LATENT[term.name]
    if term.name in NONPARAMETRIC_COMPONENTS:
        return mechanism(NONPARAMETRIC_COMPONENTS[term.name].terms[0]).description.site
    return ""


def entries(diagnosis: Diagnosis) -> list[Entry]:
    """What is missing, in the order of the report."""
    listed = [_entry(k, missing) for k, missing in enumerate(diagnosis.mechanisms, start=1)]
    if (term := diagnosis.nonparametric) is not None:
        part = PARTS.get(site_of_term(term), "")
        title = "an effect that is not in the library"
        listed.append(Entry(len(listed) + 1, title, report_text.place(term), "suspect", part))
    return listed


def _entry(number: int, missing: MissingMechanism) -> Entry:
    about = mechanism(missing.name).description
    strength = missing.parameters.get(about.strength.name)
    value = ""
    if strength is not None:
        value = report_text.quantity(strength, f"{missing.name}.{about.strength.name}")
    return Entry(number, about.title, value, "lit", PARTS[about.site])


def parts(listed: list[Entry]) -> dict[str, Part]:
    """Every part of the picture, by its place in the physics."""
    result = {}
    for site, name in PARTS.items():
        here = [entry for entry in listed if entry.part == name]
        looks = {entry.look for entry in here}
        look = "lit" if "lit" in looks else "suspect" if looks else ""
        result[site] = Part(name, look, ", ".join(str(entry.number) for entry in here))
    return result


def description(listed: list[Entry]) -> str:
    """The picture in words."""
    guilty = "; ".join(f"{entry.part}: {entry.title}" for entry in listed if entry.part)
    return f"Ventilator, circuit and lung. Guilty: {guilty or 'no part'}."
