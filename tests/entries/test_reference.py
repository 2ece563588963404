"""Reference errors: stored, resumed, refused where they do not belong, 0 and 100 on their scale."""

import numpy as np
import pytest

from ventbench.base.errors import InputError
from ventbench.base.executor import InProcess
from ventbench.entries import reference as references
from ventbench.entries.cells import protocol_of
from ventbench.entries.folder import submission_of
from ventbench.entries.scoring import run_protocol
from ventbench.task import attainable, protocol

from ..textbook_rigs import TextbookRigs

#: P, I, D of each lung's "best" PID, %/cmH2O.
GAINS = np.tile([[2.0, 4.0, 0.1]], (6, 1)) * np.linspace(0.6, 1.4, 6)[:, None]


@pytest.fixture(scope="module")
def rigs():
    return TextbookRigs().scored()


@pytest.fixture(scope="module")
def inputs(rigs):
    drawn = rigs.draws(2)
    return (
        *rigs.cells(drawn, protocol.PIPS),
        GAINS,
        references.settings(rigs.about, drawn.about()),
    )


def computed(inputs, folder, starts=(1,), **options):
    """Bounds from few starts."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(attainable, "STARTS", starts)
        return references.compute(*inputs, folder=folder, pool=InProcess(), **options)


@pytest.fixture(scope="module")
def found(inputs, tmp_path_factory):
    return computed(inputs, tmp_path_factory.mktemp("parts"))


def test_bounds_are_in_order(found):
    assert found.attainable.shape == (6, 3, 6)
    assert np.all(found.lower <= found.attainable + 1e-9)
    assert np.all(found.attainable <= found.pid)


def test_the_pid_scores_100_and_the_recorded_commands_0(rigs, found):
    gains = dict(zip((lung.id for lung in rigs.lungs), GAINS.tolist(), strict=True))

    class BestPID:
        def reset(self, task):
            self.gains = gains[task.lung]

        def act(self, observation):
            if observation.time == 0:
                self.before = self.integral = self.derivative = 0.0
            error = observation.target - observation.pressure
            a = observation.dt / (observation.dt + 0.5)
            self.integral += a * (error - self.integral)
            self.derivative += a * (error - self.before - self.derivative)
            self.before = error
            p, i, d = self.gains
            return p * error + i * self.integral + d * self.derivative

    score = run_protocol(submission_of(BestPID), protocol_of(rigs, draws=2, reference=found))
    # A command of 0.001 % moves a score by less than a fiftieth of a point.
    np.testing.assert_allclose(np.asarray(score.normalised), 100.0, atol=0.02)
    value = score.to_json()["normalised"]
    assert value["nominal"] == pytest.approx(100.0, abs=0.002)
    assert value["draws"]["score"] == pytest.approx(100.0, abs=0.002)
    assert list(score.summary()["normalised"]) == pytest.approx([100.0] * 6, abs=0.01)

    made = iter(np.ndindex(6, 3, 6))

    class Witness:
        def reset(self, task):
            first, second = found.commands[next(made)]
            self.breaths = iter([first, first, second])

        def act(self, observation):
            if observation.time == 0:
                self.steps = iter(next(self.breaths))
            return float(next(self.steps, 0.0))

    best = run_protocol(submission_of(Witness), protocol_of(rigs, draws=2, reference=found))
    np.testing.assert_allclose(np.asarray(best.normalised), 0.0, atol=0.02)


def test_saved_and_read_again(found, tmp_path):
    path = tmp_path / "bounds.npz"
    assert found.save(path) == found.save(tmp_path / "again.npz")
    again = references.load(path)
    assert again.about == found.about
    for name in ("gains", "attainable", "lower", "stationarity", "pid", "commands"):
        np.testing.assert_array_equal(getattr(again, name), getattr(found, name))


def test_an_interrupted_computation_continues(inputs, found, tmp_path):
    class Stop(Exception):
        pass

    def stop(done, total):
        if done >= 2 * 36:
            raise Stop

    folder = tmp_path / "parts"
    with pytest.raises(Stop):
        computed(inputs, folder, progress=stop)
    kept = {path.name: path.stat().st_mtime_ns for path in folder.glob("draw-*.npy")}
    assert sorted(kept) == ["draw-0.0.npy", "draw-1.0.npy"]
    again = computed(inputs, folder)
    np.testing.assert_array_equal(again.attainable, found.attainable)
    assert all((folder / name).stat().st_mtime_ns == then for name, then in kept.items())
    with pytest.raises(InputError, match="other settings"):
        computed(inputs, folder, starts=(2,))


def test_a_reference_of_other_draws_is_refused(rigs, found):
    own = rigs.draws(2).about()
    for draws, runs in ((own, 3), ({**own, "count": 1}, 2), (None, 1)):
        same = references.reference_of(rigs.about, draws, found)
        assert same is not None
        assert same.attainable.shape == (6, runs, 6)
    for draws in ({**own, "sha256": "1" * 64}, {**own, "season": "2027"}, {**own, "count": 3}):
        with pytest.raises(InputError, match="are of simulators"):
            references.reference_of(rigs.about, draws, found)
    # The published one is of other simulators: no normalised score, and no error.
    assert references.reference_of(rigs.about, own, None) is None


@pytest.mark.parametrize("content", [b"", b"no archive", b"PK\x03\x04" + bytes(60)])
def test_a_damaged_file_is_named(tmp_path, content):
    path = tmp_path / "bounds.npz"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"bounds\.npz is not a file of reference errors"):
        references.load(path)


def test_checks_find_a_forged_bound(found, inputs):
    plants, cells = inputs[:2]
    result = references.checked(found, plants, cells, every=40)
    assert result["witness_deviation"] < 1e-9
    forged = references.Reference(
        found.about,
        found.gains,
        found.attainable - 0.01,
        found.lower,
        found.stationarity,
        found.pid,
        found.commands,
    )
    assert not references.checked(forged, plants, cells, every=40)["sound"]
