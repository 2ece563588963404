"""`ventbench check` by running: what the contract asks of a controller.

In this process where the answer is that of the sandbox, which is slower to start.
"""

import itertools
import json
import pickle

import numpy as np
import pytest
from typer.testing import CliRunner

from ventbench.base.errors import InputError
from ventbench.cli import app
from ventbench.entries import contract
from ventbench.entries.cells import InProcessRunner, InProcessSession
from ventbench.entries.contract import STEPS
from ventbench.entries.folder import check_files, open_submission
from ventbench.entries.review import check_sources
from ventbench.sandbox.child.cell import SubmissionError
from ventbench.sandbox.pipes import Allowance
from ventbench.sandbox.runner import SandboxRunner, SandboxSession

from .conftest import MANIFEST

#: No machine is so busy that one of these is met.
PATIENT = Allowance(start_patience_s=300.0, patience_s=300.0, total_s=600.0)


RESET = "    def reset(self, task): pass\n"
ACT = "    def act(self, observation): return 1.0\n"


def ticking(act_s=1e-4):
    """A clock by which every call of ``act`` takes as long."""
    ticks = itertools.count(step=act_s)
    return lambda session: next(ticks)


def set_clock(monkeypatch, act_s=1e-4):
    """Let sessions, apart or in this process, count time by such a clock."""
    for kind in (SandboxSession, InProcessSession):
        monkeypatch.setattr(kind, "processor_time", ticking(act_s))


@pytest.fixture
def check(make, monkeypatch):
    """Check a submission of this source, or of this body of act; apart or in this process."""

    def run(source=None, *, apart=False, act_s=1e-4, **options):
        folder = make(source, **options)
        (folder / "README.md").write_text("A test.")
        runner = SandboxRunner(allowance=PATIENT) if apart else InProcessRunner()
        set_clock(monkeypatch, act_s)
        return contract.check(str(folder), runner)

    return run


def only(report, group):
    (finding,) = report.problems
    assert finding.group == group
    return finding


def test_a_good_one(check):
    report = check(act="return observation.target", apart=True)
    assert report.ok
    assert report.findings == ()
    assert report.skipped == ()
    assert report.sandbox is not None
    assert report.act_us == pytest.approx((100.0, 100.0))


@pytest.mark.parametrize("name", ["pid_best", "pid_robust"])
def test_our_own_are_ready(name, monkeypatch):
    set_clock(monkeypatch)
    report = contract.check(name, SandboxRunner(allowance=PATIENT))
    assert report.ok, "\n".join(report.lines())
    contract.assert_ready(name, InProcessRunner())


def test_progress_ends_when_all_rounds_are_done():
    told = []
    contract.check("pid_robust", InProcessRunner(), progress=lambda *counts: told.append(counts))
    assert told[-1][0] == told[-1][1] == len(told)


def test_assert_ready_says_all(make):
    folder = make(act="return 'a'")
    with pytest.raises(AssertionError) as caught:
        contract.assert_ready(str(folder), InProcessRunner())
    text = str(caught.value)
    assert "README.md: is missing" in text
    assert "act returned a str ('a'); it must return one number" in text
    assert "2 problems; not ready to submit" in text


def test_every_seed_is_run(make):
    folder = make(
        """
        from pathlib import Path
        import numpy as np
        class Controller:
            def reset(self, task):
                self.gain = float(np.load(Path(__file__).parent / "gain.npy"))
            def act(self, observation):
                return self.gain
        """
    )
    (folder / "README.md").write_text("A test.")
    np.save(folder / "gain.npy", 5.0)
    for seed, gain in (("0", 4.0), ("1", [1.0, 2.0])):
        (folder / "seeds" / seed).mkdir(parents=True)
        np.save(folder / "seeds" / seed / "gain.npy", gain)
    finding = only(contract.check(str(folder), InProcessRunner()), "run")
    assert "with the weights of seeds/1 raised TypeError in reset" in finding.what


def test_no_such_folder(tmp_path):
    with pytest.raises(SubmissionError, match="no such folder"):
        contract.check(str(tmp_path / "none"))


def test_a_failure_everywhere_is_said_once_with_its_place(check):
    finding = only(check(act="x = 1\nreturn observation.nothing"), "run")
    assert (finding.file, finding.line) == ("controller.py", 6)
    assert "raised AttributeError at step 1 of breath 1 (lung hidden)" in finding.what
    assert finding.what.endswith("(and in 15 other runs)")


def test_failing_on_one_lung_names_it(check):
    source = """
        class Controller:
            def reset(self, task):
                self.gain = {None: 1.0, "R5C10": 1.0, "R5C20": 1.0, "R5C50": 1.0,
                             "R20C10": 1.0, "R20C20": 1.0}[task.lung]
            def act(self, observation):
                return self.gain
        """
    finding = only(check(source), "run")
    assert "KeyError in reset (lung R20C50): 'R20C50'" in finding.what
    assert finding.line == 4


@pytest.mark.parametrize(
    ("act", "said"),
    [
        ("return float('nan')", "act returned nan at step 1 of breath 1"),
        ("return 1e308 * 10", "act returned inf"),
        ("return None", "act returned None"),
        ("return True", "act returned a bool (True)"),
        ("import numpy\nreturn numpy.zeros(1)", "act returned an array of shape (1,)"),
        ("return 10 ** 400", "act returned an integer too large"),
    ],
)
def test_answers_that_are_no_numbers(check, act, said):
    assert only(check(act=act), "run").what.startswith(said)


def test_a_process_that_ends_itself(check):
    finding = only(check(act="import os\nos._exit(3)\nreturn 1.0", apart=True), "run")
    assert finding.what.startswith("the controller ended its process (exit code 3)")


@pytest.mark.parametrize(
    ("act", "said"),
    [
        ("return 1 / (observation.pressure + 20)", "ZeroDivisionError with a pressure of -20"),
        ("return observation.pressure ** 0.5 + 0.0", "with a pressure of -20 cmH2O"),
        ("assert observation.dt < 0.05\nreturn 1.0", "with a control step of 60 ms"),
        ("assert observation.dt > 0.02\nreturn 1.0", "with a control step of 10 ms"),
        ("return 5 / observation.target", "with a pressure and a target of 0 cmH2O"),
        (
            "t = observation.time; return [1.0][round(t / observation.dt) - round(t / 0.03)]",
            "with a control step of 10 ms",
        ),
    ],
)
def test_unusual_inputs_are_tried_and_named(check, act, said):
    report = check(act=act)
    assert {finding.group for finding in report.problems} == {"run"}
    assert said in report.problems[0].what


def test_chance_is_found(check):
    finding = only(
        check("""
            import random
            class Controller:
                def reset(self, task): pass
                def act(self, observation): return random.Random().random()
            """),
        "repeat",
    )
    assert "the same run in another process gave" in finding.what
    assert "seed" in finding.advice


def test_a_seed_is_enough(check):
    report = check("""
        import random
        class Controller:
            def reset(self, task): self.random = random.Random(1)
            def act(self, observation): return self.random.random()
        """)
    assert report.ok


def test_an_import_that_fails(check):
    report = check(
        """
        import helper
        class Controller:
            def reset(self, task): pass
            def act(self, observation): return 1.0
        """,
        helper="x = 1\n1 / 0\n",
    )
    finding = only(report, "run")
    assert (finding.file, finding.line) == ("helper.py", 2)
    assert "ZeroDivisionError while it was imported" in finding.what
    assert report.skipped == ("repeat", "time")


@pytest.mark.filterwarnings("ignore:coroutine .* was never awaited:RuntimeWarning")
@pytest.mark.parametrize(
    ("body", "said", "advice"),
    [
        (f"{RESET}    def act(self): return 1\n", "raised TypeError at step 1", "act(self, obs"),
        (f"{RESET}    def act(self, o, *, b): return 1\n", "raised TypeError at", "act(self, obs"),
        (f"{RESET}    async def act(self, o): return 1\n", "act returned a coroutine", "float("),
        (f"{RESET}    def act(self, o): yield 1\n", "act returned a generator", "float("),
        (f"{RESET}    def act(self, o): 1.0\n", "act returned None; it must", "float("),
        (f"    def reset(self): pass\n{ACT}", "raised TypeError in reset", "reset(self, task)"),
        (
            f"    def __init__(self, n): pass\n{RESET}{ACT}",
            "raised TypeError in Controller()",
            "Controller() is called without arguments",
        ),
        (ACT, "class Controller in controller.py has no method reset(task)", "reset(self, task)"),
    ],
)
def test_mistakes_in_the_class_are_named_with_what_to_do(check, body, said, advice):
    finding = only(check(f"class Controller:\n{body}"), "run")
    assert finding.file == "controller.py"
    assert finding.what.startswith(said)
    assert advice in finding.advice


def test_every_method_that_is_missing_is_named(check):
    apart = check("class Controller: pass", apart=True)
    assert [finding.what.partition(" has ")[2] for finding in apart.problems] == [
        "no method reset(task)",
        "no method act(observation)",
    ]


def test_a_class_of_another_name_is_named(check):
    finding = only(check(f"from pathlib import Path\nclass Controler:\n{RESET}{ACT}"), "run")
    assert finding.what == "defines no class Controller, but Controler"
    assert finding.advice == contract._CLASS_ADVICE


def test_a_class_that_comes_from_elsewhere_is_asked_in_the_run(check):
    finding = only(check("from helper import Controller", helper="Controller = 3"), "run")
    assert "Controller in controller.py is a int, no class" in finding.what


def test_clipping_is_noted(check):
    report = check(act="return 120.0")
    assert report.ok
    (note,) = report.notes
    assert note.what.startswith("asked for 120 to 120 %, outside of 0 to 100 % at 476 of 476")


def test_slowness_is_found(check):
    finding = only(check(act="return 1.0", act_s=0.02), "time")
    assert "times faster: 450 s are the limit" in finding.advice


def test_time_limits():
    assert contract.ACTS == 756 * 102
    assert list(contract.time_findings(np.full(9, 1e-3))) == []
    (note,) = contract.time_findings(np.full(9, 5e-3))
    assert not note.problem
    (problem,) = contract.time_findings(np.full(9, 10e-3))
    assert problem.problem
    assert problem.what == (
        "act takes 10 ms of processor time on average, the 77112 calls of a round 771 s"
    )


def test_repetition_is_exact():
    run = np.linspace(0.0, 50.0, STEPS)
    assert list(contract.repetition_findings(run, run)) == []
    (finding,) = contract.repetition_findings(run, np.nextafter(run, 100.0))
    assert "another process" in finding.what


def test_the_lines_of_the_author_keep_their_numbers(check):
    source = (
        "class Controller:\n    def reset(self, task): pass\n    def act(self, o): return 1 / 0"
    )
    assert only(check(source), "run").line == 3


def test_the_submission_itself_is_not_touched(make):
    folder = make(act="open(__file__, 'a')\nreturn 1.0")
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    contract.check(str(folder), SandboxRunner(allowance=PATIENT))
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_cheats_meet_the_same_sandbox(check):
    finding = only(check(act="open('/etc/passwd')\nreturn 1.0", apart=True), "run")
    assert "PermissionError" in finding.what or "FileNotFoundError" in finding.what


@pytest.mark.parametrize(
    "act",
    [
        "return observation.nothing",
        "return None",
        "return 120.0",
        "return 5 / observation.target",
        "return {None: 1.0}[self.task.lung]",
    ],
)
def test_in_process_finds_the_same(check, act):
    report, apart = check(act=act), check(act=act, apart=True)
    assert report.findings == apart.findings != ()
    assert report.skipped == apart.skipped
    assert report.sandbox is None
    assert apart.sandbox is not None


def command(*words):
    return CliRunner().invoke(app, [str(word) for word in words])


def test_command_line(make, tmp_path):
    folder = make(act="return 1.0")
    (folder / "README.md").write_text("A test.")
    good = command("check", folder, "--json", tmp_path / "r.json")
    assert good.exit_code == 0, good.output
    assert "no problems; ready to submit" in good.output
    assert json.loads((tmp_path / "r.json").read_text())["ok"] is True
    (folder / "submission.toml").write_text(MANIFEST + "x = 1\n")
    bad = command("check", folder, "--json", tmp_path / "r.json")
    assert bad.exit_code == 1
    assert "submission.toml line 8: key x is not known" in bad.output
    (problem,) = json.loads((tmp_path / "r.json").read_text())["problems"]
    assert problem == {
        "group": "manifest",
        "file": "submission.toml",
        "line": 8,
        "column": None,
        "what": "key x is not known",
        "advice": "remove or rename it",
    }
    none = command("check", tmp_path / "none")
    assert isinstance(none.exception, SubmissionError)


def test_command_new(tmp_path):
    made = command("new", "demo", "--family", "dqn", "--out", tmp_path)
    assert made.exit_code == 0, made.output
    assert "network.py, submission.toml, weights.npz" in made.output
    refused = command("new", "demo", "--family", "nothing")
    assert isinstance(refused.exception, InputError)
    assert "is not one of pid" in str(refused.exception)


def test_everything_at_once(demo):
    (demo / "README.md").unlink()
    (demo / "weights.npz").write_bytes(pickle.dumps([1]))
    (demo / "link").symlink_to("/etc/passwd")
    (demo / ".hidden").write_text("")
    manifest = demo / "submission.toml"
    manifest.write_text(manifest.read_text().replace('"ppo"', '"pop"').replace("name", "nam", 1))
    (demo / "network.py").write_text("import torch\nimport socket\n")
    (demo / "controller.py").write_text("from network import x\nclass Controler: pass\n")
    report = contract.check(str(demo))
    assert not report.ok
    assert report.skipped == ("run", "repeat", "time")
    where = {(f.file, f.line, f.group) for f in report.problems}
    assert where == {
        ("README.md", None, "files"),
        ("weights.npz", None, "files"),
        ("link", None, "files"),
        (".hidden", None, "files"),
        ("submission.toml", 1, "manifest"),
        ("submission.toml", None, "manifest"),
        ("submission.toml", 5, "manifest"),
        ("network.py", 1, "source"),
        ("network.py", 2, "source"),
    }
    assert all(finding.advice for finding in report.problems)
    text = "\n".join(report.lines())
    assert "9 problems; not ready to submit" in text
    assert "'pop' is not one of pid, residual, ppo, dqn, other; did you mean ppo?" in text


def test_nothing_is_run_or_imported(demo, tmp_path):
    bomb = f"open({str(tmp_path / 'ran')!r}, 'w')\n"
    (demo / "controller.py").write_text(bomb + (demo / "controller.py").read_text())
    (demo / "network.py").write_text(bomb)
    check_sources(demo)
    open_submission(str(demo))
    check_files(demo)
    assert not (tmp_path / "ran").exists()


def test_output_cannot_disguise_itself(demo):
    (demo / "a\x1b[31m\u202e.txt").write_text("")
    (demo / "submission.toml").write_text('name = "\\u001b[2J"')
    text = "\n".join(contract.check(str(demo)).lines())
    assert "\x1b" not in text
    assert "\u202e" not in text


def test_scaffold_has_nothing(demo):
    assert check_files(demo) == []
    assert check_sources(demo) == []
