"""A scored run as a rerun recording: one ``log_*`` function an idea."""

from __future__ import annotations

import tempfile
import uuid
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import rerun as rr

from ventbench.errors import InputError
from ventbench.trajectories import Trajectories
from ventbench.views import about, style
from ventbench.views.blueprint import ABOUT, TIMELINE, blueprint, reference_path
from ventbench.views.runs import Floats, distinct, labels, scored

APPLICATION = "ventbench"


def recording(runs: Sequence[Trajectories]) -> bytes:
    """Return a whole ``.rrd`` file.

    Entities: ``/<lung>/{target,pressure,u_in,u_out,error,scored}`` of the first run, one value a
    PIP; ``/compare/<name>/<lung>/{pressure,u_in,u_out,error}`` of the others; ``/about``.

    Args:
        runs: matching runs, the one to look at first.

    Raises:
        InputError: if rerun is switched off by its environment variable.
    """
    names = shown_names(runs)
    layout = blueprint(runs, names)
    stream = rr.RecordingStream(APPLICATION, recording_id=uuid.uuid4())
    if not rr.is_enabled(stream):
        raise InputError("rerun is switched off by the environment variable RERUN; unset it")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "run.rrd")
        stream.save(file, default_blueprint=layout)
        stream.send_recording_name(names[0])
        log_about(stream, runs, names)
        log_target(stream, runs[0])
        log_scored(stream, runs[0])
        log_run(stream, runs[0])
        for index in range(1, len(runs)):
            log_reference(stream, runs[index], names[index], index - 1)
        stream.disconnect()  # writes the rest and the footer
        return file.read_bytes()


def shown_names(runs: Sequence[Trajectories]) -> list[str]:
    """Labels that the viewer's font can show: it ends itself over a character it lacks."""
    known = [
        "".join(c if " " <= c <= "~" or "\xa1" <= c <= "\u017e" else "?" for c in label)
        for label in labels(runs, cut="...")
    ]
    return distinct(known)


def log_about(stream: rr.RecordingStream, runs: Sequence[Trajectories], names: list[str]) -> None:
    """The text panel: what is seen, and the score table."""
    text = about.markdown(runs, names)
    stream.log(ABOUT, rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN), static=True)


def log_target(stream: rr.RecordingStream, run: Trajectories) -> None:
    """Target pressure of every lung, one line a PIP."""
    series = ["target, cmH2O"] * len(run.pips)
    for lung, values in zip(run.lungs, run.target, strict=True):
        _send(stream, f"/{lung}/target", run.time, values, series, [style.TARGET_COLOR], 1.0)


def log_scored(stream: rr.RecordingStream, run: Trajectories) -> None:
    """A bar along the bottom of every plot where the run is scored."""
    bar = np.where(scored(), 0.0, np.nan)[None]
    for lung in run.lungs:
        _send(stream, f"/{lung}/scored", run.time, bar, ["scored part"], [style.SCORED_COLOR], 6.0)


def log_run(stream: rr.RecordingStream, run: Trajectories) -> None:
    """Pressure, valves and error of every lung, one line a PIP in that PIP's colour."""
    colors = [style.pip_color(j) for j in range(len(run.pips))]
    for quantity, unit, array in _quantities(run):
        series = [f"PIP {pip:g}, {unit}" for pip in run.pips]
        for lung, values in zip(run.lungs, array, strict=True):
            _send(stream, f"/{lung}/{quantity}", run.time, values, series, colors, 2.0)


def log_reference(stream: rr.RecordingStream, run: Trajectories, name: str, index: int) -> None:
    """The same of a run to compare with: thin, one colour, under its name."""
    colors = [style.REFERENCE_COLORS[index % len(style.REFERENCE_COLORS)]]
    for quantity, unit, array in _quantities(run):
        series = [f"{name}, {unit}"] * len(run.pips)
        for lung, values in zip(run.lungs, array, strict=True):
            entity = reference_path(name, lung, quantity)
            _send(stream, entity, run.time, values, series, colors, 1.2)


def _quantities(run: Trajectories) -> tuple[tuple[str, str, Floats], ...]:
    return (
        ("pressure", "cmH2O", run.pressure),
        ("u_in", "%", run.u_in),
        ("u_out", "0/1", run.u_out),
        ("error", "cmH2O", run.pressure - run.target),
    )


def _send(
    stream: rr.RecordingStream,
    entity: str,
    time: Floats,
    values: Floats,
    series: list[str],
    colors: list[str],
    width: float,
) -> None:
    """Style once, values in bulk; ``values`` has shape ``(series, T)``."""
    n = len(series)
    look = rr.SeriesLines(
        colors=[style.rgb(colors[i % len(colors)]) for i in range(n)],
        widths=[width] * n,
        names=series,
        # A valve holds its command until the next step.
        interpolation_mode="StepAfter" if entity.endswith(("/u_in", "/u_out")) else "Linear",
    )
    stream.log(entity, look, static=True)
    stream.send_columns(
        entity,
        indexes=[rr.TimeColumn(TIMELINE, duration=time)],
        columns=rr.Scalars.columns(scalars=np.ascontiguousarray(values.T, dtype=float)),
    )
