"""Trajectories of a scored run: arrays over lungs, PIPs and time, and their file."""

from __future__ import annotations

import html
import zipfile
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ventbench.base import files
from ventbench.base.arrays import Floats
from ventbench.base.errors import InputError, InputTypeError
from ventbench.task import protocol, waveform
from ventbench.task.metrics.score import run_error

if TYPE_CHECKING:
    import pandas as pd

    from ventbench.plants.catalog import SimulatorLike
    from ventbench.task.interfaces import Controller, Plant


_SERIES = ("target", "pressure", "u_in", "u_out")


@dataclass(frozen=True)
class Trajectories:
    """Nominal trajectories of one submission; shapes with L lungs, P PIPs, T = 300 steps.

    Attributes:
        name: name of the submission.
        track: ``"performance"`` or ``"robustness"``.
        lungs: lung ids, length L.
        pips: cmH2O, length P.
        time: since the start of the run, s, shape ``(T,)``.
        target: target pressure, cmH2O, shape ``(L, P, T)``.
        pressure: true airway pressure, cmH2O, shape ``(L, P, T)``.
        u_in: inspiratory valve as applied, %, shape ``(L, P, T)``.
        u_out: expiratory valve, 0/1, shape ``(L, P, T)``.
    """

    name: str
    track: str
    lungs: tuple[str, ...]
    pips: tuple[float, ...]
    time: Floats
    target: Floats
    pressure: Floats
    u_in: Floats
    u_out: Floats

    def __repr__(self) -> str:
        """Name, track and size."""
        size = f"{len(self.lungs)} lungs x {len(self.pips)} PIPs x {len(self.time)} steps"
        return f"<Trajectories of {self.name}, {self.track}: {size}>"

    def to_frame(self) -> pd.DataFrame:
        """One row a step: ``lung``, ``pip``, ``time`` (s), and the four series as columns."""
        import pandas as pd

        index = pd.MultiIndex.from_product(
            [self.lungs, self.pips, self.time], names=["lung", "pip", "time"]
        )
        series = {name: getattr(self, name).ravel() for name in _SERIES}
        return pd.DataFrame(series, index=index).reset_index()

    def errors(self) -> pd.DataFrame:
        """Mean |p - target| of the scored inspirations, cmH2O; a row a lung, a column a PIP.

        NaN where a scored pressure is not finite: such a cell failed.
        """
        import pandas as pd

        breaths = (*self.pressure.shape[:2], protocol.BREATHS, protocol.BREATH_STEPS)
        pressure, target = (
            x.reshape(breaths)[..., : protocol.INSPIRATION_STEPS]
            for x in (self.pressure, self.target)
        )
        error = run_error(np.where(np.isfinite(pressure), pressure, np.nan), target)
        return pd.DataFrame(error, index=list(self.lungs), columns=list(self.pips))

    def _repr_html_(self) -> str:
        title = f"<p>{html.escape(self.name)}: mean |pressure - target| by lung and PIP, cmH2O</p>"
        return title + self.errors().to_html(float_format="%.3f")

    def save(self, path: Path) -> None:
        """Write an ``.npz`` file in one step."""
        names = [field.name for field in fields(self)]
        arrays: dict[str, Any] = {name: np.asarray(getattr(self, name)) for name in names}
        files.write_atomically(path, lambda file: np.savez_compressed(file, **arrays))


def end_to_end(
    name: str,
    track: str,
    lungs: tuple[str, ...],
    pips: tuple[float, ...],
    pressure: Floats,
    u_in: Floats,
) -> Trajectories:
    """Lay whole breaths end to end.

    Args:
        name: name of the controller.
        track: track of the run.
        lungs: ids, length L.
        pips: cmH2O, length P.
        pressure: true airway pressure, cmH2O, shape ``(L, P, BREATHS, BREATH_STEPS)``.
        u_in: commands as applied, %, shape of ``pressure``.
    """
    steps = np.arange(protocol.BREATHS * protocol.BREATH_STEPS)
    shape = (len(lungs), len(pips), steps.size)
    u_out = (steps % protocol.BREATH_STEPS >= protocol.INSPIRATION_STEPS).astype(float)
    return Trajectories(
        name=name,
        track=track,
        lungs=lungs,
        pips=pips,
        time=np.asarray(steps * protocol.DT, np.float64),
        target=np.broadcast_to(waveform.target(steps, np.asarray(pips)[:, None]), shape),
        pressure=pressure.reshape(shape),
        u_in=u_in.reshape(shape),
        u_out=np.broadcast_to(u_out, shape),
    )


def rollout(
    controller: Controller,
    *,
    simulator: SimulatorLike = "frozen",
    lungs: Sequence[str] | None = None,
    pips: Sequence[float] = protocol.PIPS,
) -> Trajectories:
    """Run a pure JAX controller through the noise-free protocol: three breaths at each PIP.

    Args:
        controller: a pytree with ``init`` and ``step``, see :class:`ventbench.Controller`; such as
            :class:`ventbench.controllers.pid.PID` or what a training returned.
        simulator: simulators with plants; see :func:`ventbench.load_simulators`.
        lungs: ids; all that the simulators have if not given.
        pips: peak inspiratory pressures, cmH2O.

    Returns:
        Time series of shape ``(L, P, 300)``, float64.

    Raises:
        InputError: if the simulators have no plants, or none for a lung.

    Examples:
        >>> import ventbench
        >>> from ventbench.controllers.pid import PID
        >>> run = ventbench.rollout(PID(1.0, 5.0), simulator="physics", lungs=["R20C50"], pips=[20])
        >>> run.pressure.shape
        (1, 1, 300)
        >>> bool(run.errors().loc["R20C50", 20] < 10.0)
        True
    """
    # Here, not above: who only reads and shows runs needs neither JAX nor a plant.
    import jax
    import jax.numpy as jnp

    from ventbench.base import compilation
    from ventbench.plants.catalog import load_simulators
    from ventbench.task import environment, rollouts

    if not (hasattr(controller, "init") and hasattr(controller, "step")):
        raise InputTypeError(
            "controller", controller, "a pytree with init and step, or use ventbench.score"
        )
    if isinstance(lungs, str):
        lungs = [lungs]
    simulators = load_simulators(simulator)
    names = [entry.id for entry in simulators.lungs] if lungs is None else list(lungs)
    cells = tuple(float(pip) for pip in pips)
    plants = [simulators.plant(name) for name in names]
    with compilation.float64():
        nominal = environment.nominal_scenario(np.asarray(cells))

        def run(plant: Plant) -> tuple[Floats, Floats]:
            plant = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), plant)
            inspired, expired = rollouts.closed_loop(plant, controller, nominal, whole=True)
            return tuple(  # type: ignore[return-value]
                np.concatenate([getattr(inspired, field), getattr(expired, field)], axis=-1)
                for field in ("pressure", "u_in")
            )

        pressure, u_in = (np.stack(series) for series in zip(*map(run, plants), strict=True))
    name = type(controller).__name__
    return end_to_end(name, "performance", tuple(names), cells, pressure, u_in)


def load(path: Path) -> Trajectories:
    """Read what :meth:`Trajectories.save` wrote.

    Raises:
        InputError: if the file is not such a file.
        OSError: if it cannot be read.
    """
    try:
        # Opened here: np.load leaves a file open that it cannot make sense of.
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as npz:
            return Trajectories(
                name=str(npz["name"]),
                track=str(npz["track"]),
                lungs=tuple(str(lung) for lung in npz["lungs"]),
                pips=tuple(float(pip) for pip in npz["pips"]),
                **{k: npz[k] for k in ("time", "target", "pressure", "u_in", "u_out")},
            )
    # What np.load raises for a text, an empty or cut-off file, and for a plain array (TypeError).
    except (KeyError, ValueError, EOFError, TypeError, zipfile.BadZipFile, zlib.error) as error:
        # numpy takes whatever it does not know for a pickle, and advises to load that unsafely.
        why = "it is no .npz archive" if "pickle" in str(error) else str(error)
        raise InputError(
            f"{path} is not a trajectory file of ventbench: {why}; score the submission again with "
            "`ventbench score SUBMISSION --out DIR`"
        ) from error
