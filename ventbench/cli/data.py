"""``ventbench data``: check recordings, or make new ones by exploration."""

from __future__ import annotations

import tomllib
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from ventbench.base.errors import InputError
from ventbench.cli.options import (
    Clip,
    JsonFile,
    Missing,
    Pad,
    SimulatorName,
    bar,
    complete_lungs,
    emit,
    table_of,
    written_console,
)

#: Breaths that are explored side by side.
_TOGETHER = 60

app = typer.Typer(
    name="data",
    help="Check recordings, import those of others, or make new ones by exploring simulators.",
    no_args_is_help=True,
)


@app.command()
def example(
    name: Annotated[str, typer.Argument(help="A name of `ventbench list examples`.")],
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Where to write it; default: NAME.csv in this folder."),
    ] = None,
) -> None:
    """Write a made-up recording in the public schema, to try the other commands on.

    Example: `ventbench data example concealed --out recording.csv`
    """
    from ventbench.base import files

    source = files.example(name)
    target = out or Path(source.name)
    if target.exists():
        raise InputError(f"{target} exists already; move it away or give another --out")
    files.write_bytes(target, source.read_bytes())
    typer.echo(f"wrote {target}")


def examples(json: JsonFile = None) -> None:
    """List the made-up recordings that `ventbench data example` writes.

    Example: `ventbench list examples`
    """
    from ventbench.base import files

    manifest = tomllib.loads(files.example("manifest.toml").read_text("utf-8"))["recordings"]
    columns = ("example", "breaths", "label", "what it is")
    rows = [
        (Path(name).stem, str(entry["breaths"]), entry["label"], entry["about"])
        for name, entry in manifest.items()
    ]
    values = [dict(zip(columns, row, strict=True)) for row in rows]
    written_console({"examples": values}, json).print(
        table_of("Recordings to try things on", columns, rows, left=columns)
    )


@app.command()
def check(
    file: Annotated[Path, typer.Argument(help="CSV, CSV.GZ or Parquet in the public schema.")],
    clip: Clip = False,
    pad: Pad = False,
    missing: Missing = None,
    json: JsonFile = None,
) -> None:
    """Report every problem of a recording, with line, column and value.

    Also whether columns are what they are called: signs, units, valves, labels, sensors that
    saturate, and samples that are no readings: marks of missing values, isolated and held ones,
    which every command leaves out. Ends with 0 if all is well, 1 if something is suspicious, 2 if
    it cannot be used.

    Example: `ventbench data check lab.csv`
    """
    from ventbench import recordings

    with bar(f"reading {file}") as reading:
        report = recordings.check(file, clip=clip, pad=pad, missing=missing or (), progress=reading)
    console = written_console(report.to_dict(), json)
    for line in report.lines():
        console.print(line, soft_wrap=True)
    if not report.ok:
        raise typer.Exit(2)
    if report.suspicious:
        raise typer.Exit(1)


@app.command("import")
def import_(
    file: Annotated[
        Path,
        typer.Argument(
            help="Text with any separator, JSON, .xlsx, Parquet, NumPy .npy or .npz, MATLAB .mat "
            "(-v7), EDF, WFDB, MCAP, or a bag of ROS."
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="CSV, CSV.GZ or Parquet to write; a preview if not given."
        ),
    ] = None,
    columns: Annotated[
        list[str] | None,
        typer.Option(
            "--map",
            metavar="NAME=ROLE",
            help="What a column is: time, pressure, flow, flow_in, flow_out, volume, u_in, u_out, "
            "R, C, breath, group, target or unused. May be repeated; headers that are understood "
            "need none.",
        ),
    ] = None,
    layout: Annotated[
        str | None,
        typer.Option(
            help="kaggle, respiraworks, pvp, servo, mvm or session; recognised if not given."
        ),
    ] = None,
    lung: Annotated[
        str | None, typer.Option(metavar="R20C50", help="Label where no columns hold R and C.")
    ] = None,
    rate: Annotated[
        float | None, typer.Option(metavar="HZ", help="Sampling rate where no clock is fine.")
    ] = None,
    split_breaths: Annotated[
        bool,
        typer.Option(
            "--split-breaths", help="Split at inspirations, even if a column numbers the breaths."
        ),
    ] = False,
    pressure_unit: Annotated[
        str | None, typer.Option(help="cmH2O, mbar, hPa, kPa, bar, mmHg.")
    ] = None,
    flow_unit: Annotated[
        str | None, typer.Option(help="mL/s, L/s, L/min, mL/min, L/h, cfm.")
    ] = None,
    volume_unit: Annotated[str | None, typer.Option(help="mL or L.")] = None,
    time_unit: Annotated[str | None, typer.Option(help="s, ms, us, ns, min or day.")] = None,
    u_in_unit: Annotated[str | None, typer.Option(help="% or 1 (0 to 1).")] = None,
    invert: Annotated[
        list[str] | None,
        typer.Option(metavar="ROLE", help="Its sign is the opposite: flow; u_out: 0 is open."),
    ] = None,
    offset: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ROLE=VALUE", help="Added, in the file's unit: pressure=-1013.25 if absolute."
        ),
    ] = None,
    select: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=VALUE", help="Only rows with this value; may be repeated."),
    ] = None,
    missing: Missing = None,
    map_values: Annotated[
        str | None,
        typer.Option(
            metavar="WORD=NUMBER,...", help="What words in cells stand for: open=1,closed=0."
        ),
    ] = None,
    skip_bad_breaths: Annotated[
        bool, typer.Option("--skip-bad-breaths", help="Leave out bad breaths, and name them.")
    ] = False,
    separator: Annotated[str | None, typer.Option(help="Separator of the cells.")] = None,
    decimal: Annotated[str | None, typer.Option(help="Decimal mark, '.' or ','.")] = None,
    json: JsonFile = None,
) -> None:
    """Bring a recording of another laboratory into the public schema.

    Says what was understood: columns, units with the exact way back, breaths, valves. Without --out
    only that, and a preview. Nothing is resampled; commands keep their times.

    Example: `ventbench data import lab.csv --map Paw=pressure --flow-unit L/min --lung R20C50`
    """
    from ventbench import recordings
    from ventbench.recordings.foreign import import_recording

    units = {
        "pressure": pressure_unit,
        "flow": flow_unit,
        "volume": volume_unit,
        "time": time_unit,
        "u_in": u_in_unit,
    }
    with bar(f"reading {file}"):
        imported = import_recording(
            file,
            columns=_pairs(columns, "--map"),
            units={role: unit for role, unit in units.items() if unit is not None},
            layout=layout,
            lung=lung,
            rate=rate,
            split_breaths=split_breaths,
            invert=invert or (),
            offsets=_numbers(offset, "--offset"),
            select=_pairs(select, "--select"),
            missing=missing or (),
            words=_numbers(map_values.split(",") if map_values else None, "--map-values"),
            skip_bad_breaths=skip_bad_breaths,
            separator=separator,
            decimal=decimal,
        )
    emit(imported.as_dict(), json)
    say = partial(typer.echo, err=str(json) == "-")
    for name, role in imported.columns.items():
        change = imported.conversions.get(role)
        unit = f" ({change})" if change is not None else ""
        say(f"{name}: {role}{unit}")
    for note in imported.understood:
        say(note)
    for warning in imported.warnings:
        typer.echo(f"warning: {warning}", err=True)
    say(imported.preview)
    if out is None:
        say("Nothing was written; give --out recording.csv to write it.")
        return
    recordings.write(imported.breaths, out)
    lengths = imported.breaths.valid.sum(axis=1)
    pad = " (breaths of unequal length: read it with --pad)" if len(set(lengths)) > 1 else ""
    say(f"wrote {len(imported.breaths)} breaths to {out}{pad}")


def _pairs(arguments: list[str] | None, option: str) -> dict[str, str]:
    """Split ``NAME=VALUE``."""
    pairs = {}
    for text in arguments or ():
        name, equals, value = text.rpartition("=")
        if not equals or not name or not value:
            raise InputError(f"{option} {text}: NAME=VALUE is wanted, such as Paw=pressure")
        pairs[name] = value
    return pairs


def _numbers(arguments: list[str] | None, option: str) -> dict[str, float]:
    """Numbers of ``NAME=VALUE``."""
    pairs = _pairs(arguments, option)
    try:
        return {role: float(value) for role, value in pairs.items()}
    except ValueError as error:
        raise InputError(f"{option}: a number is wanted ({error})") from None


@app.command()
def explore(
    out: Annotated[Path, typer.Argument(help="CSV, CSV.GZ or Parquet file to write.")],
    lung: Annotated[
        str, typer.Option(help="Lung setting, such as R20C50.", autocompletion=complete_lungs)
    ] = "R20C50",
    simulator: SimulatorName = "frozen",
    breaths: Annotated[
        int, typer.Option(min=1, help="Number of breaths; the PIPs alternate.")
    ] = 60,
    noise: Annotated[
        float, typer.Option(min=0.0, help="Standard deviation of the sensor noise, cmH2O.")
    ] = 0.0,
    seed: Annotated[int, typer.Option(min=0, help="Seed of disturbances and noise.")] = 0,
) -> None:
    """Record breaths for training: a safe PID with the disturbances of the paper.

    The inspiratory valve closes above min(60, PIP + 15) cmH2O. Above 60 cmH2O the expiratory valve
    opens, and the exploration stops after three such breaths.

    Example: `ventbench data explore explored.csv --lung R5C20 --breaths 120 --noise 0.2`
    """
    from ventbench import recordings
    from ventbench.plants.catalog import load_simulators
    from ventbench.train import exploration

    chosen = load_simulators(simulator).plant(lung)
    ventilator = exploration.SimulatedVentilator(
        chosen, min(breaths, _TOGETHER), noise=noise, seed=seed
    )
    with bar(f"exploring {lung}") as exploring:
        recording = exploration.explore(ventilator, lung, breaths, seed=seed, progress=exploring)
    recordings.write(recording, out)
    for note in recording.notes:
        typer.echo(f"note: {note}", err=True)
    highest = float(recording.pressure[recording.valid].max())
    typer.echo(f"wrote {len(recording)} breaths of {lung} to {out}; highest {highest:.1f} cmH2O")
