"""A whole diagnosis: which mechanisms a simulator lacks, by a recording."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeAlias, get_args

import numpy as np

from ventbench import mechanics
from ventbench.base import compilation
from ventbench.base.arrays import Bools, Floats
from ventbench.base.errors import InputError
from ventbench.diagnosis import estimates, flow_drive
from ventbench.diagnosis.conclusion import Alternatives, Conclusion
from ventbench.diagnosis.corrected import (
    Correction,
    behind_sensor,
    by_lung,
    choose,
    compare_open_loop,
    correct,
)
from ventbench.diagnosis.evidence import IN_TIME, MUSCLES, likeliest_sets
from ventbench.diagnosis.experiment import Experiment, Split, prepare
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
    first_after,
    identify,
    place_of_change,
)
from ventbench.diagnosis.intermittent import find
from ventbench.diagnosis.residual_analysis import (
    flow_and_volume,
    locate,
    of_breaths,
    quiet_samples,
)
from ventbench.diagnosis.result import Diagnosis
from ventbench.diagnosis.sensor_behind import SensorBehind, find_sensor
from ventbench.diagnosis.settings import DEFAULT, SelectionConfig
from ventbench.diagnosis.simulator_comparison import (
    describe_otherwise,
    identify_both,
    mean_error,
    missing_mechanisms,
    refit_at_simulator_parameters,
    refit_lungs,
)
from ventbench.diagnosis.validation import check_residuals, detection_limits, explained_share
from ventbench.mechanics.labels import LungMatch
from ventbench.physics.catalogue import mechanism, parameter
from ventbench.plants.catalog import SimulatorLike, load_simulators
from ventbench.plants.python_simulators import PythonSimulators
from ventbench.plants.simulators import Simulators
from ventbench.recordings.bad_samples import notable
from ventbench.recordings.breaths import Breaths
from ventbench.recordings.read import load
from ventbench.recordings.roles import require_roles
from ventbench.system_id import Data, Fit
from ventbench.task.interfaces import Plant
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


def diagnose(
    breaths: Breaths | str | Path | pd.DataFrame,
    *,
    simulator: SimulatorLike = "physics",
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
            :mod:`~ventbench.plants.python_simulators`.
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
    tell = progress or (lambda step, share: None)
    tell("simulating", _STARTED)
    by_flow = drive == "flow" or (drive == "auto" and flow_drive.lacks_commands(breaths))
    compilation.keep()
    experiment = prepare(breaths, simulators, settings.data, by_flow=by_flow)
    excluded = () if patient else MUSCLES
    if by_flow:
        excluded += (*flow_drive.ventilator_side(), *IN_TIME)
        settings = flow_drive.lung_side_settings(settings, breaths)
    intermittent: list[MissingMechanism] = []
    with compilation.one_blas_thread():
        while True:
            alone = _identify(experiment, excluded, tell, settings)
            if by_flow or len(intermittent) == _MOST_INTERMITTENT:
                break
            tell("looking for effects of some breaths", _halfway(experiment))
            reduced = _set_aside_effect(experiment, alone)
            if reduced is None:
                break
            experiment, missing = reduced
            intermittent.append(missing)
        behind = None if by_flow else _behind(experiment, alone, settings)
        if behind is None:
            diagnosis = _conclude(experiment, alone, excluded, tell, settings)
        else:
            diagnosis = behind.conclude(
                _conclude(behind.sensed, alone, excluded, tell, settings), settings
            )
    weights = alone.conclusion.posterior.weights
    for missing in intermittent:
        weights = with_effect(weights, missing.name, missing.confidence, missing.alternatives)
    return replace(
        diagnosis,
        verdict="named" if intermittent else diagnosis.verdict,
        posterior=likeliest_sets(weights),
        mechanisms=(*intermittent, *diagnosis.mechanisms),
        simulator=_name(simulator, simulators),
        seconds=time.perf_counter() - began,
    )


def with_effect(
    weights: Mapping[frozenset[str], float], name: str, confidence: float, rivals: Sequence[str]
) -> dict[frozenset[str], float]:
    """Posterior of sets beside an effect of some breaths, or beside one of its rivals.

    Args:
        weights: probabilities of sets of what acts in all breaths.
        name: the effect.
        confidence: its probability.
        rivals: effects that share the rest; none of them if there is none.
    """
    others: list[frozenset[str]] = [frozenset({rival}) for rival in rivals] or [frozenset()]
    shares = {frozenset({name}): confidence}
    shares |= dict.fromkeys(others, (1.0 - confidence) / len(others))
    joined: dict[frozenset[str], float] = defaultdict(float)
    for names, weight in weights.items():
        for effect, share in shares.items():
            joined[names | effect] += weight * share
    return joined


def _halfway(experiment: Experiment) -> float:
    """Share of a diagnosis that is done when the recording is identified."""
    return _IDENTIFIED if experiment.simulators.is_base_physics else 0.5 * _IDENTIFIED


def _identify(
    experiment: Experiment,
    excluded: tuple[str, ...],
    tell: Progress,
    settings: SelectionConfig,
    low: float = _STARTED,
    also: tuple[str, ...] = (),
) -> IdentifiedModel:
    """Identify the recording alone, from the breaths that do not judge.

    Args:
        experiment: the recording.
        excluded: mechanisms that cannot act.
        tell: receives the current step.
        settings: every threshold.
        low: share of the diagnosis that is done before.
        also: names of mechanisms that are tried in any case.
    """
    uses = experiment.uses
    identifying = uses.identifying
    high = 1.0 if also else _halfway(experiment)
    return identify(
        experiment.identification_data,
        uses.testing[identifying],
        excluded,
        steps_between(tell, low, high),
        settings,
        uses.fitted[identifying],
        also,
    )


def _set_aside_effect(
    experiment: Experiment, model: IdentifiedModel
) -> tuple[Experiment, MissingMechanism] | None:
    """The experiment without an effect of some breaths, and that effect; None if there is none.

    It competes with an error of some breaths that nobody can place.
    """
    identifying = experiment.uses.identifying
    some = find(model, experiment.identification_data, experiment.breaths.breath_id[identifying])
    if some is None:
        return None
    affected, u_in = np.zeros(len(identifying), bool), None
    affected[identifying] = some.affected
    if some.u_in is not None:
        u_in = experiment.reached.copy()
        u_in[identifying] = some.u_in
    reduced = experiment.set_aside(affected, u_in)
    return None if reduced is None else (reduced, some.missing)


def _compare(
    experiment: Experiment,
    recording_model: IdentifiedModel,
    simulator_model: IdentifiedModel | None,
) -> _Comparison:
    """What the recording has and the simulator has not, and the simulator corrected by it."""
    missing, notes = missing_mechanisms(recording_model, simulator_model)
    if simulator_model is not None:
        identifying = experiment.uses.identifying
        steady = refit_at_simulator_parameters(
            experiment.identification_data,
            experiment.uses.testing[identifying],
            experiment.before[identifying],
            recording_model,
            simulator_model,
            tuple(missing),
        )
        if steady is not None:  # the simulator keeps its mechanisms, shown or not
            (recording_model, confirmed), notes = steady, []
            missing = {name: changed for name, changed in missing.items() if name in confirmed}
    correction = correct(experiment, recording_model, simulator_model)
    return _Comparison(recording_model, missing, notes, correction)


def _conclude(
    experiment: Experiment,
    alone: IdentifiedModel,
    excluded: tuple[str, ...],
    tell: Progress,
    settings: SelectionConfig,
) -> Diagnosis:
    """Compare the recording with the simulator, correct it, and let the judge have its say.

    Args:
        experiment: breaths in which all effects act alike.
        alone: identified from the recording alone.
        excluded: mechanisms that cannot act.
        tell: receives the current step.
        settings: every threshold.
    """
    breaths, data, uses, judge = (
        experiment.breaths,
        experiment.data,
        experiment.uses,
        experiment.judge,
    )
    simulators, identifying = experiment.simulators, experiment.uses.identifying
    recording_model, simulator_model = alone, None
    if not simulators.is_base_physics:
        tell("fitting the simulator's response", _halfway(experiment))
        recording_model, simulator_model = identify_both(
            experiment.identification_data,
            uses.testing[identifying],
            experiment.before[identifying],
            alone,
            excluded,
            steps_between(tell, _halfway(experiment), _IDENTIFIED),
            uses.fitted[identifying],
        )
    tell("drawing conclusions", _IDENTIFIED)
    comparison = _compare(experiment, recording_model, simulator_model)
    if (
        simulator_model is not None
        and recording_model is alone
        and describe_otherwise(recording_model, simulator_model)
    ):
        tell("describing the recording by what the simulator has", _IDENTIFIED)
        in_its_terms = _identify(
            experiment, excluded, tell, settings, _IDENTIFIED, simulator_model.conclusion.names
        )
        comparison = min(
            comparison,
            _compare(experiment, in_its_terms, simulator_model),
            key=lambda candidate: candidate.error(data, uses.testing),
        )
    recording_model, correction = comparison.recording_model, comparison.correction
    missing, notes_on_simulator = comparison.missing, comparison.notes
    conclusion = recording_model.conclusion
    term = estimates.nonparametric_term(conclusion)
    simulator_effect = simulator_model.conclusion.unnamed if simulator_model is not None else None
    if simulator_effect is not None and term is not None and simulator_effect.name == term.name:
        notes_on_simulator.append(f"The simulator needs a nonparametric term at {term.name} too.")
    lungs, notes_on_lungs = _lungs(experiment.recorded.select(identifying), alone.fit)
    noise, pressures = conclusion.noise, correction.pressures
    tested = np.flatnonzero(~np.isnan(pressures["refit"]).all(axis=1) & identifying)
    of_drive, like = 0.0, None
    if experiment.by_flow and breaths.flow is not None:
        fitted_R = {match.label: match.fitted_R for match in lungs}
        R = np.array([fitted_R.get(label, np.nan) for label in breaths.lung_ids])
        notes_on_lungs += flow_drive.trapped_gas_notes(breaths, R)
        of_drive = flow_drive.of_noise(breaths, R)
        like = flow_drive.most_alike(breaths.select(tested))
        flow = breaths.flow
        volume = np.cumsum(data.u_in * data.dt, axis=1) * float(parameter("gain").neutral)
    else:
        flow, volume = flow_and_volume(breaths, recording_model.fit, pressures["refit"])
    gain, start = recording_model.sensitivities(data)
    # What each breath may have of its own: a start, as its first reading is noisy, and a gain.
    scattered = conclusion.gain_sd > 0.0
    nuisance = np.stack([start, gain] if scattered else [start], axis=-1)
    judged = None  # efforts of breaths to come are unknown
    if not conclusion.full.hypothesis.breath_terms:
        judged = judge.excess(correction.tested + of_drive, nuisance, quiet_samples(breaths))
    adequacy = check_residuals(
        breaths.select(tested),
        (correction.tested + of_drive)[tested],
        gain[tested],
        start[tested],
        noise.sigma[0],
        flow[tested],
        volume[tested],
        sorted_by=like,
        judged=judged,
        gains_scatter=scattered,
        settings=settings.residuals,
    )
    # A simulator that is more than a lung and a valve may know the gains of its rigs, and gains
    # that have an order in time do not scatter.
    scatters = simulators.is_base_physics and not any(c.of == "gain" for c in adequacy.changes)
    gain_error = conclusion.gain_sd * np.abs(gain) * scatters
    scatter_error = np.hypot(gain_error, recording_model.effort_spread(data))
    open_loop = compare_open_loop(
        breaths,
        judge,
        pressures,
        adequacy.noise if np.isfinite(adequacy.noise) else float(noise.sigma[0]),
        scatter_error,
        start,
    )
    is_input = conclusion.unnamed is not None and conclusion.unnamed.swing is not None
    rejected = (bool(missing) or term is not None) and not _helps(
        experiment, correction, recording_model, open_loop, by_breath=is_input
    )
    if rejected:
        missing, notes_on_simulator = {}, [_note_on_unchanged(correction)]
        term = term if is_input and not correction.unchanged else None
    of_start = of_breaths(breaths, pressures["refit"], gain, start)[2]
    location = locate(
        breaths.select(tested),
        (pressures["refit"] + of_start + of_drive)[tested],
        noise.sigma[0],
        flow[tested],
        volume[tested],
        sorted_by=like,
        settings=settings.residuals,
    )
    form, term = estimates.split_form(term, tuple(missing))
    errors = (open_loop.whole.rmse, adequacy.excess)
    swings = None if term is None else estimates.oscillation(conclusion, errors)
    term = term if swings is None else None
    unnamed = term is not None or conclusion.unresolved or (rejected and location)
    unnamed = unnamed or adequacy.vetoed
    if unnamed and adequacy.at_rest < adequacy.noise:
        # Neighbouring errors differ by more than noise where the simulator errs.
        noise_at_rest = open_loop.noise_floor * adequacy.at_rest / adequacy.noise
        open_loop = replace(open_loop, noise_floor=noise_at_rest)
    verdict: Verdict = "named" if missing or swings else "unnamed" if unnamed else "nothing_missing"
    limits: dict[str, float] = {}
    if verdict == "nothing_missing":
        limits = detection_limits(recording_model.evaluator, conclusion.named)
    return Diagnosis(
        verdict=verdict,
        mechanisms=tuple(
            _missing_mechanism(name, changed, recording_model, simulator_model, experiment, errors)
            for name, changed in missing.items()
        )
        + ((swings,) if swings else ()),
        nonparametric=term,
        form=form,
        location=location,
        remaining=adequacy.regions,
        open_loop=open_loop,
        lungs=lungs,
        request=None if rejected or experiment.by_flow else _request(conclusion),
        traces=Traces(
            replace(experiment.unsealed, u_in=breaths.u_in),
            judge.judging,
            pressures["before"],
            pressures["refit"],
            pressures["after"],
            flow,
            volume,
        ),
        split=_ids(breaths, uses),
        chosen=correction.chosen,
        changes=adequacy.changes,
        saturated=experiment.saturated,
        left_out=notable(breaths),
        gain_scatter=conclusion.gain_sd,
        posterior=likeliest_sets(conclusion.posterior.weights),
        detection_limits=limits,
        plants=correction.plants,
        simulator=simulators.name,
        noise=(float(noise.sigma[0]), float(noise.ar[0])),
        notes=(
            *experiment.notes,
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

    def step(description: str) -> None:
        nonlocal share
        tell(description, share)
        share += _STEP * (high - share)

    return step


def _helps(
    experiment: Experiment,
    correction: Correction,
    recording_model: IdentifiedModel,
    open_loop: OpenLoopComparison,
    *,
    by_breath: bool,
) -> bool:
    """Whether breaths that no fit and no test has seen speak for the correction.

    Its error need not be lower in a recording where a mild effect drowns in slow noise, but then
    the likelihood of those breaths must rise. A periodic input, which differs from breath to breath
    (``by_breath``), corrects nothing, and nobody knows the efforts of breaths to come: neither is
    judged here, and what acts beside efforts is judged beside them.
    """
    if correction.unchanged:
        return False
    if correction.helps and open_loop.after.rmse < open_loop.refit.rmse:
        return True
    full = recording_model.conclusion.full
    hypothesis = full.hypothesis
    judged = {*hypothesis.names} - {*hypothesis.breath_terms}
    if not judged:
        return by_breath or bool(hypothesis.breath_terms) or correction.helps
    base = recording_model.evaluator.fit(hypothesis.minus(*judged), full.noise)
    first = experiment.breaths.pressure[:, 0]
    nats_full, nats_base = (
        experiment.judge.log_likelihood(
            recording_model.pressures(model, experiment.data, first),
            full.noise,
            experiment.uses.share_aside,
        )
        for model in (full, base)
    )
    return nats_full > nats_base


@dataclass(frozen=True, eq=False)
class _Behind:
    """A simulator that is right but for its sensor, and its rival: the simulator of other lungs."""

    experiment: Experiment  #: with the simulator as given.
    sensor: SensorBehind  #: what stands behind it.
    refit: Floats  #: pressures of the simulator with R and C refitted, cmH2O, ``(n, T)``.
    lungs: tuple[dict[str, Plant], dict[str, Plant]]  #: base models of response and recording.

    @property
    def sensed(self) -> Experiment:
        """The experiment with the simulator as its sensor shows it."""
        shown = self.sensor.readings(self.experiment.before, self.experiment.data.dt)
        return replace(self.experiment, before=shown)

    def conclude(self, beside: Diagnosis, settings: SelectionConfig) -> Diagnosis:
        """The diagnosis with the sensor among what is missing.

        Args:
            beside: what is missing in the simulator as the sensor shows it.
            settings: every threshold.
        """
        experiment, traces = self.experiment, beside.traces
        breaths, judge = experiment.breaths, experiment.judge
        given = {"before": experiment.before, "refit": self.refit, "after": traces.after}
        refitted, chosen = choose(breaths, judge, given)
        pressures = {
            "before": experiment.before,
            "refit": by_lung(breaths, given, refitted),
            "after": by_lung(breaths, given, chosen),
        }
        open_loop = compare_open_loop(breaths, judge, pressures, beside.open_loop.noise_floor)
        open_loop = replace(open_loop, scatter_error=beside.open_loop.scatter_error)
        rest = max(open_loop.whole.rmse**2 - open_loop.noise_floor**2, 0.0) ** 0.5
        tested = experiment.uses.identifying
        location = locate(
            breaths.select(tested),
            pressures["refit"][tested],
            beside.noise[0],
            traces.flow[tested],
            traces.volume[tested],
            settings=settings.residuals,
        )
        with compilation.float64():
            plants = {
                name: behind_sensor(
                    plant, self.sensor.sensor, chosen[name], tuple(of[name] for of in self.lungs)
                )
                for name, plant in beside.plants.items()
            }
        return replace(
            beside,
            verdict="named",
            mechanisms=(
                self.sensor.missing((open_loop.whole.rmse, rest)),
                *(m for m in beside.mechanisms if m.name != self.sensor.name),  # more of the same
            ),
            open_loop=open_loop,
            location=location,
            chosen=chosen,
            plants=plants,
            traces=replace(traces, **pressures),
        )


def _behind(
    experiment: Experiment, alone: IdentifiedModel, settings: SelectionConfig
) -> _Behind | None:
    """What a sensor behind the simulator explains; None if that is not most of what it lacks."""
    if experiment.simulators.is_base_physics:
        return None
    identifying, data = experiment.uses.identifying, experiment.identification_data
    response, testing = experiment.before[identifying], experiment.uses.testing[identifying]
    evaluator, first = alone.evaluator, experiment.breaths.pressure[:, 0]
    base, refitted = refit_lungs(evaluator, data, testing, response)
    refit = (
        experiment.before
        + alone.pressures(refitted, experiment.data, first)
        - alone.pressures(base, experiment.data, first)
    )
    own_model = alone.pressures(alone.conclusion.full, data, response[:, 0])
    found = find_sensor(
        data,
        testing,
        experiment.uses.fitted[identifying],
        response,
        (own_model, refit[identifying]),
        settings,
    )
    if found is None:
        return None
    plants = (estimates.plants_of(base, evaluator), estimates.plants_of(refitted, evaluator))
    return _Behind(experiment, found, refit, plants)


def _ids(breaths: Breaths, uses: Split) -> dict[str, tuple[int, ...]]:
    """Ids of the breaths by their use."""
    masks = {
        "training": ~uses.testing & uses.fitted,
        "testing": uses.testing,
        "judging": uses.judging,
        "aside": uses.aside,
    }
    return {name: tuple(int(i) for i in breaths.breath_id[mask]) for name, mask in masks.items()}


def _of_lung(breaths: Breaths, lung: str) -> Breaths:
    by_lung = breaths.by_lung_index
    if lung not in by_lung:
        raise InputError(
            f"the recording has no breath of lung {lung}; choose one of {', '.join(by_lung)}"
        )
    return breaths.select(by_lung[lung])


def _name(given: SimulatorLike, simulators: Simulators) -> str:
    """Name of a simulator in reports."""
    if isinstance(given, str | Path | Simulators) or isinstance(simulators, PythonSimulators):
        return simulators.name
    return "given"


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
            notes = [note for lung in lungs for note in lung.notes]
            return tuple(lung.match for lung in lungs), notes
        except InputError as error:
            return mechanics.match_labels(fit), [f"R and C are from pressure alone: {error}."]
    return mechanics.match_labels(fit), []


def _missing_mechanism(
    name: str,
    changed: bool,
    recording_model: IdentifiedModel,
    simulator_model: IdentifiedModel | None,
    experiment: Experiment,
    errors: tuple[float, float],
) -> MissingMechanism:
    """A missing mechanism; ``errors``: error, and its part that is shown not to be noise, cmH2O."""
    conclusion = recording_model.conclusion
    # Nobody knows the efforts of breaths to come: their errors do not tell what efforts are worth.
    worth = float("nan") if varies_by_breath(name) else conclusion.worths.get(name, float("nan"))
    alternatives = conclusion.alternatives.get(name, Alternatives((), 1.0, ()))
    simulator_estimates = {}
    if simulator_model is not None and changed:
        simulator_estimates = estimates.parameter_estimates(simulator_model.fit, name)
    values = estimates.with_form_error(
        estimates.parameter_estimates(recording_model.fit, name),
        name,
        alone=len(conclusion.names) == 1,
    )
    changes = [p.name for p in mechanism(name).description.parameters if p.change_point]
    affected = None
    if changes:
        model, path = recording_model, f"{name}.{changes[0]}"
        at = place_of_change(model.evaluator, model.fit, experiment.identification_data, path)
        values[changes[0]] = replace(values[changes[0]], value=at.value, ci95=(at.low, at.high))
        seen = experiment.uses.identifying
        ids, position = experiment.breaths.breath_id[seen], experiment.data.position[seen]
        affected = first_after(at, position, ids)
    return MissingMechanism(
        name=name,
        parameters=values,
        confidence=alternatives.confidence,
        alternatives=alternatives.names,
        nats=conclusion.held_out_gains.get(name, 0.0),
        changed=changed,
        simulator_values={key: estimate.value for key, estimate in simulator_estimates.items()},
        worth=worth,
        breaths=affected,
        explains=explained_share(worth, *errors),
    )


def _request(conclusion: Conclusion) -> BreathRequest | None:
    rivals = [rival for listed in conclusion.alternatives.values() for rival in listed.models]
    return request_breaths(conclusion.named, rivals, conclusion.noise.white)
