"""What a diagnoser is given and what it answers: a folder of files, and one JSON value.

The folder of a case holds ``recording.csv`` (withheld breaths have commands and no pressures) and
``case.json``, a :class:`Question`. The answer is an :class:`Answer`. ``docs/diagnosers.md`` tells
both to those who write a diagnoser.

``vocabulary.toml`` is published: what may be missing, where it acts, its parameters. A *term* of an
answer is a name of it, or ``unknown:PLACE`` for an effect without a name.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import msgspec

from ventbench.base import files
from ventbench.base.errors import InputError
from ventbench.recordings.breaths import Breaths, write

#: Names of the files in a case's folder.
RECORDING, QUESTION = "recording.csv", "case.json"

#: What anyone who stands at the bench knows of the rig; the true values scatter around these.
RIG: dict[str, Any] = {
    "valve_gain": 22.8,
    "valve_gain_unit": "mL/s per %",
    "valve_gain_sd": 0.06,
    "peep": 5.0,
    "peep_sd": 1.0,
    "expiratory_resistance": 5.0,
    "somebody_may_breathe": True,
}

#: Probabilities may miss their sum by this much.
_ROUNDING = 1e-3

#: Most hypotheses, most terms of one, and largest pressure, cmH2O.
_HYPOTHESES, _TERMS, _PRESSURE = 500, 8, 1000.0


class Name(msgspec.Struct, frozen=True):
    """A name of the vocabulary."""

    place: str  #: where it acts, one of :data:`PLACES`.
    meaning: str  #: in words.
    parameters: dict[str, str]  #: unit of each parameter, the strength first.


#: The vocabulary as JSON values, as every case holds it.
PUBLISHED = files.data_beside(__file__, "vocabulary.toml")

#: Parts of the rig, from the supply to the log.
PLACES: tuple[str, ...] = tuple(PUBLISHED["places"])

VOCABULARY: dict[str, Name] = msgspec.convert(PUBLISHED["names"], dict[str, Name])

#: Prefix of a term without a name.
UNKNOWN = "unknown:"

TERMS: frozenset[str] = frozenset(VOCABULARY) | {UNKNOWN + place for place in PLACES}

#: Paths of the parameters that an answer may give.
PARAMETERS: frozenset[str] = frozenset({"R", "C"}) | {
    f"{name}.{key}" for name, about in VOCABULARY.items() for key in about.parameters
}


def place_of(term: str) -> str:
    """Where a term acts."""
    return term.removeprefix(UNKNOWN) if term.startswith(UNKNOWN) else VOCABULARY[term].place


class AnswerError(InputError):
    """An answer that is none; the text says where and why."""


class Hypothesis(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What may be missing, all of it together; no terms: nothing is."""

    terms: tuple[str, ...]  #: names of the vocabulary, and ``unknown:PLACE``.
    probability: float  #: 0..1.


class Interval(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Estimate of a parameter, with the ends of its 95 % interval."""

    value: float
    low: float
    high: float


class Answer(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The answer of a diagnoser."""

    hypotheses: tuple[Hypothesis, ...]  #: different ones, whose probabilities sum to 1.
    #: pressure at each sample, cmH2O, of each withheld breath, by its id.
    pressures: dict[int, tuple[float, ...]]
    #: estimates by path, such as ``leak.conductance``, ``R`` or ``C``.
    parameters: dict[str, Interval] = {}
    #: where an effect acts that acts in part of the recording only: intervals of time, s, by id of
    #: the breath.
    active: dict[int, tuple[tuple[float, float], ...]] = {}
    notes: Any = None  #: anything; nobody reads it.
    record_next: Any = None  #: as notes.


class Question(msgspec.Struct, frozen=True):
    """The content of ``case.json``."""

    recording: str  #: name of the recording's file.
    label: dict[str, float]  #: R, cmH2O/(L/s), and C, mL/cmH2O, that the lung is said to have.
    withheld: tuple[int, ...]  #: ids of the breaths whose pressures are asked for.
    rig: dict[str, Any]  #: see :data:`RIG`.
    seconds: float  #: processor time that the diagnoser may take.
    vocabulary: dict[str, Any]  #: places, and names with place, meaning and parameters.


def pose(folder: Path, breaths: Breaths, withheld: tuple[int, ...], seconds: float) -> None:
    """Write the folder of a case.

    Args:
        folder: folder, which exists.
        breaths: the recording, without the withheld pressures.
        withheld: ids of the withheld breaths.
        seconds: processor time that the diagnoser may take.
    """
    label = {"R": float(breaths.R[0]), "C": float(breaths.C[0])}
    question = Question(RECORDING, label, withheld, RIG, seconds, PUBLISHED)
    write(breaths, folder / RECORDING)
    files.write_json(folder / QUESTION, msgspec.to_builtins(question))


def decode(data: bytes, samples: dict[int, int]) -> Answer:
    """Read an answer.

    Args:
        data: JSON.
        samples: number of samples of each withheld breath, by id.

    Raises:
        AnswerError: if it is not one.
    """
    try:
        answer = msgspec.json.decode(data, type=Answer)
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as error:
        raise AnswerError(f"not an answer: {error}") from None
    _check_hypotheses(answer.hypotheses)
    _check_pressures(answer.pressures, samples)
    for path, given in answer.parameters.items():
        _check_parameter(path, given)
    for breath, spans in answer.active.items():
        for low, high in spans:
            if not low <= high:
                raise AnswerError(
                    f"active[{breath}]: {low:g} to {high:g} is no interval of time; give start, end"
                )
    return answer


def _check_hypotheses(hypotheses: tuple[Hypothesis, ...]) -> None:
    if not 0 < len(hypotheses) <= _HYPOTHESES:
        raise AnswerError(f"hypotheses has {len(hypotheses)} entries; give 1 to {_HYPOTHESES}")
    seen: set[frozenset[str]] = set()
    for number, hypothesis in enumerate(hypotheses):
        where, terms = f"hypotheses[{number}]", frozenset(hypothesis.terms)
        for term in hypothesis.terms:
            if term not in TERMS:
                raise AnswerError(
                    f"{where}.terms: {term[:60]!r} is not in the vocabulary; case.json lists the "
                    "names, and the places of unknown:PLACE"
                )
        if len(terms) != len(hypothesis.terms) or len(terms) > _TERMS:
            raise AnswerError(f"{where}.terms: give each term once, and {_TERMS} at most")
        if terms in seen:
            raise AnswerError(f"{where}.terms: the same terms stand in an earlier hypothesis")
        seen.add(terms)
        if not 0.0 <= hypothesis.probability <= 1.0:
            raise AnswerError(f"{where}.probability is {hypothesis.probability:g}, not in 0..1")
    total = math.fsum(hypothesis.probability for hypothesis in hypotheses)
    if abs(total - 1.0) > _ROUNDING:
        raise AnswerError(f"hypotheses: the probabilities sum to {total:g}, not to 1")


def _check_pressures(pressures: dict[int, tuple[float, ...]], samples: dict[int, int]) -> None:
    missing, further = samples.keys() - pressures.keys(), pressures.keys() - samples.keys()
    if missing:
        raise AnswerError(f"pressures: breath {min(missing)} is withheld and has none")
    if further:
        raise AnswerError(f"pressures: breath {min(further)} is not withheld; leave it out")
    for breath, values in pressures.items():
        if len(values) != samples[breath]:
            raise AnswerError(
                f"pressures[{breath}] has {len(values)} values; the breath has {samples[breath]} "
                "samples"
            )
        if not all(abs(value) <= _PRESSURE for value in values):
            raise AnswerError(f"pressures[{breath}] leaves +-{_PRESSURE:g} cmH2O")


def _check_parameter(path: str, given: Interval) -> None:
    if path not in PARAMETERS:
        raise AnswerError(f"parameters: {path[:60]!r} is not in the vocabulary of case.json")
    if not given.low <= given.value <= given.high:
        raise AnswerError(f"parameters.{path}: {given.value:g} is not within its interval")
