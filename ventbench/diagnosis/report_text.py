"""A diagnosis in plain sentences."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

from ventbench.diagnosis.findings import (
    Change,
    Findings,
    MissingMechanism,
    NonparametricTerm,
)
from ventbench.diagnosis.number_text import (
    PHASES,
    breaths_in_words,
    capital,
    error_phrase,
    error_region,
    lung,
    probability,
    quantity,
    quantity_like,
    rounded,
    scaled,
    signed,
    two_digits,
)
from ventbench.mechanics.labels import Estimate
from ventbench.physics import mechanism, parameter
from ventbench.physics.catalogue import events

#: Probability that is said at most, as no model is so right that more means anything.
_MOST_SURE = 0.99

#: Share of the error that is no noise below which a name is the nearest in the library.
_NEAREST = 0.8

#: From this number of effects on, a headline counts them instead of naming them.
_SEVERAL = 3

#: Numbers at the beginning of a headline.
_NUMBERS = {3: "Three", 4: "Four", 5: "Five", 6: "Six"}

#: Fewer judging breaths than these leave the worth of a correction vague.
_FEW_BREATHS = 10

#: Places of less weight than this are excluded; the others are one answer.
_LEAST_WEIGHT = 0.05

#: Posterior probability below which a name is weak.
_WEAK = 0.5

#: A strength this near to the end of its range, as a share of the range, stands there.
_AT_END = 0.01


def sentences(findings: Findings) -> list[str]:
    """Everything a reader should know, the most important first."""
    texts = [answer(findings), *map(missing_mechanism, findings.mechanisms)]
    texts += [effect(findings), *alternatives(findings), nonparametric_term(findings)]
    texts += [remaining(findings), *map(lung, findings.lungs)]
    texts += [scatter(findings), request(findings)]
    texts += [*would_change(findings), *findings.notes]
    return [text for text in texts if text]


def answer(findings: Findings) -> str:
    """What is missing, how sure that is, what mending it is worth, and what stays unexplained."""
    return f"{verdict(findings)}; {worth(findings)}."


def headline(findings: Findings) -> str:
    """What is missing and what mending it is worth, in one short sentence."""
    if findings.left_out is not None:
        rest = headline(dataclasses.replace(findings, left_out=None))
        return f"{findings.left_out}. {rest}"
    if findings.saturated is not None:
        rest = headline(dataclasses.replace(findings, saturated=None))
        return f"Readings saturate at {rounded(findings.saturated[0], 1)} cmH2O. {rest}"
    simulator, errors = f"the {findings.simulator} simulator", findings.open_loop
    before, after = rounded(errors.refit.rmse, 2), rounded(errors.after.rmse, 2)
    if findings.verdict == "nothing_missing":
        nothing = "No mechanism is shown to be" if findings.remaining else "Nothing is"
        return f"{nothing} missing in {simulator}: it errs by {after} cmH2O"
    if findings.verdict == "unnamed":
        summary = f"Something is missing in {simulator} that has no name"
        if findings.nonparametric is None and findings.changes:
            summary = f"Missing in {simulator}: {change(findings.changes[0])}"
    else:
        titles = [mechanism_phrase(missing) for missing in findings.mechanisms]
        several = f"{_NUMBERS.get(len(titles), str(len(titles)))} effects are missing in"
        summary = f"Missing in {simulator}: {_listed(titles)}"
        if len(titles) >= _SEVERAL:
            summary = f"{several} {simulator}"
    if after == before:
        return f"{summary}, and the error stays at {after} cmH2O"
    return f"{summary}; mending {_pronoun(findings)} takes the error from {before} to {after} cmH2O"


def verdict(findings: Findings) -> str:
    """What is missing, and how sure that is; without a full stop."""
    if findings.left_out is not None:
        continuation = verdict(dataclasses.replace(findings, left_out=None))
        return f"{findings.left_out}; by the others: {continuation}"
    if findings.saturated is not None:
        reading, share = findings.saturated
        saturates = (
            f"The pressure sensor saturates at {rounded(reading, 1)} cmH2O "
            f"({100 * share:.0f} % of the readings, which are left out); by the others: "
        )
        return saturates + verdict(dataclasses.replace(findings, saturated=None))
    simulator, term = f"the {findings.simulator} simulator", findings.nonparametric
    if findings.verdict == "nothing_missing":
        how = "" if _is_unchanged(findings) else "with R and C refitted, "
        if findings.remaining:
            region = max(findings.remaining, key=lambda region: region.share)
            return (
                f"No mechanism is shown to be missing in {simulator}, but "
                f"{error_phrase(region, findings.noise[0])} ({probability(region.p_value)})"
            )
        return f"Nothing is missing: {how}{simulator} explains the recording"
    addition = "".join(f", and {change(shift)}" for shift in findings.changes[:1])
    if findings.verdict == "unnamed":
        if term is not None:
            return (
                f"Something is missing in {simulator} that is not in the library of mechanisms "
                f"({evidence(term.nats)}); its place in the model is {_places(term)}{addition}"
            )
        if findings.changes:
            return (
                f"Something is missing in {simulator} that depends on the breath number: "
                f"{change(findings.changes[0])}, which no mechanism of the library explains"
            )
        return (
            f"Something is missing in {simulator}, but the recording singles out neither a "
            "mechanism nor a place in the model"
        )
    names = _listed(
        [mechanism_phrase(missing, with_rivals=True) for missing in findings.mechanisms]
    )
    rest = "" if term is None else ", and an effect that is not in the library"
    if findings.form is not None:
        several = len(findings.mechanisms) > 1
        which = f"; {_listed([title(name) for name in findings.form.form_of])}" if several else ""
        rest = f"{which}, in another form than the library's{rest}"
    return f"Missing in {simulator}: {names}{rest} ({sureness(findings)}){addition}"


def sureness(findings: Findings) -> str:
    """How sure the names are, or the place without a name, in words.

    A probability stands only where nothing speaks against the name or its strength; else that is
    said in its place.
    """
    doubts = [doubt for missing in findings.mechanisms for doubt in _doubts(missing, findings)]
    if doubts:
        return f"uncertain: {'; '.join(doubts)}"
    if not findings.mechanisms:
        term = findings.nonparametric
        return "" if term is None else evidence(term.nats)
    prefix = "each at " if len(findings.mechanisms) > 1 else ""
    return f"{prefix}{posterior(min(missing.confidence for missing in findings.mechanisms))}"


def _doubts(missing: MissingMechanism, findings: Findings) -> list[str]:
    """What speaks against a name or its strength, in words."""
    doubts = []
    strength = mechanism(missing.name).description.strength
    if missing.confidence < _WEAK:
        doubts.append(f"{missing.name} has a {posterior(missing.confidence)} only")
    if strength.name in missing.parameters:
        value, margin = (
            missing.parameters[strength.name].value,
            _AT_END * (strength.high - strength.low),
        )
        if min(value - strength.low, strength.high - value) < margin and strength.neutral != value:
            doubts.append(f"the strength of {missing.name} is at the end of its range")
    least = findings.settings.residuals.negligible
    if missing.worth < least:
        doubts.append(f"{missing.name} is worth less than {least:g} cmH2O")
    if missing.explains < _NEAREST:
        doubts.append(f"{missing.name} explains {_percent(missing.explains)} of what is no noise")
    return doubts


def change(shift: Change) -> str:
    """What changes in the course of the recording, as a phrase."""
    subject = {
        "gain": "the gain of the valve",
        "zero": "the zero of the pressure",
        "error": "the size of the error",
    }[shift.of]
    by = f"x {shift.size:.3g}" if shift.of != "zero" else f"by {signed(shift.size)} cmH2O"
    if shift.drifts:
        how = f"drifts from the first to the last breath ({by}"
    else:
        how = f"changes at breath {shift.breath} ({by}"
    return f"{subject} {how}, {probability(shift.p_value)})"


def evidence(nats: float) -> str:
    """Held-out log-likelihood in words."""
    return f"held-out evidence {nats:.0f} nats"


def posterior(share: float) -> str:
    """Posterior probability in words."""
    if share > _MOST_SURE:
        return f"posterior probability above {_percent(_MOST_SURE)}"
    return f"posterior probability of {_percent(share)}"


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %"


def worth(findings: Findings) -> str:
    """What mending the simulator is worth on breaths set aside, and what stays unexplained.

    It goes on from :func:`verdict`, without a full stop.
    """
    errors = findings.open_loop
    after, noise = rounded(errors.after.rmse, 2), rounded(errors.noise_floor, 2)
    noise = f"the noise of {noise}"
    if errors.scatter_error:
        scatter = rounded(errors.scatter_error, 2)
        noise = f"{noise} and the {scatter} of what differs from breath to breath"
    total = f"of the {rounded(errors.whole.rmse, 2)} over whole breaths"
    remainder = f"{total}, {rounded(errors.unexplained, 2)} cmH2O stay unexplained beyond {noise}"
    if not math.isfinite(errors.unexplained):
        remainder = f"there is {noise}"
    elif errors.unexplained < 0.5 * errors.least_error:
        remainder = f"{total}, hardly more than {noise} is left"
    count = len(errors.held_out_breaths)
    out = errors.groups.get("expiration", {})
    before_out, after_out = (
        rounded(out[stage].rmse, 2) if stage in out else "unknown" for stage in ("refit", "after")
    )
    also = "" if after_out == "unknown" else f" in inspiration and {after_out} in expiration"
    original = "" if _is_unchanged(findings) else f"{rounded(errors.before.rmse, 2)} as given"
    stays = f"{after} cmH2O{also}{original and f' ({original})'}"
    if findings.verdict == "nothing_missing":
        return f"it errs by {stays} on {count} breaths set aside, and {remainder}"
    refit = rounded(errors.refit.rmse, 2)
    term = findings.nonparametric
    by_breath = term is not None and term.x_unit.startswith("sample") and not findings.mechanisms
    if by_breath or _swings(findings):
        return (
            "it differs from breath to breath, so that no correction of the simulator mends it: "
            f"the error on {count} breaths set aside stays at {stays}, and {remainder}"
        )
    if errors.after == errors.refit or (after, after_out) == (refit, before_out):
        return (
            f"mending {_pronoun(findings)} is worth nothing on the {count} breaths set aside, "
            f"where the error stays at {stays}, and {remainder}"
        )
    if also:
        worse = out["after"].rmse - out["refit"].rmse >= findings.settings.residuals.negligible
        also = f" in inspiration, and from {before_out} to {after_out} in expiration"
        also += ", where it gets worse" if worse else ""
    start = original and f" (R and C refitted; {original})"
    return (
        f"mending {_pronoun(findings)} takes the error on {count} breaths set aside from "
        f"{refit}{start} to {after} cmH2O{also}, and {remainder}"
    )


def would_change(findings: Findings) -> list[str]:
    """What would overturn or weaken the answer, a sentence each."""
    texts = []
    names = [missing.name for missing in findings.mechanisms]
    if names:
        pronoun, them = ("it", "the name") if len(names) == 1 else ("one", "that name")
        texts.append(
            f"A further recording whose held-out breaths gain less than {_deciding(findings):g} "
            f"nats by {pronoun} would withdraw {them}."
        )
    texts.extend(
        f"Pressure alone can never tell {name} from {_listed(same, 'or')}; flow or volume of the "
        "lung may."
        for name in names
        if (same := mechanism(name).description.equivalents)
    )
    count = len(findings.open_loop.held_out_breaths)
    if count < _FEW_BREATHS:
        texts.append(
            f"Only {count} breaths judge the correction; twenty breaths more of the same lung "
            "would make its worth firm."
        )
    if findings.verdict == "nothing_missing":
        texts.append(
            "Breaths of another kind, such as short pulses, long holds or a second lung, may show "
            "what these cannot; diagnosis.json lists the smallest strength of each mechanism that "
            "would have been seen."
        )
    elif findings.open_loop.unexplained > findings.open_loop.least_error and not _swings(findings):
        texts.append(
            "More than the noise is unexplained: a further effect may act, and with it the "
            "strengths given here may move."
        )
    steps = [shift.breath for shift in findings.changes if not shift.drifts]
    if steps:
        texts.append(
            f"The breaths before {steps[0]}, and those from it on, diagnosed by themselves, show "
            "what else is missing."
        )
    elif findings.verdict == "unnamed":
        texts.append(
            "A mechanism of that shape in the library would give it a name; docs/physics.md says "
            "how one is added."
        )
    return texts


def _swings(findings: Findings) -> bool:
    """Whether all that is missing oscillates, with a phase of its own in each breath."""
    periodic = [
        missing.name in events() and not missing.affected for missing in findings.mechanisms
    ]
    return bool(periodic) and all(periodic)


def remaining(findings: Findings) -> str:
    """Where the corrected simulator still errs most."""
    if not findings.remaining or findings.open_loop.after == findings.open_loop.refit:
        return ""
    region = max(findings.remaining, key=lambda region: region.share)
    return f"After the correction, {error_phrase(region, findings.noise[0])}."


def visible_strengths(findings: Findings) -> dict[str, str]:
    """Smallest strength of each mechanism that would have been seen, with its unit, by name.

    ``""`` where none would; empty unless nothing is missing.
    """
    texts = {}
    for name, limit in findings.detection_limits.items():
        strength = mechanism(name).description.strength
        factor, unit = scaled(
            Estimate(limit, strength.unit, (limit, limit)), f"{name}.{strength.name}"
        )
        text = f"{two_digits(factor * limit)}{f' {unit}' if unit else ''}"
        texts[name] = text if math.isfinite(limit) else ""
    return texts


def scatter(findings: Findings) -> str:
    """That breaths have valve gains of their own, if that is not "0 %".

    Gains with an order in time do not scatter.
    """
    if findings.gain_scatter < 0.005 or any(shift.of == "gain" for shift in findings.changes):
        return ""
    share = 100.0 * math.expm1(findings.gain_scatter)
    return (
        f"The gain of the valve differs from breath to breath by about {share:.0f} %, as if "
        "several rigs or supplies had been recorded; no simulator that sees the commands alone can "
        "know that, so part of the error stays."
    )


def title(name: str) -> str:
    """Return the name of a mechanism in words."""
    return mechanism(name).description.title


def mechanism_phrase(missing: MissingMechanism, *, with_rivals: bool = False) -> str:
    """A missing mechanism in words; of a change at a breath, what changes from which breath on.

    Args:
        missing: the mechanism.
        with_rivals: whether to add what else a change in the session may be: a drift that is no
            worse is one answer with the step.
    """
    text, model = title(missing.name), mechanism(missing.name)
    if missing.breaths is not None:
        strength = model.description.strength
        size = missing.parameters[strength.name]
        factor, unit = scaled(size, f"{missing.name}.{strength.name}")
        how = "rises" if size.value > 0.0 else "falls"
        by = f"{two_digits(abs(factor * size.value))} {unit}"
        text = f"{text.removeprefix('step of ')} {how} by {by} from breath {missing.breaths[0]} on"
    rivals = [name for name in missing.alternatives if with_rivals and model.uses_position]
    rivals = [title(name) for name in rivals if mechanism(name).uses_position]
    if missing.affected or missing.name in events():  # places that are alike are one answer
        rivals = [title(name) for name in missing.alternatives if with_rivals]
    if missing.explains < _NEAREST:
        text = f"an effect to which the nearest in the library is {text}"
    if rivals:
        text = f"{text}, or {_listed(rivals, 'or')}"
    return f"{text}, in {breaths_in_words(missing.affected)}" if missing.affected else text


def missing_mechanism(missing: MissingMechanism) -> str:
    """Values of a missing mechanism with their 95 % intervals, and how far its name is ahead."""
    description = mechanism(missing.name).description
    meanings = {parameter.name: parameter.meaning for parameter in description.parameters}
    values = []
    if missing.breaths is not None:
        first, low, high = missing.breaths
        values.append(f"from breath {first} [{low}, {high}] on")
    for name, estimate in missing.parameters.items():
        if missing.breaths is not None and parameter(f"{missing.name}.{name}").change_point:
            continue  # which is told as a breath
        text, path = quantity(estimate, f"{missing.name}.{name}"), f"{missing.name}.{name}"
        if name in missing.simulator_values:
            reference = quantity_like(missing.simulator_values[name], estimate, path)
            text += f" instead of {reference} in the simulator"
        meaning = meanings.get(name, name)
        # "Dead time" need not be said twice.
        values.append(text if meaning in description.title else f"{text} ({meaning})")
    start = capital(description.title)
    if missing.changed and not missing.simulator_values:
        start += ", which the simulator has with another strength"
    values_in_words = "; ".join(values)
    return (
        f"{start} ({missing.name}){': ' if values else ''}{values_in_words}; "
        f"{evidence(missing.nats)}; {posterior(missing.confidence)}."
    )


def effect(findings: Findings) -> str:
    """Sentence on where and by how much the simulator errs without the correction."""
    if not findings.location:
        return ""
    phases = [region for region in findings.location if region.axis in PHASES]
    region = max(phases or findings.location, key=lambda region: region.share)
    text = error_phrase(region, findings.noise[0])
    if findings.verdict == "named":
        condition = "Without it" if len(findings.mechanisms) == 1 else "Without them"
        return f"{condition} {text}, even with R and C refitted."
    if _is_unchanged(findings):
        return error_region(region, findings.noise[0])
    return f"With R and C refitted, {text}."


def alternatives(findings: Findings) -> list[str]:
    """Mechanisms that the recording cannot distinguish."""
    return [
        f"This recording cannot tell {mechanism.name} from {_listed(mechanism.alternatives, 'or')}."
        for mechanism in findings.mechanisms
        if mechanism.alternatives
    ]


def request(findings: Findings) -> str:
    """Sentence on what to record next."""
    proposal = findings.request
    if proposal is None:
        return ""
    text = f"Record next: {proposal.title.rstrip('.')}."
    if not proposal.why:
        return text
    purpose = f"distinguish between {_listed(proposal.why)}"
    if len(proposal.why) == 1:
        purpose = f"test {proposal.why[0]}"
    expected = f"expected evidence {proposal.nats:.0f} nats; {_deciding(findings):g} decide"
    return f"{text} These breaths {purpose} ({expected})."


def nonparametric_term(findings: Findings) -> str:
    """Sentence on where an unnamed effect acts, or on a mechanism's form, and what it explains."""
    form, term = findings.form, findings.nonparametric
    if form is not None:
        names = _listed([title(name) for name in form.form_of])
        return (
            f"The form of the {names} differs from the library's: a nonparametric term for "
            f"{place(form)} beside it gains {form.nats:.0f} nats on held-out breaths and explains "
            f"{100 * form.explains:.0f} % of the squared error that it leaves above the noise."
        )
    if term is None:
        return ""
    start = "In addition to these mechanisms, a" if findings.verdict == "named" else "A"
    return (
        f"{start} nonparametric term for {_places(term)} explains {100 * term.explains:.0f} % of "
        f"the squared error above the noise.{_certainty(term)}"
    )


def _certainty(term: NonparametricTerm) -> str:
    """Sentence on how certain a place is, and by what.

    A course in time at any place can give any pressures: only its smoothness tells places apart.
    """
    listed = [(name, share) for name, share in term.places if share >= _LEAST_WEIGHT]
    text = ""
    if len(listed) > 1:
        weights = _listed([f"{name} {100 * share:.0f} %" for name, share in listed], "or")
        text = f" The breaths do not settle where it acts: {weights}."
    if not term.x_unit.startswith("sample"):
        return text
    if len(listed) == 1:
        rest = _listed([name for name, _ in term.places if name != listed[0][0]], "and")
        text = f" A course as smooth at other places ({rest}) is less likely." if rest else ""
    return f"{text} From pressure alone, a rougher course elsewhere would read the same."


def _places(term: NonparametricTerm) -> str:
    """Place of a term, with those that the recording cannot tell from it."""
    rivals = [n for n, share in term.places if share >= _LEAST_WEIGHT and n != term.name]
    if not rivals:
        return place(term)
    return f"{place(term)}, or {_listed(rivals, 'or')}, which these breaths cannot tell from it"


def place(term: NonparametricTerm) -> str:
    """Place of a term with its meaning: ``f(V) (the recoil of the lung depends on ...)``."""
    return f"{term.name} ({term.meaning.removeprefix(f'{term.name}: ')})"


def _pronoun(findings: Findings) -> str:
    """Pronoun for what is missing."""
    count = len(findings.mechanisms) + (findings.nonparametric is not None)
    return "it" if count < 2 else "them"


def _deciding(findings: Findings) -> float:
    """Held-out evidence from which a term is needed, nats."""
    return findings.settings.held_out_test.threshold


def _is_unchanged(findings: Findings) -> bool:
    """Whether the simulator is left as it is, without a refit."""
    return findings.open_loop.refit == findings.open_loop.before


def _listed(names: Sequence[str], word: str = "and") -> str:
    if len(names) < 2:
        return "".join(names)
    return f"{', '.join(names[:-1])} {word} {names[-1]}"
