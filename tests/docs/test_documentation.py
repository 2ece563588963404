"""README and docs: Python blocks run, commands parse, links lead somewhere."""

from __future__ import annotations

import importlib.util
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer.main
from _pytest.mark.structures import ParameterSet
from scipy.io import savemat
from typer.testing import CliRunner

from ci import generated_tables
from proofs import __main__ as proofs
from ventbench.base.files import example
from ventbench.cli import app
from ventbench.cli.options import quiet_first
from ventbench.recordings import load
from ventbench.task.interfaces import Observation, Task

ROOT = Path(__file__).parents[2]
PROOFS = "python -m proofs"
PROGRAMS = {"ventbench": app, PROOFS: proofs.app}
PAGES = sorted(
    page
    for page in (*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("submissions/*.md"))
    if page.name != "LICENSE.md"
)

#: What makes a block take seconds to minutes on a machine that has compiled nothing yet.
SLOW = re.compile(r"diagnose\(|train_|\bfit\(|ventbench\.score\(")


#: Blocks of commands that run as they are written, by page and number from 1, in one folder a page;
#: with those before them, and with the page's own controller or diagnoser.
QUICK = {"docs/mechanics.md": (1,), "docs/missing_physics.md": (2,)}
WHOLE = {
    "docs/submitting.md": (1,),
    "docs/diagnosers.md": (1,),
    "docs/mechanics.md": (2,),
}

if importlib.util.find_spec("stable_baselines3"):  # no extra of ventbench brings it
    WHOLE["docs/reinforcement.md"] = (2,)

#: Examples of ``--help`` that run as they are written.
EXAMPLES = (
    "ventbench list lungs",
    "ventbench list stressors",
    "ventbench doctor",
    "ventbench simulate",
    "ventbench data open-loop",
    "ventbench list entries",
    "ventbench list examples",
    "ventbench data import",
    "ventbench board new-key",
)


def blocks(page: Path, language: str) -> list[str]:
    """Return the fenced blocks of a language."""
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text("utf-8"), re.M | re.S)


def without_json() -> Iterator[str]:
    """Yield the commands of all programs that take no ``--json``."""
    from hardware_eval.cli import app as hardware

    waiting: list[tuple[str, Any]] = [
        (name, typer.main.get_command(program))
        for name, program in (PROGRAMS | {"ventbench-hardware": hardware}).items()
    ]
    while waiting:
        path, command = waiting.pop()
        inner = getattr(command, "commands", {})
        waiting += [(f"{path} {name}", each) for name, each in inner.items()]
        if not inner and not any("--json" in option.opts for option in command.params):
            yield path


def python_pages() -> list[ParameterSet]:
    """Return each page with Python blocks; pages with long fits are slow."""
    pages = []
    for page in PAGES:
        found = blocks(page, "python")
        if found:
            slow = SLOW.search("\n".join(found))
            name = str(page.relative_to(ROOT))
            marks = [pytest.mark.slow] if slow else []
            pages.append(pytest.param(page, id=name, marks=marks))
    return pages


def commands(page: Path) -> Iterator[str]:
    """Yield the command lines of a page that call ventbench or proofs, continuations joined."""
    for block in blocks(page, "sh"):
        for line in block.replace("\\\n", " ").splitlines():
            for part in line.split("&&"):
                if part.strip().startswith(("ventbench ", f"{PROOFS} ")):
                    yield part.strip()


def parse(line: str) -> str:
    """Return why a command line is wrong, or nothing; like the program, without running it."""
    program = PROOFS if line.startswith(PROOFS) else "ventbench"
    words = shlex.split(line.removeprefix(program), comments=True)
    command: Any = typer.main.get_command(PROGRAMS[program])
    path = [program]
    while hasattr(command, "commands"):
        if not words or words[0] not in command.commands:
            return f"`{' '.join(path)}` has no command {words[:1]}"
        command = command.commands[words[0]]
        path.append(words.pop(0))
    context = command.context_class(command, info_name=path[-1])
    try:
        command.make_parser(context).parse_args(args=words)
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return ""


@pytest.mark.parametrize("page", python_pages())
def test_python_blocks_run(page: Path, tmp_path: Path) -> None:
    """All blocks of a page, in order, in one fresh interpreter and an empty folder."""
    for name in ("data", "submissions", "leaderboard"):
        (tmp_path / name).symlink_to(ROOT / name)
    script = tmp_path / "blocks.py"
    script.write_text("\n\n".join(blocks(page, "python")), "utf-8")
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, script], cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


def furnish(folder: Path) -> Path:
    """Put what the pages speak of into a folder: recordings, tables, plans, a record."""
    for name in ("data", "submissions", "leaderboard", "proofs", "ci", "examples"):
        (folder / name).symlink_to(ROOT / name)
    recorded = load(example("concealed"))
    (folder / "recording.csv").write_bytes(example("concealed").read_bytes())
    u_in, u_out = recorded.u_in[:4].ravel(), recorded.u_out[:4].ravel().astype(int)
    at = 0.03 * np.arange(u_in.size)
    table = np.stack([np.repeat(range(1, 5), recorded.u_in.shape[1]), at, u_in, u_out], axis=1)
    head = "breath_id,time_step,u_in,u_out"
    np.savetxt(folder / "plan.csv", table, "%.9g", ",", header=head, comments="")
    np.savetxt(folder / "commands.csv", table[:80, 1:], "%.9g", ",", header=head[10:], comments="")
    flow = load(example("flow"))
    assert flow.flow is not None
    pressure, flows = flow.pressure.ravel(), np.asarray(flow.flow).ravel()
    at = 0.03 * np.arange(pressure.size)
    rows = np.stack([at, pressure, 0.06 * flows], axis=1)
    np.savetxt(folder / "lab.csv", rows, "%.9g", ",", header="time,Paw,Flow", comments="")
    fine = np.interp(np.arange(0.0, at[-1], 0.005), at, pressure)
    savemat(folder / "lab.mat", {"data": {"p": fine}, "other": {"p": fine}})
    names = ("timestamp", "pressure", "flow_out", "control_in", "control_out", "oxygen")
    zero, cycle = 0.0 * at, np.repeat(range(len(flow)), flow.pressure.shape[1])
    logged = [1.6e9 + at, pressure, zero, flow.u_in.ravel(), flow.u_out.ravel(), zero, cycle]
    head = ", ".join(f"'{name}'" for name in (*names, "cycle_number"))
    rows = np.stack(logged, axis=1)
    np.savetxt(folder / "waveforms.csv", rows, "%.14g", ",", header=head, comments="")
    records = ROOT / "leaderboard" / "records"
    record = next(x for x in sorted(records.glob("*.json")) if '"commands"' in x.read_text("utf-8"))
    shutil.copy(record, folder / "RECORD.json")
    for commands in records.glob("*.actions"):
        if commands.stem in record.read_text("utf-8"):
            shutil.copy(commands, folder)
    return folder


@pytest.fixture(scope="module")
def furnished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return furnish(tmp_path_factory.mktemp("reader"))


def examples() -> dict[str, str]:
    """Examples of ``--help`` by command."""
    rows = [line.strip("| ").split(" | ") for line in generated_tables.commands().splitlines()[2:]]
    return {row[0].strip("`"): row[2].strip("` ") for row in rows}


QUICK_LINES = [
    line
    for page, numbers in QUICK.items()
    for number in numbers
    for line in blocks(ROOT / page, "sh")[number - 1].splitlines()
]


@pytest.mark.parametrize("line", [*QUICK_LINES, *map(examples().__getitem__, EXAMPLES)])
def test_what_is_cheap_runs(line: str, furnished: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(furnished)
    program, *words = shlex.split(
        line.replace("leaderboard/records/RECORD", "RECORD"), comments=True
    )
    done = CliRunner().invoke(PROGRAMS[program], quiet_first(words), catch_exceptions=False)
    assert done.exit_code == 0, done.output


@pytest.mark.slow
@pytest.mark.parametrize("page", WHOLE)
def test_blocks_of_commands_run(page: str, tmp_path: Path, public_recordings: Path) -> None:
    """As written, by a shell; packages are installed already, and ``&`` gets a moment to start."""
    furnish(tmp_path)
    (tmp_path / "recordings").symlink_to(public_recordings)
    if page == "docs/diagnosers.md":
        (tmp_path / "mine").mkdir()
        for language, name in (("python", "diagnose.py"), ("toml", "diagnoser.toml")):
            (tmp_path / "mine" / name).write_text(blocks(ROOT / page, language)[0], "utf-8")
    lines = [blocks(ROOT / page, "sh")[number - 1] for number in WHOLE[page]]
    script = re.sub(r"^pip install .*", "", "\n".join(lines), flags=re.M).replace(
        "&\n", "& sleep 8\n"
    )
    if "stable" in script:
        script = script.replace("train_stable_baselines3.py", "train_stable_baselines3.py 5")
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    done = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", f"trap 'kill $(jobs -p) 2>&- || true' EXIT\n{script}"],
        cwd=tmp_path,
        env={**os.environ, "PATH": path, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]


def test_forty_journeys_run_as_written() -> None:
    """What a reader does, on pages and by ``--help``, scripts and notebooks included."""
    count = {
        "blocks of Python": sum(len(blocks(page, "python")) for page in PAGES),
        "commands of pages": len(QUICK_LINES)
        + sum(
            len(blocks(ROOT / page, "sh")[number - 1].splitlines())
            for page, numbers in WHOLE.items()
            for number in numbers
        ),
        "examples of --help": len(EXAMPLES),
        "scripts and notebooks": len([*ROOT.glob("examples/*.py"), *ROOT.glob("examples/*.ipynb")]),
    }
    print(f"{sum(count.values())} journeys: {count}")
    assert sum(count.values()) >= 40


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_commands_parse(page: Path) -> None:
    """Every command exists and takes the options that the page gives it."""
    problems = {line: problem for line in commands(page) if (problem := parse(line))}
    assert not problems


def test_the_sites_table_of_commands_has_all_and_their_examples_parse() -> None:
    assert {"ventbench score", "ventbench board withdraw", f"{PROOFS} challenge reveal"} <= {
        *examples()
    }
    parts = [part.strip() for example in examples().values() for part in example.split("&&")]
    ours = [line for line in parts if line.startswith(("ventbench ", f"{PROOFS} "))]
    assert len(ours) > 30
    assert not {line: problem for line in ours if (problem := parse(line))}


def test_every_command_that_prints_results_has_them_as_json_or_the_page_says_not() -> None:
    text = (ROOT / "docs" / "commands.md").read_text("utf-8").split("<!-- commands -->")[0]
    sentence = re.split(r"\.\s", text.partition("These print only where what they made is:")[2])[0]
    named, program = set[str](), ""
    for name in re.findall(r"`([^`]+)`", sentence):
        matched = re.match(rf"(ventbench-hardware|ventbench|{PROOFS}) ", name)
        program = matched[1] if matched else program
        named.add(name if matched else f"{program} {name}")
    assert named == set(without_json())


def test_the_page_of_submissions_names_all_that_a_controller_sees() -> None:
    text = (ROOT / "submissions" / "README.md").read_text("utf-8")
    for field in (*Task._fields, *Observation._fields):
        assert f"- `{field}`:" in text


def test_a_resistance_has_one_unit() -> None:
    """R is in cmH2O/(L/s) everywhere; "cmH2O s/L" is the same and looks like another."""
    other = re.compile(r"cmH2O ?[*·]? ?s ?/ ?L\b")
    assert other.search("R in cmH2O s/L")
    pages = [*PAGES, *ROOT.glob("*/README.md"), *ROOT.glob("ventbench/cli/*.py")]
    assert not [page.name for page in pages if other.search(page.read_text("utf-8"))]


def test_wrong_commands_do_not_parse() -> None:
    """The check above can fail."""
    assert "no_such_option" in parse("ventbench score mine --no-such-option").replace("-", "_")
    assert "no command" in parse("ventbench board no-such-command")
    assert "no command" in parse("python -m proofs challenge no-such-command")
    assert not parse("ventbench score mine --draws 20")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    """Every relative link names a file of the repository."""
    for target in re.findall(r"\]\(([^)#\s]+)", page.read_text("utf-8")):
        if "://" not in target:
            assert (page.parent / target).exists(), f"{page.name} links to {target}"
