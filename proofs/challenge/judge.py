"""One answer against the truth: everything is measured here, nothing is taken from the answer.

The judge holds the withheld pressures and knows the concealed effects. It shares no code with any
diagnoser. A lost case has no probability of the truth and predicts a constant pressure.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from proofs.challenge.contract import UNKNOWN, Answer, place_of
from proofs.challenge.folder import Withheld
from proofs.challenge.questions import DrawnCase, Kind
from proofs.challenge.truth import Concealed, concealed, is_right, true_values
from ventbench.base.arrays import Bools
from ventbench.recordings.breaths import Breaths

#: Least probability of the truth that the log score counts, so that no single case decides.
FLOOR = 1e-3

#: Hypotheses whose probabilities differ by less are one set.
_EQUAL = 1e-6

#: Probability from which a name that is not in the rig is a confident wrong name.
CONFIDENT = 0.5

#: Harm of a wrong name in the right part of the rig, where a search would begin there anyway; in
#: another part it is 1.
_SAME_PLACE = 0.5


@dataclass(frozen=True)
class EstimateAgainstTruth:
    """An estimated parameter beside the true value that a fit with the nominal valve gain sees."""

    path: str  #: path of the parameter.
    value: float  #: estimate.
    low: float  #: lower end of the estimate's 95 % interval.
    high: float  #: upper end of the interval.
    true: float  #: true value.

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
    """One case with what was measured of its answer."""

    name: str  #: name of the case.
    kind: Kind  #: kind of the question.
    lung: str  #: label.
    strengths: tuple[str, ...]  #: strengths of the effects.
    truth: tuple[Concealed, ...]  #: the effects.
    #: terms of the likeliest hypotheses, which are several if they are equally likely.
    leading: tuple[frozenset[str], ...]
    confidence: float  #: probability of the leading hypotheses together.
    isolation: float  #: 1 over the number of leading hypotheses if one of them is right, else 0.
    belief: float  #: probability of all right hypotheses.
    brier: float  #: squared error of the probabilities of the truth and of each wrong hypothesis.
    missing: float  #: probability that something is missing.
    wrong: dict[str, float]  #: probability of each name that is not in the rig.
    harm: float  #: sum of these, less where the name is in the right part of the rig.
    #: parameters of rightly named effects in the vocabulary's form; R and C where nothing is
    #: missing.
    estimates: tuple[EstimateAgainstTruth, ...]
    #: F1 of the samples in which the answer says that an effect acts; None if the effect acts
    #: everywhere.
    overlap: float | None
    inspiration: float  #: mean absolute error on withheld breaths, cmH2O.
    expiration: float  #: the same with an open expiratory valve.
    seconds: float  #: processor time.
    peak: float  #: memory, MiB.
    problem: str  #: why the case is lost, or empty.

    @property
    def effects(self) -> tuple[str, ...]:
        """Names of the effects in the rig."""
        return tuple(effect.name for effect in self.truth)

    @property
    def visible(self) -> bool:
        """Whether every effect is above the detection limit."""
        return all(effect.seen for effect in self.truth)

    @property
    def something(self) -> bool:
        """Whether an effect is above the detection limit."""
        return any(effect.seen for effect in self.truth)

    @property
    def answered(self) -> frozenset[str]:
        """Terms of the first of the leading hypotheses."""
        return self.leading[0] if self.leading else frozenset()

    @property
    def false(self) -> frozenset[str]:
        """Answered names that are not in the rig."""
        return self.answered & self.wrong.keys()

    @property
    def right(self) -> bool:
        """Whether the likeliest hypothesis alone is right."""
        return self.isolation == 1.0

    @property
    def log_score(self) -> float:
        """Minus the logarithm of the probability of the truth; 0 is best."""
        return -float(np.log(max(self.belief, FLOOR)))

    @property
    def right_place(self) -> bool:
        """Whether the answered terms act where the effects do, and nowhere else."""
        places = frozenset(place_of(term) for term in self.answered)
        allowed = frozenset().union(*(effect.places for effect in self.truth))
        everywhere = all(places & effect.places for effect in self.truth if effect.seen)
        return not self.problem and everywhere and places <= allowed


def judge(
    drawn: DrawnCase,
    nats: tuple[float, ...],
    breaths: Breaths,
    withheld: Withheld,
    given: dict[str, Any],
) -> JudgedCase:
    """Measure an answer.

    Args:
        drawn: the case.
        nats: log-likelihood that is lost without each of its effects, nats.
        breaths: its recording, without the withheld pressures.
        withheld: these pressures, and where an effect acts.
        given: content of the answer's file: the answer itself, and what it took.
    """
    case, problem = drawn.case, given["problem"]
    answer = None if problem else msgspec.convert(given["answer"], Answer, strict=False)
    truth = concealed(drawn, nats)
    hypotheses = (
        {}
        if answer is None
        else {frozenset(each.terms): each.probability for each in answer.hypotheses}
    )
    most = max(hypotheses.values(), default=0.0)
    leading = tuple(sorted((h for h, p in hypotheses.items() if p >= most - _EQUAL), key=sorted))
    right = {terms for terms in hypotheses if is_right(terms, truth)}
    belief = sum(hypotheses[terms] for terms in right)
    others = [p for terms, p in hypotheses.items() if terms not in right]
    allowed = frozenset().union(*(effect.terms | effect.beside for effect in truth))
    wrong = {
        term: sum(p for terms, p in hypotheses.items() if term in terms)
        for term in sorted(frozenset().union(*hypotheses) - allowed)
        if not term.startswith(UNKNOWN)
    }
    places = frozenset().union(*(effect.places for effect in truth))
    errors = _errors(breaths, withheld, answer)
    return JudgedCase(
        name=case.name,
        kind=drawn.kind,
        lung=case.lung,
        strengths=tuple(effect.strength for effect in case.effects),
        truth=truth,
        leading=leading,
        confidence=most * len(leading),
        isolation=any(terms in right for terms in leading) / max(len(leading), 1),
        belief=belief,
        brier=(1.0 - belief) ** 2 + float(np.sum(np.square(others))),
        missing=0.0 if answer is None else 1.0 - hypotheses.get(frozenset(), 0.0),
        wrong=wrong,
        harm=sum(p * (_SAME_PLACE if place_of(t) in places else 1.0) for t, p in wrong.items()),
        estimates=_estimates(true_values(case), answer, leading),
        overlap=_overlap(breaths, withheld, answer),
        inspiration=errors[0],
        expiration=errors[1],
        seconds=given["seconds"],
        peak=given["peak_mib"],
        problem=problem,
    )


def _estimates(
    true: dict[str, float], answer: Answer | None, leading: tuple[frozenset[str], ...]
) -> tuple[EstimateAgainstTruth, ...]:
    if answer is None or not leading:
        return ()
    return tuple(
        EstimateAgainstTruth(path, given.value, given.low, given.high, true[path])
        for path, given in sorted(answer.parameters.items())
        if path in true and ("." not in path or path.partition(".")[0] in leading[0])
    )


def _errors(breaths: Breaths, withheld: Withheld, answer: Answer | None) -> tuple[float, float]:
    """Mean absolute error of inspirations and of expirations, cmH2O.

    The first sample is left out: it is the start of the breath, which commands do not tell.
    """
    constant, parts = float(np.nanmedian(breaths.pressure)), ([], [])
    for breath, readings in withheld.pressures.items():
        (k,) = np.flatnonzero(breaths.breath_id == breath)
        measured = np.array(readings, float)
        count = int(breaths.valid[k].sum())
        told = np.full(len(measured), constant)
        if answer is not None:
            told[:count] = answer.pressures[breath]
        error = np.abs(told - measured)[1:count]
        open_ = breaths.u_out[k, 1:count] == 1
        parts[0].append(error[~open_])
        parts[1].append(error[open_])
    inspiration, expiration = (float(np.nanmean(np.concatenate(part))) for part in parts)
    return inspiration, expiration


def _overlap(breaths: Breaths, withheld: Withheld, answer: Answer | None) -> float | None:
    """F1 of the samples of all breaths in which an effect is said to act."""
    if withheld.active is None:
        return None
    true, told = _flags(breaths, withheld.active), _flags(breaths, answer.active if answer else {})
    both = int((true & told).sum())
    return 2.0 * both / max(int(true.sum()) + int(told.sum()), 1)


def _flags(breaths: Breaths, spans: dict[int, tuple[tuple[float, float], ...]]) -> Bools:
    flags = np.zeros(breaths.time.shape, bool)
    for k, breath in enumerate(breaths.breath_id.tolist()):
        for low, high in spans.get(breath, ()):
            flags[k] |= (breaths.time[k] >= low - 1e-9) & (breaths.time[k] <= high + 1e-9)
    return flags & breaths.valid
