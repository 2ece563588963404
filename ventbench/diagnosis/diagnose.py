"""A whole diagnosis: which mechanisms a simulator lacks, by a recording."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeAlias, get_args

import numpy as np

from ventbench import mechanics
from ventbench.base.arrays import Bools
from ventbench.base.errors import InputError
from ventbench.diagnosis import estimates, flow_drive
from ventbench.diagnosis.conclusion import Alternatives, Conclusion
from ventbench.diagnosis.corrected import (
    Correction,
    compare_open_loop,
    correct,
    is_unexplained,
    noise_floor,
    sensor_noise,
)
from ventbench.diagnosis.evidence import IN_TIME, told_posterior
from ventbench.diagnosis.experiment_design import request_breaths
from ventbench.diagnosis.findings import (
    BreathRequest,
    MissingMechanism,
    OpenLoopComparison,
    Traces,
    Verdict,
)
from ventbench.diagnosis.hypothesis import varies_by_breath
from ventbench.diagnosis.identification import (
    IdentifiedModel,
    Split,
    identify,
    never_fitted,
    place_of_change,
    split,
    usable,
    without_saturated,
)
from ventbench.diagnosis.intermittent import Intermittent, find
from ventbench.diagnosis.residual_analysis import flow_and_volume, locate
from ventbench.diagnosis.result import Diagnosis
from ventbench.diagnosis.settings import DEFAULT, SelectionConfig
from ventbench.diagnosis.simulator_comparison import (
    describe_otherwise,
    identify_both,
    mean_error,
    missing_mechanisms,
    refit_at_simulator_parameters,
)
from ventbench.diagnosis.validation import check_residuals, detection_limits, explained_share
from ventbench.mechanics.labels import LungMatch
from ventbench.physics.catalogue import mechanism, parameter
from ventbench.plants.catalog import Given, load_simulators
from ventbench.plants.simulators import Simulators
from ventbench.recordings.breaths import Breaths
from ventbench.recordings.decimation import decimate, is_fast
from ventbench.recordings.read import load
from ventbench.recordings.roles import require_roles
from ventbench.system_id import Data, Fit, Noise, make_data
from ventbench.task.lungs import lung as parse_lung

if TYPE_CHECKING:
    import pandas as pd

#: Receives the current step in words, and the share of the whole that is done.
Progress: TypeAlias = Callable[[str, float], None]

#: What a diagnosis follows.
Drive: TypeAlias = Literal["auto", "valve", "flow"]

#: Shares of a diagnosis that are done when the recording is simulated and when the models are
#: identified; and the part of what is left that a step of an identification takes, so that the five
#: or six steps of one effect come near the end.
_STARTED, _IDENTIFIED, _STEP = 0.02, 0.9, 0.3

#: Most effects that act in some breaths.
_MOST_INTERMITTENT = 2

_NOTE_ON_FLOW = (
    "No valve command: the recorded flow drives the model, so nothing is said of the valves, R_ex "
    "and PEEP, and an offset of the flow sensor looks like a leak."
)


def diagnose(
    breaths: Breaths | str | Path | pd.DataFrame,
    *,
    simulator: Given = "physics",
    lung: str | None = None,
    patient: bool = False,
    drive: Drive = "auto",
    progress: Progress | None = None,
    settings: SelectionConfig = DEFAULT,
) -> Diagnosis:
    """Find which mechanisms a simulator lacks.

    The same candidate mechanisms are fitted to the recording and, unless the simulator is the base
    model, to the simulator's response to the recorded commands. What only the recording needs is
    missing.

    Args:
        breaths: n recorded breaths, or what :func:`ventbench.load_recording` takes. Of each
            lung, every third tests which terms are needed, and every sixth, which nothing else
            sees, judges the corrected simulator.
        simulator: what to diagnose. A name (``"physics"``, ``"frozen"``,
            ``"two_balloon"``), a path to a plant file, a plant, plants by lung id, an array of
            simulated pressures of these breaths, cmH2O, ``(n, T)``, or a Python function of one
            breath's commands, ``f(u_in, u_out, dt, *, R, C, initial_pressure)``, that returns the
            pressures, cmH2O, ``(T,)``, or a class with ``step``, in plain Python or NumPy; see
            :mod:`~ventbench.plants.simulators`.
        lung: use only the breaths of this label.
        patient: True if the lung is a patient's or an active simulator's, so that somebody may
            breathe; False for a test lung, which makes no effort.
        drive: what the model follows: ``"valve"``, the recorded commands; ``"flow"``, the recorded
            flow, which says nothing of the valves; ``"auto"``, the flow only if ``u_in`` is zero
            throughout, so that no command was recorded.
        progress: receives the current step in words, and the share that is done.
        settings: every threshold.

    Returns:
        The diagnosis. Functions and arrays have no plants, so that ``plants`` is empty; the
        corrected pressures are in ``corrected_pressures``. Of a recording faster than about 65 Hz,
        ``traces`` has some of the samples (see :mod:`ventbench.recordings.decimation`).

    Raises:
        InputError: if there are too few breaths, no simulator for their lung, or no such drive.

    Examples:
        >>> import numpy as np
        >>> def ideal(u_in, u_out, dt, *, R, C, initial_pressure):
        ...     flow = 22.8 * u_in / 1000.0  # L/s
        ...     volume = np.concatenate([[0.0], np.cumsum(flow * dt)[:-1]])
        ...     pressure = initial_pressure + 1000.0 * volume / C + R * flow
        ...     return np.where(u_out == 1, initial_pressure, pressure)
        >>> diagnosis = diagnose("x.csv", simulator=ideal)  # doctest: +SKIP
        >>> print(diagnosis)  # doctest: +SKIP
    """
    began = time.perf_counter()
    if drive not in get_args(Drive):
        raise InputError(f"drive is {drive!r}; choose {', '.join(get_args(Drive))}")
    breaths = load(breaths)
    require_roles(breaths)
    simulators = load_simulators(simulator, breaths=breaths)
    if lung is not None:
        breaths = _of_lung(breaths, parse_lung(lung).id)
    by_flow = drive == "flow" or (drive == "auto" and flow_drive.lacks_commands(breaths))
    told: list[MissingMechanism] = []
    posterior = None  # that of all breaths has all effects
    while True:
        found = _diagnose(
            breaths,
            simulators,
            patient,
            by_flow,
            progress or (lambda what, share: None),
            settings,
            look=not by_flow and len(told) < _MOST_INTERMITTENT,
        )
        if isinstance(found, Diagnosis):
            break
        told.append(found.missing)
        posterior = posterior or found.posterior
        breaths = found.rest_of(breaths)
    return replace(
        found,
        verdict="named" if told else found.verdict,
        posterior=posterior or found.posterior,
        mechanisms=(*told, *found.mechanisms),
        simulator=_name(simulator, simulators),
        seconds=time.perf_counter() - began,
    )


def _diagnose(
    breaths: Breaths,
    simulators: Simulators,
    patient: bool,
    by_flow: bool,
    tell: Progress,
    settings: SelectionConfig,
    *,
    look: bool,
) -> Diagnosis | Intermittent:
    """Diagnose breaths in which all effects act alike; see :func:`diagnose`.

    Args:
        breaths: the breaths.
        simulators: what to diagnose.
        patient: whether somebody may breathe.
        by_flow: whether the recorded flow drives the model.
        tell: receives the current step.
        settings: every threshold.
        look: whether to look for an effect of some breaths, which is returned alone.
    """
    notes_on_flow: list[str] = []
    if by_flow:
        breaths, notes_on_flow = flow_drive.with_flow(breaths)
    breaths, saturated = without_saturated(breaths, settings.data)
    breaths, notes = usable(breaths, settings.data)
    recorded, uses = breaths, split(breaths, settings.data, never_fitted(breaths, simulators))
    seen = uses.identifying  # nothing below looks at other breaths until a simulator is chosen
    held, fitted = uses.testing[seen], uses.fitted[seen]
    excluded = () if patient else ("patient_effort",)
    tell("simulating", _STARTED)
    if by_flow:
        driven, index = flow_drive.drive_grid(recorded)
        before = flow_drive.simulate(simulators, recorded, driven, index)
        data = make_data(driven)
        u_out = np.take_along_axis(recorded.u_out, index, axis=1)
        breaths = replace(driven, u_out=u_out)  # phases of the report are those of the recording
        excluded += (*flow_drive.ventilator_side(), *IN_TIME)
        settings = flow_drive.without_ventilator(settings)
        notes += [*notes_on_flow, _NOTE_ON_FLOW]
    else:
        before = simulators.pressures(breaths)
        if is_fast(breaths):
            rate = 1.0 / float(np.median(breaths.dt[breaths.valid]))
            grid = decimate(breaths)
            breaths, before = grid.breaths, grid.of(before)
            notes.append(_note_on_rate(rate, breaths))
        data = make_data(breaths)
    halfway = _IDENTIFIED if simulators.is_base_physics else 0.5 * _IDENTIFIED
    recording_only_model = identify(
        data.select(seen), held, excluded, steps_between(tell, _STARTED, halfway), settings, fitted
    )
    if look:
        tell("looking for effects of some breaths", halfway)
        some = find(recording_only_model, data, recorded.breath_id)
        if some is not None and some.leaves_enough(recorded, simulators, settings):
            return some
    recording_model, simulator_model = recording_only_model, None
    if not simulators.is_base_physics:
        tell("fitting the simulator's response", halfway)
        recording_model, simulator_model = identify_both(
            data.select(seen),
            held,
            before[seen],
            recording_only_model,
            excluded,
            steps_between(tell, halfway, _IDENTIFIED),
            fitted,
        )
    tell("drawing conclusions", _IDENTIFIED)

    def compared(recording_model: IdentifiedModel) -> _Comparison:
        missing, notes = missing_mechanisms(recording_model, simulator_model)
        if simulator_model is not None:
            steady = refit_at_simulator_parameters(
                data.select(seen),
                held,
                before[seen],
                recording_model,
                simulator_model,
                tuple(missing),
            )
            if steady is not None:  # the simulator keeps its mechanisms, shown or not
                (recording_model, kept), notes = steady, []
                missing = {name: changed for name, changed in missing.items() if name in kept}
        correction = correct(
            breaths, data, uses, before, recording_model, simulator_model, simulators
        )
        return _Comparison(recording_model, missing, notes, correction)

    comparison = compared(recording_model)
    if (
        simulator_model is not None
        and recording_model is recording_only_model
        and describe_otherwise(recording_model, simulator_model)
    ):
        tell("describing the recording by what the simulator has", _IDENTIFIED)
        in_its_terms = identify(
            data.select(seen),
            held,
            excluded,
            steps_between(tell, _IDENTIFIED, 1.0),
            settings,
            fitted,
            simulator_model.conclusion.named,
        )
        comparison = min(
            comparison, compared(in_its_terms), key=lambda each: each.error(data, uses.testing)
        )
    recording_model, correction = comparison.recording_model, comparison.correction
    missing, notes_on_simulator = comparison.missing, comparison.notes
    conclusion = recording_model.conclusion
    term = estimates.nonparametric_term(conclusion)
    own = simulator_model.conclusion.unnamed if simulator_model is not None else None
    if own is not None and term is not None and own.name == term.name:
        notes_on_simulator.append(f"The simulator needs a nonparametric term at {term.name} too.")
    lungs, notes_on_lungs = _lungs(recorded, recording_only_model.fit)
    noise, pressures = conclusion.noise, correction.pressures
    if by_flow and breaths.flow is not None:
        flow = breaths.flow
        volume = np.cumsum(data.u_in * data.dt, axis=1) * float(parameter("gain").neutral)
    else:
        flow, volume = flow_and_volume(breaths, recording_model.fit, pressures["refit"])
    here = np.flatnonzero(~np.isnan(pressures["refit"]).all(axis=1))
    gain, start = recording_model.sensitivities(data)
    adequacy = check_residuals(
        breaths.select(here),
        pressures["after"][here],
        gain[here],
        start[here],
        noise.sigma[0],
        flow[here],
        volume[here],
        gains_scatter=conclusion.gain_sd > 0.0,
        settings=settings.residuals,
    )
    # A simulator that is more than a lung and a valve may know the gains of its rigs, and gains
    # that have an order in time do not scatter.
    scatters = simulators.is_base_physics and not any(c.of == "gain" for c in adequacy.changes)
    gain_error = conclusion.gain_sd * np.abs(gain) * scatters
    scatter_error = np.hypot(gain_error, recording_model.effort_spread(data))
    sensor = sensor_noise(breaths)
    open_loop = compare_open_loop(
        breaths,
        uses.judging,
        pressures,
        noise_floor(float(noise.sigma[0]), sensor),
        scatter_error,
        sensor,
    )
    if adequacy.changes:  # breaths that err more because of a change are no outliers
        open_loop = replace(open_loop, usual=open_loop.after.rmse)
    is_input = conclusion.unnamed is not None and conclusion.unnamed.swing is not None
    rejected = (bool(missing) or term is not None) and not _helps(
        correction, recording_model, open_loop, data.select(uses.judging), by_breath=is_input
    )
    if rejected:
        missing, notes_on_simulator = {}, [_note_on_unchanged(correction)]
        term = term if is_input and not correction.unchanged else None
    location = locate(
        breaths.select(here),
        pressures["refit"][here],
        noise.sigma[0],
        flow[here],
        volume[here],
        settings=settings.residuals,
    )
    form, term = estimates.split_form(term, tuple(missing))
    swings = None if term is None else estimates.oscillation(conclusion)
    term = term if swings is None else None
    left = (open_loop.after.rmse, open_loop.unexplained if adequacy.vetoed else 0.0)
    unnamed = term is not None or conclusion.unresolved or (rejected and location)
    unnamed = unnamed or is_unexplained(open_loop, settings.correction) or adequacy.vetoed
    verdict: Verdict = "named" if missing or swings else "unnamed" if unnamed else "nothing_missing"
    limits: dict[str, float] = {}
    if verdict == "nothing_missing":
        limits = detection_limits(recording_model.evaluator, conclusion.named)
    return Diagnosis(
        verdict=verdict,
        mechanisms=tuple(
            _missing_mechanism(name, changed, recording_model, simulator_model, breaths, data, left)
            for name, changed in missing.items()
        )
        + ((swings,) if swings else ()),
        nonparametric=term,
        form=form,
        location=location,
        remaining=adequacy.regions,
        open_loop=open_loop,
        lungs=lungs,
        request=None if rejected or by_flow else _request(conclusion),
        traces=Traces(
            breaths,
            uses.judging,
            pressures["before"],
            pressures["refit"],
            pressures["after"],
            flow,
            volume,
        ),
        split=_ids(breaths, uses),
        chosen=correction.chosen,
        changes=adequacy.changes,
        saturated=saturated,
        gain_scatter=conclusion.gain_sd,
        posterior=told_posterior(conclusion.posterior),
        detection_limits=limits,
        plants=correction.plants,
        simulator=simulators.name,
        noise=(float(noise.sigma[0]), float(noise.ar[0])),
        notes=(
            *notes,
            *notes_on_simulator,
            *correction.notes,
            *notes_on_lungs,
        ),
        settings=settings,
        seconds=0.0,
    )


@dataclass(frozen=True, eq=False)
class _Comparison:
    """A model of the recording compared with the simulator's."""

    #: the model, with the simulator's own parameters where breaths allow.
    recording_model: IdentifiedModel
    #: what the simulator lacks, and whether it has it with other parameters.
    missing: dict[str, bool]
    notes: list[str]  #: on what the simulator has and the recording does not show.
    correction: Correction  #: the simulator corrected.

    def error(self, data: Data, testing: Bools) -> float:
        """Mean absolute error of the corrected simulator on the testing breaths, cmH2O."""
        corrected = np.nan_to_num(self.correction.pressures["after"])
        return mean_error(data.select(testing), corrected[testing])


def steps_between(tell: Progress, low: float, high: float) -> Callable[[str], None]:
    """Progress through steps whose number nobody knows before: each takes a part of what is left.

    Args:
        tell: receives the step in words, and the share of the whole that is done.
        low: share before the first step.
        high: share that the steps come near.
    """
    share = low

    def step(what: str) -> None:
        nonlocal share
        tell(what, share)
        share += _STEP * (high - share)

    return step


def _note_on_rate(rate: float, breaths: Breaths) -> str:
    """Note on what was kept of a fast recording."""
    kept = breaths.valid.sum(axis=1)
    readings = np.isfinite(breaths.pressure).sum(axis=1)
    return (
        f"Recorded at {rate:.0f} Hz: {int(np.median(readings))} readings of a breath are used, "
        f"and {int(np.median(kept))} samples of its commands, whose changes keep their times."
    )


def _helps(
    correction: Correction,
    recording_model: IdentifiedModel,
    open_loop: OpenLoopComparison,
    judging: Data,
    *,
    by_breath: bool,
) -> bool:
    """Whether breaths that no fit and no test has seen speak for the correction.

    Its error need not be lower in a recording where a mild effect drowns in slow noise, but then
    the likelihood of those breaths must rise. A periodic input, which differs from breath to breath
    (``by_breath``), corrects nothing and is not judged here.
    """
    if correction.unchanged:
        return False
    if correction.helps and open_loop.after.rmse < open_loop.refit.rmse:
        return True
    evaluator, conclusion = recording_model.evaluator, recording_model.conclusion
    if conclusion.base.hypothesis == conclusion.full.hypothesis:
        return by_breath or correction.helps
    partition = evaluator.partition(judging)
    base = evaluator.fit(conclusion.base.hypothesis, conclusion.full.noise)
    gained = evaluator.log_likelihood(conclusion.full, partition)
    return bool(np.sum(gained - evaluator.log_likelihood(base, partition)) > 0.0)


def _ids(breaths: Breaths, uses: Split) -> dict[str, tuple[int, ...]]:
    """Ids of the breaths by their use."""
    masks = {
        "training": ~uses.testing & ~uses.judging,
        "testing": uses.testing,
        "judging": uses.judging,
    }
    return {name: tuple(int(i) for i in breaths.breath_id[mask]) for name, mask in masks.items()}


def _of_lung(breaths: Breaths, lung: str) -> Breaths:
    by_lung = breaths.by_lung_index
    if lung not in by_lung:
        raise InputError(
            f"the recording has no breath of lung {lung}; choose one of {', '.join(by_lung)}"
        )
    return breaths.select(by_lung[lung])


def _name(given: Given, simulators: Simulators) -> str:
    """Name of a simulator in reports."""
    has_name = isinstance(given, str | Path | Simulators) or simulators.kind == "function"
    return simulators.name if has_name else "given"


def _note_on_unchanged(correction: Correction) -> str:
    """Note on why a simulator is left as it is."""
    before, after = correction.training_errors
    if not correction.unchanged:
        return (
            "What was identified helps on none of the breaths that were set aside to judge it, so "
            "it is withdrawn, and the simulator stays as it is or is refitted."
        )
    return (
        "The identified correction would raise the simulator's mean absolute error on the training "
        f"breaths from {before:.2f} to {after:.2f} cmH2O, so the simulator is left as it is."
    )


def _lungs(breaths: Breaths, fit: Fit) -> tuple[tuple[LungMatch, ...], list[str]]:
    """The lungs; from flow or volume where they are recorded, which needs no model of the valve."""
    if breaths.flow is not None or breaths.volume is not None:
        try:
            lungs = mechanics.identify(breaths)
            notes = [note for each in lungs for note in each.notes]
            return tuple(each.match for each in lungs), notes
        except InputError as error:
            return mechanics.match_labels(fit), [f"R and C are from pressure alone: {error}."]
    return mechanics.match_labels(fit), []


def _missing_mechanism(
    name: str,
    changed: bool,
    recording_model: IdentifiedModel,
    simulator_model: IdentifiedModel | None,
    breaths: Breaths,
    data: Data,
    left: tuple[float, float],
) -> MissingMechanism:
    """A missing mechanism; ``left`` are the error and what is shown to be no noise of it, cmH2O."""
    conclusion = recording_model.conclusion
    # Nobody knows the efforts of breaths to come: their errors do not tell what efforts are worth.
    worth = float("nan") if varies_by_breath(name) else conclusion.worths.get(name, float("nan"))
    alternatives = conclusion.alternatives.get(name, Alternatives((), 1.0, ()))
    own = {}
    if simulator_model is not None and changed:
        own = estimates.parameter_estimates(simulator_model.fit, name)
    values = estimates.with_form_error(
        estimates.parameter_estimates(recording_model.fit, name),
        name,
        alone=len(conclusion.names) == 1,
    )
    changes = [p.name for p in mechanism(name).description.parameters if p.change_point]
    affected = None
    if changes:
        model, path = recording_model, f"{name}.{changes[0]}"
        at = place_of_change(model.evaluator, model.fit, data, path)
        values[changes[0]] = replace(values[changes[0]], value=at.value, ci95=(at.low, at.high))
        first = np.searchsorted(data.position, at).clip(max=len(breaths) - 1)
        now, low, high = (int(i) for i in breaths.breath_id[first])
        affected = (now, low, high)
    return MissingMechanism(
        name=name,
        parameters=values,
        confidence=alternatives.confidence,
        alternatives=alternatives.names,
        nats=conclusion.held_out_gains.get(name, 0.0),
        changed=changed,
        simulator_values={key: estimate.value for key, estimate in own.items()},
        worth=worth,
        breaths=affected,
        explains=explained_share(worth, *left),
    )


def _request(conclusion: Conclusion) -> BreathRequest | None:
    rivals = [rival for other in conclusion.alternatives.values() for rival in other.models]
    noise = Noise((conclusion.noise.sigma[0],), (0.0,))
    return request_breaths(conclusion.named, rivals, noise)
