"""Diagnosis of recordings without a valve command: the recorded flow drives the model instead.

What enters the lung's side of the circuit is then known, so that nothing can be said of the valves;
everything behind the flow sensor (airway, lung, leak, tubing, pressure sensor) is diagnosed as
usual. The model's expiratory valve stays shut, and gas leaves by the measured negative flow.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ventbench.base.arrays import Floats, Ints
from ventbench.base.errors import InputError
from ventbench.diagnosis.jumps import without_noise
from ventbench.diagnosis.settings import SelectionConfig
from ventbench.physics.catalogue import basis_terms, library, mechanism, parameter
from ventbench.plants.simulators import OnePlant, PlantsByLung, PlantSimulators, Simulators
from ventbench.recordings.breaths import FILL, Breaths, stack, stack_times, valid_mask

#: Parts of the ventilator, on which a prescribed flow has no bearing; and clocks of the commands.
_VENTILATOR = ("command", "inspiratory valve", "supply", "expiratory valve")
_CLOCKS = ("clock_offset", "clock_skew")

#: Interval of the readings that are used, s, as far as whole samples allow, and most readings of a
#: breath.
_READINGS, _MOST = 0.03, 150

#: Time before a reading, s, in which the flow stands as it is at the reading: a mean over the whole
#: interval would lag, and R times that lag is pressure.
_AT_READING = 0.0002

#: Least share of a breath's samples that need a flow or volume.
_MIN_RECORDED = 0.5


def lacks_commands(breaths: Breaths) -> bool:
    """Whether no valve command was recorded, but flow or volume was."""
    recorded = breaths.flow is not None or breaths.volume is not None
    return recorded and not np.any(breaths.u_in[breaths.valid] > 0)


def with_flow(breaths: Breaths) -> tuple[Breaths, list[str]]:
    """Breaths whose ``flow`` has no gaps and whose ``u_in`` stands for the flow; and notes.

    ``u_in`` is the command at which the base model's valve has the mean flow until the next sample;
    it is negative while gas leaves.

    Raises:
        InputError: if no breath has flow or volume in at least half of its samples.
    """
    notes, flow = [], breaths.flow
    if flow is not None and not np.isfinite(flow).any():
        flow = None
    if flow is None:
        if breaths.volume is None:
            raise InputError("the recording has neither flow nor volume to drive a diagnosis with")
        flow = np.stack(
            [np.gradient(v, t) for v, t in zip(breaths.volume, breaths.time, strict=True)]
        )
        notes.append("Flow is the derivative of the recorded volume.")
    recorded = np.isfinite(flow) & breaths.valid
    good = recorded.sum(axis=1) >= _MIN_RECORDED * breaths.valid.sum(axis=1)
    if not good.any():
        raise InputError("no breath has flow or volume in at least half of its samples")
    if not good.all():
        notes.append(f"{int((~good).sum())} breaths without flow were left out.")
    filled = np.zeros_like(flow)
    pressure = breaths.pressure.copy()
    for i in np.flatnonzero(good):
        measured = without_noise(flow[i, recorded[i]])
        filled[i] = np.interp(breaths.time[i], breaths.time[i, recorded[i]], measured)
        last = np.flatnonzero(recorded[i])[-1]
        pressure[i, last + 1 :] = np.nan  # what flowed there is unknown
    ahead = np.concatenate([filled[:, 1:], filled[:, -1:]], axis=1)
    u_in = 0.5 * (filled + ahead) / _gain()
    complete = replace(breaths, flow=filled, u_in=u_in, pressure=pressure)
    return complete.select(good), notes


def drive_grid(breaths: Breaths) -> tuple[Breaths, Ints]:
    """Breaths on the grid that a fit uses, with a shut expiratory valve.

    Between two readings the flow stands at its mean, and shortly before a reading as it is there.

    Args:
        breaths: n breaths of :func:`with_flow`.

    Returns:
        The breaths, with blank pressures at the samples that are no readings; and the recorded
        sample at or before each sample, ``(n, T)``.
    """
    rows: dict[str, list[Floats]] = {name: [] for name in ("time", "u_in", "pressure", "flow")}
    places, counts = [], []
    for i in range(len(breaths)):
        length = int(breaths.valid[i].sum())
        time, flow = breaths.time[i, :length], breaths.flow[i, :length]  # type: ignore[index]
        step = float(np.median(np.diff(time)))  # even readings, so that few substeps suffice
        every = step * max(int(_READINGS / step + 1e-6), -int(-time[-1] // (_MOST * step)), 1)
        picked = np.searchsorted(time, np.arange(0.0, time[-1], every) - 0.25 * step)
        picked = np.unique(np.append(picked, length - 1))
        at = time[picked]
        gap = np.diff(at)
        before = at[1:] - np.minimum(_AT_READING, 0.1 * gap)
        nodes = np.sort(np.concatenate([at, before]))
        volume = np.concatenate([[0.0], np.cumsum(0.5 * (flow[1:] + flow[:-1]) * np.diff(time))])
        means = np.diff(_volume_at(nodes, time, flow, volume)) / np.diff(nodes)
        pressure = np.full(len(nodes), np.nan)
        pressure[::2] = breaths.pressure[i, :length][picked]
        rows["time"].append(nodes)
        rows["u_in"].append(np.append(means, flow[-1]) / _gain())
        rows["pressure"].append(pressure)
        rows["flow"].append(np.interp(nodes, time, flow))
        places.append(np.searchsorted(time, nodes + 1e-9) - 1)
        counts.append(len(nodes))
    lengths = np.array(counts)
    time, dt = stack_times(np.concatenate(rows["time"]), lengths)
    width = time.shape[1]
    driven = replace(
        breaths,
        time=time,
        dt=dt,
        u_in=stack(np.concatenate(rows["u_in"]), lengths, FILL["u_in"]),
        u_out=np.zeros((len(breaths), width), np.int8),
        pressure=stack(np.concatenate(rows["pressure"]), lengths, np.nan),
        flow=stack(np.concatenate(rows["flow"]), lengths, np.nan),
        volume=None,
        valid=valid_mask(lengths),
    )
    index = np.stack([np.append(p, np.full(width - len(p), p[-1])) for p in places])
    return driven, index


def simulate(simulators: Simulators, recorded: Breaths, driven: Breaths, index: Ints) -> Floats:
    """Pressures of a simulator under the recorded flow, on the grid of a fit, cmH2O, ``(n, T)``.

    Args:
        simulators: functions of commands get the flow as ``flow`` and as the ``u_in`` of a linear
            valve.
        recorded: breaths of :func:`with_flow`.
        driven: the same on the grid of :func:`drive_grid`.
        index: recorded sample of each of its samples.

    Raises:
        InputError: if the simulator's valve cannot be driven by a flow.
    """
    if not isinstance(simulators, PlantSimulators):
        return np.take_along_axis(simulators.pressures(recorded), index, axis=1)
    if simulators.is_base_physics or isinstance(simulators, OnePlant | PlantsByLung):
        return simulators.pressures(driven)
    raise InputError(
        f"the recording has no valve command, and {simulators.name} needs one; diagnose physics, "
        "a Python function or simulated pressures"
    )


def ventilator_side() -> tuple[str, ...]:
    """Mechanisms of the ventilator's side, of which nothing can be said."""
    return (*filter(_is_of_ventilator, library()), *_CLOCKS)


def _is_of_ventilator(name: str) -> bool:
    return mechanism(name).description.site in _VENTILATOR


def lung_side_settings(settings: SelectionConfig) -> SelectionConfig:
    """Settings whose nonparametric terms are those of the lung's side.

    What noise of the flow adds up to is slow, and no sign of physics that slow noise hides: nothing
    is searched at white noise.
    """
    chosen = settings.search.nonparametric_terms
    terms = tuple(t for t in (chosen or basis_terms()) if not _is_of_ventilator(t))
    return replace(
        settings, search=replace(settings.search, nonparametric_terms=terms, ventilator=())
    )


def _volume_at(nodes: Floats, time: Floats, flow: Floats, volume: Floats) -> Floats:
    """Volume at any times under a flow that is linear between its samples, ``(k,)``."""
    k = np.clip(np.searchsorted(time, nodes, side="right") - 1, 0, len(time) - 2)
    passed = nodes - time[k]
    slope = (flow[k + 1] - flow[k]) / (time[k + 1] - time[k])
    return volume[k] + passed * (flow[k] + 0.5 * slope * passed)


def _gain() -> float:
    """Flow of the base model's valve, mL/s per %."""
    return float(parameter("gain").neutral)
