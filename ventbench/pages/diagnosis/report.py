"""The HTML report of a diagnosis: one file, no script, nothing from the network.

Its diagram shows the rig and the lung: parts by their place in the physics, the guilty ones lit.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup, escape

import ventbench
from ventbench import palette
from ventbench.base import files
from ventbench.base.arrays import runs
from ventbench.base.text import page_templates
from ventbench.diagnosis import number_text, report_text
from ventbench.diagnosis.findings import (
    ErrorRegion,
    MissingMechanism,
    NonparametricTerm,
    OpenLoopError,
)
from ventbench.diagnosis.in_time import ALVEOLUS, CIRCUIT, SUPPLY
from ventbench.diagnosis.result import RECORD_NEXT, Diagnosis
from ventbench.pages.diagnosis import charts
from ventbench.physics import mechanism
from ventbench.physics.characteristics import characteristic
from ventbench.physics.nonparametric import NONPARAMETRIC_COMPONENTS

#: Places that are told in words; the charts show all.
PLACES = 6

#: Powers, units, quantities with an index, and signs of the notation of ``Description.equation``.
_SYMBOL = re.compile(
    r"\^(?P<power>-?\w+|\((?:[^()]|\([^()]*\))*\))|(?P<unit>L/s2?|cmH2O)"
    r"|\b(?P<quantity>[A-Za-z][A-Za-z0-9]*(?:'s)?)(?:_(?P<index>[A-Za-z0-9]+))?|(?P<sign>-\+|<=|-|\.{2,3}|.)"
)
_SIGNS = {"-": "−", "-+": "∓", "<=": "≤", "..": " to ", "...": "…"}
_LETTERS = {"tau": "τ", "pi": "π", "sum": "∑"}


def write(path: Path, diagnosis: Diagnosis) -> Path:
    """Write the report, ``.html`` by custom, and return the path.

    Raises:
        OSError: if the file cannot be written.
    """
    files.write_text(path, html(diagnosis))
    return path


def html(diagnosis: Diagnosis) -> str:
    """Return the whole page; equal input gives equal text."""
    listed = entries(diagnosis)
    lead = [report_text.effect(diagnosis), report_text.remaining(diagnosis)]
    lead += [report_text.scatter(diagnosis)]
    page = page_templates("ventbench.pages.diagnosis").get_template("diagnosis.html.j2")
    return page.render(
        headline=report_text.headline(diagnosis),
        facts=facts(diagnosis),
        lead=[text for text in lead if text],
        entries=listed,
        parts=parts(listed),
        diagram_alt=description(listed),
        would_change=report_text.would_change(diagnosis),
        visible=[
            (report_text.title(name), name, limit or "not at any strength")
            for name, limit in report_text.visible_strengths(diagnosis).items()
        ],
        commands_file=RECORD_NEXT,
        plant=diagnosis.simulator,
        light=(palette.RUNS[0], palette.GREY, *palette.RUNS[1:]),
        dark=(palette.RUNS_DARK[0], palette.GREY_DARK, *palette.RUNS_DARK[1:]),
        mechanisms=[_named(diagnosis, missing) for missing in diagnosis.mechanisms],
        alternatives=report_text.alternatives(diagnosis),
        bars=bars(diagnosis),
        groups=groups(diagnosis),
        corrected=diagnosis.verdict != "nothing_missing",
        held_out=len(diagnosis.open_loop.held_out_breaths),
        stages=charts.stages(diagnosis),
        panels=charts.panels(diagnosis),
        places=[_place(diagnosis, place) for place in diagnosis.location[:PLACES]],
        remaining=[_place(diagnosis, place) for place in diagnosis.remaining[:PLACES]],
        more=max(len(diagnosis.location) - PLACES, 0),
        axes=charts.by_axis(diagnosis),
        slot=diagnosis.form or diagnosis.nonparametric,
        slot_words=report_text.nonparametric_term(diagnosis),
        slot_title="The form of what is missing"
        if diagnosis.form is not None
        else "An effect outside the library",
        slot_chart=None
        if (slot_term := diagnosis.form or diagnosis.nonparametric) is None
        else charts.nonparametric_term(slot_term),
        request=diagnosis.request,
        request_words=report_text.request(diagnosis),
        request_charts=[] if diagnosis.request is None else charts.request(diagnosis.request),
        lungs=[report_text.lung(match) for match in diagnosis.lungs],
        notes=diagnosis.notes,
        about=_facts_of_run(diagnosis),
    )


def facts(diagnosis: Diagnosis) -> list[tuple[str, str, str]]:
    """What a reader asks first: the question, the answer in short, and a line beneath it."""
    errors, count = diagnosis.open_loop, len(diagnosis.open_loop.held_out_breaths)
    answers = []
    if sure := report_text.sureness(diagnosis):
        first, _, doubts = sure.partition(": ")
        each = "each effect by itself" if sure.startswith("each at ") else ""
        answers.append(("How sure?", first.removeprefix("each at "), doubts or each))
    after, out = _number(errors.after.rmse), errors.groups.get("expiration", {})
    if diagnosis.verdict == "nothing_missing":
        also = f"; expiration {_number(out['after'].rmse)}" if "after" in out else ""
        detail = f"in inspiration, root mean square on {count} breaths{also}"
        answers.append(("How far off?", f"{after} cmH2O", detail))
    else:
        worth = f"{_number(errors.refit.rmse)} → {after} cmH2O"
        detail = f"error in inspiration on {count} breaths set aside"
        if {"refit", "after"} <= out.keys():
            ends = (_number(out[stage].rmse) for stage in ("refit", "after"))
            detail += f"; expiration {' → '.join(ends)}"
        answers.append(("What is mending it worth?", worth, detail))
    noise = f"beyond the measurement's noise of {_number(errors.noise_floor)}"
    if errors.scatter_error:
        noise += f" and the {_number(errors.scatter_error)} of what differs from breath to breath"
    answers.append(("What stays unexplained?", f"{_number(errors.unexplained)} cmH2O", noise))
    return answers


def bars(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """Root-mean-square errors as bars: text, class, value and width in %."""
    distance = diagnosis.open_loop
    rows = [
        ("as given", "before", distance.before.rmse),
        ("R and C refitted", "refit", distance.refit.rmse),
    ]
    if diagnosis.verdict != "nothing_missing":
        rows.append(("corrected", "after", distance.after.rmse))
    rows.append(("noise of the measurement", "noise", distance.noise_floor))
    top = max((value for *_, value in rows if np.isfinite(value)), default=1.0) or 1.0
    return [
        {
            "name": name,
            "look": look,
            "value": _number(value),
            "width": round(100 * value / top, 1) if np.isfinite(value) else 0.0,
        }
        for name, look, value in rows
    ]


def groups(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """Rows of the table of open-loop errors: all breaths first, then each part."""
    distance = diagnosis.open_loop
    everything = {"before": distance.before, "refit": distance.refit, "after": distance.after}
    rows = [("all", everything), *distance.groups.items()]
    keys = charts.stages(diagnosis)
    return [
        {"name": name, "cells": [_cell(values.get(key)) for key in keys]} for name, values in rows
    ]


def _cell(distance: OpenLoopError | None) -> dict[str, str]:
    if distance is None:
        return {"rmse": "–", "mae": "–"}
    return {"rmse": _number(distance.rmse), "mae": _number(distance.mae)}


def _named(diagnosis: Diagnosis, missing: MissingMechanism) -> dict[str, Any]:
    """A missing mechanism with its formula, its parameters and its own signal."""
    description = mechanism(missing.name).description
    meanings = {parameter.name: parameter.meaning for parameter in description.parameters}
    breaths = diagnosis.traces.breaths
    largest = float(np.max(breaths.u_in, initial=10.0, where=breaths.valid))
    curve = characteristic(missing.name, _values(diagnosis, missing), largest_command=largest)
    return {
        "name": missing.name,
        "heading": number_text.capital(description.title),
        "simulator": {
            key: number_text.quantity_like(value, missing.parameters[key], f"{missing.name}.{key}")
            for key, value in missing.simulator_values.items()
            if key in missing.parameters
        },
        "equation": typeset(description.equation),
        "signature": description.signature,
        "changed": missing.changed,
        "confidence": f"{100 * missing.confidence:.0f} %",
        "nats": f"{missing.nats:.0f}",
        "alternatives": missing.alternatives,
        "chart": None if curve is None else charts.characteristic_chart(description.title, curve),
        "timeline": timeline(diagnosis, missing),
        "affected": missing.affected,
        "parameters": [
            (key, meanings.get(key, key), number_text.quantity(value, f"{missing.name}.{key}"))
            for key, value in missing.parameters.items()
        ],
    }


def timeline(diagnosis: Diagnosis, missing: MissingMechanism) -> list[tuple[float, float]]:
    """Where in the session a mechanism acts, as left ends and widths, % of all breaths.

    Empty if it acts alike in all breaths.
    """
    ids = np.union1d(diagnosis.traces.breaths.breath_id, missing.affected)
    acts = np.isin(ids, missing.affected)
    if missing.breaths is not None:
        acts = ids >= missing.breaths[0]
    shares = np.round(100.0 * np.reshape(runs(acts), (-1, 2)) / max(len(ids), 1), 2)
    return [(float(low), float(high - low)) for low, high in shares]


def _values(diagnosis: Diagnosis, missing: MissingMechanism) -> dict[str, float]:
    """Values of a mechanism's parameters by short name, and of the base model's."""
    values: dict[str, float] = {}
    plant: Any = next(iter(diagnosis.plants.values()), None)
    parameters = None if plant is None else plant.parameters()
    if parameters is not None:
        for path, value in parameters.items():
            owner, _, short = path.rpartition(".")
            if owner in ("", missing.name):
                values[short] = float(np.mean(np.asarray(value)))
    elif diagnosis.lungs and np.isfinite(diagnosis.lungs[0].fitted_R):
        values |= {"R": diagnosis.lungs[0].fitted_R, "C": diagnosis.lungs[0].fitted_C}
    return values | {name: estimate.value for name, estimate in missing.parameters.items()}


def _place(diagnosis: Diagnosis, place: ErrorRegion) -> dict[str, str]:
    return {
        "text": number_text.error_region(place, diagnosis.noise[0]),
        "share": f"{100 * place.share:.0f} %",
        "p": number_text.probability(place.p_value),
    }


def _facts_of_run(diagnosis: Diagnosis) -> list[tuple[str, str]]:
    recorded = diagnosis.traces.breaths
    held = int(np.count_nonzero(diagnosis.traces.held_out))
    sd, correlation = diagnosis.noise
    rows = [
        ("ventbench", ventbench.__version__),
        ("simulator", diagnosis.simulator),
        ("recording", recorded.source or "in memory"),
        ("its SHA-256", recorded.sha256 or ""),
        ("breaths", f"{len(recorded)}, of which {held} were held out of every fit"),
        ("lungs", ", ".join(recorded.by_lung_index)),
        ("noise", f"{sd:.3g} cmH2O, correlation of neighbouring samples {correlation:.2f}"),
        ("computed in", f"{diagnosis.seconds:.0f} s"),
    ]
    return [(name, text) for name, text in rows if text]


def _number(value: float) -> str:
    return f"{value:.2f}" if np.isfinite(value) else "–"


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

#: Places of inputs that vary in time.
_LATENT = {ALVEOLUS: "alveolus", SUPPLY: "supply", CIRCUIT: "circuit"}


@dataclass(frozen=True)
class Part:
    """One part of the picture."""

    name: str  #: its name in the picture.
    #: class: ``"lit"`` if a named mechanism acts there, ``"suspect"`` if an effect acts there that
    #: the library does not have, else ``""``.
    look: str = ""
    badge: str = ""  #: numbers of the entries of the key that act there, such as ``"1, 3"``.


@dataclass(frozen=True)
class Entry:
    """One line of the key beside the picture."""

    number: int  #: number in the picture.
    title: str  #: what is missing.
    value: str  #: its strength with its interval; ``""`` if it has none.
    look: str  #: class, as in :class:`Part`.
    part: str  #: name of the part in which it acts.


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
    description = mechanism(missing.name).description
    strength = missing.parameters.get(description.strength.name)
    value = ""
    if strength is not None:
        value = number_text.quantity(strength, f"{missing.name}.{description.strength.name}")
    return Entry(number, description.title, value, "lit", PARTS[description.site])


def parts(listed: list[Entry]) -> dict[str, Part]:
    """Every part of the picture, by its place in the physics."""
    result = {}
    for site, name in PARTS.items():
        entries_of_part = [entry for entry in listed if entry.part == name]
        looks = {entry.look for entry in entries_of_part}
        look = "lit" if "lit" in looks else "suspect" if looks else ""
        result[site] = Part(name, look, ", ".join(str(entry.number) for entry in entries_of_part))
    return result


def description(listed: list[Entry]) -> str:
    """The picture in words."""
    guilty = "; ".join(f"{entry.part}: {entry.title}" for entry in listed if entry.part)
    return f"Ventilator, circuit and lung. Guilty: {guilty or 'no part'}."


def typeset(equation: str) -> Markup:
    """A line of mathematics as HTML: letters in italics, indices below, powers above."""

    def markup(match: re.Match[str]) -> str:
        power, unit, quantity, index, sign = match.group(
            "power", "unit", "quantity", "index", "sign"
        )
        if power is not None:
            return f"<sup>{typeset(power[1:-1] if power.startswith('(') else power)}</sup>"
        if unit is not None:
            return unit.replace("H2O", "H<sub>2</sub>O").replace("s2", "s<sup>2</sup>")
        if quantity is None:
            return str(escape(_SIGNS.get(sign, sign)))
        text = _LETTERS.get(quantity, quantity)
        derivative = len(quantity) == 2 and quantity[0] == "d"
        text = f"<i>{text}</i>" if len(text) == 1 or derivative else text
        return text if index is None else f"{text}<sub>{index}</sub>"

    return Markup(_SYMBOL.sub(markup, equation))
