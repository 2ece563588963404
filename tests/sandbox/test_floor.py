"""Nothing foreign runs where cells are confined too little: every door refuses.

Kernels without a layer are simulated by a filter of system calls, under which the calls that the
layer is made of are unknown; then the same processes run as anywhere.
"""

import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from hardware_eval.results.evaluate import make_runner
from proofs.studies.adversary import adversary
from ventbench.board import official_runs
from ventbench.cli import app
from ventbench.entries import contract
from ventbench.sandbox import runner as runner_module
from ventbench.sandbox.child import kernel, seccomp
from ventbench.sandbox.pipes import SandboxError
from ventbench.sandbox.runner import SandboxRunner, layers

ROOT = Path(runner_module.__file__).parents[2]

#: Calls that a kernel without a layer does not know.
CALLS = {
    "landlock": seccomp.CallNumber(444, 444),
    "namespaces": seccomp.CallNumber(272, 97),
    "mounts": seccomp.CallNumber(165, 40),
    "seccomp": seccomp.SECCOMP,
}

WITHOUT = f"""
import errno, sys
from ventbench.sandbox.child import kernel, seccomp
calls = {{name: seccomp.CallNumber(*numbers) for name, numbers in {
    {name: tuple(call) for name, call in CALLS.items()}
}.items()}}
numbers = [getattr(calls[name], kernel.MACHINE) for name in sys.argv[1].split()]
rules = [seccomp.Rule(number, seccomp.errno_action(errno.ENOSYS)) for number in numbers]
kernel.no_new_privs()
seccomp.install(seccomp.assemble(kernel.MACHINE, rules, seccomp.ALLOW))
"""
SHOW = "from ventbench.sandbox.runner import SandboxRunner; print(*SandboxRunner().missing)"
COMMAND = "from ventbench.cli import main; sys.argv[:] = ['ventbench', *sys.argv[2:]]; main()"

if not kernel.LINUX or not seccomp.available() or not {"landlock", "empty-root"} <= set(layers()):
    pytest.skip("this machine lacks the layers that are taken away here", allow_module_level=True)


def without(what, code, *words):
    command = [sys.executable, "-c", WITHOUT + code, what, *words]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("what", ["landlock", "namespaces", "mounts"])
def test_one_way_to_keep_files_away_is_enough_and_not_official(what):
    run = without(what, SHOW)
    assert run.returncode == 0, run.stderr
    assert ("landlock" if what == "landlock" else "empty-root") in run.stdout.split()


@pytest.mark.parametrize(
    ("what", "missing"),
    [
        ("seccomp", "seccomp missing"),
        ("landlock namespaces", "empty-root/landlock missing"),
        ("landlock mounts", "empty-root/landlock missing"),
        ("landlock namespaces seccomp", "empty-root/landlock and seccomp missing"),
    ],
)
def test_below_the_floor_the_missing_layer_is_named_first(what, missing):
    run = without(what, COMMAND, "check", "pid_best")
    assert run.returncode == 2, run.stdout + run.stderr
    assert run.stderr.startswith(f"ventbench: {missing} on this machine")
    assert "--in-process" in run.stderr
    assert run.stdout == "", "nothing of the entry was looked at"


@pytest.mark.parametrize(
    "door",
    [
        lambda: contract.check("pid_best"),
        lambda: contract.assert_ready("pid_best"),
        lambda: make_runner(sandbox=True),
        official_runs.sandboxed,
        lambda: adversary("pid_robust", simulator="physics"),
        *(
            lambda words=words: CliRunner().invoke(app, words.split(), catch_exceptions=False)
            for words in (
                "score pid_best",
                "score pid_best --simulator physics",
                "score pid_robust --stress 1",
            )
        ),
    ],
)
@pytest.mark.parametrize("shown", [(), ("rlimits", "landlock"), ("namespaces", "seccomp")])
def test_every_door_is_closed(monkeypatch, door, shown):
    monkeypatch.setattr(runner_module, "layers", lambda: shown)
    with pytest.raises(SandboxError, match=r"^\S+( and seccomp)? missing on this machine"):
        door()


def test_other_systems_have_no_floor(monkeypatch):
    monkeypatch.setattr(kernel, "LINUX", False)
    monkeypatch.setattr(runner_module.platform, "system", lambda: "Darwin")
    with pytest.raises(SandboxError, match=r"^empty-root/landlock and seccomp missing .*Darwin"):
        SandboxRunner()
