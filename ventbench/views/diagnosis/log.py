"""A diagnosis as a rerun recording: traces of every breath, errors by breath, maps of the error."""

from __future__ import annotations

import tempfile
import uuid
from pathlib import Path

import numpy as np
import rerun as rr

from ventbench.diagnosis import report_text
from ventbench.diagnosis.result import Diagnosis
from ventbench.errors import InputError
from ventbench.text import escape_markdown
from ventbench.views import style
from ventbench.views.diagnosis.breaths import STAGES, rmse
from ventbench.views.diagnosis.layout import ABOUT, TIMELINE, blueprint, span
from ventbench.views.runs import Floats

APPLICATION = "ventbench"

#: Colours of the three simulators, and of the recording, on dark and light ground.
COLORS = {
    "before": style.TARGET_COLOR,
    "refit": style.PIP_COLORS[5],
    "after": style.PIP_COLORS[1],
    "recorded": style.PIP_COLORS[2],
}

#: Pixels of a map for each sample and breath.
_ZOOM = 6


def recording(found: Diagnosis) -> bytes:
    """Return a whole ``.rrd`` file.

    Entities, for each lung: ``/<lung>/pressure/{recorded,before,refit,after}``,
    ``/<lung>/error/{before,refit,after}`` (recorded - simulated), ``/<lung>/u_in``,
    ``/<lung>/u_out``, ``/<lung>/held_out``, breaths end to end on the timeline;
    ``/by_breath/{before,refit,after}``, ``/map/{refit,after}`` and ``/about``.

    Raises:
        InputError: if rerun is switched off by its environment variable.
    """
    stream = rr.RecordingStream(APPLICATION, recording_id=uuid.uuid4())
    if not rr.is_enabled(stream):
        raise InputError("rerun is switched off by the environment variable RERUN; unset it")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "diagnosis.rrd")
        stream.save(file, default_blueprint=blueprint(found))
        stream.send_recording_name(f"diagnosis of {plain(found.simulator)}")
        text = rr.TextDocument(markdown(found), media_type=rr.MediaType.MARKDOWN)
        stream.log(ABOUT, text, static=True)
        for lung, index in found.traces.breaths.by_lung_index.items():
            log_lung(stream, found, lung, index)
        log_by_breath(stream, found)
        log_maps(stream, found)
        stream.disconnect()  # writes the rest and the footer
        return file.read_bytes()


def plain(text: str) -> str:
    """Text that the viewer's font can show: it ends itself over a character it lacks."""
    return "".join(c if " " <= c <= "~" or "\xa1" <= c <= "\u017e" else "?" for c in text)


def markdown(found: Diagnosis) -> str:
    """The text panel: the diagnosis in words, and what is seen."""
    verdict, *others = (escape_markdown(plain(text)) for text in report_text.sentences(found))
    places = [
        escape_markdown(report_text.error_region(place, found.noise[0]))
        for place in found.location[:5]
    ]
    lines = [f"## {verdict}", "", *(f"{text}\n" for text in others)]
    if places:
        lines += ["## Where the refitted simulator errs", "", *(f"- {text}" for text in places), ""]
    lines += [
        "## What you see",
        "",
        "- the first tab: the held-out breath on which the refitted simulator errs most",
        "- a lung's tab: all its breaths end to end; "
        "**green**: recorded, **grey**: simulator as given, **orange**: R and C refitted, "
        "**blue**: corrected; the bar at the bottom marks breaths that no fit has seen",
        "- error: recorded minus simulated, cmH2O",
        "- Errors by breath: root mean square of each breath's inspiration, cmH2O; each "
        "simulator on its own scale",
        "- Maps: one row a breath, time to the right; red: simulated too low, blue: too high",
    ]
    return "\n".join(lines) + "\n"


def log_lung(stream: rr.RecordingStream, found: Diagnosis, lung: str, index: np.ndarray) -> None:
    """Traces of one lung's breaths, laid end to end."""
    traces = found.traces
    breaths = traces.breaths.select(index)
    start = np.arange(len(index))[:, None] * span(found)
    time = (start + breaths.time).ravel()
    order = breaths.valid.ravel()

    def send(entity: str, values: Floats, name: str, color: str, width: float) -> None:
        look = rr.SeriesLines(
            colors=[style.rgb(color)],
            widths=[width],
            names=[name],
            interpolation_mode="StepAfter" if entity.startswith("u_") else "Linear",
        )
        stream.log(f"/{lung}/{entity}", look, static=True)
        stream.send_columns(
            f"/{lung}/{entity}",
            indexes=[rr.TimeColumn(TIMELINE, duration=time[order])],
            columns=rr.Scalars.columns(scalars=np.ravel(values).astype(float)[order]),
        )

    send("pressure/recorded", breaths.pressure, "recorded", COLORS["recorded"], 3.0)
    for key, text, _ in _stages(found):
        simulated = getattr(traces, key)[index]
        send(f"pressure/{key}", simulated, text, COLORS[key], 1.5)
        send(f"error/{key}", breaths.pressure - simulated, text, COLORS[key], 1.5)
    send("u_in", breaths.u_in, "u_in, %", style.PIP_COLORS[4], 1.5)
    send("u_out", np.asarray(breaths.u_out, float), "u_out, 1 open", style.PIP_COLORS[0], 1.5)
    held = np.where(traces.held_out[index][:, None] & breaths.valid, 0.0, np.nan)
    send("held_out", held, "held out of every fit", style.REFERENCE_COLORS[0], 6.0)


def log_by_breath(stream: rr.RecordingStream, found: Diagnosis) -> None:
    """Root mean square errors of every breath, in the order of the recording."""
    number = np.arange(1, len(found.traces.breaths) + 1)
    for key, _, _ in _stages(found):
        values = np.nan_to_num(rmse(found.traces, getattr(found.traces, key)))
        bars = rr.BarChart(values, color=style.rgb(COLORS[key]), abscissa=number)
        stream.log(f"/by_breath/{key}", bars, static=True)


def log_maps(stream: rr.RecordingStream, found: Diagnosis) -> None:
    """Errors of all breaths as pictures on one scale of colours, the first breath on top."""
    traces = found.traces
    errors = {key: traces.breaths.pressure - getattr(traces, key) for key, _, _ in _stages(found)}
    errors.pop("before")
    refit = np.abs(errors["refit"][np.isfinite(errors["refit"])])
    top = max(3.0 * found.noise[0], float(np.quantile(refit, 0.98)) if refit.size else 0.0, 0.1)
    for key, error in errors.items():
        picture = np.repeat(np.repeat(diverging(error / top), _ZOOM, axis=0), _ZOOM, axis=1)
        stream.log(f"/map/{key}", rr.Image(picture), static=True)


def diverging(share: Floats) -> np.ndarray:
    """Blue below zero, white at zero, red above; grey where unknown, uint8 ``(..., 3)``."""
    known = np.clip(np.nan_to_num(share), -1.0, 1.0)[..., None]
    red, blue = np.array(style.rgb("#c4370a")), np.array(style.rgb("#0065b3"))
    end = np.where(known > 0, red, blue)
    color = 255.0 + np.abs(known) * (end - 255.0)
    return np.where(np.isfinite(share)[..., None], color, 128.0).round().astype(np.uint8)


def _stages(found: Diagnosis) -> list[tuple[str, str, str]]:
    return [x for x in STAGES if x[0] != "after" or found.verdict != "nothing_missing"]
