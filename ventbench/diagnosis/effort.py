"""Evidence for efforts of the patient, which differ from breath to breath.

Amplitude and onset are each breath's own, so that a likelihood at their best values proves nothing.
They are integrated out: amplitude is Gaussian, onset one of a grid, and a breath may have none.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ventbench.diagnosis.linear import Local
from ventbench.system_id.data import Floats

EFFORT = "patient_effort"

#: Onsets, s, durations, s, amplitude of a template and its prior standard deviation, cmH2O, and
#: the share of breaths that have an effort.
ONSETS = tuple(0.1 * k for k in range(0, 17))
_DURATIONS = (0.4, 0.6, 0.8, 1.0, 1.3)
_AMPLITUDE, WIDTH, SHARE = 1.0, 3.0, 0.6


class Evidence(NamedTuple):
    """Log Bayes factor of efforts in each breath, and the likeliest effort.

    Attributes:
        nats: ``(n,)``.
        duration: s, that of the largest sum.
        amplitude: cmH2O, expected at the likeliest onset, ``(n,)``.
        onset: s, the likeliest, ``(n,)``.
    """

    nats: Floats
    duration: float
    amplitude: Floats
    onset: Floats


def evidence(place: Local, duration: float | None = None) -> Evidence:
    """Integrate efforts out of the breaths of a linearised hypothesis.

    Args:
        place: of the breaths.
        duration: of the efforts, s; the best of a grid if not given.
    """
    return of_all([place], duration)[0]


def of_all(places: list[Local], duration: float | None = None) -> list[Evidence]:
    """The same of one hypothesis at several noises, which share what is predicted."""
    best: list[Evidence] = []
    for length in _DURATIONS if duration is None else (duration,):
        found = _at(places, length)
        best = best or found
        best = [new if new.nats.sum() > old.nats.sum() else old
                for new, old in zip(found, best, strict=True)]  # fmt: skip
    return best


def _at(places: list[Local], duration: float) -> list[Evidence]:
    answers = _answers(places[0], duration)
    return [_of(place, duration, answers) for place in places]


def _answers(place: Local, duration: float) -> list[Floats]:
    """What an effort at each onset changes, ``(n, c, T)``."""
    simulator = place.problem.simulator
    columns = [simulator.names.index(f"{EFFORT}.{p}") for p in ("amplitude", "onset", "duration")]
    points = np.repeat(place.values[None], len(ONSETS), axis=0)
    for point, onset in zip(points, ONSETS, strict=True):
        point[:, columns] = (_AMPLITUDE, onset, duration)
    return list(simulator.predict_all(points) - place.seen)


def _of(place: Local, duration: float, answers: list[Floats]) -> Evidence:
    logs, means = [], []
    for answer in answers:
        white = place.whitened(answer)
        template = place.without_own(white[:, None])[:, 0]
        power = np.sum(template**2, axis=1)
        match = -np.sum(place.residual * template, axis=1)
        precision = (_AMPLITUDE / WIDTH) ** 2
        logs.append(0.5 * match**2 / (power + precision) - 0.5 * np.log1p(power / precision))
        means.append(match / (power + precision) * _AMPLITUDE)
    log_factors, amplitudes = np.stack(logs, 1), np.stack(means, 1)
    mixed = np.logaddexp.reduce(log_factors, axis=1) - np.log(len(ONSETS)) + np.log(SHARE)
    top = np.argmax(log_factors, axis=1)
    nats = np.logaddexp(np.log(1.0 - SHARE), mixed)
    rows = np.arange(len(top))
    return Evidence(nats, duration, amplitudes[rows, top], np.asarray(ONSETS)[top])
