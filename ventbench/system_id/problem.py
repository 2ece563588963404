"""A hypothesis and its data: unknowns, residuals, likelihood and normal equations."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from ventbench.base.arrays import Bools, Floats, Ints
from ventbench.base.errors import InputError
from ventbench.physics.catalogue import mechanism, parameter, paths, strength_path
from ventbench.physics.mechanism import REFITTED, Parameter
from ventbench.system_id.data import Data, Noise
from ventbench.system_id.levenberg_marquardt import Minimum, minimise
from ventbench.system_id.predictor import START, Predictor, needs_small_steps

#: The starting pressure of a breath as a parameter.
_START = Parameter(
    START, "cmH2O", "reading at the first sample", -50.0, 150.0, 5.0, 5.0, 5.0, scope="breath"
)

#: Parameters of a breath that its data give.
GIVEN = ("position", "initial_flow")

#: Where a change lies between two breaths, as a share: not where another one may be.
BETWEEN = 0.49

#: Starting pressure of a breath whose first pressure is not measured, cmH2O.
_DEFAULT_START = 5.0


def parameter_of(path: str) -> Parameter:
    """Parameter of a path; the path may be the start of a breath."""
    return _START if path == START else parameter(path)


def free_paths(mechanisms: Iterable[str]) -> tuple[str, ...]:
    """Paths that a hypothesis frees: R, C, R_ex, PEEP, parameters of its mechanisms, the starts."""
    inner = [
        f"{name}.{parameter.name}"
        for name in dict.fromkeys(mechanisms)
        for parameter in mechanism(name).description.parameters
        if not parameter.shape
    ]
    return (*REFITTED, *inner, START)


@dataclass(frozen=True, eq=False)
class Unknowns:
    """Layout of the vector of a fit: U numbers in the coordinates of their parameters."""

    paths: tuple[str, ...]  #: paths of the k free parameters.
    index: Ints  #: unknown that each breath uses for each free parameter, ``(n, k)``.
    path_of: Ints  #: free parameter of each unknown, as an index into ``paths``, ``(U,)``.

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Parameters of the free paths."""
        return tuple(parameter_of(path) for path in self.paths)

    @property
    def shared(self) -> Bools:
        """Whether each unknown is shared by breaths, ``(U,)``."""
        breath_scope = np.array([parameter.scope == "breath" for parameter in self.parameters])
        return ~breath_scope[self.path_of]

    def of(self, path: str) -> Ints:
        """Unknowns of a parameter, in the order of their groups."""
        return np.flatnonzero(self.path_of == self.paths.index(path))

    def bounds(self) -> tuple[Floats, Floats]:
        """Lowest and highest coordinates, ``(U,)``."""
        pairs = [(p.coordinate(p.low), p.coordinate(p.high)) for p in self.parameters]
        low, high = np.array(pairs, float).reshape(-1, 2)[self.path_of].T.copy()
        return low, high

    def prior(self, gain_sd: float = 0.0) -> tuple[Floats, Floats]:
        """Prior means and precisions (1 / variance) in coordinates, ``(U,)``; precision 0 if none.

        A parameter other than the strength has its own prior, because no data bear on it while the
        effect is off. So does a strength with a ``spread``, and the valve's gain if the standard
        deviation of its logarithm is given.
        """
        mean, precision = np.zeros(len(self.path_of)), np.zeros(len(self.path_of))
        for path in self.paths:
            owner = path.rpartition(".")[0]
            if path == "gain" and gain_sd:
                centre, width = float(np.log(parameter_of(path).neutral)), gain_sd
            elif owner and (path != strength_path(owner) or parameter(path).spread is not None):
                centre, width = parameter(path).prior()
            else:
                continue
            mean[self.of(path)], precision[self.of(path)] = centre, width**-2.0
        return mean, precision

    def pack(self, values: Mapping[str, ArrayLike]) -> Floats:
        """Coordinates of physical values, a number or one for each breath by path."""
        x = np.zeros(len(self.path_of))
        for column, (path, bounded) in enumerate(zip(self.paths, self.parameters, strict=True)):
            value = np.broadcast_to(np.asarray(values[path], float), self.index.shape[:1])
            x[self.index[:, column]] = bounded.coordinate(np.clip(value, bounded.low, bounded.high))
        return x

    def unpack(self, x: Floats) -> Floats:
        """Physical values of each breath, ``(n, k)``."""
        columns = x[self.index].T
        pairs = zip(self.parameters, columns, strict=True)
        return np.stack([parameter.physical(column) for parameter, column in pairs], axis=1)

    def slopes(self, physical: Floats) -> Floats:
        """Derivatives of physical values with respect to coordinates, ``(n, k)``."""
        pairs = zip(self.parameters, physical.T, strict=True)
        return np.stack([parameter.slope(column) for parameter, column in pairs], axis=1)


def make_unknowns(
    data: Data, paths: Iterable[str], groups: Mapping[str, ArrayLike] | None = None
) -> Unknowns:
    """Lay out the unknowns of a fit with free parameters of some paths.

    Groups are breaths that share a parameter, by its path, as whole numbers ``(n,)``. By default, R
    and C belong to the lung, a parameter that follows R or C to that label, a parameter of scope
    ``breath`` to the breath, and all others are shared by all breaths.

    Raises:
        InputError: if a group does not fit the data, or a parameter appears twice.
    """
    paths, groups = tuple(paths), dict(groups or {})
    if len(set(paths)) < len(paths):
        raise InputError(f"a parameter is freed twice among {', '.join(paths)}")
    index, path_of = [], []
    for column, path in enumerate(paths):
        parameter = parameter_of(path)
        default = np.arange(len(data)) if parameter.scope == "breath" else np.zeros(len(data), int)
        if path in ("R", "C"):
            default = data.lung
        elif parameter.follows:
            default = data.R if parameter.follows == "R" else data.C
        group = np.asarray(groups.get(path, default))
        if group.shape != (len(data),):
            raise InputError(f"groups of {path}: {group.shape} for {len(data)} breaths")
        kinds, place = np.unique(group, return_inverse=True)
        index.append(len(path_of) + place.reshape(-1))
        path_of += [column] * len(kinds)
    return Unknowns(paths, np.stack(index, axis=1), np.asarray(path_of))


@dataclass(frozen=True, eq=False)
class Partition:
    """Breaths, such as the training breaths, with the predictor of their readings."""

    data: Data
    predictor: Predictor


@dataclass(frozen=True, eq=False)
class Problem:
    """The cost that a fit minimises. Methods take the unknowns ``x`` in coordinates, ``(U,)``."""

    data: Data  #: measurements.
    predictor: Predictor  #: predicts the same breaths.
    unknowns: Unknowns  #: layout of ``x``.
    #: physical values of all columns of the predictor, ``(n, P + 1)``; the unknowns replace those
    #: of free parameters.
    fixed: Floats
    noise: Noise  #: measurement noise.
    mean: Floats  #: prior mean in coordinates, ``(U,)``.
    precision: Floats  #: prior precision, 1 / variance, ``(U,)``.

    @cached_property
    def columns(self) -> tuple[int, ...]:
        """Columns of the free parameters in the predictor's values."""
        order = (*self.predictor.names, START)
        return tuple(order.index(path) for path in self.unknowns.paths)

    def values(self, x: Floats) -> Floats:
        """Physical values of all columns, ``(n, P + 1)``."""
        values = self.fixed.copy()
        values[:, list(self.columns)] = self.unknowns.unpack(x)
        return values

    def predict(self, x: Floats) -> Floats:
        """Predicted measurements, ``(n, c, T)``."""
        return self.predictor.predict(self.values(x))

    def residual(self, x: Floats) -> Floats:
        """Predicted minus measured, 0 where nothing was measured, ``(n, c, T)``."""
        return self.residual_of(self.values(x))

    def residual_of(self, values: Floats) -> Floats:
        """Residual at physical values of all columns, ``(n, P + 1)``."""
        return self._residual(self.predictor.predict(values))

    def jacobian(self, x: Floats) -> tuple[Floats, Floats]:
        """Residual, and its derivative with respect to each free coordinate, ``(n, k, c, T)``.

        Column ``j`` of breath ``i`` belongs to the unknown ``unknowns.index[i, j]``.
        """
        values = self.values(x)
        predicted, slopes = self.predictor.derivatives(values, self.columns)
        chain = self.unknowns.slopes(values[:, list(self.columns)])
        return self._residual(predicted), slopes * (
            chain[:, :, None, None] * self.data.weight[:, None]
        )

    def log_likelihood(self, x: Floats) -> Floats:
        """Log-likelihood of each breath, without the prior, ``(n,)``."""
        return self.noise.log_likelihood(self.residual(x), self.data.weight)

    def cost(self, x: Floats) -> float:
        """Negative log posterior, up to a constant; infinite if the model is unstable."""
        return self._cost(self._white(self.residual(x)), x)

    def costs(self, points: Floats) -> Floats:
        """Costs at several points ``(m, U)``, simulated together, ``(m,)``."""
        predicted = self.predictor.predict_all(np.stack([self.values(x) for x in points]))
        pairs = zip(predicted, points, strict=True)
        return np.array([self._cost(self._white(self._residual(s)), x) for s, x in pairs])

    def scores(self, x: Floats) -> tuple[float, Floats, Floats]:
        """Cost with the prior; gradient and Gauss-Newton Hessian of the likelihood by breath.

        Shapes ``()``, ``(n, k)`` and ``(n, k, k)``.
        """
        residual, slopes = self.jacobian(x)
        white = self._white(residual)
        rows = self.noise.whiten(slopes, self.data.weight)
        rows = rows.reshape(*rows.shape[:2], -1)
        flat = white.reshape(len(white), -1)
        weight = self.noise.influence(flat)
        weighted = rows * weight[:, None]
        gradient = np.matmul(weighted, flat[:, :, None])[:, :, 0]
        return self._cost(white, x), gradient, np.matmul(weighted, rows.swapaxes(1, 2))

    def normal(self, x: Floats) -> tuple[float, Floats, Floats]:
        """Cost, its gradient ``(U,)`` and its Gauss-Newton Hessian ``(U, U)``."""
        with np.errstate(over="ignore", invalid="ignore"):  # where a step leads to instability
            cost, by_breath, curvature = self.scores(x)
        index = self.unknowns.index
        gradient = self.precision * (x - self.mean)
        np.add.at(gradient, index, by_breath)
        hessian = np.diag(self.precision)
        np.add.at(hessian, (index[:, :, None], index[:, None, :]), curvature)
        return cost, gradient, hessian

    def start(self, initial: Mapping[str, ArrayLike]) -> Floats:
        """Unknowns to start a search from, ``(U,)``.

        Mechanisms start at their mild strength, because some have little slope at zero. Of two
        parameters of a mechanism that may change places, the larger comes first.

        Args:
            initial: physical values to start from instead, by path, one number or one a breath;
                paths that are not free are passed over.
        """
        paths = self.unknowns.paths
        first: dict[str, ArrayLike] = {
            path: parameter_of(path).mild if "." in path else self.fixed[:, column]
            for path, column in zip(paths, self.columns, strict=True)
        }
        first |= {path: value for path, value in initial.items() if path in first}
        for name in dict.fromkeys(path.rpartition(".")[0] for path in paths if "." in path):
            for pair in mechanism(name).description.interchangeable:
                larger, smaller = (f"{name}.{short}" for short in pair)
                if {larger, smaller} <= first.keys() and np.all(
                    np.less(first[larger], first[smaller])
                ):
                    first[larger], first[smaller] = first[smaller], first[larger]
        return self.unknowns.pack(first)

    def best_of_scan(self, minimum: Minimum, paths: Iterable[str], least: float) -> Floats | None:
        """The likeliest point with another value of one parameter, all else as in a minimum.

        Args:
            minimum: the minimum.
            paths: parameters whose values of ``scan`` are tried.
            least: nats by which the point must be better.

        Returns:
            None if no point is.
        """
        best, lowest = None, minimum.cost - least
        for path in paths:
            definition = parameter_of(path)
            trials = np.repeat(minimum.x[None], len(definition.scan), axis=0)
            trials[:, self.unknowns.of(path)] = definition.coordinate(definition.scan)[:, None]
            for trial, cost in zip(trials, self.costs(trials), strict=True):
                if cost < lowest:
                    best, lowest = trial, float(cost)
        return best

    def smoothed_start(self, x: Floats, *, tolerance: float = 1e-3, iterations: int = 40) -> Floats:
        """Where a search should start: ``x``, or a better point that larger steps lead to.

        The cost of a model that rings has many local minima. With larger steps the integrator damps
        the ringing, and most of these minima are gone.

        Options as of :func:`~ventbench.system_id.levenberg_marquardt.minimise`.
        """
        if not any(needs_small_steps(path) for path in self.unknowns.paths):
            return x
        smooth = replace(self, predictor=self.predictor.with_large_steps)
        low, high = self.unknowns.bounds()
        smoothed = minimise(
            smooth.cost, smooth.normal, x, low, high, tolerance=tolerance, iterations=iterations
        ).x
        return smoothed if self.cost(smoothed) < self.cost(x) else x

    def change_costs(
        self, x: Floats, path: str, after: Floats | None = None
    ) -> tuple[Floats, Floats]:
        """Costs, nats, of a change between any two breaths, all else as at ``x``.

        Whether a breath comes before or after the change is all that matters to it, so that two
        simulations of it serve all places.

        Args:
            x: unknowns, ``(U,)``.
            path: parameter of a change point.
            after: unknowns of breaths after the change, if they differ.

        Returns:
            Positions between two breaths, and the cost of each, without the prior; ``(k,)`` each.
            At least two breaths lie on either side, if there are four.
        """
        both = np.stack([self.values(x), self.values(x if after is None else after)])
        both[:, :, self.predictor.names.index(path)] = np.array([[2.0], [-1.0]])
        predicted = self.predictor.predict_all(both)
        white = np.stack([self._white(self._residual(prediction)) for prediction in predicted])
        earlier, later = np.sum(self.noise.loss(white), axis=(2, 3))
        order = np.argsort(self.data.position)
        places, first = np.unique(self.data.position[order], return_index=True)
        costs = np.cumsum(earlier[order]) + later.sum() - np.cumsum(later[order])
        costs = costs[first[1:] - 1]
        between = places[:-1] + BETWEEN * np.diff(places)
        inner = slice(1, -1) if len(between) > 2 else slice(None)
        return between[inner], costs[inner]

    def at_likeliest_changes(self, x: Floats, least: float) -> Floats | None:
        """The point with each change between the breaths where it is likeliest, all else as it is.

        Another place must be likelier by ``least`` nats; None if no change moves.
        """
        relocated = None
        for path in self.unknowns.paths:
            if not parameter_of(path).change_point:
                continue
            unknowns, point = self.unknowns.of(path), x if relocated is None else relocated
            places, costs = self.change_costs(point, path)
            if not len(places):
                continue
            current = int(np.argmin(np.abs(places - point[unknowns])))
            if costs.min() < costs[current] - least:
                relocated = point.copy()
                relocated[unknowns] = places[int(np.argmin(costs))]
        return relocated

    def _residual(self, predicted: Floats) -> Floats:
        return np.where(self.data.weight > 0, predicted - self.data.measured, 0.0)

    def _white(self, residual: Floats) -> Floats:
        return self.noise.whiten(residual, self.data.weight)

    def _cost(self, white: Floats, x: Floats) -> float:
        prior = 0.5 * np.sum(self.precision * (x - self.mean) ** 2)
        cost = float(np.sum(self.noise.loss(white)) + prior)
        return cost if np.isfinite(cost) else np.inf


def make_problem(
    partition: Partition,
    paths: Iterable[str],
    noise: Noise,
    fixed: Mapping[str, ArrayLike],
    gain_sd: float = 0.0,
) -> Problem:
    """Lay out the problem of a fit.

    Args:
        partition: the breaths.
        paths: parameters that are fitted.
        noise: model of the measurement noise.
        fixed: values of others, by path; those that are not given are neutral.
        gain_sd: prior standard deviation of the logarithm of each breath's valve gain, which is
            then fitted too; 0 if all breaths have the same gain.

    Raises:
        InputError: if a path is unknown or a value outside its bounds.
    """
    data, names = partition.data, partition.predictor.names
    groups = {"gain": np.arange(len(data))} if gain_sd else {}
    layout = make_unknowns(data, dict.fromkeys((*paths, *groups)), groups)
    values = parameter_values(data, names, fixed)
    mean, precision = layout.prior(gain_sd)
    if gain_sd:  # breaths scatter around the gain of their lung
        mean[layout.of("gain")] = np.log(values[:, names.index("gain")])
    return Problem(data, partition.predictor, layout, values, noise, mean, precision)


def parameter_values(
    data: Data, names: tuple[str, ...], overrides: Mapping[str, ArrayLike]
) -> Floats:
    """Physical values of all columns of a predictor, ``(n, P + 1)``.

    R, C, those of :data:`GIVEN` and starting pressures are those of the data, unless they are given
    by path as others are, a number or one for each breath; the rest is neutral.

    Raises:
        InputError: if a name is unknown or a value outside its bounds.
    """
    reading = data.measured[:, 0, 0]
    first = np.where((data.weight[:, 0, 0] > 0.0) | (reading != 0.0), reading, _DEFAULT_START)
    remaining = {name: getattr(data, name) for name in ("R", "C", *GIVEN) if name in names}
    remaining[START] = first
    remaining |= overrides
    columns = []
    for name in (*names, START):
        value = np.asarray(remaining.pop(name, None if name == START else parameter(name).neutral))
        if name != START:
            definition = parameter(name)
            if not np.all((value >= definition.low) & (value <= definition.high)):
                bounds = f"{definition.low}..{definition.high} {definition.unit}"
                raise InputError(f"{name} = {value} is outside {bounds}")
        columns.append(np.broadcast_to(value, (len(data),)).astype(float))
    if remaining:
        raise InputError(f"no parameter {sorted(remaining)} here; choose of {', '.join(paths())}")
    return np.stack(columns, axis=1)
