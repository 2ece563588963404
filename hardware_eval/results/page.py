"""The page of a session: one HTML file without script or network, from its log alone.

A session that is not finished has a page too, which says what is left.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import ventbench
from hardware_eval.bench.raw_log import LoggedBreath, Session, read_session
from hardware_eval.results import record, trial
from ventbench import palette
from ventbench.base import files
from ventbench.base.errors import InputError
from ventbench.base.interval import Interval
from ventbench.base.text import number, page_templates, plain
from ventbench.pages import panels
from ventbench.task import protocol, waveform

#: Files of the pages in a session's folder.
PAGE, ACCEPTANCE = "session.html", "acceptance.html"


def rendered(template: str, session: Session, **content: Any) -> str:
    """A page by a template of this room, which knows the session too."""
    sheet = page_templates("ventbench.pages").get_template("report.css.j2")
    given = {"colors": palette.css(), "run_colors": palette.RUNS, "shades": (), "names": ()}
    page = page_templates("hardware_eval.results").get_template(template)
    return page.render(
        style=sheet.render(**given, pips=session.plan.pips),
        session=session,
        plain=plain,
        sha256=files.sha256(session.path),
        version=ventbench.__version__,
        **content,
    )


def page(session: Session) -> str:
    """The page."""
    entries = session.plan.entries
    try:
        analysed = trial.analyse([session.path])
        missing = analysed.missing
    except InputError as error:
        analysed, missing = None, (str(error),)
    return rendered(
        "session.html.j2",
        session,
        trial=analysed,
        shown=shown,
        missing=missing,
        grids={name: _grid(session, name) for name in entries},
        timing={name: _timing(session, name) for name in entries},
        stopped=_stopped(session),
        control=record.control(session),
        skipped=_skipped(session),
        shown_breath=panels.BREATH + 1,
    )


def shown(value: Interval | float, sign: bool = False) -> str:
    """A figure with its interval, if it has one; a dash for none."""
    if not isinstance(value, Interval):
        value = Interval(value)
    if math.isnan(value.value):
        return "–"
    own, low, high = (number(x, 3, sign) for x in (value.value, value.low, value.high))
    return own if math.isnan(value.low) else f"{own} ({low} to {high})"


def _grid(session: Session, name: str) -> dict[str, list[dict[str, Any]]]:
    """Panels of an entry: a row for each lung, a column for each PIP, with all repeats."""
    runs = [x for x in session.breaths if x.run.entry == name and x.run.kind == "scored"]
    shown = [x for x in runs if x.breath == panels.BREATH and x.complete]
    return {
        lung: [
            _panel(pip, [x for x in shown if (x.run.lung, x.run.pip) == (lung, pip)])
            for pip in session.plan.pips
        ]
        for lung in session.lungs
    }


def _panel(pip: float, repeats: Sequence[LoggedBreath]) -> dict[str, Any]:
    steps = len(panels.TIMES)
    target = np.asarray(waveform.target(np.arange(steps), pip), float)
    pressures = [np.array(x.log.pressure[:steps]) for x in repeats]
    pressure, valve = panels.axes(target, panels.pressure_limits(target, pressures))
    for each, measured in zip(repeats, pressures, strict=True):
        pressure.line("p r0", panels.TIMES[: len(measured)], np.clip(measured, *pressure.y))
        u_in = each.log.u_in[:steps]
        valve.held("u r0", panels.TIMES[: len(u_in)], u_in)
    pressure.line("t", panels.TIMES, target)
    errors = [float(np.nanmean(np.abs(x[: protocol.INSPIRATION_STEPS] - pip))) for x in pressures]
    return {
        "pip": f"{pip:g}",
        "repeats": len(repeats),
        "error": number(float(np.mean(errors))) if errors else "no run",
        "charts": (pressure, valve),
        "above": panels.above(pressure, pressures),
    }


def _timing(session: Session, name: str) -> dict[str, Any]:
    """Late answers and fallbacks of an entry in all of its attempts, and what ran beside it."""
    runs = session.of_type("run", entry=name)
    beside = [x["beside"] for x in runs if x.get("beside")]
    try:
        figures: Any = record.timing(session, name)
    except InputError:  # no breath yet
        figures = None
    return {
        "figures": figures,
        "late": sum(x["late"] for x in beside),
        "asked": sum(x["asked"] for x in beside),
        "trips": sum(len(x.get("trips", ())) for x in runs),
    }


def _stopped(session: Session) -> Counter[tuple[str, str, float, str, str]]:
    """Attempts that did not complete, alike ones together: entry, lung, PIP, status and reason."""
    return Counter(
        (x["entry"], x["lung"], x["pip"], x["status"], plain(x["reason"]))
        for x in session.of_type("run")
        if x["status"] != "complete"
    )


def _skipped(session: Session) -> list[str]:
    """What was not done, a sentence each."""
    told = []
    if left := len(session.left):
        told.append(f"{left} of {len(session.plan.runs)} runs are left; `run` continues the plan.")
    if not any(x.get("simulated") for x in session.of_type("session")):
        told.append("There was no dry run, so that nothing is known of the simulation.")
    if not session.plan.control_every:
        told.append("No control ran, so that a drift of the bench would not show.")
    told += [
        f"Self-test of {line['lung']}: {', '.join(line['skipped'])} left out."
        for line in session.of_type("selftest")
        if line["skipped"]
    ]
    return list(dict.fromkeys(told))


def write(folder: Path, made: Callable[[Session], str] = page, name: str = PAGE) -> Path:
    """Write a page of a session beside its log; returns its path.

    Raises:
        InputError: if there is no session, or there is nothing to say of it.
    """
    session = read_session(folder)
    path = session.path.parent / name
    files.write_bytes(path, made(session).encode())
    return path
