"""Mechanics of a lung from pressure with flow or volume, whatever the ventilator."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ventbench.errors import InputError
from ventbench.lungs import Lung
from ventbench.mechanics import labels
from ventbench.mechanics.circuit import Circuit, behind, circuit
from ventbench.mechanics.fitted import Fitted, Term
from ventbench.mechanics.lung_match import Estimate, LungMatch
from ventbench.mechanics.regression import GRID, Table, covariance, solve, table
from ventbench.mechanics.segments import Segment, clipped, segments
from ventbench.mechanics.select import FEWEST, Chosen, select
from ventbench.mechanics.terms import BASE, columns_of
from ventbench.recordings.breaths import Breaths

#: Share of clipped pressures, and size of what is left, cmH2O, that the reader must be told of.
_CLIPPED, _LARGE = 0.02, 1.0


@dataclass(frozen=True, eq=False)
class Mechanics:
    """A lung, as pressure and flow show it.

    Attributes:
        label: of the recording.
        R: resistance at small flow, inspiratory, cmH2O s/L.
        C: compliance over the tidal volume, mL/cmH2O.
        offset: pressure at the start of a breath if nothing flowed, cmH2O.
        terms: what is needed beyond R and C, the most important first.
        match: with R at the flow for which its label holds.
        settings: known settings that this lung may be, the nearest first.
        noise: standard deviation of what is left, cmH2O.
        breaths: that were used.
        samples: smoothed ones.
        notes: what the reader should know.
    """

    label: str
    R: Estimate
    C: Estimate
    offset: Estimate
    terms: tuple[Term, ...]
    match: LungMatch
    settings: tuple[Lung, ...]
    noise: float
    breaths: int
    samples: int
    notes: tuple[str, ...]


def identify(breaths: Breaths) -> tuple[Mechanics, ...]:
    """Identify each lung of a recording with flow or volume.

    Raises:
        InputError: if there is neither, or too little of a lung to tell R from C.
    """
    return tuple(_one(name, part) for name, part in breaths.by_lung().items())


def _one(name: str, breaths: Breaths) -> Mechanics:
    pieces = segments(breaths)
    if not pieces:
        raise InputError(
            f"{name}: no piece of a breath has pressure with flow or volume for about a second; "
            "record longer pieces"
        )
    tube = circuit(pieces)
    pieces = tuple(behind(s, tube.compliance.value if tube else 0.0) for s in pieces)
    known = table(pieces)
    chosen = select(known)
    full = _fitted(known, chosen, pieces, breaths)
    plain = _fitted(known, _bent(known), pieces, breaths)
    label = Lung(float(breaths.R[0]), float(breaths.C[0]))
    best = _best(full, plain, label)
    source = "pressure and flow" if breaths.flow is not None else "pressure and volume"
    noise = float(full.solution.sigma / np.sqrt(1.0 - GRID[full.solution.grid] ** 2))
    return Mechanics(
        name, best.resistance(0.0), best.compliance(), full.offset(),
        (*_circuit(tube), *(full.term(item) for item in chosen)),
        labels.match(label, best.resistance, best.compliance(), source),
        labels.matching(best.resistance, best.compliance()),
        noise, len(known), sum(len(piece) for piece in pieces),
        tuple(_notes(breaths, pieces, known, noise)),
    )  # fmt: skip


def _fitted(
    known: Table, chosen: tuple[Chosen, ...], pieces: tuple[Segment, ...], breaths: Breaths
) -> Fitted:
    columns = (*range(len(BASE)), *(item.column for item in chosen))
    found = solve(known, np.ones(len(known), bool), columns)
    return Fitted(found, covariance(known, found), known, pieces, _blur(breaths))


def _bent(known: Table) -> tuple[Chosen, ...]:
    """The quadratic part of a resistor, unless it comes out negative: labels leave it open."""
    (column,) = columns_of("turbulent_resistance")
    found = solve(known, np.ones(len(known), bool), (*range(len(BASE)), column))
    return (Chosen("turbulent_resistance", column, 0.0, ()),) if found.x[-1] > 0.0 else ()


def _best(full: Fitted, plain: Fitted, label: Lung) -> Fitted:
    """The description to judge the label by.

    Further terms take part of R and C over, rightly (creep) or not (what only looks like creep), so
    that a plain lung is tried too: what counts is whether either is a setting.
    """
    for one in (full, plain):
        if labels.fits(one.resistance, one.compliance(), label):
            return one
    for one in (full, plain):
        if labels.matching(one.resistance, one.compliance()):
            return one
    return plain


def _circuit(tube: Circuit | None) -> tuple[Term, ...]:
    if tube is None:
        return ()
    others = ("sensor_lag",)
    parameters = {"compliance": tube.compliance}
    return (Term("circuit_compliance", parameters, tube.nats, tube.effect, others),)


def _blur(breaths: Breaths) -> float:
    """Uncertainty of the integral of a flow that may jump between two samples, s."""
    return 0.0 if breaths.volume is not None else 0.25 * float(np.median(breaths.dt))


def _notes(breaths: Breaths, pieces: tuple[Segment, ...], known: Table, noise: float) -> list[str]:
    notes = []
    if len(known) < FEWEST:
        notes.append(f"Fewer than {FEWEST} breaths: R and C alone, nothing else could be tested.")
    if lost := len(breaths) - len(known):
        notes.append(f"{lost} of {len(breaths)} breaths have no piece long enough to be used.")
    share = clipped(breaths)
    if share > _CLIPPED:
        notes.append(
            f"{100 * share:.0f} % of the pressures stand at the end of the sensor's range and are "
            "left out."
        )
    top = max(float(piece.flow.max()) for piece in pieces)
    if top < 0.2:
        notes.append(f"The flow stays below {1000 * top:.0f} mL/s: R is known at small flow only.")
    if noise > _LARGE:
        notes.append(
            f"{noise:.1f} cmH2O are left unexplained, such as a valve that chatters: R and C are "
            "rough."
        )
    return notes
