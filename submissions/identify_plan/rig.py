"""A rig with a lung as numpy arithmetic: many of them side by side, one sample after another.

The physics is that of the published simulators: a valve with a curve, play, dead time and lag, the
compliance of the circuit, a lung with flow-dependent resistance and a curved recoil, an expiratory
valve that closes late, and a sensor with lag. ``make.py`` reads the means and the spread of its
parameters off the training rigs.
"""

import numpy as np

#: Commands at which the valve's curve has its knots, %.
KNOTS = np.array([0.0, 1.0, 2.0, 3.5, 5.0, 7.0, 10.0, 14.0, 19.0, 26.0, 36.0, 50.0, 70.0, 100.0])

#: V / C up to which the recoil has a table, cmH2O.
TOP = 80

#: Half-widths of the valve's plays, %, and the change of a command at which the sensor's answer to
#: its direction saturates, %.
PLAYS, DIRECTION = (0.7, 3.0, 10.0), 0.4

#: Past samples that the dead time can reach, and parts of a sample.
MEMORY, PARTS = 3, 3

#: What is identified: logarithms but for the last three (s, and cmH2O).
NAMES = ("R", "K2", "E", "gain", "low", "high", "closing", "delay", "start", "offset")


def simulate(rig, theta, dt, commands, lung):
    """Run inspirations from rest.

    Args:
        rig: fixed parameters by name.
        theta: parameters in the order of ``NAMES``, shape ``(n, len(NAMES))``.
        dt: control step, s.
        commands: %, shape ``(n, T)``.
        lung: which of the rig's recoils, shape ``(n,)``.

    Returns:
        Readings and airway pressures at the samples 0 to T, cmH2O, shape ``(n, T + 1)`` each.
    """
    n, steps = commands.shape
    R, K2, E, gain, low, high, closing = np.exp(theta[:, :7].T)
    delay, start, offset = np.maximum(theta[:, 7], 0.0), theta[:, 8], theta[:, 9]
    four_K2, R2 = 4.0 * K2, R * R
    h = dt / PARTS
    circuit, lag = rig["circuit"], rig["lag"]
    kept, smooth = np.exp(-h / lag), np.exp(-h / rig["sensor_lag"])
    lagging = lag / h * (1.0 - kept)
    # Share of each past change of the command that each part of a sample has already seen.
    ends = (delay[:, None] - dt * np.arange(MEMORY)) / h
    seen = np.clip(ends[:, :, None] - np.arange(PARTS), 0.0, 1.0)  # (n, MEMORY, PARTS)
    # The expiratory valve: open share in each part of the first samples.
    time = h * (np.arange(2 * PARTS) + 1.0)
    wide = np.exp(-np.maximum(time - rig["closing_delay"], 0.0) / rig["closing_lag"])
    wide = np.where(wide < 0.02, 0.0, wide)

    curve = rig["curve"]
    tables = rig["recoil"]
    table, row = tables.ravel(), (TOP + 1) * lung

    def valve(u):
        flow = np.interp(u, KNOTS, curve)
        small = np.interp(u, (0.0, 5.0, 20.0), (1.0, 1.0, 0.0))
        large = np.interp(u, (20.0, 60.0), (0.0, 1.0))
        return gain * flow * (1.0 + (low - 1.0) * small) * (1.0 + (high - 1.0) * large)

    rest = np.full(n, float(rig["rest"]))
    flow = valve(rest)
    behind = start - flow / closing
    elastic, drop, sensor = start + offset, -offset, start.copy()
    plays = [rest.copy() for _ in PLAYS]
    past = [flow] * (MEMORY + 1)
    before = rest
    shown, airway = np.empty((n, steps + 1)), np.empty((n, steps + 1))
    shown[:, 0] = airway[:, 0] = start
    recoil, slope = _recoil(table, row, elastic)
    for k in range(steps):
        u = commands[:, k]
        effective = u.copy()
        for i, half in enumerate(PLAYS):
            plays[i] = np.minimum(np.maximum(plays[i], u - half), u + half)
            effective += rig["direction"][i] * (plays[i] - u)
        asked = valve(np.maximum(effective, 0.0))
        past = [asked, *past[:MEMORY]]
        changes = [past[i + 1] - past[i] for i in range(MEMORY)]
        for part in range(PARTS):
            wanted = asked
            for i in range(MEMORY):
                wanted = wanted + changes[i] * seen[:, i, part]
            inflow = wanted + (flow - wanted) * lagging
            flow = wanted + (flow - wanted) * kept
            resistance = 0.5 * (R + np.sqrt(R2 + four_K2 * (np.abs(drop) + 1e-6)))
            at = k * PARTS + part
            rate = (1.0 / circuit + E * slope) / resistance
            if at < len(wide) and wide[at] > 0.0:
                outlet = closing * wide[at]
                rate = rate + outlet / circuit
                goal = (inflow - outlet * (recoil - behind)) / (circuit * rate)
            else:
                goal = inflow / (circuit * rate)
            decay = np.exp(-rate * h)
            away = drop - goal
            elastic = elastic + E * (goal * h + away * (1.0 - decay) / rate) / resistance
            rose, slope = _recoil(table, row, elastic)
            pressure = rose + goal + away * decay
            drop, recoil = pressure - rose, rose
            sensor = pressure + (sensor - pressure) * smooth
        change = np.tanh((u - before) / DIRECTION)
        before = u
        shown[:, k + 1] = sensor + np.where(change > 0, rig["rising"], rig["falling"]) * change
        airway[:, k + 1] = pressure
    return shown, airway


def _recoil(table, row, elastic):
    """Recoil, cmH2O, and its slope, of V / C, cmH2O; tables with a step of 1 cmH2O, a row each."""
    at = np.minimum(np.maximum(elastic, 0.0), TOP - 0.1)
    k = at.astype(int)
    low = table[row + k]
    slope = table[row + k + 1] - low
    return low + slope * (elastic - k), slope
