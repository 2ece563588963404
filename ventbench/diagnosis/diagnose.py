"""A whole diagnosis: what a simulator lacks, by a recording."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ventbench.diagnosis import estimates, shapes, simulators, split
from ventbench.diagnosis.against import against
from ventbench.diagnosis.compare import Lack, lacking
from ventbench.diagnosis.conclusion import Conclusion
from ventbench.diagnosis.corrected import Correction, corrected
from ventbench.diagnosis.experiment_design import request_breaths
from ventbench.diagnosis.findings import BreathRequest, MissingMechanism, Traces, Verdict
from ventbench.diagnosis.found import Found, found_in
from ventbench.diagnosis.refinement import Alternatives
from ventbench.diagnosis.residual_analysis import compare_open_loop, flow_and_volume, locate
from ventbench.diagnosis.result import Diagnosis
from ventbench.diagnosis.settings import DEFAULT, SelectionConfig
from ventbench.diagnosis.simulators import Given
from ventbench.diagnosis.steady import steadied
from ventbench.errors import InputError
from ventbench.mechanics.lung_match import LungMatch
from ventbench.recordings.breaths import Breaths
from ventbench.system_id import Fit, Noise, recorded
from ventbench.system_id.data import Floats

Progress = Callable[[str, float], None]


def diagnose(
    breaths: Breaths,
    *,
    plant: Given = "physics",
    lung: str | None = None,
    passive: bool = False,
    progress: Progress | None = None,
    settings: SelectionConfig = DEFAULT,
) -> Diagnosis:
    """Find what a simulator lacks.

    The same language is fitted to the recording and, unless the simulator is the base model itself,
    to its answers to the same commands: what only the recording needs is missing.

    Args:
        breaths: n recorded breaths; every third one of a lung is held out.
        plant: see :data:`~ventbench.diagnosis.simulators.Given`.
        lung: use only the breaths of this label.
        passive: nobody breathes, as in a test lung: efforts are out of the question.
        progress: is told what is done and which share of the whole is behind.
        settings: every threshold.

    Raises:
        InputError: if there are too few breaths, or no simulator for their lung.
    """
    began = time.perf_counter()
    tell = progress or (lambda what, share: None)
    if lung is not None:
        breaths = breaths.select(np.flatnonzero(breaths.lung_ids == lung))
    breaths, notes = split.usable(breaths)
    held = split.held_out(breaths)
    tell("simulating", 0.02)
    before = simulators.answers(plant, breaths)
    data = recorded(breaths)
    excluded = ("patient_effort",) if passive else ()
    alone = found_in(data, held, excluded, lambda what: tell(what, 0.3), settings)
    found, had = alone, None
    if plant != "physics":
        tell("the same questions to the simulator", 0.6)
        found, had = against(data, held, before, alone, excluded, lambda what: tell(what, 0.7))
    tell("drawing conclusions", 0.9)
    return _diagnosis(breaths, held, before, found, had, alone.fit, plant, notes, began)


def _diagnosis(
    breaths: Breaths, held: NDArray[np.bool_], before: Floats, found: Found, had: Found | None,
    alone: Fit, plant: Given, notes: list[str], began: float,
) -> Diagnosis:  # fmt: skip
    names, removed = lacking(found.fit, found.conclusion, had and had.fit, had and had.conclusion)
    steady = None if had is None else steadied(found, had, [one.name for one in names])
    if steady is not None:  # of what the recording does not show nothing is taken away
        (found, kept), removed = steady, []
        names = [one for one in names if one.name in kept]
    conclusion = found.conclusion
    correction = corrected(breaths, held, before, found, had, plant)
    answers = correction.answers
    place = shapes.slot(conclusion)
    own = had.conclusion.unnamed if had is not None else None
    if own is not None and place is not None and own.name == place.name:
        removed.append(f"The simulator has something without a name at {place.name} as well.")
    useless = correction.left and (bool(names) or place is not None)
    if useless:
        names, place, removed = [], None, [_left(correction)]
    noise = conclusion.noise
    lungs, more = _lungs(breaths, alone)
    flow, volume = flow_and_volume(breaths, found.fit, answers["refit"])
    here = np.flatnonzero(~np.isnan(answers["refit"]).all(axis=1))
    location = locate(
        breaths.select(here), answers["refit"][here], noise.sigma[0], flow[here], volume[here]
    )
    unnamed = place is not None or conclusion.unresolved or (useless and location)
    verdict: Verdict = "named" if names else "unnamed" if unnamed else "nothing_missing"
    return Diagnosis(
        verdict=verdict,
        mechanisms=tuple(_named(one, conclusion, found.fit, had) for one in names),
        nonparametric=place,
        location=location,
        open_loop=compare_open_loop(breaths, held, answers, float(noise.sigma[0])),
        lungs=lungs,
        request=None if useless else _request(conclusion),
        traces=Traces(breaths, held, answers["before"], answers["refit"], answers["after"], flow,
                      volume),
        plants=correction.plants,
        simulator=plant if isinstance(plant, str) else "given",
        noise=(float(noise.sigma[0]), float(noise.ar[0])),
        notes=(*notes, *removed, *correction.notes, *more),
        seconds=time.perf_counter() - began,
    )  # fmt: skip


def _left(correction: Correction) -> str:
    """Why a simulator is left as it is."""
    before, after = correction.errs
    return (
        "What could be found would make the simulator err more on the breaths that were fitted "
        f"({after:.2f} instead of {before:.2f} cmH2O, mean), so it is left as it is."
    )


def _lungs(breaths: Breaths, fit: Fit) -> tuple[tuple[LungMatch, ...], list[str]]:
    """The lungs: by flow or volume where they are recorded, which needs no model of the valve."""
    if breaths.flow is not None or breaths.volume is not None:
        try:
            matches, notes = estimates.lungs_by_flow(breaths)
            return matches, list(notes)
        except InputError as error:
            return estimates.lungs(fit), [f"R and C are from pressure alone: {error}."]
    return estimates.lungs(fit), []


def _named(one: Lack, conclusion: Conclusion, fit: Fit, had: Found | None) -> MissingMechanism:
    other = conclusion.alternatives.get(one.name, Alternatives((), 1.0, ()))
    own = estimates.parameters(had.fit, one.name) if had is not None and one.changed else {}
    return MissingMechanism(
        one.name,
        estimates.parameters(fit, one.name),
        other.confidence,
        other.names,
        conclusion.held_out_gains.get(one.name, 0.0),
        one.changed,
        {key: x.value for key, x in own.items()},
    )


def _request(conclusion: Conclusion) -> BreathRequest | None:
    rivals = [one.fitted for other in conclusion.alternatives.values() for one in other.models]
    return request_breaths(
        conclusion.named, rivals, noise=Noise((conclusion.noise.sigma[0],), (0.0,))
    )
