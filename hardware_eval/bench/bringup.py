"""Bring-up: before anything runs on a machine, a person confirms what its parts do.

What a configuration says of pins, polarity and sensor may be of another revision of the hardware.
So the sensor is read open to the room and at a pressure that a person applies, each valve is
clicked without saying which, and a vent is watched as it lowers a pressure. Only then a device that
is not simulated is armed by anything else (:meth:`hardware_eval.wire.client.Client.arm`), and only
as long as it tells the same number and the same hash of wiring and calibration.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from random import SystemRandom
from typing import Any

import numpy as np

from hardware_eval.bench import dated
from hardware_eval.bench.drive import Commands, Program, drive, in_turn
from hardware_eval.bench.identity import white_noise
from hardware_eval.bench.loop import Bench
from hardware_eval.bench.selftest import Finding, judged, unknown
from hardware_eval.wire.client import Client
from ventbench.base import VERSION
from ventbench.base.arrays import Floats
from ventbench.base.errors import InputError
from ventbench.task import protocol

FORMAT, REMEDY = "ventbench-bringup-1", "ventbench-hardware bringup --port PORT"

#: What is looked at, in this order: no valve moves before the sensor is right.
STEPS = ("room", "reference", "expiratory", "inspiratory", "vent")

#: Pressure above which the device vents meanwhile, cmH2O.
_LIMIT = 30.0

#: Pressures that a person may apply, cmH2O: enough to tell a slope, and no lung is on.
_APPLIED = (10.0, 60.0)

#: Readings of which a pressure is the mean.
_READINGS = 60

#: A click: opening of the inspiratory valve, %, steps between two movements, and clicks.
_CLICK, _PERIOD, _CLICKS = 40.0, 16, 3

#: Lung for the checks of the drive; any label will do where little gas flows.
_ANY_LUNG = "R20C20"

#: The vent: steps at rest, opening, %, rise after which both valves close, cmH2O, longest filling,
#: steps closed, and steps vented: in 3 s the slowest lung (R50C50, 2.75 s) loses two thirds.
_LEAD, _OPENING, _RISE, _FILLING, _CLOSED, _VENTING = 10, 5.0, 10.0, 100, 10, 110

_VALVES = {1.0: "inspiratory", 2.0: "expiratory", 3.0: "both", 0.0: "none"}


def is_confirmed(findings: Sequence[Finding]) -> bool:
    """Whether all steps were gone, and each was right."""
    return len(findings) >= len(STEPS) and all(x.ok for x in findings)


def keep(client: Client, operator: str, findings: Sequence[Finding]) -> dict[str, Any]:
    """Write what a person found on a device; returns it, with the file and its hash."""
    content = {
        "format": FORMAT,
        "device": client.identity.device,
        "date": dated.today().isoformat(timespec="seconds"),
        "operator": operator,
        "version": VERSION,
        "go": is_confirmed(findings),
        "findings": [x.as_dict() for x in findings],
    }
    path = place(content["device"])
    return {**content, "file": str(path), "sha256": dated.save(path, content)}


def place(device: dict[str, str]) -> Path:
    """Where this computer keeps the bring-up of a device."""
    import typer

    return Path(typer.get_app_dir("ventbench")) / "bringup" / f"{device['device_id']}.json"


def load(client: Client) -> dict[str, Any]:
    """The bring-up of a device, with its hash; from here on the client may arm it.

    Raises:
        InputError: if there is none, or it is stale, was changed, or not confirmed.
    """
    device = client.identity.device
    path = place(device)
    if not path.exists():
        raise InputError(
            f"device {device['device_id']} was never brought up: nobody has confirmed what its "
            f"valves and its sensor do. Run `{REMEDY}`"
        )
    found = dated.load(path, FORMAT, device, REMEDY)
    dated.check_age(found["date"], "the bring-up of this device", REMEDY)
    if found.get("go") is not True:
        raise InputError(f"{path}: the bring-up was not confirmed. Run `{REMEDY}`")
    client.brought_up = device
    return found


def bring_up(bench: Bench) -> list[Finding]:
    """Walk a person through all steps; one that is wrong ends it.

    Afterwards the client may arm the device if all was right, and else may not.

    Raises:
        EmergencyStop: if the person pressed the key.
        InputError: if nobody is there to answer.
        LinkError: if the device is lost.
    """
    client = bench.client
    client.brought_up = None
    client.hello(_LIMIT)
    clicks = list(STEPS[2:4])
    SystemRandom().shuffle(clicks)
    findings: list[Finding] = []
    for step in (*STEPS[:2], *clicks, STEPS[-1]):
        findings += look(bench, step)
        if not all(x.ok for x in findings):
            break
    client.hello()
    if is_confirmed(findings):
        client.brought_up = client.identity.device
    return findings


def look(bench: Bench, step: str) -> list[Finding]:
    """Take one of :data:`STEPS`; the device is vented before and after, and may not be armed."""
    if step == "room":
        return _room(bench)
    if step == "reference":
        return _reference(bench)
    bench.client.brought_up = bench.client.identity.device
    try:
        return _vent(bench) if step == "vent" else _clicked(bench, step)
    finally:
        bench.client.brought_up = None


def vented(bench: Bench, count: int) -> tuple[Floats, Floats]:
    """Pressures, cmH2O, and flows, mL/s, of a vented device, one each control step."""
    client, clock, taken = bench.client, bench.clock, []
    client.vent()
    start = clock.now()
    for step in range(count):
        clock.sleep_until(start + step * protocol.DT)
        taken.append(client.heartbeat())
    return np.array([x.pressure for x in taken]), np.array([x.flow for x in taken])


def _asked(bench: Bench, name: str, question: str) -> list[Finding]:
    """Nothing if a person confirms, else why the step was not taken."""
    if bench.operator.confirm(question):
        return []
    return [unknown(name, "not confirmed")]


def _room(bench: Bench) -> list[Finding]:
    question = "air supply off, no lung, the sensor's tube open to the room. Is it so?"
    if refused := _asked(bench, "room", question):
        return refused
    read, _ = vented(bench, _READINGS)
    if not np.isfinite(read).all():
        return [unknown("room", "the sensor gives no pressure")]
    mean, noise = float(read.mean()), white_noise(read)
    found = [judged("room", mean, f"{mean:.2f} cmH2O open to the room")]
    if not np.ptp(read):
        text = f"{len(read)} readings are equal to the last digit: it is frozen, or not connected"
        return [*found, Finding("sensor_noise", 0.0, False, text)]
    return [*found, judged("sensor_noise", noise, f"{noise:.2f} cmH2O of noise")]


def _reference(bench: Bench) -> list[Finding]:
    low, high = _APPLIED
    applied = bench.operator.number(
        f"apply a steady pressure of {low:g} to {high:g} cmH2O to the sensor, such as a water "
        "column; what does the reference show, cmH2O? "
    )
    if not low <= applied <= high:
        text = f"{applied:g} cmH2O tell no slope: apply {low:g} to {high:g}"
        return [unknown("reference", text)]
    shown = float(vented(bench, _READINGS)[0].mean())
    text = f"{shown:.2f} cmH2O where the reference shows {applied:g}"
    found = judged("reference", shown / applied, text)
    if found.ok:
        return [found]
    return [replace(found, text=f"{text}: the slope is another sensor's, or its tube is off")]


def at_open_tube(bench: Bench) -> Bench:
    """A bench whose checks do not miss the pressure, as there is none at an open tube."""
    return replace(bench, settings=replace(bench.settings, open_tube=True), rest=0.5)


def _clicked(bench: Bench, valve: str) -> list[Finding]:
    if refused := _asked(bench, "clicked", "air supply off. A valve will click; listen. Ready?"):
        return refused
    moved = (_PERIOD, 0.0, 0) if valve == "expiratory" else (_PERIOD, _CLICK, 1)
    clicks = in_turn(_LIMIT, *[(_PERIOD, 0.0, 1), moved] * _CLICKS)
    driven = drive(at_open_tube(bench), _ANY_LUNG, clicks)
    if driven.trips:
        return [unknown("clicked", f"{valve}: {driven.trips[0]}")]
    answer = bench.operator.number(
        "which valve clicked? 1 inspiratory, 2 expiratory, 3 both, 0 none: "
    )
    heard = _VALVES.get(answer, "neither")
    text = f"{valve} ordered, {heard} clicked"
    if heard != valve:
        text += ": the pins are not those of this machine"
    return [judged("clicked", float(heard == valve), text)]


def _filled_and_vented() -> Commands:
    """Fill until the pressure has risen, close both valves, and vent."""
    before, filled = math.nan, -1

    def commands(step: int, pressure: float) -> tuple[float, int]:
        nonlocal before, filled
        if step < _LEAD:
            before = pressure
            return 0.0, 1
        if filled < 0 and step < _LEAD + _FILLING and not pressure > before + _RISE:
            return _OPENING, 0
        filled = step if filled < 0 else filled
        return 0.0, int(step >= filled + _CLOSED)

    return commands


def _vent(bench: Bench) -> list[Finding]:
    question = "connect a test lung with a relief valve, air supply on, low. Ready to fill it?"
    if refused := _asked(bench, "rise", question):
        return refused
    steps = _LEAD + _FILLING + _CLOSED + _VENTING
    program = Program(_filled_and_vented(), steps, _LIMIT)
    driven = drive(replace(at_open_tube(bench), rest=1.0), _ANY_LUNG, program)
    closed = driven.u_out == 0.0
    if not closed.any():
        return [unknown("rise", "; ".join(driven.trips))]
    before = float(driven.pressure[:_LEAD].mean())
    peak = float(driven.pressure[closed].max())
    text = f"the pressure rose by {peak - before:.1f} cmH2O"
    rise = judged("rise", peak - before, text)
    if not rise.ok:
        text += ": the supply is off, the inspiratory valve does not open, or the expiratory one "
        return [replace(rise, text=text + "is open when it should be closed (polarity?)")]
    left = (float(driven.pressure[-_LEAD:].mean()) - before) / (peak - before)
    text = f"{100.0 * left:.0f} % of it was left after {_VENTING * protocol.DT:.1f} s of venting"
    vent = judged("vented", left, text)
    if driven.trips or not vent.ok:
        text = "; ".join((text, *driven.trips)) + ": the vent does not open (pin? polarity?)"
        vent = replace(vent, ok=False, text=text)
    return [rise, vent]
