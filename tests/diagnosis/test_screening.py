"""Values of rules on commands that are screened to first order, as the steps of a valve are."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import ventbench
from hardware_eval.emulation.cases import Base, Effect
from proofs.challenge.faults.effects import FaultsCase
from proofs.challenge.faults.laboratory import record
from ventbench.diagnosis.evaluator import fit_with_noise
from ventbench.diagnosis.hypothesis import Hypothesis, Partition
from ventbench.diagnosis.in_time import command_responses
from ventbench.diagnosis.screening import screened_points


def test_a_reading_follows_each_command_one_sample_later(plain):
    partition = plain.evaluator.training
    values = plain.evaluator.transferred_values(plain.base, partition)
    more = partition.data.u_in.copy()
    more[:, 9] += 0.01
    other = partition.predictor.of(dataclasses.replace(partition.data, u_in=more))
    slope = 100.0 * (other.predict(values) - partition.predictor.predict(values))[:, 0]
    answer = command_responses(partition, values)[:, 9]
    assert not answer[:, :10].any()
    assert slope[:, 10].min() > 0.1
    np.testing.assert_allclose(answer[:, :30], slope[:, :30], atol=2e-3)


@pytest.mark.parametrize(("bias", "step"), [(0.0, 1.0), (0.0, 1.733), (0.5, 2.21)])
def test_the_steps_of_a_valve_are_told_beside_a_wrong_lung(plain, bias, step):
    evaluator, data = plain.evaluator, plain.evaluator.training.data
    moved = step * np.floor(data.u_in / step + bias)
    partition = evaluator.training.predictor.of(dataclasses.replace(data, u_in=moved))
    values = evaluator.transferred_values(plain.base, evaluator.training)
    noise = np.random.default_rng(3).normal(0.0, 0.2, data.measured.shape)
    rounded = dataclasses.replace(data, measured=partition.predict(values) + noise)
    own = dataclasses.replace(evaluator, training=Partition(rounded, evaluator.training.predictor))
    points = screened_points(fit_with_noise(own, Hypothesis()), "command_rounding")
    by_bias = {point["command_rounding.bias"]: point for point in points}
    assert by_bias.keys() == {0.0, 0.5}
    assert by_bias[bias]["command_rounding.step"] == pytest.approx(step, rel=0.003)
    assert by_bias[bias]["command_rounding.amount"] == 1.0
    if step == 1.0:  # whole percents exactly, or a command of 30 % would stop at 29
        assert by_bias[bias]["command_rounding.step"] == 1.0


def test_a_valve_with_steps_of_its_own_is_named_with_their_size():
    # The generator shares no code with the library.
    effect = Effect("command_rounding", "strong", "truncation", {"step": 1.64})
    case = FaultsCase(
        "x",
        20.0,
        20.0,
        (effect,),
        Base(21.0, 19.5, 5.0, 5.0, 23.4),
        noise=0.15,
        step=0.01,
        jitter=0.0003,
        breaths=18,
        samples=60,
        choice=4,
    )
    diagnosis = ventbench.diagnose(record(case, np.random.default_rng(5)))
    assert [m.name for m in diagnosis.mechanisms] == ["command_rounding"]
    step = diagnosis.mechanisms[0].parameters["step"]
    assert step.value == pytest.approx(1.64, rel=0.005)
    assert step.ci95[0] < 1.64 < step.ci95[1]
    assert diagnosis.open_loop.after.rmse < 0.6 * diagnosis.open_loop.refit.rmse
