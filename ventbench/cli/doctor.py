"""``ventbench doctor``: what this machine can do, before anything is computed on it."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import shutil
import sys
from pathlib import Path
from typing import Any

import typer

from ventbench.base.errors import InputError
from ventbench.cli.options import JsonFile, written_console

#: Packages whose version matters to a score, and those of each extra.
_CORE = ("jax", "jaxlib", "flax", "optax", "numpy", "scipy", "pandas", "pyarrow")
_EXTRAS = {
    "view": ("jinja2", "matplotlib", "rerun-sdk"),
    "hardware": ("pyserial",),
    "dask": ("distributed",),
    "gym": ("gymnasium", "safetensors"),
    "attest": ("cryptography",),
    "rounds": ("py-ecc",),
}

#: Free space that compiled functions, results and reports of a day of work may take, GiB.
_DISK_GIB = 2.0


def doctor(json: JsonFile = None) -> None:
    """Say what this machine can do: versions, sandbox, devices, recordings, ports, disk.

    Exit code 1 if scores made here would not be official or something needs attention.

    Example: `ventbench doctor`
    """
    from rich.table import Table

    report = examine()
    console, table = written_console(report, json), Table(show_header=False)
    for name, value in report["facts"].items():
        table.add_row(name, value)
    console.print(table)
    for problem in report["problems"]:
        console.print(f"- {problem}")
    if report["problems"]:
        raise typer.Exit(1)
    console.print("Nothing needs attention.")


def examine() -> dict[str, Any]:
    """Return what was seen: ``facts``, text by name, and ``problems``, a list of text."""
    problems: list[str] = []
    facts = {
        "ventbench": _version("ventbench"),
        "Python": f"{platform.python_version()} on {platform.system()} {platform.release()}",
        "packages": ", ".join(f"{name} {_version(name)}" for name in _CORE),
    }
    for extra, names in _EXTRAS.items():
        missing = [name for name in names if _version(name) == "-"]
        facts[f"extra [{extra}]"] = (
            f"lacks {', '.join(missing)}: pip install 'ventbench[{extra}]'" if missing else "here"
        )
    facts["official scores"] = _sandbox(problems)
    facts["simulators"] = _simulators(problems)
    facts["processors"] = _processors()
    facts["recordings"] = _recordings()
    facts["compiled functions"] = _cache(problems)
    facts["serial ports"] = _ports()
    free = shutil.disk_usage(Path.cwd()).free / 2**30
    facts["disk"] = f"{free:.0f} GiB free in {Path.cwd()}"
    if free < _DISK_GIB:
        problems.append(f"less than {_DISK_GIB:g} GiB of disk are free")
    return {"facts": facts, "problems": problems}


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "-"


def _sandbox(problems: list[str]) -> str:
    from ventbench.sandbox.runner import SandboxRunner

    try:
        missing = SandboxRunner().missing
    except InputError as error:
        problems.append(f"submissions cannot run in a sandbox here: {error}")
        return "no: no sandbox"
    if missing:
        problems.append(
            f"scores made here are not official: the sandbox lacks {', '.join(missing)} "
            "(see docs/security.md)"
        )
        return f"no: the sandbox lacks {', '.join(missing)}"
    return "yes: every layer of the sandbox is in force"


def _simulators(problems: list[str]) -> str:
    from ventbench.plants import frozen

    try:
        return f"SHA-256 of the manifest {frozen.load().manifest_sha256[:12]}…, as published"
    except (InputError, OSError) as error:
        problems.append(str(error))
        return "damaged"


def _processors() -> str:
    import jax

    usable = len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count()
    devices = ", ".join(sorted({device.device_kind for device in jax.devices()}))
    return f"{usable} cores; JAX runs on {devices}"


def _recordings() -> str:
    from ventbench.recordings import recordings_dir

    folder = recordings_dir()
    if folder is None:
        return "none (VENTBENCH_RECORDINGS names no folder); data/examples are always there"
    files = [path for path in folder.iterdir() if path.suffix in (".csv", ".parquet", ".gz")]
    return f"{len(files)} files in {folder}"


def _cache(problems: list[str]) -> str:
    from ventbench.base import compilation

    folder = compilation.folder()
    existing = next(path for path in (folder, *folder.parents) if path.exists())
    if not os.access(existing, os.W_OK):
        problems.append(
            f"{existing} cannot be written to: functions are compiled anew in each run; "
            "VENTBENCH_CACHE may name another folder"
        )
        return f"not kept: {existing} cannot be written to"
    return f"kept in {folder}"


def _ports() -> str:
    """Serial ports of microcontrollers and adapters, by their names on Linux and macOS."""
    patterns = ("ttyUSB*", "ttyACM*", "ttyAMA*", "cu.usb*")
    names = [str(path) for pattern in patterns for path in sorted(Path("/dev").glob(pattern))]
    return ", ".join(names) or "none"
