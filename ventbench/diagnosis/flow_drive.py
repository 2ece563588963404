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
from ventbench.physics.model import Physics, physics
from ventbench.plants.simulators import OnePlant, PlantsByLung, PlantSimulators, Simulators
from ventbench.plants.stacking import nominal_plants, open_loop_breaths
from ventbench.recordings.bad_samples import noise_of
from ventbench.recordings.breaths import FILL, Breaths, stack, stack_times, valid_mask
from ventbench.system_id.data import Data
from ventbench.task.interfaces import Plant

#: Parts of the ventilator, on which a prescribed flow has no bearing; and clocks of the commands.
_VENTILATOR = ("command", "inspiratory valve", "supply", "expiratory valve")
_CLOCKS = ("clock_offset", "clock_skew")

#: Interval of the readings that are used, s, as far as whole samples allow, and most readings of a
#: breath.
_READINGS, _MOST = 0.03, 150

#: Time before a reading, s, in which the flow stands as it is at the reading: a mean over the whole
#: interval would lag, and R times that lag is pressure.
_AT_READING = 0.0002

#: Share of the noise of a flow that smoothing leaves at most, by the tests of it.
_LEFT = 0.7

#: Least share of a breath's samples that need a flow or volume, and largest share of the volume
#: that it takes in that gaps may leave open: about what noise is of the pressure.
_MIN_RECORDED, _MAX_OPEN = 0.5, 0.01


def lacks_commands(breaths: Breaths) -> bool:
    """Whether no valve command was recorded, but flow or volume was."""
    recorded = breaths.flow is not None or breaths.volume is not None
    return recorded and not np.any(breaths.u_in[breaths.valid] > 0)


def with_flow(breaths: Breaths) -> tuple[Breaths, list[str]]:
    """Breaths whose ``flow`` has no gaps and whose ``u_in`` stands for the flow; and notes.

    ``u_in`` is the command at which the base model's valve has the mean flow until the next sample;
    it is negative while gas leaves.

    Raises:
        InputError: if no breath has flow or volume in its first sample, in at least half of all,
            and where the flow changes.
    """
    flow, notes = _recorded_flow(breaths)
    recorded = np.isfinite(flow) & breaths.valid
    good = recorded.sum(axis=1) >= _MIN_RECORDED * breaths.valid.sum(axis=1)
    good &= recorded[:, 0]
    for i in np.flatnonzero(good):
        good[i] = _open(breaths.time[i, recorded[i]], flow[i, recorded[i]]) <= _MAX_OPEN
    if not good.any():
        raise InputError(
            "no breath has flow or volume in its first sample, in at least half of all, and where "
            "the flow changes; begin each breath with a row that has a flow"
        )
    if not good.all():
        notes.append(
            f"{int((~good).sum())} breaths without flow, or with gaps in it, were left out."
        )
    filled = np.zeros_like(flow)
    pressure = breaths.pressure.copy()
    for i in np.flatnonzero(good):
        filled[i] = np.interp(breaths.time[i], breaths.time[i, recorded[i]], flow[i, recorded[i]])
        last = np.flatnonzero(recorded[i])[-1]
        pressure[i, last + 1 :] = np.nan  # what flowed there is unknown
    return _commanding(replace(breaths, pressure=pressure), filled).select(good), notes


def _commanding(breaths: Breaths, flow: Floats) -> Breaths:
    """Breaths with a flow, mL/s, ``(n, T)``, for which ``u_in`` stands."""
    ahead = np.concatenate([flow[:, 1:], flow[:, -1:]], axis=1)
    return replace(breaths, flow=flow, u_in=0.5 * (flow + ahead) / _gain())


def _recorded_flow(breaths: Breaths) -> tuple[Floats, list[str]]:
    """Flow of each sample, mL/s, ``(n, T)``, if need be from the volume; and notes."""
    if breaths.flow is not None and np.isfinite(breaths.flow).any():
        return breaths.flow, []
    if breaths.volume is None:
        raise InputError("the recording has neither flow nor volume to drive a diagnosis with")
    pairs = zip(breaths.volume, breaths.time, strict=True)
    flow = np.stack([np.gradient(volume, time) for volume, time in pairs])
    return flow, ["Flow is the derivative of the recorded volume."]


def _smooth(flow: Floats) -> Floats:
    """Flow of a breath without most of its noise, mL/s, ``(T,)``."""
    smooth = without_noise(flow)
    smooth[0] = flow[0]  # the rise behind it must not bias what the breath begins with
    return smooth


def _open(time: Floats, flow: Floats) -> float:
    """Share of the volume that a breath takes in that the gaps of its flow leave open.

    Over a gap, the flow may keep either of its ends.
    """
    step = np.diff(time)
    gap = np.maximum(step - 1.5 * np.median(step), 0.0)
    inhaled = np.sum(step * np.maximum(0.5 * (flow[1:] + flow[:-1]), 0.0))
    return float(np.sum(0.5 * gap * np.abs(np.diff(flow))) / max(inhaled, 1e-9))


def drive_grid(breaths: Breaths) -> tuple[Breaths, Ints]:
    """Breaths on the grid that a fit uses, with a shut expiratory valve.

    Between two readings the command stands for the mean of the flow, and shortly before a reading
    for what it is there, both less its noise; ``flow`` has that.

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
        time, raw = breaths.time[i, :length], breaths.flow[i, :length]  # type: ignore[index]
        flow = _smooth(raw)
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
        rows["flow"].append(np.interp(nodes, time, raw))
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


def begun(data: Data, driven: Breaths) -> Data:
    """Data of breaths that begin with their flow, and with a pressure that all readings tell.

    What the lung holds as a breath begins is the first reading less R times a flow with noise. A
    fit that took that reading for sure would look for effects that make up for the noise.
    """
    weight, measured = data.weight.copy(), data.measured.copy()
    weight[:, 0, 0] = 0.0
    measured[measured[:, 0, 0] == 0.0, 0, 0] = 1e-9  # zero would be a reading that there is not
    return replace(data, weight=weight, measured=measured, initial_flow=initial_flow(driven))


def initial_flow(driven: Breaths) -> Floats:
    """Flow into the lung at the first sample, mL/s, ``(n,)``: not zero where gas is trapped."""
    assert driven.flow is not None
    return driven.flow[:, 0]


def of_noise(driven: Breaths, R: Floats) -> Floats:
    """Pressure of the noise that smoothing took off the flow, cmH2O, ``(n, T)``.

    Smoothing is wrong where the flow bends. Under the flow as it was recorded, errors are larger
    and have the mean zero if nothing is missing.

    Args:
        driven: breaths of :func:`drive_grid`.
        R: fitted resistance, cmH2O/(L/s), ``(n,)``; NaN where none is.
    """
    assert driven.flow is not None
    noise = driven.flow[:, 1:] - _gain() * driven.u_in[:, :-1]
    return np.pad(np.nan_to_num(1e-3 * R[:, None] * noise), ((0, 0), (1, 0)))


def most_alike(driven: Breaths) -> Ints:
    """Other breath whose flow differs least in mean square from that of each, ``(n,)``.

    Noise of a flow is in what is simulated: sorted by that, it alone would have a mean error. The
    values of another breath sort as well without it.
    """
    assert driven.flow is not None
    rows = np.ma.masked_array(driven.flow, ~driven.valid)
    distances = np.stack([np.ma.mean((rows - row) ** 2, axis=1).filled(np.inf) for row in rows])
    np.fill_diagonal(distances, np.inf)
    return np.argmin(distances, axis=1)


def trapped_gas_notes(driven: Breaths, R: Floats) -> list[str]:
    """What the lungs hold above the airway as breaths end, in a sentence, where it is notable.

    Args:
        driven: breaths of :func:`drive_grid`.
        R: fitted resistance, cmH2O/(L/s), ``(n,)``; NaN where none is.
    """
    assert driven.flow is not None
    last = driven.valid.sum(axis=1, keepdims=True) - 1
    typical = float(np.median(-1e-3 * R * np.take_along_axis(driven.flow, last, axis=1)[:, 0]))
    if not typical >= mechanism("trapped_gas").description.least:  # nor where it is unknown
        return []
    return [
        f"Gas still leaves the lung as breaths end: by R and the flow, {typical:.2g} cmH2O of "
        "trapped gas (auto-PEEP; median). The model begins with what the flow shows of it."
    ]


def simulate(simulators: Simulators, recorded: Breaths, driven: Breaths, index: Ints) -> Floats:
    """Pressures of a simulator under the recorded flow, on the grid of a fit, cmH2O, ``(n, T)``.

    Args:
        simulators: functions of commands get the flow, less its noise, as ``flow`` and as the
            ``u_in`` of a linear valve.
        recorded: breaths of :func:`with_flow`.
        driven: the same on the grid of :func:`drive_grid`.
        index: recorded sample of each of its samples.

    Raises:
        InputError: if the simulator's valve cannot be driven by a flow.
    """
    if not isinstance(simulators, PlantSimulators):
        smooth = np.stack([_smooth(flow) for flow in recorded.flow])  # type: ignore[union-attr]
        pressures = simulators.pressures(_commanding(recorded, smooth))
        return np.take_along_axis(pressures, index, axis=1)
    if simulators.is_base_physics or isinstance(simulators, OnePlant | PlantsByLung):
        return open_loop_breaths(lambda part: _breathing(simulators, part), driven)
    raise InputError(
        f"the recording has no valve command, and {simulators.name} needs one; diagnose physics, "
        "a Python function or simulated pressures"
    )


def _breathing(simulators: Simulators, driven: Breaths) -> Plant:
    """Plants of breaths; those of the library start at the breaths' flow, others at rest."""
    base = simulators.is_base_physics  # breaths of it are quicker by a model that starts at rest
    plant = nominal_plants(physics, driven) if base else simulators.for_breaths(driven)
    flow = initial_flow(driven)
    return plant.having(initial_flow=flow) if isinstance(plant, Physics) else plant


def ventilator_side() -> tuple[str, ...]:
    """Mechanisms of the ventilator's side, of which nothing can be said."""
    return (*filter(_is_of_ventilator, library()), *_CLOCKS)


def _is_of_ventilator(name: str) -> bool:
    return mechanism(name).description.site in _VENTILATOR


def lung_side_settings(settings: SelectionConfig, breaths: Breaths) -> SelectionConfig:
    """Settings for the lung's side of these breaths, and for the noise of their flow.

    What noise of the flow adds up to is slow, and no sign of physics that slow noise hides: nothing
    is searched at white noise.
    """
    chosen = settings.search.nonparametric_terms
    terms = tuple(t for t in (chosen or basis_terms()) if not _is_of_ventilator(t))
    flow = _recorded_flow(breaths)[0]
    noise = float(np.median([noise_of(x) for x in flow]))
    search = replace(
        settings.search, nonparametric_terms=terms, ventilator=(), drive_noise=_LEFT * noise
    )
    return replace(settings, search=search)


def _volume_at(nodes: Floats, time: Floats, flow: Floats, volume: Floats) -> Floats:
    """Volume at any times under a flow that is linear between its samples, ``(k,)``."""
    k = np.clip(np.searchsorted(time, nodes, side="right") - 1, 0, len(time) - 2)
    passed = nodes - time[k]
    slope = (flow[k + 1] - flow[k]) / (time[k + 1] - time[k])
    return volume[k] + passed * (flow[k] + 0.5 * slope * passed)


def _gain() -> float:
    """Flow of the base model's valve, mL/s per %."""
    return float(parameter("gain").neutral)
