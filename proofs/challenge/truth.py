"""What a rig conceals, in the terms of the vocabulary: what is right to say of it, and its values.

A fit assumes the nominal gain of the valve; true values are converted to what it should find.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from hardware_eval.emulation.cases import EFFECTS, NOMINAL_GAIN, Case, Effect
from proofs.challenge.contract import PARAMETERS, TERMS, UNKNOWN, place_of
from proofs.challenge.detectability import LIMIT
from proofs.challenge.faults.effects import FaultsCase
from proofs.challenge.questions import DrawnCase
from proofs.challenge.stranger import effects as stranger

#: Power of (true gain / nominal gain) by which a parameter's value changes when a fit assumes the
#: nominal gain: flows are scaled, pressures are not.
_POWERS = {
    "leak.conductance": -1,
    "circuit_compliance.compliance": -1,
    "inertance.inertance": 1,
    "turbulent_resistance.quadratic": 2,
}


@dataclass(frozen=True)
class Concealed:
    """One effect of a rig."""

    name: str  #: name of the effect in its generator.
    seen: bool  #: whether it is above the detection limit; what is not may be left out.
    terms: frozenset[str]  #: terms that are right for it, one of which is enough.
    beside: frozenset[str] = frozenset()  #: terms that may stand beside these.

    @property
    def places(self) -> frozenset[str]:
        """Where it acts."""
        return frozenset(place_of(term) for term in self.terms)


def concealed(drawn: DrawnCase, nats: Iterable[float]) -> tuple[Concealed, ...]:
    """The effects of a case.

    Args:
        drawn: the case.
        nats: log-likelihood that is lost without each of its effects, nats.
    """
    return tuple(
        Concealed(effect.name, loss >= LIMIT, *_terms(drawn.case, effect))
        for effect, loss in zip(drawn.case.effects, nats, strict=True)
    )


def _terms(case: Case, effect: Effect) -> tuple[frozenset[str], frozenset[str]]:
    right, beside = {effect.name}, set()
    of_stranger = isinstance(case, stranger.StrangerCase)
    families = stranger.EFFECTS if of_stranger else EFFECTS
    if isinstance(case, FaultsCase) or families[effect.name].inside:
        if of_stranger and effect.name == "inertance":
            # It comes with a circuit's compliance, which may be named or not; alone below the
            # detection limit.
            beside = {"circuit_compliance"}
    else:  # both generators have it in the same places
        family = stranger.EFFECTS[effect.name]
        right = {*TERMS.intersection(family.names), *(UNKNOWN + at for at in family.places)}
    return frozenset(right), frozenset(beside)


def is_right(terms: frozenset[str], truth: tuple[Concealed, ...]) -> bool:
    """Whether terms hold one right term for each effect that is seen, and nothing wrong."""
    allowed = frozenset().union(*(effect.terms | effect.beside for effect in truth))
    return terms <= allowed and all(terms & effect.terms for effect in truth if effect.seen)


def has_library_form(effect: Effect) -> bool:
    """Tell whether the library has the effect in exactly this form."""
    family = EFFECTS[effect.name]
    return family.inside and effect.form == family.forms[0]


def true_values(case: Case) -> dict[str, float]:
    """Parameters by path, of effects that the vocabulary has in exactly this form.

    R and C are given where nothing is missing, since effects change their meaning.

    Parameters that the library fits only on request (shapes), parameters that differ from breath to
    breath, and rounding, which has no size, are left out.
    """
    assert case.base is not None
    ratio = case.base.gain / NOMINAL_GAIN
    if not case.effects:
        return {"R": case.base.R * ratio, "C": case.base.C / ratio}
    if isinstance(case, FaultsCase):
        paths = {f"{e.name}.{key}": v for e in case.effects for key, v in e.parameters.items()}
        return {path: value for path, value in paths.items() if path in PARAMETERS}
    values: dict[str, float] = {}
    if not isinstance(case, stranger.StrangerCase):
        for effect in filter(has_library_form, case.effects):
            values |= _values_of(effect, ratio)
        return values
    for effect in case.effects:
        if effect.name == "circuit_compliance":
            # The circuit that every rig of this generator has adds to the drawn one.
            whole = effect.parameters["compliance"] + case.dead_space
            effect = replace(effect, parameters={"compliance": whole})
        if effect.form == stranger.SAME:
            values |= _values_of(effect, ratio)
    _refer_to_zero_pressure(values, case)
    return values


def _refer_to_zero_pressure(values: dict[str, float], case: stranger.StrangerCase) -> None:
    """Convert a ratio to the elastance of a stiffening lung, which the generator states at PEEP.

    The library states it at zero pressure. An exponential curve is the same from any pressure, with
    another compliance; half a sigmoid is not, and has no such ratio.
    """
    path = "viscoelasticity.ratio"
    for effect in case.effects:
        if effect.name == "nonlinear_compliance" and path in values:
            assert case.base is not None
            ratio = values.pop(path)
            if effect.form == "Salazar-Knowles":
                values[path] = ratio * np.exp(case.base.peep / effect.parameters["capacity"])


def _values_of(effect: Effect, ratio: float) -> dict[str, float]:
    given = effect.parameters
    if effect.name == "command_rounding":
        return {}
    if effect.name == "patient_effort":
        return {"patient_effort.duration": given["duration"]}
    if effect.name == "supply_droop":  # per flow, which is scaled
        k = given["drop"] / (1.0 - given["drop"]) * ratio
        return {"supply_droop.drop": k / (1.0 + k)}
    paths = {f"{effect.name}.{key}": value for key, value in given.items()}
    return {path: value * ratio ** _POWERS.get(path, 0) for path, value in paths.items()}
