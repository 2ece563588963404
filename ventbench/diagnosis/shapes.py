"""The slot of a conclusion as it is shown: what it explains, and its drawn shape."""

from __future__ import annotations

import numpy as np

from ventbench.diagnosis.conclusion import Conclusion, UnnamedEffect
from ventbench.diagnosis.findings import NonparametricTerm
from ventbench.diagnosis.hypothesis import FittedModel
from ventbench.diagnosis.latent_inputs import ALVEOLUS, MEASUREMENT, SUPPLY, LatentInput
from ventbench.diagnosis.screening import component_of
from ventbench.physics.catalogue import mechanism
from ventbench.physics.component_curves import component_curves, without_absorbed
from ventbench.physics.nonparametric import NONPARAMETRIC_COMPONENTS

_MEANINGS = {
    ALVEOLUS: "a pressure at the alveolus that moves in time and that no command explains",
    SUPPLY: "a flow of the supply that moves in time and that no command explains",
    MEASUREMENT: "a pressure at the sensor that moves in time and that is not in the airway",
}


def slot(conclusion: Conclusion) -> NonparametricTerm | None:
    """Slot of a conclusion, or None."""
    place = conclusion.unnamed
    if place is None:
        return None
    explains = _share(conclusion)
    if place.latent_input is not None:
        return _moving(place, place.latent_input, explains)
    assert place.term is not None
    x, y, x_unit, y_unit = _curve(conclusion.full, place.term)
    meaning = NONPARAMETRIC_COMPONENTS[place.name].meaning
    return NonparametricTerm(place.name, meaning, explains, place.nats, x, x_unit, y, y_unit)


def _share(conclusion: Conclusion) -> float:
    """Share of the squared error above the noise that goes with the slot, 0..1."""
    named = conclusion.named
    weight = named.problem.data.weight
    before = float(np.sum(named.residual**2) / weight.sum())
    floor = float(conclusion.noise.sigma[0] ** 2)
    if conclusion.unnamed is not None and conclusion.unnamed.latent_input is not None:
        after = floor
    else:
        after = float(np.sum(conclusion.full.residual**2) / weight.sum())
    return float(np.clip((before - after) / max(before - min(floor, after), 1e-9), 0.0, 1.0))


def _moving(place: UnnamedEffect, source: LatentInput, explains: float) -> NonparametricTerm:
    size = np.sqrt(np.mean(source.course**2, axis=1))
    course = source.course[int(np.argmax(size))]
    unit = "share of the flow, 1" if place.name == SUPPLY else "pressure, cmH2O"
    meaning = _MEANINGS[place.name]
    if source.periodic:
        meaning += f", {source.scale:.1f} times a second"
    x = np.arange(len(course), dtype=float)
    return NonparametricTerm(
        place.name, meaning, explains, place.nats, x, "sample of the breath where it is largest",
        course, unit,
    )  # fmt: skip


def _curve(full: FittedModel, element: str) -> tuple[np.ndarray, np.ndarray, str, str]:
    own = [f"{element}.{p.name}" for p in mechanism(element).description.parameters]
    values = {
        name: float(np.median(full.column(name)))
        for name in (*own, "R", "C", "gain", "R_ex", "PEEP")
    }
    # The slot's other elements are neutral; the strongest curve is the first.
    curve = without_absorbed(component_curves(component_of(element), values)[0])
    return np.asarray(curve.x, float), np.asarray(curve.y, float), curve.x_unit, curve.y_unit
