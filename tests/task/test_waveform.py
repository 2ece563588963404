import numpy as np
import pytest

from ventbench.task import protocol, waveform


def test_key_points():
    # t = 0, 0.99, 1.02 (the first of the fall), 1.26, 1.5, 2.97 s
    found = waveform.target([0, 33, 34, 42, 50, 99], 35.0)
    expected = [35.0, 35.0, 5 + 30 * 0.48 / 0.5, 5 + 30 * 0.24 / 0.5, 5.0, 5.0]
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_against_interpolation_of_the_authors_key_points():
    t = np.arange(100) * protocol.DT
    for pip in protocol.PIPS:
        expected = np.interp(t, [0.0, 1.0, 1.5, 3.0], [pip, pip, 5.0, 5.0])
        np.testing.assert_allclose(waveform.target(np.arange(100), pip), expected, atol=1e-12)


def test_inspiration_is_34_steps():
    t = np.arange(protocol.BREATH_STEPS) * protocol.DT
    assert np.sum(t < 1.0) == protocol.INSPIRATION_STEPS
    assert np.all(waveform.shape(np.arange(protocol.INSPIRATION_STEPS)) == 1.0)


def test_phase_never_drifts():
    for breath in (1, 2, 10_000_000):
        np.testing.assert_array_equal(
            waveform.shape(np.arange(100) + 100 * breath), waveform.shape(np.arange(100))
        )


def test_broadcasts():
    pip, peep = np.array([[10.0], [20.0]]), np.array([[5.0], [6.0]])
    found = waveform.target(np.arange(60), pip, peep)
    assert found.shape == (2, 60)
    np.testing.assert_array_equal(found[1], waveform.target(np.arange(60), 20.0, 6.0))


@pytest.mark.parametrize("step", [0, 28, 33, 95])
def test_targets_ahead(step):
    found = waveform.targets_ahead(step, np.array([10.0, 35.0]))
    assert found.shape == (2, protocol.TARGETS_AHEAD)
    for k in range(protocol.TARGETS_AHEAD):
        np.testing.assert_array_equal(found[:, k], waveform.target(step + 1 + k, [10.0, 35.0]))


def test_expiratory_controller():
    steps = np.arange(34, 100)
    t = steps * 0.03
    expected = np.where(t < 1.5, 0.0, 5 * (1 - np.exp(5 * (1.5 - t))))
    np.testing.assert_allclose(waveform.expiratory_command(steps), expected, atol=1e-12)
    assert waveform.expiratory_command(50) == 0.0
    np.testing.assert_array_equal(
        waveform.expiratory_command(steps + 200), waveform.expiratory_command(steps)
    )
