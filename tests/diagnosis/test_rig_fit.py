"""Parameters of each rig: what they gain where rigs differ, and what the public rig gains."""

from __future__ import annotations

import numpy as np
import pytest

from ventbench.diagnosis.evaluator import make_evaluator
from ventbench.diagnosis.hypothesis import Hypothesis, Partition, make_partition
from ventbench.diagnosis.identification import split
from ventbench.diagnosis.residual_analysis import open_loop_error
from ventbench.diagnosis.rig_fit import fit_rigs
from ventbench.physics import paths
from ventbench.plants import frozen
from ventbench.recordings import load
from ventbench.system_id import Noise, make_data
from ventbench.system_id.data import robust_noise
from ventbench.system_id.problem import parameter_of
from ventbench.task.lungs import LUNG_IDS

from . import small

#: What the public rig lacks, as ``python -m proofs rig --only rc`` names it.
NAMES = ("exhalation_valve_delay", "circuit_compliance", "valve_curve", "sensor_lag")


@pytest.mark.slow
def test_strengths_a_rig_on_the_public_recordings(public_recordings):
    breaths = load(public_recordings / "pvp_quicklung.csv")
    breaths = breaths.select(np.isin(breaths.lung_ids, LUNG_IDS))
    rigs = frozen.load().sessions.assign(breaths)
    uses, data, names = split(breaths), make_data(breaths), paths(NAMES)
    seen, first = uses.identifying, breaths.pressure[:, 0]
    evaluator = make_evaluator(data.select(seen), uses.testing[seen], names, ("patient_effort",))
    partition: Partition = make_partition(data.select(uses.fitted), names)
    white = Noise((1.0, 20.0), (0.0, 0.0), 5.0)

    def pressures(fitted):
        whole = make_partition(data, names)
        values = evaluator.transferred_values(fitted, whole)
        values[:, -1] = first
        return whole.predictor.predict(values)[:, 0]

    judged = breaths.inspiratory & (breaths.time > 0) & uses.judging[:, None]

    def errors(pressure):
        by_lung = breaths.by_lung_index.values()
        parts = [open_loop_error(breaths.pressure[i], pressure[i], judged[i]).mae for i in by_lung]
        return np.array([open_loop_error(breaths.pressure, pressure, judged).mae, *parts])

    refit = errors(pressures(evaluator.fit(Hypothesis(), white, partition=partition)))
    shared = evaluator.fit(Hypothesis(NAMES), white, partition=partition)
    noise = robust_noise(shared.residual, partition.data.weight)
    shared = evaluator.fit(Hypothesis(NAMES), noise, shared, partition=partition)
    own = fit_rigs(evaluator, shared, partition, rigs[uses.fitted])
    assert own is not None
    pooled, by_rig = errors(pressures(shared)), errors(own.pressures(data, rigs, first))
    lungs = list(breaths.by_lung_index)
    best = np.minimum(np.minimum(refit, pooled), by_rig)[1:]
    k = lungs.index("R20C20")
    assert by_rig[1 + k] < 0.6 * pooled[1 + k]
    assert best[k] < 2.2
    assert by_rig[1 + lungs.index("R20C50")] < 0.8 * pooled[1 + lungs.index("R20C50")]
    assert set(own.values) == set(own.scatter)
    # A rig of which nothing is known has what its lung's other rigs have.
    unknown = own.pressures(data, np.full(len(breaths), 10_000), first)
    np.testing.assert_allclose(unknown, pressures(shared), atol=1e-6)


def test_rigs_may_differ_in_a_shape_parameter():
    """A shape parameter has no mild effect that could say how much rigs differ."""
    name, shape = "exhalation_valve_delay", "exhalation_valve_delay.closing"
    evaluator = small.split(small.made(small.effect(name, opening=0.06)))
    terms, start = Hypothesis((name,), (shape,)), {f"{name}.opening": 0.05}
    fitted = evaluator.fit(terms, Noise((0.2,), (0.0, 0.0)), start=start)
    rigs = np.arange(len(evaluator.training.data)) % 2
    own = fit_rigs(evaluator, fitted, evaluator.training, rigs)
    assert own is not None
    about = parameter_of(shape)
    assert np.all((own.values[shape] >= about.low) & (own.values[shape] <= about.high))
    assert 0 < own.scatter[shape] < 0.1 * (about.high - about.low)
    # Readings are 75 ms apart, so that R_ex and the delay of the one rig are known together alone.
    shared = fitted.column(f"{name}.opening")[0]
    np.testing.assert_allclose(own.values[f"{name}.opening"], shared, atol=0.01)
