"""The HTML report of a diagnosis: one file, no script, nothing from the network."""

from __future__ import annotations

from typing import Any

import jinja2
import numpy as np

import ventbench
from ventbench.diagnosis import quantity, words
from ventbench.diagnosis.result import Diagnosis, Distance, Named
from ventbench.physics import mechanism
from ventbench.views import style
from ventbench.views.diagnosis import breaths, figures

#: Places that are told in words; the charts show all.
PLACES = 6


def html(found: Diagnosis) -> str:
    """Return the whole page; equal input gives equal text."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("ventbench.views.diagnosis"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    lead = [*map(words.named, found.mechanisms), words.effect(found)]
    lead += [words.slot(found), words.distances(found)]
    return environment.get_template("diagnosis.html.j2").render(
        verdict=words.verdict(found),
        lead=[text for text in lead if text],
        plant=found.plant,
        light=style.RUN_COLORS,
        dark=style.RUN_COLORS_DARK,
        mechanisms=[_named(item) for item in found.mechanisms],
        alternatives=words.alternatives(found),
        bars=bars(found),
        groups=groups(found),
        corrected=found.verdict != "nothing_missing",
        held_out=len(found.open_loop.held_out_breaths),
        stages=_stages(found),
        panels=breaths.panels(found),
        places=[_place(found, i) for i in range(min(len(found.location), PLACES))],
        more=max(len(found.location) - PLACES, 0),
        axes=figures.by_axis(found),
        slot=found.slot,
        slot_words=words.slot(found),
        slot_chart=None if found.slot is None else figures.slot(found.slot),
        request=found.request,
        request_words=words.request(found),
        request_charts=[] if found.request is None else figures.request(found.request),
        lungs=[words.lung(match) for match in found.lungs],
        notes=found.notes,
        about=_about(found),
        version=ventbench.__version__,
    )


def bars(found: Diagnosis) -> list[dict[str, Any]]:
    """Root mean square errors as bars: text, class, value and width in %."""
    one = found.open_loop
    rows = [("as given", "before", one.before.rmse), ("R and C refitted", "refit", one.refit.rmse)]
    if found.verdict != "nothing_missing":
        rows.append(("corrected", "after", one.after.rmse))
    rows.append(("noise of the measurement", "noise", one.noise_floor))
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


def groups(found: Diagnosis) -> list[dict[str, Any]]:
    """Rows of the table of distances: all breaths first, then each part."""
    one = found.open_loop
    everything = {"before": one.before, "refit": one.refit, "after": one.after}
    rows = [("all", everything), *one.groups.items()]
    keys = [key for key, _, _ in _stages(found)]
    return [
        {"name": name, "cells": [_cell(values.get(key)) for key in keys]} for name, values in rows
    ]


def _stages(found: Diagnosis) -> list[tuple[str, str, str]]:
    return [x for x in breaths.STAGES if x[0] != "after" or found.verdict != "nothing_missing"]


def _cell(distance: Distance | None) -> dict[str, str]:
    if distance is None:
        return {"rmse": "–", "mae": "–"}
    return {"rmse": _number(distance.rmse), "mae": _number(distance.mae)}


def _named(item: Named) -> dict[str, Any]:
    """A mechanism for the table."""
    about = mechanism(item.name).description
    meanings = {parameter.name: parameter.meaning for parameter in about.parameters}
    return {
        "name": item.name,
        "title": about.title,
        "equation": about.equation,
        "signature": about.signature,
        "changed": item.changed,
        "confidence": f"{100 * item.confidence:.0f} %",
        "alternatives": item.alternatives,
        "parameters": [
            (meanings.get(key, key), quantity.quantity(value, f"{item.name}.{key}"))
            for key, value in item.parameters.items()
        ],
    }


def _place(found: Diagnosis, index: int) -> dict[str, str]:
    place = found.location[index]
    return {
        "text": words.location(place, found.noise[0]),
        "share": f"{100 * place.share:.0f} %",
        "p": quantity.probability(place.p_value),
    }


def _about(found: Diagnosis) -> list[tuple[str, str]]:
    recorded = found.traces.breaths
    held = int(np.count_nonzero(found.traces.held_out))
    sd, correlation = found.noise
    rows = [
        ("ventbench", ventbench.__version__),
        ("simulator", found.plant),
        ("recording", recorded.source or "in memory"),
        ("its SHA-256", recorded.sha256 or ""),
        ("breaths", f"{len(recorded)}, of which {held} were held out of every fit"),
        ("lungs", ", ".join(recorded.by_lung_index)),
        ("noise", f"{sd:.3g} cmH2O, correlation of neighbouring samples {correlation:.2f}"),
        ("computed in", f"{found.seconds:.0f} s"),
    ]
    return [(name, text) for name, text in rows if text]


def _number(value: float) -> str:
    return f"{value:.2f}" if np.isfinite(value) else "–"
