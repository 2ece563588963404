"""One answer against the truth: names, places and values.

A fit assumes the nominal gain of the valve; true values are converted to what it should find.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hardware_eval.emulation.cases import EFFECTS, NOMINAL_GAIN, Case, Effect
from proofs.challenge.detectability import LIMIT
from proofs.challenge.generators import in_library
from proofs.challenge.questions import DrawnCase, Kind
from proofs.challenge.stranger import effects as stranger

#: Places that are right for an effect outside the library.
PLACES: dict[str, frozenset[str]] = {
    "volume_resistance": frozenset({"R(V)"}),
    "cardiogenic": frozenset({"f(t) at the alveolus"}),
    "pulsating_supply": frozenset({"f(t) at the supply"}),
    "direction_resistance": frozenset({"R(direction)", "f(Q)"}),
    "second_compartment": frozenset({"memory of p", "memory of V"}),
    "sensor_nonlinearity": frozenset({"measurement"}),
    "expiratory_valve_orifice": frozenset({"exhalation path"}),
}

#: Mechanisms whose equations equal those of an effect outside this generator's library, or do so
#: when only pressure is seen.
EQUIVALENTS: dict[str, str] = {
    "second_compartment": "viscoelasticity",
    "sensor_nonlinearity": "sensor_curve",
}

#: Power of (true gain / nominal gain) by which a parameter's value changes when a fit assumes the
#: nominal gain: flows are scaled, pressures are not.
_POWERS = {
    "leak.conductance": -1,
    "circuit_compliance.compliance": -1,
    "inertance.inertance": 1,
    "turbulent_resistance.quadratic": 2,
}

#: Number of alternatives of an answer that count.
_ALTERNATIVES = 2


def library_names(case: Case) -> frozenset[str]:
    """Mechanisms of the library that are in the case."""
    return frozenset(effect.name for effect in case.effects if in_library(case, effect.name))


def acceptable_names(
    case: Case, named: frozenset[str] = frozenset(), *, inertance_is_seen: bool = True
) -> frozenset[str]:
    """Mechanisms of the library that are in the case, or are equivalent to an effect in it.

    Args:
        case: the case.
        named: names of the answer. A stranger's effect outside the library has names that are right
            if the library has come to have one of them; and its inertance comes with a circuit's
            compliance, which may be named or not.
        inertance_is_seen: False if a stranger's inertance is below the detection limit, so that the
            circuit alone is a right answer.
    """
    if isinstance(case, stranger.StrangerCase):
        other = {n for e in case.effects if not in_library(case, e.name)
                 for n in stranger.EFFECTS[e.name].names}  # fmt: skip
        inside = library_names(case)
        if "inertance" in inside:
            other.add("circuit_compliance")
        if not inertance_is_seen and "inertance" not in named:
            inside -= {"inertance"}
        return inside | (named & other)
    equivalents = {EQUIVALENTS[e.name] for e in case.effects if e.name in EQUIVALENTS}
    return library_names(case) | equivalents


def right_places(case: Case) -> frozenset[str]:
    """Places that are right for the case's effects outside the library."""
    if isinstance(case, stranger.StrangerCase):
        own = [e.name for e in case.effects if not in_library(case, e.name)]
        return frozenset(place for name in own for place in stranger.EFFECTS[name].places)
    return frozenset().union(*(PLACES.get(effect.name, frozenset()) for effect in case.effects))


def detectable_names(case: Case, nats: list[float]) -> frozenset[str]:
    """Effects above the detection limit, by their nats."""
    pairs = zip(case.effects, nats, strict=True)
    return frozenset(effect.name for effect, loss in pairs if loss >= LIMIT)


def has_library_form(effect: Effect) -> bool:
    """Tell whether the library has the effect in exactly this form."""
    family = EFFECTS[effect.name]
    return family.inside and effect.form == family.forms[0]


def true_values(case: Case) -> dict[str, float]:
    """Parameters by path, of effects that the library has in exactly this form.

    Parameters that the library fits only on request (shapes), parameters that differ from breath to
    breath, and rounding, which has no size, are left out.
    """
    assert case.base is not None
    ratio = case.base.gain / NOMINAL_GAIN
    values = {}
    for effect in case.effects:
        if isinstance(case, stranger.StrangerCase):
            same = effect.form == stranger.SAME
        else:
            same = has_library_form(effect)
        if same and effect.name == "circuit_compliance" and isinstance(case, stranger.StrangerCase):
            # The circuit that every rig of this generator has adds to the drawn one.
            whole = effect.parameters["compliance"] + case.dead_space
            effect = replace(effect, parameters={"compliance": whole})
        if same:
            values |= _values_of(effect, ratio)
    if isinstance(case, stranger.StrangerCase):
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


@dataclass(frozen=True)
class EstimateAgainstTruth:
    """An estimated parameter beside its true value.

    Attributes:
        path: path of the parameter.
        value: estimate.
        low: lower end of the estimate's 95 % interval.
        high: upper end of the interval.
        true: true value, as a fit with the nominal valve gain sees it.
    """

    path: str
    value: float
    low: float
    high: float
    true: float

    @property
    def error(self) -> float:
        """Absolute relative error."""
        return abs(self.value - self.true) / abs(self.true)

    @property
    def covered(self) -> bool:
        """Whether the interval holds the truth."""
        return self.low <= self.true <= self.high


@dataclass(frozen=True)
class JudgedCase:
    """One case with its answer.

    Attributes:
        name: name of the case.
        kind: kind of the question.
        lung: label.
        strengths: strengths of the effects.
        effects: names of the effects in the rig.
        library: names of the library that are acceptable for these effects.
        seen: effects above the detection limit.
        verdict: verdict of the answer.
        named: mechanisms that the answer names.
        listed: true mechanisms that are named or among the first two alternatives to a name.
        open: whether the answer lists alternatives.
        slot: place without a name that the answer gives, or None.
        form: place of the nonparametric term that shows the form of a named mechanism, or None.
        right_slot: whether that place is one of the effect's.
        estimates: parameters of rightly named effects in the library's form.
        before: held-out open-loop RMSE of the given simulator, cmH2O.
        refit: held-out open-loop RMSE of the refitted simulator, cmH2O.
        after: held-out open-loop RMSE of the corrected simulator, cmH2O.
        seconds: time of the answer.
        peak: memory, MiB.
        first: whether the case was the first of its process, which includes compilation.
    """

    name: str
    kind: Kind
    lung: str
    strengths: tuple[str, ...]
    effects: tuple[str, ...]
    library: frozenset[str]
    seen: frozenset[str]
    verdict: str
    named: frozenset[str]
    listed: frozenset[str]
    open: bool
    slot: str | None
    form: str | None
    right_slot: bool
    estimates: tuple[EstimateAgainstTruth, ...]
    before: float
    refit: float
    after: float
    seconds: float
    peak: float
    first: bool

    @property
    def visible(self) -> bool:
        """Whether every effect is above the detection limit."""
        return self.seen == frozenset(self.effects)

    @property
    def silent(self) -> bool:
        """Whether the answer is that nothing is missing."""
        return self.verdict == "nothing_missing"

    @property
    def right(self) -> bool:
        """Whether the answer has all true names, no other name and no place without a name."""
        if self.kind == "outside":
            return self.said_outside and self.right_slot
        if not self.effects:
            return self.silent
        return self.verdict == "named" and self.named == self.library and self.slot is None

    @property
    def wrong(self) -> frozenset[str]:
        """Names that are not in the rig."""
        return self.named - self.library

    @property
    def said_outside(self) -> bool:
        """Whether the answer calls the effect unknown to the library, or names an equivalent."""
        equivalent = bool(self.library) and self.named == self.library
        return self.verdict == "unnamed" or equivalent

    @property
    def resolved(self) -> bool:
        """Whether the answer is right and lists no alternatives."""
        return self.right and not self.open


def judge(drawn: DrawnCase, nats: list[float], answer: dict[str, Any]) -> JudgedCase:
    """Compare an answer with the truth.

    Args:
        drawn: the case.
        nats: log-likelihood that is lost without each of its effects, nats.
        answer: content of the answer's file.
    """
    case, diagnosis = drawn.case, answer["diagnosis"]
    mechanisms = diagnosis["mechanisms"]
    named = frozenset(mechanism["name"] for mechanism in mechanisms)
    seen = detectable_names(case, nats)
    library = acceptable_names(case, named, inertance_is_seen="inertance" in seen)
    alternatives = {name for m in mechanisms for name in m["alternatives"][:_ALTERNATIVES]}
    place = diagnosis["slot"]["name"] if diagnosis["slot"] else None
    equivalent = drawn.kind == "outside" and bool(library) and named == library
    return JudgedCase(
        name=case.name,
        kind=drawn.kind,
        lung=case.lung,
        strengths=tuple(effect.strength for effect in case.effects),
        effects=tuple(effect.name for effect in case.effects),
        library=library,
        seen=seen,
        verdict=diagnosis["verdict"],
        named=named,
        listed=library & (named | alternatives),
        open=any(mechanism["alternatives"] for mechanism in mechanisms),
        slot=place,
        form=(diagnosis.get("form") or {}).get("name"),
        right_slot=place in right_places(case) or equivalent,
        estimates=_estimates(true_values(case), mechanisms),
        before=diagnosis["open_loop"]["before"]["rmse"],
        refit=diagnosis["open_loop"]["refit"]["rmse"],
        after=diagnosis["open_loop"]["after"]["rmse"],
        seconds=answer["seconds"],
        peak=answer["peak_mib"],
        first=answer["first_in_process"],
    )


def _estimates(
    true: dict[str, float], mechanisms: list[dict[str, Any]]
) -> tuple[EstimateAgainstTruth, ...]:
    estimates = []
    for mechanism in mechanisms:
        for key, estimate in mechanism["parameters"].items():
            path, value = f"{mechanism['name']}.{key}", estimate["value"]
            low, high = estimate["ci95"]
            if path in true and None not in (low, high, value):
                estimates.append(EstimateAgainstTruth(path, value, low, high, true[path]))
    return tuple(estimates)
