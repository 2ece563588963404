"""Between workflow and script: nothing that a submission says may become a command or a page."""

import pytest

from ci import workflow
from ventbench.base.errors import InputError

HOSTILE = ["::set-output name=x::y", "```", "<script>x</script>", "| a | b |", "a\n::error::b"]


def test_a_variable_must_be_set(monkeypatch):
    monkeypatch.setenv("NAME", "demo")
    assert workflow.required("NAME") == "demo"
    for empty in (lambda: monkeypatch.setenv("NAME", ""), lambda: monkeypatch.delenv("NAME")):
        empty()
        with pytest.raises(InputError, match="NAME is not set"):
            workflow.required("NAME")


def test_lines_are_neither_commands_nor_markdown(monkeypatch, tmp_path, capsys):
    monkeypatch.setenv("GITHUB_STEP_SUMMARY", str(tmp_path / "summary"))
    workflow.summary("Title", HOSTILE)
    printed = capsys.readouterr().out
    assert not any(line.lstrip().startswith("::") for line in printed.splitlines())
    title, empty, *block = (tmp_path / "summary").read_text().splitlines()
    assert (title, empty) == ("## Title", "")
    assert len(block) == 7
    assert all(line.startswith("    ") for line in block if line)


def test_without_a_page_it_only_prints(monkeypatch, capsys):
    monkeypatch.delenv("GITHUB_STEP_SUMMARY", raising=False)
    workflow.summary("Title", ["x"])
    assert capsys.readouterr().out == "| x\n"


def test_what_is_shown_on_a_pull_request_is_one_command_each(monkeypatch, capsys):
    workflow.annotate("Title", HOSTILE, "a", wrong=False)
    assert capsys.readouterr().out == "", "only where there is one"
    monkeypatch.setenv("GITHUB_ACTIONS", "true")
    workflow.annotate("Title", [*HOSTILE, "100 %"], "a,line=7::\n::error::b", wrong=True)
    (line,) = capsys.readouterr().out.splitlines()
    place, _, said = line.removeprefix("::error ").partition("::")
    assert place == "file=a%2Cline=7%3A%3A%0A%3A%3Aerror%3A%3Ab,line=1,title=Title"
    assert said.split("%0A") == [*HOSTILE[:-1], "a", "::error::b", "100 %25"]


def test_outputs_are_single_lines(monkeypatch, tmp_path):
    monkeypatch.setenv("GITHUB_OUTPUT", str(tmp_path / "output"))
    workflow.output(branch="record/demo", commit="")
    assert (tmp_path / "output").read_text() == "branch=record/demo\ncommit=\n"
    with pytest.raises(ValueError, match="not one line"):
        workflow.output(branch="x\nGH_TOKEN=y")


def test_what_stops_a_job_is_said(capsys):
    def stopped():
        raise InputError("first\n::error::second")

    assert workflow.run("Title", stopped) == 2
    assert capsys.readouterr().out == "| stopped: first\n| stopped: ::error::second\n"
    assert workflow.run("Title", lambda: 1) == 1
