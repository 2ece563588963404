"""What the workflows may and may not do."""

import importlib.util
import re
from pathlib import Path
from typing import Any

import pytest
import yaml

from ci import advisory
from ventbench.task import protocol

FOLDER = Path(__file__).resolve().parents[2] / ".github" / "workflows"
FILES = sorted(FOLDER.glob("*.yml")) if FOLDER.is_dir() else []

pytestmark = pytest.mark.skipif(not FILES, reason="not a checkout of the repository")

#: Values that nobody outside can choose, besides those of `matrix`.
TRUSTED = {
    "github.server_url",
    "github.repository",
    "github.sha",
    "github.ref",
    "github.token",
    "github.event_name == 'pull_request'",
    "github.event.repository.default_branch",
    "github.event.pull_request.number",
    "github.event.pull_request.base.sha",
    "github.event.pull_request.head.sha",
    "runner.temp",
    "matrix.python",
    "matrix.entry",  # names of frozen entries, which are letters, digits and _
    "steps.plan.outputs.entries",
    "fromJSON(needs.bounds.outputs.entries)",
}
#: Texts of a maintainer, and outputs of our own scripts: as environment variables only.
ONLY_ENV = {
    "github.ref_name",
    "secrets.VENTBENCH_SIGNING_KEY",
    "inputs.name",
    "inputs.step",
    "steps.step.outputs.branch",
    "steps.pages.outputs.commit",
}


def read(path: Path) -> dict[Any, Any]:
    return yaml.safe_load(path.read_text())


def steps(path: Path) -> list[dict[str, Any]]:
    return [step for job in read(path)["jobs"].values() for step in job["steps"]]


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
class TestEach:
    def test_nothing_is_expanded_in_a_script(self, path):
        assert not [step["run"] for step in steps(path) if "${{" in step.get("run", "")]

    def test_only_known_values_are_expanded_anywhere(self, path):
        found = set(re.findall(r"\$\{\{\s*(.*?)\s*\}\}", path.read_text()))
        assert found <= TRUSTED | ONLY_ENV
        for step in steps(path):
            elsewhere = {key: value for key, value in step.items() if key != "env"}
            assert not [name for name in ONLY_ENV if f"{{{{ {name}" in str(elsewhere)]

    def test_actions_are_pinned(self, path):
        used = re.findall(r"uses: (.*)", path.read_text())
        for line in used:
            assert re.fullmatch(r"(actions|pypa)/[a-z-]+@[0-9a-f]{40} # v\d+\.\d+\.\d+", line), line

    def test_rights_are_named_and_few(self, path):
        content = read(path)
        assert content["permissions"] == {}
        for job in content["jobs"].values():
            extra = {key for key, value in job["permissions"].items() if value != "read"}
            assert extra <= {"contents", "pull-requests", "id-token"}
            assert not extra or content[True].keys() <= {"push", "workflow_dispatch"}

    def test_no_secret_and_no_foreign_pull_request_with_rights(self, path):
        text = path.read_text().replace("${{ secrets.VENTBENCH_SIGNING_KEY }}", "")
        assert not re.search(r"\bsecrets\b *[.\[]", text.replace("no secrets.", ""))
        assert "pull_request_target" not in text
        assert "workflow_run" not in text

    def test_checkouts_keep_no_token_and_are_never_of_the_pull_request(self, path):
        for step in steps(path):
            if "checkout" in step.get("uses", ""):
                assert step["with"]["persist-credentials"] is False
                assert "head" not in str(step["with"])

    def test_jobs_end(self, path):
        assert all(job["timeout-minutes"] <= 60 for job in read(path)["jobs"].values())

    def test_called_modules_are_there(self, path):
        for name in re.findall(r"-m (ci\.[\w.]+)", path.read_text()):
            assert importlib.util.find_spec(name) is not None


def test_expected_workflows_are_there():
    assert {path.stem for path in FILES} >= {
        "test",
        "score-pr",
        "round",
        "publish",
        "release",
    }


def test_a_slow_entry_keeps_no_other_waiting():
    groups = {
        path.stem: read(path)["concurrency"]["group"] for path in FILES if "score" in path.stem
    }
    assert all("${{" in group for group in groups.values()), "one group for each entry"
    (job,) = read(next(path for path in FILES if path.stem == "score-pr"))["jobs"].values()
    assert 60 * job["timeout-minutes"] > advisory.JOB_S


def test_a_release_needs_a_maintainer_and_runs_nothing_of_ours_with_its_identity():
    with_identity = [
        (path.stem, job)
        for path in FILES
        for job in read(path)["jobs"].values()
        if "id-token" in job["permissions"]
    ]
    ((workflow, job),) = with_identity
    assert workflow == "release"
    assert job["permissions"] == {"id-token": "write"}
    assert job["environment"] == "release"
    assert not [step for step in job["steps"] if "run" in step or "checkout" in step["uses"]]


def test_only_the_tests_fill_a_cache():
    assert [path.stem for path in FILES if "cache:" in path.read_text()] == ["test"]


def test_slow_tests_run_on_schedule_and_branches_may_be_main_or_master():
    started = read(FOLDER / "test.yml")[True]
    assert started["schedule"][0]["cron"]
    pushed = [read(path)[True].get("push", {}) for path in FILES]
    branches = [on["branches"] for on in pushed if "branches" in on]
    assert branches == [["main", "master"]] * 2, "tests and pages"
    slow = read(FOLDER / "test.yml")["jobs"]["slow"]
    assert any("make test-slow" in step.get("run", "") for step in slow["steps"])
    assert any("stable-baselines3" in step.get("run", "") for step in slow["steps"]), (
        "its page runs"
    )


def test_actions_are_kept_up_to_date():
    (update,) = read(FOLDER.parent / "dependabot.yml")["updates"]
    assert update["package-ecosystem"] == "github-actions"


def test_the_advisory_job_can_only_read():
    content = read(FOLDER / "score-pr.yml")
    assert list(content[True]) == ["pull_request"]
    (job,) = content["jobs"].values()
    assert job["permissions"] == {"contents": "read"}


def commands(job: dict[str, Any]) -> str:
    return "\n".join(step.get("run", "") for step in job["steps"])


def runs_strangers(job: dict[str, Any]) -> bool:
    """Whether code of submissions runs in a job."""
    return bool(re.search(r"round score|ventbench score|--rerun|ci\.advisory", commands(job)))


def test_bounds_come_from_a_machine_that_has_run_no_stranger():
    every = [job for path in FILES for job in read(path)["jobs"].values()]
    assert sum(map(runs_strangers, every)) == 2, "control: entries of a round, and of a change"
    (bounds,) = [job for job in every if "round bounds" in commands(job)]
    assert not runs_strangers(bounds)
    assert "needs" not in bounds
    jobs = read(FOLDER / "round.yml")["jobs"]
    assert jobs["bounds"] == bounds
    assert jobs["entries"]["needs"] == "bounds"
    (given,) = [step for step in jobs["entries"]["steps"] if "download-artifact" in str(step)]
    assert given["with"]["name"] == "bounds"


def test_each_entry_of_a_round_has_a_job_of_its_own():
    jobs = read(FOLDER / "round.yml")["jobs"]
    job, last = jobs["entries"], jobs["propose"]
    assert list(job["strategy"]["matrix"]) == ["entry"]
    assert job["strategy"]["fail-fast"] is False
    assert re.findall("round score.*", commands(job)) == ['round score "$NAME" --only "$ENTRY"']
    assert 60 * job["timeout-minutes"] > 2 * protocol.ENTRY_S
    (left,) = [step for step in job["steps"] if "upload-artifact" in str(step)]
    assert left["with"]["name"] == "entry-${{ matrix.entry }}"
    assert last["needs"] == ["bounds", "entries"]
    assert last["if"] == "!cancelled() && needs.bounds.result == 'success'"
    (taken,) = [step for step in last["steps"] if "download-artifact" in str(step)]
    assert "merge-multiple" not in taken["with"], "no job writes into what another one left"


def test_where_a_submission_runs_nothing_can_be_written():
    jobs = read(FOLDER / "round.yml")["jobs"]
    assert jobs["entries"]["permissions"] == {"contents": "read"}
    assert "GH_TOKEN" not in str(jobs["entries"])
    assert not runs_strangers(jobs["propose"])


def test_the_key_that_signs_is_where_no_submission_runs():
    """In one step, that of our own script; the environment keeps it from other branches."""
    with_key = [
        (path.stem, name, job)
        for path in FILES
        for name, job in read(path)["jobs"].items()
        if "secrets.VENTBENCH_SIGNING_KEY" in str(job)
    ]
    ((workflow, name, job),) = with_key
    assert (workflow, name) == ("round", "propose")
    assert job["environment"] == "records"
    (step,) = [step for step in job["steps"] if "secrets." in str(step)]
    assert step["run"] == ".venv/bin/python -m ci.propose"


def test_a_submission_meets_no_secret():
    jobs = read(FOLDER / "round.yml")["jobs"]
    assert "secrets." not in str(jobs["entries"])
    assert "environment" not in jobs["entries"]


def test_pages_come_from_a_job_that_may_only_read():
    jobs = read(FOLDER / "publish.yml")["jobs"]
    assert jobs["verify"]["permissions"] == {"contents": "read"}
    steps = [step.get("run", "") for step in jobs["verify"]["steps"]]
    verified = next(k for k, run in enumerate(steps) if "board verify" in run)
    built = next(k for k, run in enumerate(steps) if "board build" in run)
    assert verified < built
    assert jobs["publish"]["needs"] == "verify"
    assert "make setup" not in str(jobs["publish"]), "nothing is installed where one may write"


def test_exploits_may_not_be_skipped():
    jobs = read(FOLDER / "test.yml")["jobs"].values()
    testing = [job for job in jobs if "make" in str(job["steps"])]
    assert len(testing) == 2
    for job in testing:
        assert job["env"]["VENTBENCH_REQUIRE_ALL"] == "1"
