import dataclasses
import json
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from typer.testing import CliRunner

from ventbench.base import compilation
from ventbench.base.errors import InputError
from ventbench.cli import app
from ventbench.controllers.pid import PID
from ventbench.entries import cells
from ventbench.entries.cells import InProcessRunner, protocol_of
from ventbench.entries.folder import open_submission
from ventbench.entries.scoring import run_protocol, score
from ventbench.plants.rigs import Rigs
from ventbench.plants.single_compartment import single_compartment
from ventbench.plants.stacking import take
from ventbench.sandbox.child.cell import Failure, SubmissionError
from ventbench.task import draws, environment, protocol, rollouts, waveform
from ventbench.task.interfaces import Task
from ventbench.task.lungs import LUNG_IDS, LUNGS, lung
from ventbench.task.metrics.score import run_error

from ..valve import Lowered, Stepped

GAINS = {
    "R5C10": (10.0, 0.0, 10.0),
    "R5C20": (10.0, 3.0, 10.0),
    "R5C50": (10.0, 10.0, 10.0),
    "R20C10": (7.0, 0.1, 4.0),
    "R20C20": (4.0, 10.0, 0.1),
    "R20C50": (4.0, 10.0, 0.0),
}


def pure_errors(plants, cells, gains):
    """Errors of the pure PID in one scan, shape ``(L, ...)``; cells of all or of each lung."""
    errors = []
    with compilation.float64():
        for i, gain in enumerate(gains):
            own = cells if cells.pip.ndim == 1 else jax.tree.map(lambda x, i=i: x[i], cells)
            found, _ = rollouts.closed_loop(take(plants, i), Stepped(Lowered(PID(*gain))), own)
            errors.append(run_error(found.pressure, np.asarray(own.pip)[..., None, None]))
    return np.stack(errors)


@pytest.fixture(scope="module")
def best(plants):
    return run_protocol(
        open_submission("pid_best"),
        protocol_of(Rigs(LUNGS, plants), draws=20),
        runner=InProcessRunner(),
    )


def test_nominal_is_that_of_the_pure_pid(plants, best):
    with compilation.float64():
        cells = environment.nominal_scenario(np.array(protocol.PIPS))
    expected = pure_errors(plants, cells, GAINS.values())
    np.testing.assert_allclose(best.nominal, expected, rtol=0, atol=1e-9)


def test_draws_are_those_of_the_pure_pid(plants, best):
    with compilation.float64():
        cells = Rigs(LUNGS, plants).draws(20).cells
    expected = np.moveaxis(pure_errors(plants, cells, GAINS.values()), 0, 1)
    np.testing.assert_allclose(best.drawn, expected, rtol=0, atol=1e-9)


def test_robust_pid(plants):
    for track in ("robustness", "performance"):
        found = run_protocol(
            open_submission("pid_robust"),
            protocol_of(Rigs(LUNGS, plants)),
            track=track,
            runner=InProcessRunner(),
        )
        with compilation.float64():
            cells = environment.nominal_scenario(np.array(protocol.PIPS))
        expected = pure_errors(plants, cells, [(4.0, 8.0, 9.0)] * 6)
        np.testing.assert_allclose(found.nominal, expected, rtol=0, atol=1e-9)


def test_json(best):
    found = best.to_json()
    json.dumps(found, allow_nan=False)
    assert list(found["lungs"]) == list(LUNG_IDS)
    for lung_id, result in found["lungs"].items():
        assert list(result["pips"]) == ["10", "15", "20", "25", "30", "35"]
        assert result["score"] == pytest.approx(np.mean(list(result["pips"].values())))
        own = result["draws"]
        assert own["score"] == pytest.approx(np.mean(own["values"]))
        assert own["ci95"][0] < own["score"] < own["ci95"][1], lung_id
    assert found["score"] == pytest.approx(np.mean([x["score"] for x in found["lungs"].values()]))
    assert len(found["draws"]["values"]) == 20
    assert found["draws"]["values"][3] == pytest.approx(best.drawn[3].mean())
    assert found["draws"]["sha256"] == draws.commitment(draws.DEVELOPMENT_SEED)
    assert found["sandbox"] is None
    assert found["official"] is False
    assert found["complete"] is True
    assert found["failures"] == []
    clipped = found["clipped"]
    assert clipped["commands"] == 6 * 6 * 102
    assert clipped["below"] == sum(x["clipped"]["below"] for x in found["lungs"].values())
    assert clipped["share"] == (clipped["below"] + clipped["above"]) / clipped["commands"]


def test_secondary_figures_are_those_of_the_lung(best, plants):
    result, trajectories = best, best.trajectories
    for values in result.figures.values():
        assert values.shape == (6, 6, 2)
    inspirations = trajectories.pressure.reshape(6, 6, 3, 100)[:, :, 1:, :34]
    over = np.maximum(inspirations.max(axis=-1) - np.array(protocol.PIPS)[:, None], 0)
    np.testing.assert_allclose(result.figures["overshoot_cmH2O"], over, atol=1e-9)
    found = result.to_json()["lungs"]["R20C10"]
    assert found["secondary"]["overshoot_cmH2O"] == pytest.approx(over[3].mean())
    settling = result.figures["settling_time_s"][3]
    assert found["secondary_missing"].get("settling_time_s", 0) == np.isnan(settling).sum()


def test_deterministic(best, plants):
    again = run_protocol(
        open_submission("pid_best"),
        protocol_of(Rigs(LUNGS, plants), draws=20),
        runner=InProcessRunner(),
    )
    first, second = best.to_json(), again.to_json()
    assert set(first.pop("timing")) == set(second.pop("timing"))
    assert first == second


def test_trajectories(best, plants):
    result, found = best, best.trajectories
    assert found.pressure.shape == (6, 6, 300)
    np.testing.assert_allclose(found.time, 0.03 * np.arange(300))
    np.testing.assert_array_equal(found.target[2, 3], waveform.target(np.arange(300), 25.0))
    phase = np.arange(300) % 100
    assert np.all((found.u_out == 1) == (phase >= 34))
    scored = (phase < 34) & (np.arange(300) >= 100)
    error = np.abs(found.pressure - found.target)[..., scored].mean(axis=-1)
    np.testing.assert_allclose(error, result.nominal, rtol=0, atol=1e-9)
    with compilation.float64():
        cells = environment.nominal_scenario(np.array(protocol.PIPS))
        pid = Stepped(Lowered(PID(*GAINS["R20C20"])))
        inspired, expired = rollouts.closed_loop(take(plants, 4), pid, cells, whole=True)
    for name in ("pressure", "u_in"):
        whole = np.concatenate([getattr(inspired, name), getattr(expired, name)], axis=-1)
        np.testing.assert_allclose(
            getattr(found, name)[4], whole.reshape(6, 300), rtol=0, atol=1e-8
        )


def test_parts(best, plants):
    part = jax.tree.map(lambda leaf: leaf[jnp.array([5, 0])], plants)
    rigs = Rigs((lung("R20C50"), lung("R5C10")), part, about={"version": 1})
    # A lung keeps its draws wherever the PIPs are fewer.
    drawn = Rigs(LUNGS, plants).draws(2, (35.0, 10.0))
    own = dataclasses.replace(drawn, cells=jax.tree.map(lambda x: x[[5, 0]], drawn.cells))
    own = dataclasses.replace(own, rig=drawn.rig[[5, 0]], member=drawn.member[[5, 0]])
    found = run_protocol(
        open_submission("pid_best"),
        protocol_of(rigs, drawn=own, pips=[35.0, 10.0]),
        runner=InProcessRunner(),
    )
    np.testing.assert_allclose(found.nominal, best.nominal[[5, 0]][:, [5, 0]], atol=1e-12)
    np.testing.assert_allclose(found.drawn, best.drawn[:2, [5, 0]][:, :, [5, 0]], atol=1e-12)
    result = found.to_json()
    assert result["complete"] is False
    assert result["simulators"] == {"version": 1}
    assert list(result["lungs"]["R20C50"]["pips"]) == ["35", "10"]


def test_without_draws(plants):
    result = run_protocol(
        open_submission("pid_best"), protocol_of(Rigs(LUNGS, plants)), runner=InProcessRunner()
    ).to_json()
    assert result["draws"] is None
    assert result["lungs"]["R5C10"]["draws"] is None


def test_compiles_once(plants):
    compiled: list[Any] = [cells._inspire, cells._observe]
    for function in compiled:
        function.clear_cache()
    run_protocol(
        open_submission("pid_best"),
        protocol_of(Rigs(LUNGS, plants), draws=1),
        runner=InProcessRunner(),
    )
    run_protocol(
        open_submission("pid_robust"),
        protocol_of(Rigs(LUNGS, plants), draws=1),
        runner=InProcessRunner(),
    )
    assert [function._cache_size() for function in compiled] == [1, 1]


@pytest.mark.parametrize(("track", "known"), [("robustness", False), ("performance", True)])
def test_what_a_submission_is_told(make, plants, track, known):
    source = """
        import json, pathlib
        LOG = pathlib.Path(__file__).parent.parent / "log"
        class Controller:
            def reset(self, task):
                self.task, self.seen = task, []
            def act(self, observation):
                self.seen.append(observation)
                if len(self.seen) == 102:
                    with LOG.open("a") as file:
                        print(json.dumps([self.task, self.seen]), file=file)
                return 2.0 * len(self.seen) - 20.0
        """
    folder = make(source)
    run_protocol(
        open_submission(str(folder)),
        protocol_of(Rigs(LUNGS, plants), draws=1),
        track=track,
        runner=InProcessRunner(),
    )
    runs = [json.loads(line) for line in (folder.parent / "log").read_text().splitlines()]
    assert len(runs) == 6 * 2 * 6
    for index, (task, seen) in enumerate(runs):
        lung_index, draw, pip_index = np.unravel_index(index, (6, 2, 6))
        assert task == [track, LUNG_IDS[lung_index] if known else None, 0.03, 34]
        times, dts, pressures, targets, ahead, previous = (list(x) for x in zip(*seen, strict=True))
        if draw == 0:
            np.testing.assert_allclose(times, np.tile(0.03 * np.arange(34), 3))
            np.testing.assert_allclose(targets, protocol.PIPS[pip_index])
            assert pressures[0] == pressures[34] == 5.0
            for step in (0, 24, 33):
                expected = waveform.targets_ahead(step, protocol.PIPS[pip_index])
                np.testing.assert_allclose(ahead[step], expected)
        assert len(set(dts)) == 1
        requested = np.clip(2.0 * np.arange(1, 103) - 20.0, 0, 100)
        bias = waveform.expiratory_command(protocol.BREATH_STEPS - 1)
        requested[[33, 67]] = bias  # the step after is the first of a breath
        np.testing.assert_allclose(previous, [bias, *requested[:-1]])


def test_failed_cells(make, plants):
    act = """
        self.calls = getattr(self, "calls", 0) + 1
        if self.task.lung == "R5C20" and self.calls == 40 and observation.target == 20.0:
            raise ValueError("no idea")
        return 3.0
        """
    found = run_protocol(
        open_submission(str(make(act=act))),
        protocol_of(Rigs(LUNGS, plants), draws=1),
        track="performance",
        runner=InProcessRunner(),
    )
    result = found.to_json()
    assert result["score"] is None
    assert result["lungs"]["R5C20"]["score"] is None
    assert result["lungs"]["R5C20"]["pips"]["20"] is None
    assert result["lungs"]["R5C20"]["pips"]["25"] > 0
    assert result["lungs"]["R5C10"]["score"] > 0
    (failure,) = result["failures"]
    assert {k: failure[k] for k in ("lung", "pip", "draw", "breath", "step", "kind")} == {
        "lung": "R5C20",
        "pip": 20.0,
        "draw": None,
        "breath": 2,
        "step": 6,
        "kind": "act",
    }
    assert failure["message"].endswith(
        "controller.py line 8 raised ValueError at step 6 of breath 2 (lung R5C20): no idea; "
        "the entry is not ranked."
    )
    inspired = found.trajectories.u_in[1, 2].reshape(3, 100)[:, :34].ravel()
    np.testing.assert_array_equal(inspired, np.where(np.arange(102) < 39, 3.0, 0.0))
    json.dumps(result, allow_nan=False)


def test_failure_in_a_draw(make, plants):
    act = "return 3.0 if observation.target in (10, 15, 20, 25, 30, 35) else None"
    result = run_protocol(
        open_submission(str(make(act=act))),
        protocol_of(Rigs(LUNGS, plants), draws=2),
        runner=InProcessRunner(),
    ).to_json()
    assert result["score"] is None
    assert result["draws"]["score"] is None
    assert result["draws"]["values"] == [None, None]
    assert len(result["failures"]) == 6 * 2 * 6
    assert {f["draw"] for f in result["failures"]} == {1, 2}
    assert "(lung hidden)" in result["failures"][0]["message"]
    assert result["lungs"]["R5C10"]["pips"]["10"] > 0


def test_all_cells_fail_before_the_first_step(make, plants):
    source = "class Controller:\n def reset(self): pass\n def act(self, o): return 0.0\n"
    result = run_protocol(
        open_submission(str(make(source))),
        protocol_of(Rigs(LUNGS, plants)),
        runner=InProcessRunner(),
    ).to_json()
    assert len(result["failures"]) == 36
    assert "raised TypeError in reset (lung hidden)" in result["failures"][0]["message"]


def test_unsafe_lung(make, plants):
    act = "return 100.0 if self.task.lung == 'R5C10' else 0.0"
    found = run_protocol(
        open_submission(str(make(act=act))),
        protocol_of(Rigs(LUNGS, plants)),
        track="performance",
        runner=InProcessRunner(),
    )
    np.testing.assert_array_equal(found.safe, [False] + [True] * 5)
    result = found.to_json()
    assert result["safe"] is False
    assert result["lungs"]["R5C10"]["peak_pressure_cmH2O"] > 100


def test_clipping(make, plants):
    act = "return -1.0 if observation.time == 0 else 101.0 if observation.time > 0.95 else 1.0"
    result = run_protocol(
        open_submission(str(make(act=act))),
        protocol_of(Rigs(LUNGS, plants)),
        runner=InProcessRunner(),
    ).to_json()
    assert result["lungs"]["R5C10"]["clipped"] == {
        "below": 18,
        "above": 36,
        "commands": 612,
        "share": 54 / 612,
    }
    assert result["secondary"]["clipped_share"] == pytest.approx(3 / 34)


def test_wrong_track(plants):
    with pytest.raises(SubmissionError, match="enters performance; it cannot be scored for robus"):
        run_protocol(
            open_submission("pid_best"),
            protocol_of(Rigs(LUNGS, plants)),
            track="robustness",
            runner=InProcessRunner(),
        )


def test_too_many_draws(plants):
    with pytest.raises(InputError, match="20 development draws"):
        run_protocol(
            open_submission("pid_best"),
            protocol_of(Rigs(LUNGS, plants), draws=21),
            runner=InProcessRunner(),
        )


def test_plants_of_other_lungs(plants):
    with pytest.raises(ValueError, match="not stacked over 2 lungs"):
        run_protocol(
            open_submission("pid_best"),
            protocol_of(Rigs(LUNGS[:2], plants)),
            runner=InProcessRunner(),
        )


def test_broken_simulator_is_no_score(plants):
    broken = dataclasses.replace(plants, C=np.array([10.0, 20.0, np.nan, 10.0, 20.0, 50.0]))
    with pytest.raises(FloatingPointError, match="simulator 2 answered with NaN"):
        run_protocol(
            open_submission("pid_best"), protocol_of(Rigs(LUNGS, broken)), runner=InProcessRunner()
        )


def test_code_that_cannot_be_imported(make, plants):
    with pytest.raises(SubmissionError, match=r"controller.py line 1: "):
        run_protocol(open_submission(str(make("x = (\n"))), protocol_of(Rigs(LUNGS, plants)))


class Recorder:
    """A runner of another kind: one call for all cells, closed once; its last cell times out."""

    def __init__(self):
        self.sandbox = {"layers": ["none really"]}

    def start(self, submission, tasks):
        self.tasks, self.closed, self.failures, self.rows = tasks, 0, {}, []
        return self

    def ask(self, cells, observations):
        self.cells = cells
        self.rows.append(observations)
        if len(self.rows) == 50:
            self.failures[len(self.tasks) - 1] = Failure("timeout", "took 1 s", "", 2, 16)

    def answers(self):
        return self.cells, np.full(len(self.cells), 2.0)

    def close(self):
        self.closed += 1


def test_another_runner(plants):
    runner: Any = Recorder()
    found = run_protocol(
        open_submission("pid_best"), protocol_of(Rigs(LUNGS, plants), draws=1), runner=runner
    )
    assert len(runner.rows) == 102
    assert all(rows.shape == (72, 15) and rows.dtype == np.float64 for rows in runner.rows)
    assert [task.lung for task in runner.tasks[::12]] == list(LUNG_IDS)
    assert runner.closed == 1
    result = found.to_json()
    assert result["sandbox"] == {"layers": ["none really"]}
    (failure,) = result["failures"]
    assert (failure["lung"], failure["pip"], failure["draw"]) == ("R20C50", 35.0, 1)
    assert failure["message"] == (
        "pid_best: took 1 s at step 16 of breath 2 (lung R20C50); the entry is not ranked."
    )


def test_session_is_closed_when_the_loop_breaks(plants):
    class Breaks(Recorder):
        def answers(self):
            raise KeyboardInterrupt

    runner: Any = Breaks()
    with pytest.raises(KeyboardInterrupt):
        run_protocol(open_submission("pid_best"), protocol_of(Rigs(LUNGS, plants)), runner=runner)
    assert runner.closed == 1


def test_cells_do_not_share_controllers(make):
    source = """
        class Controller:
            def reset(self, task): self.calls = 0
            def act(self, observation):
                self.calls += 1
                return float(self.calls)
        """
    submission = open_submission(str(make(source)))
    session = InProcessRunner().start(submission, [Task("robustness", None, 0.03, 34)] * 3)
    for call in (1.0, 2.0):
        np.testing.assert_array_equal(session.act(np.zeros((3, 15))), call)
    session.close()
    session.close()


def test_jax_in_a_submission_is_as_elsewhere(make, plants):
    act = """
        import jax.numpy as jnp
        assert jnp.zeros(()).dtype == "float32"
        return jnp.asarray(observation.pressure)
        """
    part = jax.tree.map(lambda leaf: leaf[:1], plants)
    found = run_protocol(
        open_submission(str(make(act=act))),
        protocol_of(Rigs(LUNGS[:1], part), pips=[10.0]),
        runner=InProcessRunner(),
    )
    assert found.failures == ()


def test_nothing_is_left_on_the_search_path(plants):
    before = list(sys.path)
    run_protocol(
        open_submission("pid_best"), protocol_of(Rigs(LUNGS, plants)), runner=InProcessRunner()
    )
    assert sys.path == before


@pytest.fixture(scope="module")
def two_lungs():
    with compilation.float64():
        return {lung.id: single_compartment(lung) for lung in LUNGS[:2]}


class Proportional:
    """A class in place of a folder."""

    def reset(self, task):
        self.gain = {"R5C10": 1.0}.get(task.lung, 2.0)

    def act(self, observation):
        return 5.0 + self.gain * (observation.target - observation.pressure)


def twice(observation):
    return 5.0 + 2.0 * (observation.target - observation.pressure)


def test_a_folder_a_name_a_class_and_a_function_are_scored_alike(make, two_lungs):
    act = "return 5.0 + 2.0 * (observation.target - observation.pressure)"
    folder = make(act=act)
    inside = score(folder, simulator=two_lungs, sandbox=False)
    again = score(str(folder), simulator=two_lungs, draws=1, sandbox=False)
    function = score(twice, simulator=two_lungs, draws=1)
    assert (again.track, function.track) == ("robustness", "robustness")
    np.testing.assert_array_equal(again.nominal, inside.nominal)
    np.testing.assert_array_equal(function.nominal, inside.nominal)
    np.testing.assert_array_equal(function.drawn, again.drawn)
    told = score(Proportional, simulator=two_lungs)
    assert told.track == "performance"
    np.testing.assert_array_equal(told.nominal[1], inside.nominal[1])
    assert not np.array_equal(told.nominal[0], inside.nominal[0])
    hidden = score(Proportional, simulator=two_lungs, track="robustness")
    np.testing.assert_array_equal(hidden.nominal, inside.nominal)
    named = score("pid_best", simulator=two_lungs, sandbox=False)
    assert named.submission == open_submission("pid_best")
    for result in (inside, function, told, named):
        assert result.sandbox is None
        assert not result.official
    json.dumps(function.to_json(), allow_nan=False)
    assert function.to_json()["submission"]["sha256"] is None


def test_one_command_scores_every_track_that_an_entry_enters(make, tmp_path):
    folder = make(act="return 3.0 if self.task.lung is None else 9.0")
    out = tmp_path / "runs"

    def scored(track, *options):
        words = ["score", str(folder), "--simulator", "physics", "--in-process", "--json", "-"]
        ended = CliRunner().invoke(app, [*words, "--track", track, *options])
        assert ended.exit_code == 0, ended.output
        return json.loads(ended.stdout)

    both = scored("all", "--out", str(out))["submissions"]
    assert [entry["track"] for entry in both] == ["robustness", "performance"]
    assert len({entry["score"] for entry in both}) == 2
    for entry in both:
        assert entry["lungs"] == scored(entry["track"])["lungs"]
        kept = json.loads((out / entry["name"] / entry["track"] / "score.json").read_text())
        assert kept["score"] == entry["score"]


def test_a_folder_runs_in_the_sandbox_unless_told_otherwise(make, two_lungs):
    result = score(make(act="return 3.0"), simulator=two_lungs)
    assert result.sandbox is not None
    assert not result.failures
    assert not result.official, "not the frozen lungs"


def test_failures_of_a_function_name_its_file_and_line(two_lungs):
    def divides(observation):
        return 1.0 / 0.0

    with pytest.raises(SubmissionError, match=r"^divides: test_scoring\.py line "):
        score(divides, simulator=two_lungs)
    typed = eval("lambda observation: {}['gain']")
    with pytest.raises(SubmissionError, match=r"^<lambda>: <lambda> raised KeyError at step 1"):
        score(typed, simulator=two_lungs)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (Proportional(), "give the class Proportional, not an instance"),
        (type("Half", (), {"reset": print}), "class Half has no method act"),
        (type("None_", (), {}), "class None_ has no method reset and no method act"),
        (3, "a int cannot be scored; give a folder"),
    ],
)
def test_what_cannot_be_scored(given, said):
    with pytest.raises(SubmissionError, match=said):
        score(given, simulator="physics")


def test_progress_counts_the_rounds_of_all_runs():
    seen = []
    stressors = ["supply_high"]
    score(
        lambda observation: 5.0,
        simulator="physics",
        stress=1,
        stressors=stressors,
        progress=lambda *far: seen.append(far),
    )
    total = 2 * protocol.BREATHS * protocol.INSPIRATION_STEPS
    assert seen == [(done, total) for done in range(1, total + 1)]


@pytest.mark.slow
@pytest.mark.filterwarnings("default")  # of Dask's own, about ports and closing
def test_entries_on_a_cluster_have_the_scores_that_they_have_here(tmp_path):
    distributed = pytest.importorskip("distributed", reason="the extra ventbench[dask] is missing")

    def scores(*options: object) -> dict[str, Any]:
        file = tmp_path / "scores.json"
        words = ("score", "pid_robust", "pid_best", "--simulator", "physics", "--in-process")
        ended = CliRunner().invoke(app, [*words, "--json", str(file), *map(str, options)])
        assert ended.exit_code == 0, ended.output
        return {
            entry["name"]: entry["lungs"] for entry in json.loads(file.read_text())["submissions"]
        }

    started = distributed.LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        processes=True,
        dashboard_address=None,
        host="127.0.0.1",
        local_directory=str(tmp_path),
    )
    with started as cluster:
        there = scores("--scheduler", cluster.scheduler_address)
    assert list(there) == ["pid_robust", "pid_best"]
    assert there == scores()


@pytest.mark.parametrize(
    ("shape", "cell"),
    [((2, 4, 1, 3), (1, slice(None), 0, 2)), ((2, 1, 3, 4), (1, 0, 2)), ((2, 1, 3), (1, 0, 2))],
    ids=["stacked by a mechanism", "behind the batch", "one"],
)
def test_cells_that_wait_keep_all_their_states(shape, cell):
    mask = np.zeros((2, 1, 3), bool)
    mask[1, 0, 2] = True
    chosen = np.asarray(cells._select(jnp.asarray(mask), jnp.ones(shape), jnp.zeros(shape)))
    assert chosen.shape == shape
    assert np.all(chosen[cell] == 1.0)
    assert chosen.sum() == np.size(chosen[cell])
