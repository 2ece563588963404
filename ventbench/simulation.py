"""What simulators answer to valve commands: of a file, and of recorded breaths.

The second is the open-loop test of ``ventbench data open-loop``: how far the answers stray from the
recorded pressures.
"""

from __future__ import annotations

import html
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ventbench.base import files
from ventbench.base.arrays import Bools, Floats, Ints
from ventbench.base.errors import InputError, InputTypeError
from ventbench.base.text import number
from ventbench.plants import frozen
from ventbench.plants.catalog import SimulatorLike, load_simulators, names
from ventbench.plants.simulators import FrozenSimulators
from ventbench.plants.stacking import PlantsFor, open_loop_breaths
from ventbench.recordings import Breaths, load
from ventbench.task import protocol
from ventbench.task.lungs import lung as parse_lung
from ventbench.task.metrics import bootstrap
from ventbench.task.metrics.open_loop import mae

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class Controls:
    """One sequence of commands; arrays of shape ``(T,)``.

    Attributes:
        time: s.
        u_in: inspiratory valve, %.
        u_out: expiratory valve, 0/1.
    """

    time: Floats
    u_in: Floats
    u_out: Floats

    @property
    def dt(self) -> Floats:
        """Time from each sample to the next, s, shape ``(T,)``; the last one is repeated."""
        steps = np.diff(self.time)
        return np.append(steps, steps[-1] if steps.size else protocol.DT)


@dataclass(frozen=True)
class Simulation:
    """Response of a simulator to one sequence of commands; arrays of shape ``(T,)``.

    Attributes:
        lung: id, such as ``"R20C50"``.
        simulators: name of the simulators.
        time: s.
        u_in: inspiratory valve, %.
        u_out: expiratory valve, 0/1.
        pressure: airway pressure, cmH2O.
    """

    lung: str
    simulators: str
    time: Floats
    u_in: Floats
    u_out: Floats
    pressure: Floats

    def __repr__(self) -> str:
        """Lung, simulators and size."""
        return f"<Simulation of {self.lung} by {self.simulators}: {len(self.time)} samples>"

    def to_frame(self) -> pd.DataFrame:
        """One row a sample: ``time_step`` (s), ``u_in`` (%), ``u_out``, ``pressure`` (cmH2O)."""
        import pandas as pd

        names = ("time_step", "u_in", "u_out", "pressure")
        values = (self.time, self.u_in, self.u_out.astype(int), self.pressure)
        return pd.DataFrame(dict(zip(names, values, strict=True)))

    def to_csv(self) -> str:
        """Text of a CSV file with the columns of :meth:`to_frame`."""
        return self.to_frame().to_csv(index=False, float_format="%.6f", lineterminator="\n")

    def _repr_html_(self) -> str:
        """A line of text and the table, as a notebook shows it."""
        title = (
            f"<p>Lung {self.lung} by the {self.simulators} simulators: {len(self.time)} samples, "
            f"highest pressure {self.pressure.max():.1f} cmH2O</p>"
        )
        return title + self.to_frame().to_html(max_rows=10, index=False, float_format="%.3f")


def simulate(
    controls: Controls | Path | str | ArrayLike,
    *,
    lung: str = "R20C50",
    simulator: SimulatorLike = "frozen",
    start: float = protocol.PEEP,
) -> Simulation:
    """Answer valve commands with pressures.

    Args:
        controls: T commands; or a CSV file of them, see :func:`read_controls`; or ``u_in`` alone,
            %, shape ``(T,)``, at steps of 30 ms with the expiratory valve closed.
        lung: id of the lung.
        simulator: a name, a file, plants by lung or a function of commands; see
            :func:`ventbench.load_simulators`.
        start: pressure at the first sample, cmH2O; the lung is at rest there.

    Returns:
        The commands and the pressures, shapes ``(T,)``.

    Raises:
        InputError: if a command is wrong, or there is no simulator for the lung.

    Examples:
        >>> import numpy as np
        >>> import ventbench
        >>> u_in = np.full(30, 10.0)  # the inspiratory valve held at 10 % for 0.9 s
        >>> answer = ventbench.simulate(u_in, lung="R20C50", simulator="physics")
        >>> answer.pressure.shape
        (30,)
        >>> bool(answer.pressure[-1] > answer.pressure[1] > 5.0)
        True
    """
    if isinstance(controls, str | Path):
        (controls,) = read_controls(controls)
    elif not isinstance(controls, Controls):
        controls = _controls(controls)
    simulators = load_simulators(simulator)
    commands = (controls.u_in, controls.u_out, controls.dt)
    pressure = simulators.respond(lung, *commands, initial_pressure=start)
    return Simulation(lung, simulators.name, controls.time, controls.u_in, controls.u_out, pressure)


def simulate_breaths(
    table: Path | str | pd.DataFrame,
    *,
    lung: str | None = None,
    simulator: SimulatorLike = "frozen",
    start: float = protocol.PEEP,
) -> Breaths:
    """Answer the commands of many breaths with pressures.

    Args:
        table: a table, or its CSV file, with a row a sample: ``breath_id`` and ``u_in``, %;
            optionally ``u_out`` (0 if missing), ``time_step``, s (steps of 30 ms if missing), and
            ``R``, cmH2O/(L/s), and ``C``, mL/cmH2O. Breaths may differ in length. Other columns,
            such as a pressure, are not used.
        lung: id of the lung of all breaths; needed where there is no ``R`` or ``C``.
        simulator: see :func:`ventbench.load_simulators`.
        start: pressure at the first sample of each breath, cmH2O; the lung is at rest there.

    Returns:
        The breaths with the simulated pressures, which ``to_frame`` and
        :func:`ventbench.recordings.write` give in the public schema.

    Raises:
        InputError: if a column is missing, a command is wrong, or there is no simulator of a lung.

    Examples:
        >>> import pandas as pd
        >>> import ventbench
        >>> table = pd.DataFrame({"breath_id": [1, 1, 1, 2, 2, 2], "u_in": [10.0] * 6})
        >>> answer = ventbench.simulate_breaths(table, lung="R5C20", simulator="physics")
        >>> answer.pressure.shape
        (2, 3)
    """
    import pandas as pd

    if not isinstance(table, pd.DataFrame):
        table = _read_csv(table)
    lacking = [name for name in ("breath_id", "u_in") if name not in table]
    if lacking:
        raise InputError(f"the table has no column {lacking[0]}; it has {', '.join(table)}")
    if lung is None and not {"R", "C"} <= {*table}:
        raise InputError("the table has no columns R and C: name the lung of all its breaths")
    sample = table.groupby("breath_id").cumcount()
    complete = table.assign(id=range(1, len(table) + 1), pressure=float(start))
    if lung is not None:
        label = parse_lung(lung)
        complete = complete.assign(R=label.R, C=label.C)
    for name, values in (("u_out", 0), ("time_step", protocol.DT * sample)):
        complete = complete if name in complete else complete.assign(**{name: values})
    needed = ["id", "breath_id", "R", "C", "time_step", "u_in", "u_out", "pressure"]
    breaths = load(pd.DataFrame(complete[needed]), pad=True)
    return replace(breaths, pressure=load_simulators(simulator).pressures(breaths))


def _controls(u_in: ArrayLike) -> Controls:
    try:
        values = np.asarray(u_in, float)
    except (TypeError, ValueError):
        expected = "u_in, %, one number a sample, a CSV file, or ventbench.simulation.Controls"
        raise InputTypeError("controls", u_in, expected) from None
    if values.ndim != 1 or not values.size:
        raise InputError(f"u_in has shape {values.shape}; give one command a sample, shape (T,)")
    wrong = ~((values >= 0) & (values <= protocol.U_MAX))
    if np.any(wrong):
        raise InputError(f"u_in[{wrong.argmax()}] = {values[wrong.argmax()]:g} is outside 0..100 %")
    return Controls(_steps(values.size), values, np.zeros_like(values))


def read_controls(path: Path | str, *, by_breath: bool = False) -> list[Controls]:
    """Read a CSV file of commands: one sequence, or one for each breath.

    Args:
        path: header line and one row a sample; column ``u_in``, optionally ``u_out`` (0 if missing)
            and ``time_step`` in s (steps of 30 ms if missing); others are ignored, so that a
            recording of one breath is such a file too.
        by_breath: whether another ``breath_id`` begins another sequence; its times may start anew.

    Raises:
        InputError: if a column is missing or a value is wrong; it says which.
        OSError: if the file cannot be read.
    """
    import pandas as pd

    texts = _read_csv(path, dtype=str, keep_default_na=False)
    if texts.empty or "u_in" not in texts:
        raise InputError(f"{path} needs a header line with a column u_in, and at least one row")

    def check(column: str, bad: Bools, why: str) -> None:
        if np.any(bad):
            row = int(np.argmax(bad))
            cell = texts[column].iloc[row]
            raise InputError(f"{path} line {row + 2}, column {column}: {cell!r} {why} Fix the row.")

    def numbers(column: str) -> Floats:
        values = np.array(pd.to_numeric(texts[column], errors="coerce"), float)
        check(column, ~np.isfinite(values), "is not a number.")
        return values

    u_in = numbers("u_in")
    u_out = numbers("u_out") if "u_out" in texts else np.zeros(len(texts))
    time = numbers("time_step") if "time_step" in texts else _steps(len(texts))
    check("u_in", (u_in < 0) | (u_in > protocol.U_MAX), "is outside 0..100 %.")
    check("u_out", (u_out != 0) & (u_out != 1), "is neither 0 nor 1.")
    breath = texts["breath_id"].to_numpy() if by_breath and "breath_id" in texts else u_in * 0.0
    starts = np.flatnonzero(breath[1:] != breath[:-1]) + 1
    back = np.append(False, np.diff(time) <= 0)
    back[starts] = False
    check("time_step", back, "s is not later than the row before, in one breath.")
    parts = zip(*(np.split(column, starts) for column in (time, u_in, u_out)), strict=True)
    return [Controls(*part) for part in parts]


def _read_csv(path: Path | str, **options: Any) -> pd.DataFrame:
    import pandas as pd

    try:
        return pd.read_csv(path, encoding="utf-8-sig", **options)
    except ValueError as error:  # those of the parser and of UTF-8 too
        raise InputError(f"{path} is not a CSV file in UTF-8: {error}") from error


def _steps(count: int) -> Floats:
    return np.arange(count, dtype=np.float64) * protocol.DT


@dataclass(frozen=True)
class OpenLoopReport:
    """Open-loop errors of simulators on a recording, cmH2O.

    Attributes:
        plant: name of the simulators.
        simulators: version and hashes of the official ones.
        about: what is known of simulators from a file, a function or the caller; else None.
        lungs: figures by lung id, those of :func:`error_summary`: without prefix of the simulators
            that make the scores, over all breaths; ``held_out_...`` of each breath by a member of
            the ensemble that has not seen it; ``official_held_out_...`` of the simulators that make
            the scores, on what they have not seen.
        not_judged: ids of breaths without a first or another inspiratory pressure.
        perhaps_copies: ids of breaths with the commands of one of the training, of which blank
            pressures do not tell whether they are copies: they count as such.
        notes: what a reader of the recording should know.
    """

    plant: str
    simulators: dict[str, Any]
    about: dict[str, Any] | None
    lungs: dict[str, dict[str, Any]]
    not_judged: tuple[int, ...]
    perhaps_copies: tuple[int, ...]
    notes: tuple[str, ...]

    def __repr__(self) -> str:
        """Simulators and number of breaths."""
        breaths = sum(figures["breaths"] for figures in self.lungs.values())
        return f"<OpenLoopReport of {self.plant}: {breaths} breaths, {len(self.lungs)} lungs>"

    def as_dict(self) -> dict[str, Any]:
        """JSON values of ``ventbench data open-loop --json``."""
        return {
            "plant": self.plant,
            "simulators": self.simulators,
            **({} if self.about is None else {"about": self.about}),
            "unit": "cmH2O",
            "lungs": self.lungs,
            "not_judged": list(self.not_judged),
            "perhaps_copies": list(self.perhaps_copies),
            "notes": list(self.notes),
        }

    def to_frame(self) -> pd.DataFrame:
        """One row a lung: the figures of :attr:`lungs`."""
        import pandas as pd

        return pd.DataFrame.from_dict(self.lungs, orient="index").rename_axis("lung")

    def remarks(self) -> list[str]:
        """Sentences about breaths that were not judged or are perhaps copies."""
        lines = []
        if self.not_judged:
            lines.append(
                f"{len(self.not_judged)} breaths have no first pressure or no other inspiratory "
                "one and were not judged."
            )
        if self.perhaps_copies:
            count = len(self.perhaps_copies)
            lines.append(
                f"{count} {'breath is' if count == 1 else 'breaths are'} perhaps a copy of one in "
                "the training: the commands are the same, and blank pressures do not tell. Their "
                "errors are not those of new breaths."
            )
        return lines

    def __str__(self) -> str:
        """Return mean errors by lung, and the sentences of :meth:`remarks`."""
        title = f"Open-loop MAE of the {self.plant} simulators, cmH2O"
        rows = [
            f"  {name}: {number(figures['mae'])}, held out {number(figures['held_out_mae'])} "
            f"({figures['breaths']} breaths)"
            for name, figures in self.lungs.items()
        ]
        return "\n".join([title, *rows, *self.remarks()])

    def _repr_html_(self) -> str:
        frame = self.to_frame()[["breaths", "mae", "median_mae", "held_out_mae"]]
        title = f"<p>Open-loop MAE of the {html.escape(self.plant)} simulators, cmH2O</p>"
        below = "".join(f"<p>{html.escape(line)}</p>" for line in self.remarks())
        return title + frame.to_html(float_format="%.2f") + below


def open_loop(
    breaths: Breaths | Path | str | pd.DataFrame,
    simulator: SimulatorLike = "frozen",
    *,
    progress: Callable[[int, int], object] = lambda finished, total: None,
) -> OpenLoopReport:
    """Measure how far simulators stray from recorded breaths under the recorded commands.

    The error of a breath is the mean |simulated - recorded| pressure over its inspiratory samples,
    from its first recorded pressure, cmH2O.

    Args:
        breaths: n recorded breaths, or what :func:`ventbench.load_recording` takes.
        simulator: a name, a file, a plant, plants by lung, a function of commands or an array of
            simulated pressures ``(n, T)``; see :func:`ventbench.load_simulators`.
        progress: called with how many simulations of a breath are done and how many there are,
            two of each breath for simulators that were trained.

    Returns:
        Errors by lung.

    Raises:
        InputError: if there is no simulator for a lung of the recording.

    Examples:
        >>> import ventbench
        >>> report = ventbench.open_loop(ventbench.example("sound"), "physics")
        >>> bool(report.to_frame().loc["R5C20", "mae"] < 1.0)
        True
    """
    breaths = load(breaths)
    tested = load_simulators(simulator, breaths=breaths)
    trained = tested.trained if isinstance(tested, FrozenSimulators) else None
    finished, total = 0, len(breaths) * (1 if trained is None else 2)

    def count(simulated: int) -> None:
        nonlocal finished
        finished += simulated
        progress(finished, total)

    crossed = error = mean_errors(tested.pressures(breaths, progress=count), breaths)
    held_out = unseen = np.ones(len(breaths), bool)
    perhaps: list[int] = []
    if trained is not None:
        crossed = mean_errors(open_loop_breaths(trained.cross_fitted, breaths, count), breaths)
        held_out, unseen = trained.held_out(breaths), trained.unseen(breaths)
        perhaps = breaths.breath_id[trained.perhaps_copies(breaths)].tolist()

    def figures(index: Ints) -> dict[str, Any]:
        return {
            **error_summary("", error[index]),
            **error_summary("held_out_", crossed[index][held_out[index]]),
            **error_summary("official_held_out_", error[index][unseen[index]]),
        }

    return OpenLoopReport(
        plant=simulator if isinstance(simulator, str) and simulator in names() else tested.name,
        simulators=frozen.load().about(),
        about=None if tested.name in names() else dict(tested.about),
        lungs={lung: figures(index) for lung, index in breaths.by_lung_index.items()},
        not_judged=tuple(breaths.breath_id[np.isnan(error)].tolist()),
        perhaps_copies=tuple(perhaps),
        notes=breaths.notes,
    )


def open_loop_errors(plants_for: PlantsFor, breaths: Breaths) -> Floats:
    """Open-loop MAE of each breath by some plants; see :func:`mean_errors`."""
    return mean_errors(open_loop_breaths(plants_for, breaths), breaths)


def mean_errors(simulated: Floats, breaths: Breaths) -> Floats:
    """Mean |simulated - recorded| of each breath over its inspiratory samples, cmH2O, ``(n,)``.

    NaN where a breath has no first pressure or no other inspiratory one.

    Args:
        simulated: open-loop answers, cmH2O, shape ``(n, T)``.
        breaths: n recorded breaths.
    """
    blank = np.isnan(breaths.pressure[:, 0])
    error = mae(breaths.pressure, np.nan_to_num(simulated), breaths.inspiratory)
    return np.where(blank, np.nan, error)


def error_summary(prefix: str, error: Floats) -> dict[str, Any]:
    """Figures of some breaths.

    Args:
        prefix: prefix of the keys, such as ``"held_out_"``.
        error: errors of each breath, cmH2O, shape ``(n,)``; NaN for one that could not be judged.

    Returns:
        JSON values: ``mae``, ``median_mae``, ``ci95`` (bootstrap interval of the mean) and
        ``breaths``, with the prefix; null where there is no breath.
    """
    estimate = bootstrap.summary(error)
    return files.json_values(
        {
            f"{prefix}mae": estimate.mean,
            f"{prefix}median_mae": estimate.median,
            f"{prefix}ci95": estimate.ci95,
            f"{prefix}breaths": estimate.count,
        }
    )
