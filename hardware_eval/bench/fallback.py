"""A fallback that takes over when an entry is late or about to leave its envelope, and hands back.

Simplex: the entry commands as long as the safe controller could still rescue the lung after its
command. Whether it could is asked of a set of rigs that span the right ones: R, C and the valve's
gain off by so much, a resistor that is linear or parabolic, a valve that is quick or slow. On each
the pressure ``j`` steps after a reading ``p`` is at most ::

    p + e + D(g u[j]) - D(g u[0]) + g dt / C (u[1] + ... + u[j])

with the noise ``e``, the commands ``u`` whose flow is seen then, and the resistor's drop ``D``. It
is monotonic in 1/C and in R, and its largest value over R and g lies at their ends, whichever way
the flow changes. Every reading of the last steps gives such a bound, as does the volume that can be
left of the breath before; the least of them holds. After the entry's command the safe controller
closes the valve. The command is inside the envelope if then on no rig the pressure that remains is
above the protocol's limit, and on none the pressure, with the breath's readings before, is above it
for longer than the safety gate allows. Each rig is judged by itself: a late valve shows a peak late
and a quick one soon, but none shows it twice.

A peak that a resistor makes in a step or two passes the gate, and on rigs that are all right it is
here and there twice as high. No bound of R tells it without refusing commands that do no harm: it
is left to the device, which vents at 60 cmH2O at once. In the first steps of a breath no reading
tells the drop of its flow; there, the pressure that remains decides. ``python
benchmarks/hardware_guards.py`` prints how often the fallback is wrong.

The fallback is the paper's PI of the labelled lung, cut to the largest command that is inside.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from hardware_eval.bench.plan import CONTROL_GAINS
from hardware_eval.bench.safety import VALVE_GAIN
from ventbench.base.arrays import Floats
from ventbench.mechanics.labels import APPARATUS, TOLERANCE_R
from ventbench.task import protocol
from ventbench.task.lungs import Lung
from ventbench.task.metrics import measured
from ventbench.task.metrics.score import is_brief, safety_limit


@dataclass(frozen=True)
class FallbackSettings:
    """Bounds and habits of the fallback; written into every record.

    Attributes:
        R, C, gain: factors by which a rig may differ from its label and from the nominal valve;
            a test lung keeps within about half of that.
        apparatus: resistance of tubes and filters, cmH2O/(L/s).
        outlet: largest resistance of the expiratory valve, cmH2O/(L/s).
        delays: shares of a command's flow that the readings 1, 2 and 3 steps later show; of 192
            rigs of the population with R 20, 98 % still show 0.25 to 1.10 of a flow one step after
            its end, and 0 to 0.08 two steps after it.
        noise: most by which a reading is too low, cmH2O.
        readings: newest readings that bound the future.
        hand_back: answers in a row, in time and inside, after which the entry commands again.
    """

    R: float = TOLERANCE_R
    C: float = 1.15
    gain: float = 1.15
    apparatus: float = APPARATUS
    outlet: float = 10.0
    delays: tuple[tuple[float, ...], ...] = (
        (1.0, 0.0, 0.0),
        (0.5, 0.5, 0.0),
        (0.0, 1.0, 0.0),
        (0.0, 0.8, 0.2),
    )
    noise: float = 1.0
    readings: int = 4
    hand_back: int = 3

    @property
    def last(self) -> int:
        """Steps after which a command shows for the last time."""
        return len(self.delays[0])


#: Those of every bench.
BOUNDS = FallbackSettings()


@dataclass(frozen=True)
class FallbackState:
    """State between two steps; with the lung alone, before the first breath, at rest.

    Attributes:
        lung: label of the mounted lung.
        commands: of this inspiration, oldest first, behind those that were on their way when it
            began, %.
        pressures: readings of this inspiration, cmH2O; NaN where there was none.
        residual: most that the lung can have held when it began, as a pressure, cmH2O.
        integral: the PI's average of the error, cmH2O.
        active: whether the fallback commands.
        good: answers in a row that were in time and inside.
        taken: steps that the fallback has commanded.
        outside: answers that were not inside.
        episode, longest: steps in a row that it commands, now and at most.
    """

    lung: Lung
    commands: tuple[float, ...] = ()
    pressures: tuple[float, ...] = ()
    residual: float = protocol.PEEP
    integral: float = 0.0
    active: bool = False
    good: int = 0
    taken: int = 0
    outside: int = 0
    episode: int = 0
    longest: int = 0


def step(
    state: FallbackState,
    time_step: int,
    pressure: float,
    pip: float,
    answer: float | None,
    before: float,
) -> tuple[FallbackState, float]:
    """Choose between the entry's command and the fallback's, at a step of an inspiration.

    Args:
        state: of a lung at rest, or of the step before.
        time_step: step of the breath, from 0.
        pressure: reading, cmH2O; NaN if there is none.
        pip: target, cmH2O.
        answer: the entry's command, %; None if it is late.
        before: command in force before this step, %.

    Returns:
        The next state, and the command, %.
    """
    if time_step == 0:
        state = _begun(state, pressure, before)
    state = replace(state, pressures=(*state.pressures, pressure))
    known = math.isfinite(pressure)
    error = pip - pressure if known else 0.0
    share = protocol.DT / (protocol.DT + 0.5)
    integral = state.integral + share * (error - state.integral) if known else state.integral
    # Nothing is safer than a valve that is closed.
    outside = bool(answer) and answer > 0.0 and not is_inside(state, pip, answer)
    good = 0 if answer is None or outside else state.good + 1
    active = not good or (state.active and good <= BOUNDS.hand_back)
    if active or answer is None:
        P, I = CONTROL_GAINS[state.lung.id]  # noqa: E741 - the field's names
        wanted = min(max(P * error + I * integral, 0.0), protocol.U_MAX) if known else before
        command = largest_inside(state, pip, wanted)
    else:
        command = answer
    episode = state.episode + 1 if active else 0
    return replace(
        state,
        commands=(*state.commands, command),
        integral=integral,
        active=active,
        good=good,
        taken=state.taken + active,
        outside=state.outside + outside,
        episode=episode,
        longest=max(state.longest, episode),
    ), command


def _begun(state: FallbackState, pressure: float, before: float) -> FallbackState:
    """The state at the first step of an inspiration; ``before`` is the bias flow's command."""
    residual, late = protocol.PEEP, BOUNDS.last
    if seen := [x for x in state.pressures if math.isfinite(x)]:
        R, C, gain = _most(state.lung)
        filled = seen[-1] + BOUNDS.noise + gain * protocol.DT / C * sum(state.commands[-late:])
        emptied = (protocol.BREATH_STEPS - protocol.INSPIRATION_STEPS) * protocol.DT
        slowest = 1e-3 * state.lung.C * BOUNDS.C * (R + BOUNDS.outlet)
        residual += max(filled - protocol.PEEP, 0.0) * math.exp(-emptied / slowest)
    if math.isfinite(pressure):
        residual = max(residual, pressure)
    return replace(
        state,
        commands=(before,) * late,
        pressures=(),
        integral=0.0,
        residual=residual + BOUNDS.noise,
    )


def _most(lung: Lung) -> tuple[float, float, float]:
    """Most of R, cmH2O/(L/s), least of C, mL/cmH2O, most of the gain, mL/s per %."""
    R = lung.R * BOUNDS.R + BOUNDS.apparatus
    return R, lung.C / BOUNDS.C, VALVE_GAIN * BOUNDS.gain


def reachable(state: FallbackState, answer: float) -> Floats:
    """Highest pressures on each rig if the valve takes an answer for a step and is then closed.

    Args:
        state: with the reading of this step.
        answer: command, %.

    Returns:
        Bound of each next step until all flow has ended, cmH2O, shape ``(rigs, last + 1)``.
    """
    R_most, C, gain_most = _most(state.lung)
    last = BOUNDS.last
    newest = len(state.pressures) - 1  # this step
    sent = np.array([*state.commands, answer, *[0.0] * (last + 1)])
    # Command whose flow each reading shows, from the inspiration's first on, by delay.
    by_lag = [sent[last - lag : len(sent) - lag] for lag in range(1, last + 1)]
    shown = np.array(BOUNDS.delays) @ np.stack(by_lag)
    ahead = newest + np.arange(1, last + 2)
    R = np.array([state.lung.R / BOUNDS.R, R_most])[:, None, None, None]
    gain = VALVE_GAIN * np.array([1.0 / BOUNDS.gain, BOUNDS.gain])
    flows = 1e-3 * gain[:, None, None] * shown  # L/s
    drops = R * np.stack([flows, flows**2])[:, None]  # linear, parabolic: (2, R, gain, delay, k)
    stored = np.cumsum(shown, axis=1) * gain_most * protocol.DT / C
    risen = (drops + stored).reshape(-1, len(sent) - last)
    # Since the inspiration began, with what may be left of the breath before.
    least = state.residual + risen[:, ahead]
    for k in range(max(last, newest + 1 - BOUNDS.readings), newest + 1):
        if math.isfinite(state.pressures[k]):
            bound = state.pressures[k] + BOUNDS.noise + risen[:, ahead] - risen[:, k : k + 1]
            least = np.minimum(least, bound)
    return least


def is_inside(state: FallbackState, pip: float, answer: float) -> bool:
    """Whether no rig within the bounds comes to harm by a command, if the valve closes after it."""
    ahead = reachable(state, answer)
    if ahead[:, -1].max() > safety_limit(pip):
        return False
    if len(state.pressures) <= BOUNDS.last:  # no reading tells the resistor's drop yet
        return True
    seen = np.broadcast_to(measured.worst(state.pressures), (len(ahead), len(state.pressures)))
    return bool(is_brief(np.concatenate([seen, ahead], axis=1), pip, protocol.DT).all())


def largest_inside(state: FallbackState, pip: float, wanted: float) -> float:
    """The largest command up to ``wanted`` that is inside, %; 0 if none is."""
    if is_inside(state, pip, wanted):
        return wanted
    low, high = 0.0, wanted
    for _ in range(10):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if is_inside(state, pip, middle) else (low, middle)
    return low
