"""Which mechanisms planned breaths could tell apart, before anything is recorded.

The response to planned commands is simulated without any mechanism and with each at its mild
strength. What a refit of R, C, R_ex, PEEP and each breath's start absorbs is projected out, in the
metric of the noise. Half of what is left, squared, is the log-likelihood, nats, that the mechanism
is worth. Of a pair, what is left of one after the other is refitted too, with all of its
parameters and the sign that it can have, is what tells them apart; the smaller of both directions
counts. (Fault isolability by sensitivities: the angle between residual subspaces.)
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from ventbench.base.errors import InputError, InputTypeError
from ventbench.diagnosis.experiment_design import Contrast, Rig, families, project_out
from ventbench.diagnosis.settings import DEFAULT
from ventbench.physics.catalogue import library, mechanism, parameter, paths, strength_path
from ventbench.physics.mechanism import REFITTED
from ventbench.recordings.breaths import Breaths
from ventbench.simulation import Controls, read_controls
from ventbench.system_id import START, Data, Noise, Predictor, parameter_values
from ventbench.system_id.data import Floats
from ventbench.task import protocol
from ventbench.task.lungs import lung as parse_lung

#: What may be measured, and the channel of each.
SENSORS = ("pressure", "flow")

#: Share of the other parameters of a mechanism by which they are moved for their derivatives.
_STEP = 0.1


@dataclass(frozen=True)
class Pair:
    """Two mechanisms that the plan cannot tell apart, or one that it cannot show."""

    names: tuple[str, ...]  #: both, or the one.
    nats: float  #: log-likelihood by which the plan tells them apart, or shows it.
    #: the least that would, a sensor or one further breath in words; None if none does.
    remedy: str | None
    gained: float  #: nats with it; with the best there is if it is not enough.


@dataclass(frozen=True)
class Isolability:
    """What a plan can tell."""

    lung: str  #: label.
    sensors: tuple[str, ...]  #: what is measured.
    threshold: float  #: nats from which a mechanism is detectable.
    #: nats that each mechanism is worth at its mild strength, by name.
    detectable: dict[str, float]
    #: nats by which each pair of detectable mechanisms differs.
    nats: dict[tuple[str, str], float]
    confused: tuple[Pair, ...]  #: the pairs below the threshold, the closest first.
    unseen: tuple[Pair, ...]  #: mechanisms that the plan would not show at a mild strength.
    #: detectable mechanisms, those in one group that pairs below the threshold join.
    groups: tuple[tuple[str, ...], ...]

    def __repr__(self) -> str:
        """Lung, sensors and groups."""
        groups = "; ".join(" ~ ".join(names) for names in self.groups if len(names) > 1) or "none"
        return (
            f"<Isolability of {self.lung}, {' and '.join(self.sensors)}: not told apart {groups}>"
        )

    def as_dict(self) -> dict[str, Any]:
        """JSON values."""
        pairs = [{"names": list(names), "nats": value} for names, value in self.nats.items()]
        return asdict(self) | {"nats": pairs}


def isolability(
    controls: Controls | Sequence[Controls] | Breaths | Path | str,
    *,
    lung: str = "R20C50",
    sensors: Sequence[str] = ("pressure",),
    noise: Mapping[str, float] | None = None,
    names: Iterable[str] | None = None,
    threshold: float = DEFAULT.held_out_test.threshold,
) -> Isolability:
    """Tell which mechanisms planned breaths can tell apart.

    Args:
        controls: planned breaths: one, several, those of a recording, or a CSV file of them
            (``u_in``, and perhaps ``u_out``, ``time_step`` and ``breath_id``).
        lung: label of the lung.
        sensors: ``"pressure"``, ``"flow"`` or both.
        noise: standard deviations, cmH2O and mL/s, by sensor; 0.25 and 20 if not given.
        names: mechanisms to compare; the library without patient effort if None.
        threshold: nats from which something is told: odds of a hundred to one.

    Raises:
        InputError: if a command, a sensor or a name is wrong.

    Examples:
        >>> from ventbench.diagnosis.isolability import isolability
        >>> told = isolability("plan.csv", lung="R20C20")  # doctest: +SKIP
        >>> told.groups  # doctest: +SKIP
    """
    if not sensors or not set(sensors) <= set(SENSORS):
        raise InputError(f"sensors {', '.join(sensors)}: choose among {', '.join(SENSORS)}")
    chosen = tuple(names or (name for name in library() if name != "patient_effort"))
    for name in chosen:
        mechanism(name)  # says what there is if the name is wrong
    planned = controls
    if isinstance(planned, str | Path):
        planned = read_controls(planned, by_breath=True)
    if isinstance(planned, Breaths):
        rows = zip(planned.time, planned.u_in, planned.u_out, planned.valid, strict=True)
        planned = [
            Controls(t[mask], u[mask], np.asarray(out[mask], float)) for t, u, out, mask in rows
        ]
    planned = [planned] if isinstance(planned, Controls) else planned
    if not isinstance(planned, list | tuple) or not all(isinstance(x, Controls) for x in planned):
        expected = "breaths, a CSV file of them, or ventbench.simulation.Controls"
        raise InputTypeError("controls", controls, expected)
    if not planned:
        raise InputError("no breath is planned: controls is empty")
    label = parse_lung(lung)
    dt = float(np.median(np.concatenate([breath.dt for breath in planned])))
    rig = Rig(label.R, label.C, float(parameter("gain").neutral), protocol.PEEP)
    samples = max(len(breath.time) for breath in planned)
    kinds = families(rig, samples, dt)
    further = [
        (kind.title, Controls(np.arange(samples, dtype=np.float64) * dt, u_in, u_out))
        for kind in kinds
        for u_in, u_out in zip(kind.u_in, kind.u_out, strict=True)
    ]
    every = [*planned, *(breath for _, breath in further)]
    data = _data(every, len(planned), label.R, label.C, samples)
    sigma = dict(zip(SENSORS, Noise().sigma, strict=True)) | dict(noise or {})
    white = Noise((sigma["pressure"], sigma["flow"]), tail=np.inf)
    now = _Responses(data, chosen, sensors, white)
    both = now if "flow" in sensors else _Responses(data, chosen, SENSORS, white)
    plan = list(range(len(planned)))
    detectable = {name: now.worth(name, plan) for name in chosen}
    detected = [name for name in chosen if detectable[name] >= threshold]
    nats = {pair: now.apart(*pair, plan) for pair in combinations(detected, 2)}

    def remedy(measure: Callable[[_Responses, list[int]], float]) -> tuple[str | None, float]:
        options = [
            (f"one breath: {title}", measure(now, [*plan, len(planned) + k]))
            for k, (title, _) in enumerate(further)
        ]
        best = max(options, key=lambda option: option[1])
        if best[1] < threshold and "flow" not in sensors:
            best = max(best, ("also measure flow", measure(both, plan)), key=lambda o: o[1])
        return (best[0] if best[1] >= threshold else None), best[1]

    confused = [
        Pair(pair, value, *remedy(lambda space, which, pair=pair: space.apart(*pair, which)))
        for pair, value in sorted(nats.items(), key=lambda item: item[1])
        if value < threshold
    ]
    unseen = [
        Pair((name,), value, *remedy(lambda space, which, name=name: space.worth(name, which)))
        for name, value in detectable.items()
        if value < threshold
    ]
    return Isolability(
        label.id,
        tuple(sensors),
        threshold,
        detectable,
        nats,
        tuple(confused),
        tuple(unseen),
        _groups(detected, confused),
    )


def _data(breaths: Sequence[Controls], planned: int, R: float, C: float, samples: int) -> Data:
    """Breaths without readings; short ones end with an open expiratory valve that nobody reads."""
    n = len(breaths)
    u_in, u_out, weight = np.zeros((n, samples)), np.ones((n, samples)), np.zeros((n, 2, samples))
    dt = np.full((n, samples), float(np.median(breaths[0].dt)))
    for k, breath in enumerate(breaths):
        count = len(breath.time)
        u_in[k, :count], u_out[k, :count], dt[k, :count] = breath.u_in, breath.u_out, breath.dt
        weight[k, :, :count] = 1.0
    weight[:, 1, 0] = 0.0
    ones: Floats = np.ones(n)
    position = np.minimum(np.arange(n) / max(planned - 1, 1), 1.0)  # further breaths come last
    readings, at_rest = np.zeros((n, 2, samples)), np.zeros(n)
    return Data(u_in, u_out, dt, readings, weight, R * ones, C * ones, position, at_rest)


class _Responses:
    """Changes of the response by each mechanism, and what a refit of the rest leaves of them."""

    def __init__(
        self, data: Data, names: Sequence[str], sensors: Sequence[str], noise: Noise
    ) -> None:
        simulator = Predictor(data, paths(tuple(names)))
        start = np.full(len(data), protocol.PEEP)
        values = parameter_values(data, simulator.names, {START: start})
        first, slopes = simulator.derivatives(
            values, tuple((*simulator.names, START).index(path) for path in (*REFITTED, START))
        )
        columns = [slopes[:, k] for k in range(len(REFITTED))]
        self._of: dict[str, list[int]] = {}
        for name in names:
            mild = _mild(name)
            perturbed = [simulator.predict(_with(values, simulator.names, mild))]
            for path in mild:
                if path != strength_path(name):
                    rescaled = mild | {path: mild[path] * (1.0 + _STEP)}
                    perturbed.append(simulator.predict(_with(values, simulator.names, rescaled)))
            changes = [
                perturbed[0] - first,
                *(response - perturbed[0] for response in perturbed[1:]),
            ]
            self._of[name] = list(range(len(columns), len(columns) + len(changes)))
            columns += changes
        weight = data.weight * np.array([[sensor in sensors] for sensor in SENSORS])
        white = noise.whiten(np.stack([*columns, slopes[:, -1]], axis=1), weight)
        white = white.reshape(*white.shape[:2], -1)
        self._columns, self._noise = project_out(white[:, :-1], white[:, -1:]), noise

    def worth(self, name: str, breaths: Sequence[int]) -> float:
        """Nats that a mechanism is worth after a refit."""
        return self._refit(name, [], breaths)[0]

    def apart(self, first: str, second: str, breaths: Sequence[int]) -> float:
        """Nats by which two mechanisms are told apart, in the worse of both directions."""
        return min(self._against(first, second, breaths), self._against(second, first, breaths))

    def _against(self, true: str, rival: str, breaths: Sequence[int]) -> float:
        nats, weights = self._refit(true, self._of[rival], breaths)
        strength = mechanism(rival).description.strength
        is_bounded = not strength.low < strength.neutral < strength.high
        return self.worth(true, breaths) if is_bounded and weights[0] < 0.0 else nats

    def _refit(
        self, name: str, rivals: Sequence[int], breaths: Sequence[int]
    ) -> tuple[float, Floats]:
        """Nats of a mechanism after rivals are refitted too, and the weights of these first."""
        rows = [*rivals, *range(len(REFITTED))]
        information = np.zeros((len(rows), len(rows)))  # nothing is recorded yet
        change = self._columns[:, self._of[name][0]]
        return Contrast(change, self._columns[:, rows], information, self._noise).refit(
            np.array(breaths)
        )


def _mild(name: str) -> dict[str, float]:
    parameters = mechanism(name).description.parameters
    return {f"{name}.{p.name}": float(p.mild) for p in parameters if not p.shape}


def _with(values: Floats, names: tuple[str, ...], changes: Mapping[str, float]) -> Floats:
    changed = values.copy()
    for path, value in changes.items():
        changed[:, names.index(path)] = value
    return changed


def _groups(names: Sequence[str], confused: Sequence[Pair]) -> tuple[tuple[str, ...], ...]:
    """Sets of names that confused pairs join, the largest first."""
    group = {name: {name} for name in names}
    for pair in confused:
        joined = group[pair.names[0]] | group[pair.names[1]]
        for name in joined:
            group[name] = joined
    groups = {tuple(sorted(members)) for members in group.values()}
    return tuple(sorted(groups, key=lambda members: (-len(members), members)))
