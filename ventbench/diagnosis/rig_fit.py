"""Parameters of each rig of a recording, shrunk towards what its rigs have in common.

A recording of one lung may come from several rigs: ventilators of one design, each with a lung that
somebody set up. They lack the same physics, but not to the same degree. Which mechanisms act is
therefore decided by all breaths together; strengths, R, C, R_ex and PEEP are then fitted to each
rig. The logarithm of each (or the value itself, of what may be zero) is normal around a centre, R
and C around that of their lung. Centre and scatter are estimated with them (empirical Bayes by
expectation maximisation; Dempster, Laird and Rubin, 1977), so that a rig of which little was
recorded stays near the centre.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ventbench.base.arrays import Floats, Ints
from ventbench.diagnosis.evaluator import Evaluator, make_problem
from ventbench.diagnosis.hypothesis import FittedModel, Partition, make_partition, varies_by_breath
from ventbench.system_id.data import Data, Noise
from ventbench.system_id.levenberg_marquardt import minimise
from ventbench.system_id.predictor import START
from ventbench.system_id.problem import make_unknowns, parameter_of

#: Gain of the inspiratory valve, one of each breath, whose centre is that of all rigs.
_GAIN = "gain"

#: Parameters whose centre is that of the lung, not that of all rigs.
_OF_THE_LUNG = ("R", "C")

#: Standard deviation between rigs to start with (of the logarithm, or as a share of a mild effect),
#: and least one of a logarithm: a smaller one would end the search for it.
_SCATTER, _LEAST = 0.3, 0.01

#: Rounds in which parameters and scatter are estimated in turn; end of each search, nats and steps.
_ROUNDS, _TOLERANCE, _STEPS = 4, 0.05, 15


@dataclass(frozen=True, eq=False)
class RigFit:
    """Parameters of rigs."""

    fitted: FittedModel  #: the model of all rigs, with the same parameters.
    evaluator: Evaluator  #: evaluator with which it was fitted.
    rigs: Ints  #: the k rigs that were fitted.
    values: dict[str, Floats]  #: physical values by path, one for each rig, ``(k,)``.
    #: standard deviation between rigs, by path, of the logarithm of a parameter whose scale is
    #: logarithmic.
    scatter: dict[str, float]

    def pressures(self, data: Data, rigs: Ints, first: Floats) -> Floats:
        """Open-loop pressures for the commands of n breaths, cmH2O, ``(n, T)``.

        Args:
            data: any breaths of the lungs.
            rigs: rig of each breath, ``(n,)``. Breaths of a rig that was not fitted get the
                parameters that all rigs share.
            first: pressures that the breaths start from, cmH2O, ``(n,)``.
        """
        names = self.evaluator.training.predictor.names
        partition = make_partition(data, names, self.evaluator.settings)
        values = self.evaluator.transferred_values(self.fitted, partition)
        known = np.isin(rigs, self.rigs)
        place = np.searchsorted(self.rigs, rigs[known])
        for path, own in self.values.items():
            values[known, names.index(path)] = own[place]
        values[:, -1] = first
        return partition.predictor.predict(values)[:, 0]


def fit_rigs(
    evaluator: Evaluator, fitted: FittedModel, partition: Partition, rigs: Ints
) -> RigFit | None:
    """Fit the parameters of a model to each rig of some breaths.

    Args:
        evaluator: evaluator of the recording.
        fitted: the model, fitted to all rigs together.
        partition: breaths to fit.
        rigs: rig of each of them, ``(n,)``.

    Returns:
        None if there is one rig alone, or breaths differ from each other by more than their rig.
    """
    known, place = np.unique(rigs, return_inverse=True)
    if len(known) < 2 or any(varies_by_breath(name) for name in fitted.names):
        return None
    data, names = partition.data, partition.predictor.names
    paths = tuple(path for path in fitted.hypothesis.paths if path != START)
    # White noise of the same information: coloured noise would excuse slow errors.
    sigma, ar = fitted.noise.sigma[0], max(fitted.noise.ar[0], 0.0)
    size = sigma * np.sqrt((1.0 + ar) / (1.0 - ar))
    noise = Noise((size, *fitted.noise.sigma[1:]), (0.0,) * len(fitted.noise.ar))
    common = evaluator.transferred_values(fitted, partition)
    fixed = {name: common[:, k] for k, name in enumerate(names) if name != "position"}
    problem = make_problem(
        partition, (*paths, START), noise, {p: v for p, v in fixed.items() if p not in paths}, 0.0
    )
    groups = dict.fromkeys(paths, place) | {_GAIN: np.arange(len(data))}
    layout = make_unknowns(data, (*paths, _GAIN, START), groups)
    first = {path: common[:, names.index(path)] for path in (*paths, _GAIN)}
    first[START] = common[:, -1]
    x, (low, high) = layout.pack(first), layout.bounds()
    lung = np.array([data.lung[place == k][0] for k in range(len(known))])
    around = {path: lung if path in _OF_THE_LUNG else np.zeros_like(lung) for path in paths}
    mean, scatter = x.copy(), {}
    for path in (*paths, _GAIN):
        about = parameter_of(path)
        # A shape parameter may have no mild effect; it is of the size of its range.
        size = 1.0 if about.scale == "log" else abs(about.mild) or about.high - about.low
        scatter[path] = _SCATTER * size
    for _ in range(_ROUNDS):
        precision = np.zeros(len(x))
        for path in scatter:
            precision[layout.of(path)] = scatter[path] ** -2.0
        posed = replace(problem, unknowns=layout, mean=mean, precision=precision)
        minimum = minimise(
            posed.cost, posed.normal, x, low, high, tolerance=_TOLERANCE, iterations=_STEPS
        )
        x = minimum.x
        variance = np.diag(np.linalg.inv(minimum.hessian + 1e-9 * np.eye(len(x))))
        for path in scatter:
            own = layout.of(path)
            for group in np.unique(around.get(path, ())):
                members = own[around[path] == group]
                mean[members] = x[members].mean()
            spread = float(np.sqrt(np.mean((x[own] - mean[own]) ** 2 + variance[own])))
            least = _LEAST * (1.0 if parameter_of(path).scale == "log" else 1e-3)
            scatter[path] = max(spread, least)
    values = {path: parameter_of(path).physical(x[layout.of(path)]) for path in paths}
    gains = x[layout.of(_GAIN)]
    usual = np.array([gains[place == k].mean() for k in range(len(known))])
    values[_GAIN] = parameter_of(_GAIN).physical(usual)
    return RigFit(fitted, evaluator, known, values, scatter)
