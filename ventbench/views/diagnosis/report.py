"""The HTML report of a diagnosis: one file, no script, nothing from the network."""

from __future__ import annotations

from typing import Any

import jinja2
import numpy as np

import ventbench
from ventbench.diagnosis import report_text
from ventbench.diagnosis.findings import MissingMechanism, OpenLoopError
from ventbench.diagnosis.result import Diagnosis
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
    lead = [*map(report_text.missing_mechanism, found.mechanisms), report_text.effect(found)]
    lead += [report_text.nonparametric_term(found), report_text.open_loop(found)]
    return environment.get_template("diagnosis.html.j2").render(
        verdict=report_text.verdict(found),
        lead=[text for text in lead if text],
        plant=found.simulator,
        light=style.RUN_COLORS,
        dark=style.RUN_COLORS_DARK,
        mechanisms=[_named(item) for item in found.mechanisms],
        alternatives=report_text.alternatives(found),
        bars=bars(found),
        groups=groups(found),
        corrected=found.verdict != "nothing_missing",
        held_out=len(found.open_loop.held_out_breaths),
        stages=_stages(found),
        panels=breaths.panels(found),
        places=[_place(found, i) for i in range(min(len(found.location), PLACES))],
        more=max(len(found.location) - PLACES, 0),
        axes=figures.by_axis(found),
        slot=found.nonparametric,
        slot_words=report_text.nonparametric_term(found),
        slot_chart=None if found.nonparametric is None else figures.slot(found.nonparametric),
        request=found.request,
        request_words=report_text.request(found),
        request_charts=[] if found.request is None else figures.request(found.request),
        lungs=[report_text.lung(match) for match in found.lungs],
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


def _cell(distance: OpenLoopError | None) -> dict[str, str]:
    if distance is None:
        return {"rmse": "–", "mae": "–"}
    return {"rmse": _number(distance.rmse), "mae": _number(distance.mae)}


def _named(item: MissingMechanism) -> dict[str, Any]:
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
            (meanings.get(key, key), report_text.quantity(value, f"{item.name}.{key}"))
            for key, value in item.parameters.items()
        ],
    }


def _place(found: Diagnosis, index: int) -> dict[str, str]:
    place = found.location[index]
    return {
        "text": report_text.error_region(place, found.noise[0]),
        "share": f"{100 * place.share:.0f} %",
        "p": report_text.probability(place.p_value),
    }


def _about(found: Diagnosis) -> list[tuple[str, str]]:
    recorded = found.traces.breaths
    held = int(np.count_nonzero(found.traces.held_out))
    sd, correlation = found.noise
    rows = [
        ("ventbench", ventbench.__version__),
        ("simulator", found.simulator),
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
