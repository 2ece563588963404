"""What is shipped: the tree, the lock, and the wheel as its users get it."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import sysconfig
import tomllib
import venv
import zipfile
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

import ventbench

ROOT = Path(__file__).resolve().parents[1]
LARGEST = 2 * 2**20  # bytes

# The brackets keep this file from matching itself.
INDEX = re.compile(r"py[p]i\.org|pythonhoste[d]\.org|npmj[s]\.|index-[u]rl|find-[l]inks|/simpl[e]/")
MACHINE_PATH = re.compile(r"(?<![\w.~$})>])/(?:work|root|(?:home|Users)/\w+)/\w")

# Too slow to import for a command that only prints its help.
HEAVY = {"flax", "jax", "matplotlib", "pandas", "pyarrow", "rerun", "scipy"}


def _git_files(*arguments: str) -> list[str]:
    if shutil.which("git") is None or not (ROOT / ".git").exists():
        pytest.skip("not a git checkout")
    listing = subprocess.run(
        ["git", "ls-files", "-z", *arguments], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return [name for name in listing.stdout.split("\0") if name]


@pytest.fixture(scope="module")
def shipped() -> list[Path]:
    """Every file that is or may be committed."""
    names = _git_files("--cached", "--others", "--exclude-standard")
    return [ROOT / name for name in names if (ROOT / name).is_file()]


@pytest.mark.parametrize("forbidden", [INDEX, MACHINE_PATH], ids=["package index", "machine path"])
def test_tree_names_no_place(shipped: list[Path], forbidden: re.Pattern[str]) -> None:
    found = []
    for path in shipped:
        try:
            lines = path.read_text().splitlines()
        except UnicodeDecodeError:
            continue
        found += [
            f"{path.relative_to(ROOT)}:{number}: {line.strip()[:120]}"
            for number, line in enumerate(lines, 1)
            if forbidden.search(line)
        ]
    assert not found


def test_patterns_find_what_they_forbid() -> None:
    assert INDEX.search("https://files.pythonhosted" + ".org/packages/x.whl")
    assert INDEX.search("--extra-index" + "-url x")
    assert MACHINE_PATH.search('path = "' + "/home" + '/somebody/x"')
    assert MACHINE_PATH.search("see " + "/work" + "/main")
    assert not MACHINE_PATH.search("https://example.org" + "/work" + "/main")


def test_no_large_file(shipped: list[Path]) -> None:
    assert not [
        f"{path.relative_to(ROOT)}: {path.stat().st_size} bytes"
        for path in shipped
        if path.stat().st_size > LARGEST
    ]


def test_one_version_everywhere() -> None:
    cited = re.search(r"^version: (.+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    assert cited is not None
    assert cited[1] == ventbench.__version__
    try:
        installed = metadata.version("ventbench")
    except metadata.PackageNotFoundError:
        return  # run from a checkout that is not installed
    assert installed == ventbench.__version__


def _locked() -> dict[str, tuple[Version, int]]:
    """Name -> version and number of hashes of every package in the lock."""
    packages: dict[str, tuple[Version, int]] = {}
    text = (ROOT / "requirements.lock").read_text().replace("\\\n", " ")
    for line in text.splitlines():
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        pin = re.match(r"([a-z0-9-]+)==([^ ;]+)", line)
        assert pin is not None, f"not a pinned package: {line[:80]}"
        assert pin[1] not in packages, f"{pin[1]}: one version for every Python and system"
        packages[pin[1]] = (Version(pin[2]), line.count("--hash=sha256:"))
    return packages


def test_lock_has_hashes() -> None:
    assert not [name for name, (_, hashes) in _locked().items() if hashes == 0]


def test_lock_fits_pyproject() -> None:
    locked = _locked()
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    wanted = [*project["build-system"]["requires"], *project["project"]["dependencies"]]
    for extra in project["project"]["optional-dependencies"].values():
        wanted += extra
    for text in wanted:
        requirement = Requirement(text)
        name = canonicalize_name(requirement.name)
        if name == "ventbench":
            continue  # an extra that names another extra
        assert name in locked, f"{name} is not in requirements.lock: run 'make lock'"
        assert locked[name][0] in requirement.specifier, f"{text}: run 'make lock'"


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys; sys.argv = ['ventbench', '--help']\n"
        "from ventbench.cli import main\n"
        "try: main()\n"
        "except SystemExit as end: assert not end.code, end.code\n"
        "print('modules:', *sorted({name.partition('.')[0] for name in sys.modules}))\n"
    )
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    usage, _, modules = run.stdout.rpartition("modules:")
    assert "score" in usage
    assert not HEAVY & set(modules.split())


#: What needs an extra: the extra, its packages as they are imported, and how it is asked for.
NEEDS_EXTRA = {
    "selftest": (
        "hardware",
        ("cobs", "serial"),
        "ventbench-hardware selftest --port p --lung R5C20",
    ),
    "device": ("hardware", ("cobs", "serial"), "-m hardware_eval.device --help"),
    "report": ("view", ("jinja2", "rerun"), "ventbench score pid_best --report --out o"),
    "build": ("view", ("jinja2",), "ventbench board build --out o --folder {root}/leaderboard"),
    "scheduler": ("dask", ("distributed",), "ventbench score pid_best --scheduler tcp://host:1"),
    "gym": ("gym", ("gymnasium",), "-c 'import ventbench.gym_env'"),
}


def _one_line_names_the_extra(run: subprocess.CompletedProcess[str], extra: str) -> None:
    line = run.stderr.splitlines()[-1]
    assert f"pip install 'ventbench[{extra}]'" in line, run.stderr
    if "InputError" not in line:  # from Python there are lines of the caller above it
        assert (run.returncode, run.stderr.count("\n")) == (2, 1)


@pytest.mark.parametrize("case", NEEDS_EXTRA)
def test_without_an_extra_one_line_names_it(case: str, tmp_path: Path) -> None:
    extra, missing, command = NEEDS_EXTRA[case]
    name, *arguments = shlex.split(command.format(root=ROOT))
    hidden = f"import runpy, sys; sys.modules.update(dict.fromkeys({missing})); sys.argv[1:] = "
    if name == "-c":
        code = f"{hidden}[]; {arguments[0]}"
    elif name == "-m":
        code = f"{hidden}{arguments[1:]}; runpy.run_module('{arguments[0]}', run_name='__main__')"
    else:
        module = {"ventbench": "ventbench.cli", "ventbench-hardware": "hardware_eval.cli"}[name]
        code = f"{hidden}{arguments}; from {module} import main; main()"
    ended = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True
    )
    _one_line_names_the_extra(ended, extra)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(folder)]
    run = subprocess.run([*command, str(ROOT)], cwd=folder, capture_output=True, text=True)
    assert run.returncode == 0, run.stdout + run.stderr
    (path,) = folder.glob("ventbench-*.whl")
    return path


@pytest.mark.slow
def test_wheel_content(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    for folder, inside in [
        ("ventbench", "ventbench"),
        ("data", "ventbench/_data"),
        ("submissions", "ventbench/_submissions"),
        ("leaderboard", "ventbench/_leaderboard"),
    ]:
        tracked = {name.replace(folder, inside, 1) for name in _git_files("--", folder)}
        assert tracked <= names, f"missing in the wheel: {sorted(tracked - names)}"
    assert any(name.startswith("ventbench/_data/") for name in names)
    assert "ventbench/_submissions/pid_best/controller.py" in names
    assert not [name for name in names if "__pycache__" in name or name.endswith((".pyc", ".rrd"))]
    assert not [name for name in names if name.startswith(("tests/", "runs/", "docs/", "proofs/"))]


@pytest.mark.slow
def test_wheel_works_outside_the_repository(
    wheel: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("PYTHONPATH", raising=False)  # it may name this checkout
    # A venv of its own, with links to this one's packages behind it: neither this checkout, which
    # a path file in those names, nor the packages of any extra can be seen.
    home = tmp_path / "venv"
    venv.create(home, with_pip=False)
    python = home / "bin" / "python"
    site = Path(
        subprocess.run(
            [python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"],
            capture_output=True,
            text=True,
            check=True,
        ).stdout.strip()
    )
    behind = tmp_path / "behind"
    behind.mkdir()
    hidden = {name.partition("_")[0] for _, names, _ in NEEDS_EXTRA.values() for name in names}
    for path in Path(sysconfig.get_path("purelib")).iterdir():
        if path.suffix != ".pth" and path.name.partition("_")[0].partition("-")[0] not in hidden:
            (behind / path.name).symlink_to(path)
    (site / "behind.pth").write_text(f"{behind}\n")
    install = ["uv", "pip", "install", "--offline", "--no-cache", "--no-deps", "--python"]
    subprocess.run([sys.executable, "-m", *install, python, wheel], check=True)

    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()

    def ventbench_command(*arguments: str | Path) -> str:
        run = subprocess.run(
            [home / "bin" / "ventbench", *arguments], cwd=elsewhere, capture_output=True, text=True
        )
        assert run.returncode == 0, run.stderr
        return run.stdout

    where = [python, "-c", "import ventbench; print(ventbench.__file__)"]
    imported = subprocess.run(where, cwd=elsewhere, capture_output=True, text=True, check=True)
    assert Path(imported.stdout.strip()).is_relative_to(site)

    assert ventbench.__version__ in ventbench_command("--version")
    assert "score" in ventbench_command("--help")
    assert "R20C50" in ventbench_command("list", "lungs")
    assert "identify_plan" in ventbench_command("board", "show")
    for extra, _, command in NEEDS_EXTRA.values():
        program, *words = shlex.split(command.format(root=ROOT))
        start = [python, program] if program.startswith("-") else [home / "bin" / program]
        ended = subprocess.run([*start, *words], cwd=elsewhere, capture_output=True, text=True)
        _one_line_names_the_extra(ended, extra)
    submission = site / "ventbench" / "_submissions" / "pid_best"
    ventbench_command("score", submission, "--json", "out.json")
    result = json.loads((elsewhere / "out.json").read_text())
    assert set(result["lungs"]) == {f"R{r}C{c}" for r in (5, 20) for c in (10, 20, 50)}


def test_every_slow_test_exists() -> None:
    lines = (ROOT / "tests" / "slow.txt").read_text("utf-8").splitlines()
    listed = [line for line in lines if line and not line.startswith("#")]
    assert len(set(listed)) == len(listed) > 10
    for line in listed:
        file, _, name = line.partition("[")[0].partition("::")
        assert f"def {name.rpartition('::')[2]}(" in (ROOT / file).read_text("utf-8"), line


#: What a walk through the bench manual replaces. Machine and real time, for which a busy computer
#: is no bench, by lungs on a virtual clock; persons with instruments; hours. The emulator on a
#: terminal and the demo have tests of their own.
AT_THE_BENCH = {
    r"^.*(ventbench-hardware (calibrate|demo|emulate)|--only).*\n": "",
    r"\./lung": "virtual:R20C10",
    r"/dev/ttyACM0": "virtual:R20C50",
    r"(ventbench-hardware (?:run mine|collect))": r"\1 --yes",
    r"--breaths 600": "--breaths 12",
    r"(ventbench-hardware run mine)": r"\1 --pips 10 --repeats 1",
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("manual", "replaced", "blocks"),
    [("README.md", {}, 5), ("hardware_eval/README.md", AT_THE_BENCH, 6)],
    ids=["readme", "bench manual"],
)
def test_a_manual_runs_from_top_to_bottom(
    manual: str, replaced: dict[str, str], blocks: int, wheel: Path, tmp_path: Path
) -> None:
    """Every block, in order, in one empty folder, from the wheel; its packages are here already."""
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path / "wheel")
    folder = tmp_path / "folder"
    folder.mkdir()
    text = (ROOT / manual).read_text("utf-8")
    ran = 0
    for language, block in re.findall(r"^```(sh|python)\n(.*?)^```", text, re.M | re.S):
        if "make " in block:  # how a contributor runs the tests, this one among them
            continue
        source = block
        for pattern, instead in {r"^pip install .*": "", **replaced}.items():
            source = re.sub(pattern, instead, source, flags=re.M)
        command = (
            [sys.executable, "-c"] if language == "python" else ["bash", "-euo", "pipefail", "-c"]
        )
        done = subprocess.run(
            [*command, source],
            cwd=folder,
            env={
                **os.environ,
                "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
                "PYTHONPATH": str(tmp_path / "wheel"),
            },
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, f"{block}\n{done.stdout[-2000:]}{done.stderr[-2000:]}"
        ran += 1
    assert ran == blocks
