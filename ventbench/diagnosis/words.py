"""A diagnosis in plain sentences."""

from __future__ import annotations

import math

from ventbench.diagnosis.quantity import like, quantity, rounded, span
from ventbench.diagnosis.result import Diagnosis, Estimate, LungMatch, Named, Place, Slot
from ventbench.physics import mechanism

#: Axes whose ranges are a part of a breath: by these an effect is told best.
_PHASES = ("time since inspiration", "time since expiration")
_EDGE = "time since a valve edge"

#: How a range of a time is told: from what on, and of what if it begins there.
_MOMENTS = {
    _PHASES[0]: ("the start of inspiration", "of each breath"),
    _PHASES[1]: ("the start of expiration", "of expiration"),
    _EDGE: ("an edge of a valve", "after an edge of a valve"),
}

#: Times up to this are told in ms, s.
_SHORT = 0.15


def sentences(found: Diagnosis) -> list[str]:
    """All that a reader should know, the most important first."""
    said = [verdict(found), *(named(item) for item in found.mechanisms)]
    said += [effect(found), *alternatives(found), slot(found), distances(found)]
    said += [*(lung(item) for item in found.lungs), request(found), *found.notes]
    return [text for text in said if text]


def verdict(found: Diagnosis) -> str:
    """The answer in one sentence."""
    what = f"the {found.plant} simulator"
    if found.verdict == "nothing_missing":
        how = "" if _as_given(found) else "with R and C refitted, "
        return f"Nothing is missing: {how}{what} explains the recording."
    if found.verdict == "unnamed":
        return (
            f"Something is missing in {what}, but no name and no place is certain."
            if found.slot is None
            else f"Something is missing in {what} that the library has no name for; it acts as "
            f"{_acts(found.slot)}."
        )
    names = _and([f"{title(item.name)} ({item.name})" for item in found.mechanisms])
    rest = "" if found.slot is None else "; something without a name is missing too"
    return f"Missing in {what}: {names}{rest}."


def title(name: str) -> str:
    """A mechanism in a few words."""
    return mechanism(name).description.title


def named(item: Named) -> str:
    """What the recording needs, with the values and their intervals."""
    about = mechanism(item.name).description
    meanings = {parameter.name: parameter.meaning for parameter in about.parameters}
    needs = "The recording needs"
    if item.changed:
        needs = f"The simulator has {about.title} too, but the recording needs another:"
    values = [(key, _value(item, key, x)) for key, x in item.parameters.items()]
    if not values:
        return f"{needs} {about.title}."
    (first, value), *others = values
    meaning = meanings.get(first, first)
    # "Dead time" need not be said twice.
    if about.title.startswith(meaning) and not item.changed:
        text = f"{needs} {value} of {about.title}"
    else:
        within = "" if meaning in about.title else f" ({meaning})"
        text = f"{needs} {about.title}: {value}{within}"
    for key, more in others:
        text += f"; {meanings.get(key, key)}: {more}"
    return f"{text}. Confidence in the name: {100 * item.confidence:.0f} %."


def _value(item: Named, key: str, estimate: Estimate) -> str:
    """A value, and which one the simulator has in its place."""
    path = f"{item.name}.{key}"
    other = f" instead of {like(item.had[key], estimate, path)}" if key in item.had else ""
    return f"{quantity(estimate, path)}{other}"


def effect(found: Diagnosis) -> str:
    """Where and how far the simulator is off without what was found."""
    phases = [place for place in found.location if place.axis in _PHASES]
    if not found.location:
        return ""
    place = max(phases or found.location, key=lambda place: place.share)
    if found.verdict == "named":
        without = "Without it" if len(found.mechanisms) == 1 else "Without them"
        return f"{without} {_error(place, found.noise[0])}, even with R and C refitted."
    if _as_given(found):
        return location(place, found.noise[0])
    return f"With R and C refitted, {_error(place, found.noise[0])}."


def location(place: Place, noise: float = 0.0) -> str:
    """One place as a sentence."""
    return _capital(f"{_error(place, noise)}.")


def where(place: Place) -> str:
    """A place in words that follow "the pressure is too high"."""
    if place.axis in (*_PHASES, _EDGE):
        after, whole = _MOMENTS[place.axis]
        if place.low == 0:
            return f"in the first {_time(place.high)} {whole}"
        ends = f"{place.low:.6g} to {place.high:.6g} s"
        if place.high <= _SHORT:
            ends = f"{1000 * place.low:.6g} to {1000 * place.high:.6g} ms"
        return f"from {ends} after {after}"
    if place.axis == "breath number":
        return f"in breaths {place.low:.6g} to {place.high:.6g} of the recording"
    if place.axis.startswith("lung "):
        return f"on {place.axis}"
    return f"where the {place.axis} is {span(place.low, place.high, place.unit)}"


def _time(seconds: float) -> str:
    return f"{1000 * seconds:.6g} ms" if seconds <= _SHORT else f"{seconds:.6g} s"


def alternatives(found: Diagnosis) -> list[str]:
    """What the recording cannot tell apart."""
    return [
        f"This recording cannot tell {item.name} from {_and(list(item.alternatives), 'or')}."
        for item in found.mechanisms
        if item.alternatives
    ]


def request(found: Diagnosis) -> str:
    """What to record next."""
    wanted = found.request
    if wanted is None:
        return ""
    why = f" That tells {_and(list(wanted.why))} apart" if len(wanted.why) > 1 else ""
    if len(wanted.why) == 1:
        why = f" That decides about {wanted.why[0]}"
    nats = f" (expected evidence {wanted.nats:.0f} nats; 5 decide)" if why else ""
    return f"Record next: {wanted.title.rstrip('.')}.{why}{nats}{'.' if why else ''}"


def slot(found: Diagnosis) -> str:
    """Where something without a name sits."""
    if found.slot is None:
        return ""
    what = "What remains" if found.verdict == "named" else "What is missing"
    return (
        f"{what} acts as {_acts(found.slot)}: with a free curve there, "
        f"{100 * found.slot.explains:.0f} % of the squared error above the noise is explained."
    )


def _acts(slot: Slot) -> str:
    """The place with its name: ``a recoil of the lung, f(V)``."""
    meaning = slot.meaning.removeprefix(f"{slot.name}: ")
    if meaning.startswith("any "):
        meaning = f"a {meaning.removeprefix('any ')}"
    return f"{meaning}, {slot.name}"


def distances(found: Diagnosis) -> str:
    """Open-loop errors before and after."""
    one = found.open_loop
    held = len(one.held_out_breaths)
    given, refit, after, noise = (
        rounded(x, 2) for x in (one.before.rmse, one.refit.rmse, one.after.rmse, one.noise_floor)
    )
    refitted = "" if _as_given(found) else f", {refit} refitted"
    if found.verdict != "nothing_missing" and one.after != one.refit:
        refitted += f", {after} corrected"
    return (
        f"Open-loop error on {held} held-out breaths (root mean square): {given} as given"
        f"{refitted}, noise {noise} cmH2O."
    )


def _as_given(found: Diagnosis) -> bool:
    """Whether the simulator is left as it is, without a refit."""
    return found.open_loop.refit == found.open_loop.before


def lung(match: LungMatch) -> str:
    """Whether a lung is what its label says."""
    values = []
    fitted = (
        ("R", match.fitted_R, match.ci95_R, "cmH2O s/L"),
        ("C", match.fitted_C, match.ci95_C, "mL/cmH2O"),
    )
    for name, value, ends, unit in fitted:
        if math.isfinite(value):
            values.append(f"{name} {quantity(Estimate(value, unit, ends))}")
    fits = f"{' and '.join(values)}, from {match.source}" if values else "R and C unknown"
    if match.label_matches:
        return f"The lung matches its label {match.label}: {fits}."
    known = f" It may be {' or '.join(match.settings[:2])}." if match.settings else ""
    return f"The lung is not what its label {match.label} says: the recording fits {fits}.{known}"


def _error(place: Place, noise: float) -> str:
    """How the simulator errs at a place; errors are recorded minus simulated."""
    size = abs(place.mean_error)
    if size < max(0.25 * noise, 0.005):
        return (
            "the simulated pressure is off by errors whose sign changes from breath to breath "
            f"{where(place)}"
        )
    side = "too low" if place.mean_error > 0 else "too high"
    return f"the simulated pressure is {_size(size)} cmH2O {side} {where(place)}"


def _size(value: float) -> str:
    """Two digits, without an exponent."""
    return f"{value:.0f}" if value >= 10 else f"{value:.2g}" if value >= 0.01 else f"{value:.3f}"


def _and(items: list[str], word: str = "and") -> str:
    if len(items) < 2:
        return "".join(items)
    return f"{', '.join(items[:-1])} {word} {items[-1]}"


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]
