"""Detectability of an effect once R, C, R_ex, PEEP and initial pressures are refitted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.optimize import minimize_scalar

from hardware_eval.emulation.cases import Base, Case, Effect
from proofs.challenge.generators import generator_of
from ventbench.base.arrays import Floats
from ventbench.recordings.breaths import Breaths

#: Detection limit, nats over all breaths of a recording. The fifth of the breaths that a diagnosis
#: holds out would hardly raise the likelihood of a weaker effect by log 100.
LIMIT = 25.0

#: Values of the rig that are refitted, and the step of their finite differences (PEEP and initial
#: pressure in cmH2O, the others in their logarithm).
_REFITTED = ("R", "C", "R_ex", "peep")
_STEP = 1e-3

#: Largest circuit that is left when an inertance is taken out, and the step of its refit, in units
#: of the circuit that came with it.
_LARGEST_CIRCUIT, _CIRCUIT_STEP = 2.0, 0.01

#: Gauss-Newton iterations at most, the shares of a step that are tried, and the relative decrease
#: of the squared error below which they end.
_ITERATIONS = 6
_STEP_SHARES = (1.0, 0.5, 0.25)
_LEAST_DECREASE = 0.1

#: Largest change of a value in one step, in the units of its finite difference.
_LARGEST_STEP = 0.7

#: Least variance of the noise, cmH2O^2, for recordings without any.
_LEAST_VARIANCE = 1e-6


def log_likelihood_loss(case: Case, breaths: Breaths, index: int) -> float:
    """Expected loss of log-likelihood, nats, without one effect, over all breaths of a recording.

    The rig without the effect is fitted to the noise-free response of the rig with the effect under
    the recorded commands; the remaining squared error is divided by the noise variance. The
    patient's efforts are not those of the recording.

    Args:
        case: case with its base.
        breaths: recording of the case.
        index: index of the effect in ``case.effects``.
    """
    assert case.base is not None
    count = min(generator_of(case).compared, len(breaths))
    chosen = breaths.select(np.linspace(0, len(breaths) - 1, count).astype(int))
    start = np.full(count, case.base.peep)
    response = generator_of(case).replay(case, chosen, start, seed=index)
    base, effect = case.base, case.effects[index]
    before, after = case.effects[:index], case.effects[index + 1 :]

    def squared_error(*left: Effect) -> float:
        rest = replace(case, effects=(*before, *left, *after))
        return float(np.sum(_refitted(rest, base, chosen, start, response, seed=index) ** 2))

    if effect.name == "inertance" and "circuit" in effect.parameters:
        # The circuit that came with it stays, and is refitted: behind a high resistance, a little
        # less of it does most of what the mass does.
        massless = effect.parameters | {"inertance": 0.0}
        left = float(
            minimize_scalar(
                lambda size: squared_error(
                    replace(effect, parameters=massless | {"circuit": float(size)})
                ),
                bounds=(0.0, _LARGEST_CIRCUIT * effect.parameters["circuit"]),
                method="bounded",
                options={"xatol": _CIRCUIT_STEP * effect.parameters["circuit"]},
            ).fun  # type: ignore[attr-defined]
        )
    else:
        left = squared_error()
    noise = max(case.noise**2 + case.step**2 / 12.0, _LEAST_VARIANCE)
    return 0.5 * left / noise * len(breaths) / count


def _refitted(
    case: Case, base: Base, breaths: Breaths, start: Floats, response: Floats, seed: int
) -> Floats:
    """Residuals of the best rig, by Gauss-Newton steps that are halved until the error falls."""

    def run(*rigs: tuple[Base, Floats]) -> Floats:
        """Residuals of rigs with their initial pressures, all side by side, ``(k, n, T)``."""
        many = breaths.select(np.tile(np.arange(len(breaths)), len(rigs)))
        values = {
            key: np.repeat([getattr(rig, key) for rig, _ in rigs], len(breaths))
            for key in _REFITTED
        }
        one = replace(case, base=replace(base, **values))  # type: ignore[arg-type]
        told = generator_of(case).replay(one, many, np.concatenate([s for _, s in rigs]), seed)
        return response - told.reshape(len(rigs), *response.shape)

    (error,) = run((base, start))
    for _ in range(_ITERATIONS):
        stepped = run(
            *((_changed(base, key, _STEP), start) for key in _REFITTED), (base, start + _STEP)
        )
        changes = (error - stepped) / _STEP
        slopes, by_start = changes[:-1], changes[-1]
        # Initial pressures are projected out, breath by breath; their steps follow afterwards.
        square = np.sum(by_start**2, axis=1)
        along = np.einsum("knt,nt->kn", slopes, by_start) / square
        projected = slopes - along[:, :, None] * by_start
        remaining = error - (np.sum(error * by_start, axis=1) / square)[:, None] * by_start
        jacobian = projected.reshape(len(_REFITTED), -1).T
        step = np.linalg.lstsq(jacobian, remaining.ravel(), rcond=None)[0]
        shift = np.sum((error - np.tensordot(step, slopes, 1)) * by_start, axis=1) / square
        limited = np.clip(step, -_LARGEST_STEP, _LARGEST_STEP)
        tried = []
        for share in _STEP_SHARES:
            rig = base
            for key, value in zip(_REFITTED, limited, strict=True):
                rig = _changed(rig, key, share * float(value))
            tried.append((rig, start + share * shift))
        errors = run(*tried)
        better = np.flatnonzero(np.sum(errors**2, axis=(1, 2)) < np.sum(error**2))
        if not better.size:
            break
        gain = 1.0 - np.sum(errors[better[0]] ** 2) / np.sum(error**2)
        (base, start), error = tried[better[0]], errors[better[0]]
        if gain < _LEAST_DECREASE:
            break
    return error


def _changed(base: Base, key: str, by: float) -> Base:
    """The rig with one value multiplied by exp(by), or PEEP raised by ``by`` cmH2O."""
    old = getattr(base, key)
    return replace(base, **{key: old + by if key == "peep" else old * float(np.exp(by))})
