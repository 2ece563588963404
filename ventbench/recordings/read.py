"""Reading recordings: all of a file, batch by batch, or only to check it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from ventbench.recordings.blocks import Block, join, scan
from ventbench.recordings.breaths import Breaths
from ventbench.recordings.build import FILL, stack, stack_times, valid_mask
from ventbench.recordings.errors import Problem, RecordingError
from ventbench.recordings.files import fail
from ventbench.recordings.findings import Findings
from ventbench.recordings.report import CheckReport, describe, unit_warning
from ventbench.recordings.source import Source, locate, open_source
from ventbench.recordings.tally import Tally, check_inferable, check_lengths
from ventbench.recordings.times import IntervalTable

Path = str | os.PathLike[str]


def load(path: Path, *, clip: bool = False, pad: bool = False) -> Breaths:
    """Read a recording (CSV, gzipped CSV or Parquet) into memory.

    Args:
        path: the file.
        clip: bring u_in into 0..100 % where it is outside.
        pad: allow breaths of unequal length and fill the short ones (see `Breaths`).

    Returns:
        All breaths; `notes` says what was inferred, filled in or ignored.

    Raises:
        RecordingError: the file cannot be used; it carries every kind of problem found.
    """
    source = open_source(path)
    findings = Findings(source.file)
    tally = Tally()
    blocks: list[Block] = []
    for block in scan(source, findings, clip=clip):
        tally.add(block)
        if findings.counts["problem"]:
            blocks.clear()
        else:
            blocks.append(block)
    _check_whole(source, tally, findings, pad=pad)
    findings.raise_problems(partial(locate, source), source.place)
    notes = _report(source, findings, tally).notes()
    whole = join(blocks)
    blocks.clear()
    breaths = _assemble(whole, tally.table(), source.file)
    return replace(breaths, sha256=source.sha256, notes=notes)


def check(path: Path, *, clip: bool = False, pad: bool = False) -> CheckReport:
    """Check a recording without keeping it; needs about 80 bytes a breath.

    Args:
        path: the file.
        clip: as in `load`.
        pad: as in `load`.

    Returns:
        What the file holds and what is wrong. Nothing is raised for a bad file.
    """
    tally = Tally()
    findings = Findings(str(path))
    source: Source | None = None
    try:
        source = open_source(path)
        for block in scan(source, findings, clip=clip):
            tally.add(block)
        _check_whole(source, tally, findings, pad=pad)
    except RecordingError as error:
        kind = source.kind if source else None
        warnings = source.warnings if source else ()
        return CheckReport(
            str(path),
            kind,
            problems=error.problems,
            problem_count=error.total,
            warnings=warnings,
            warning_count=len(warnings),
        )
    return _report(source, findings, tally)


def iter_breaths(
    path: Path, *, batch: int = 1024, clip: bool = False, pad: bool = False
) -> Iterator[Breaths]:
    """Read a recording of any size, some breaths at a time.

    Memory is that of a batch and about 100 bytes for each breath read so far. If a breath has no
    times, the file is read once more to estimate its interval from all breaths, as `load` does.

    Args:
        path: the file.
        batch: breaths in each result; the last may have fewer.
        clip: as in `load`.
        pad: as in `load`, but only up to the longest breath of each batch.

    Yields:
        Breaths in file order, without `sha256`.

    Raises:
        ValueError: batch is below 1.
        RecordingError: the batch that comes next cannot be used; those before were sound.
    """
    if batch < 1:
        raise ValueError(f"batch is {batch}, but at least 1 is needed")
    source = open_source(path)
    findings = Findings(source.file)
    table: IntervalTable | None = None
    expected = 0
    for block in scan(source, findings, clip=clip, batch=batch):
        tally = Tally()
        tally.add(block)
        check_lengths(tally, findings, pad=pad, expected=expected)
        expected = expected or int(np.bincount(block.lengths).argmax())
        if block.times.blank.any() and table is None:
            table = _table_of(path, clip=clip)
        if table is not None and table.overall is None:
            check_inferable(tally, findings)
        findings.raise_problems(partial(locate, source), source.place)
        yield _assemble(block, table or tally.table(), source.file)
    if expected == 0:
        raise _no_rows(source)


def _table_of(path: Path, *, clip: bool) -> IntervalTable:
    tally = Tally()
    for block in scan(open_source(path), Findings(str(path)), clip=clip):
        tally.add(block)
    return tally.table()


def _check_whole(source: Source, tally: Tally, findings: Findings, *, pad: bool) -> None:
    if len(tally) == 0:
        raise _no_rows(source)
    check_lengths(tally, findings, pad=pad)
    check_inferable(tally, findings)


def _no_rows(source: Source) -> RecordingError:
    return fail(source.file, "the file has a header but no rows", "Write at least one breath.")


def _report(source: Source, findings: Findings, tally: Tally) -> CheckReport:
    find = partial(locate, source)
    whole: tuple[Problem, ...] = source.warnings + unit_warning(source.file, tally)
    warnings = whole + findings.listed("warning", find, source.place)
    return CheckReport(
        source.file,
        source.kind,
        source.sha256,
        findings.listed("problem", find, source.place),
        findings.counts["problem"],
        warnings,
        len(whole) + findings.counts["warning"],
        **describe(tally),
    )


def _assemble(block: Block, table: IntervalTable, file: str) -> Breaths:
    """Make breaths of a sound block, with times for those that have none."""
    time = block.times.time
    blank = np.flatnonzero(block.times.blank)
    if len(blank):
        time = time.copy()
        starts = np.cumsum(block.lengths) - block.lengths
        for i in blank:
            length = int(block.lengths[i])
            dt = table.estimate(int(block.n_inspiratory[i]), length)
            assert dt is not None  # check_inferable
            time[starts[i] : starts[i] + length] = dt * np.arange(length)
    times, dts = stack_times(time, block.lengths)
    samples = {
        name: stack(values, block.lengths, FILL[name]) for name, values in block.samples.items()
    }
    return Breaths(
        breath_id=block.breath_id,
        R=block.R,
        C=block.C,
        time=times,
        dt=dts,
        valid=valid_mask(block.lengths),
        time_inferred=block.times.blank,
        source=file,
        u_in=samples["u_in"],
        u_out=samples["u_out"],
        pressure=samples["pressure"],
        flow=samples.get("flow"),
        volume=samples.get("volume"),
    )
