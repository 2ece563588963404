"""Lungs as co-simulation FMUs (Functional Mock-up Units): one of ours written, one of others run.

An FMU is machine code. Reading one runs it in this process, with all rights of the caller, so that
nothing reads one unasked: a path is refused, and :class:`Fmu` is the caller's word that it is
trusted (``--in-process`` on the command line). Needs the extra ``ventbench[fmu]``.

Variables, by name: inputs ``u_in``, %, and ``u_out``, 0/1; output ``pressure``, cmH2O; and where
there are such, parameters ``initial_pressure``, cmH2O, ``R``, cmH2O/(L/s), and ``C``, mL/cmH2O.
"""

from __future__ import annotations

import shutil
import tempfile
import weakref
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax import Array

from ventbench.base import files, precision
from ventbench.base.errors import InputError, require
from ventbench.plants.plant_files import load_plants, save_plants
from ventbench.task import protocol
from ventbench.task.interfaces import Plant, Signals
from ventbench.task.lungs import lung as parse_lung

#: What an FMU must have, by our names, and what it may have.
NEEDED, PARAMETERS = ("u_in", "u_out", "pressure"), ("initial_pressure", "R", "C")

#: The plant within an FMU, and the script that its binary runs.
_PLANT, _SCRIPT = "plant.json", "ventbench_lung.py"
_TEXT = """from pythonfmu3 import Fmi3Slave
from ventbench.plants.fmu import RunningLung


class Lung(Fmi3Slave):
    def __init__(self, **given):
        super().__init__(**given)
        self.lung = RunningLung(self)

    def exit_initialization_mode(self):
        self.lung.begin()

    def do_step(self, current_time, step_size):
        return self.lung.step(step_size)
"""


def export(plant: Plant, path: Path | str, *, lung: str) -> Path:
    """Write a lung as an FMU of FMI 3.0, for co-simulation with steps of any length.

    It runs where Python can import ventbench, on the systems that pythonfmu3 has a binary for
    (Linux and Windows, x86-64). Beside ``pressure``, the reading, it shows ``flow``, mL/s, and
    ``volume``, mL, where the plant has them. At rest it has ``initial_pressure``, which also stands
    behind the expiratory valve.

    Args:
        plant: of one lung, as of :meth:`ventbench.load_simulators(...).plant`.
        path: target, ``.fmu``, which is returned.
        lung: id of the lung, the name of the model.

    Raises:
        InputError: if the path has another ending or there is no such lung.
    """
    require("pythonfmu3", extra="fmu", what="FMUs")
    from pythonfmu3 import FmuBuilder

    path, name = Path(path), parse_lung(lung).id
    if path.suffix != ".fmu":
        raise InputError(f"{path}: the name of an FMU ends in .fmu")
    with tempfile.TemporaryDirectory() as made:
        script, stored = Path(made, _SCRIPT), Path(made, _PLANT)
        script.write_text(_TEXT, "utf-8")
        save_plants(stored, {name: plant})
        built = FmuBuilder.build_FMU(script, made, [stored], needsExecutionTool="true")
        content = built.read_bytes()
    files.write_atomically(path, lambda file: file.write(content))
    return path


@jax.jit
def _start(plant: Plant, pressure: Array) -> tuple[Any, Signals]:
    return plant.init(pressure)


@jax.jit
def _advance(plant: Plant, state: Any, commands: tuple[Array, ...]) -> tuple[Any, Signals]:
    return plant.step(state, *commands)


class RunningLung:
    """A lung as its FMU runs it; the script within the FMU calls nothing else.

    Args:
        slave: instance of the FMU, which gets a variable for each signal, and holds their values.
    """

    def __init__(self, slave: Any):
        from pythonfmu3 import DefaultExperiment, Float64, Fmi3Causality, Fmi3Variability

        ((name, self._plant),) = load_plants(Path(slave.resources, _PLANT)).items()
        slave.modelName, slave.description = name, f"Lung {name} of ventbench"
        slave.default_experiment = DefaultExperiment(0.0, step_size=protocol.DT)
        slave.initial_pressure, slave.time = protocol.PEEP, 0.0
        slave.u_in, slave.u_out = 0.0, 0.0
        self._slave = slave
        self.begin()
        kinds = {
            "time": (Fmi3Causality.independent, Fmi3Variability.continuous, "s"),
            "initial_pressure": (Fmi3Causality.parameter, Fmi3Variability.fixed, "cmH2O"),
            "u_in": (Fmi3Causality.input, Fmi3Variability.continuous, "inspiratory valve, %"),
            "u_out": (Fmi3Causality.input, Fmi3Variability.continuous, "expiratory valve, 1 open"),
            "pressure": (Fmi3Causality.output, Fmi3Variability.continuous, "reading, cmH2O"),
            "flow": (Fmi3Causality.output, Fmi3Variability.continuous, "into the lung, mL/s"),
            "volume": (Fmi3Causality.output, Fmi3Variability.continuous, "in the lung, mL"),
        }
        for key, (causality, variability, text) in kinds.items():
            if getattr(slave, key) is not None:
                about = {"causality": causality, "variability": variability, "description": text}
                slave.register_variable(Float64(key, **about))

    def begin(self) -> None:
        """Put the lung at rest at ``initial_pressure``."""
        with precision.float64():
            state, signals = _start(self._plant, np.float64(self._slave.initial_pressure))
        self._keep(state, signals)

    def step(self, duration: float) -> bool:
        """Hold ``u_in`` and ``u_out`` for a time, s; returns True: the step was done."""
        commands = np.float64(self._slave.u_in), np.float64(self._slave.u_out), np.float64(duration)
        with precision.float64():
            state, signals = _advance(self._plant, self._state, commands)
        self._keep(state, signals)
        return True

    def _keep(self, state: Any, signals: Signals) -> None:
        self._state, slave = state, self._slave
        slave.pressure = float(signals.reading)
        for key in ("flow", "volume"):
            value = getattr(signals, key)
            setattr(slave, key, None if value is None else float(value))


class Fmu:
    """A co-simulation FMU (FMI 2 or 3) as a simulator in plain Python, sample by sample.

    Args:
        path: path of the FMU, whose code you trust: it runs with all your rights.
        names: names of its variables by ours, where they differ, such as ``{"u_in": "valve.u"}``.

    Raises:
        InputError: if it is no such FMU, has no binary for this system, or lacks a variable.

    Attributes:
        path: path of the FMU.
        sha256: of the file.
    """

    def __init__(self, path: Path | str, names: Mapping[str, str] | None = None):
        require("fmpy", extra="fmu", what="FMUs")
        import fmpy

        self.path, self._running, self._time = Path(path), None, 0.0
        try:
            self.sha256 = files.sha256(self.path)
            self._about = fmpy.read_model_description(str(path))
        except FileNotFoundError as error:
            raise InputError(f"{path}: there is no such file") from error
        except Exception as error:  # the library raises plain ones
            what = "a zip archive" if not zipfile.is_zipfile(path) else "an FMU"
            raise InputError(f"{path} is not {what}: {error}") from error
        self._version = str(self._about.fmiVersion)
        if self._about.coSimulation is None or self._version.startswith("1"):
            raise InputError(f"{path} is no FMU for co-simulation of FMI 2 or 3; export it as one")
        known = {variable.name: variable for variable in self._about.modelVariables}
        names = {key: (names or {}).get(key, key) for key in (*NEEDED, *PARAMETERS)}
        missing = [names[key] for key in NEEDED if names[key] not in known]
        if missing:
            raise InputError(
                f"{path} has no variable {missing[0]}; it has {', '.join(known)}: name the one "
                'meant, such as Fmu(path, {"pressure": "p_aw"})'
            )
        self._variables = {key: known[name] for key, name in names.items() if name in known}

    def reset(self, initial_pressure: float, R: float, C: float) -> None:
        """Begin a breath at rest, with those of pressure, cmH2O, R and C that it takes."""
        if self._running is None:
            self._running = self._instance()
        else:
            self._running.reset()
        for key, value in zip(PARAMETERS, (initial_pressure, R, C), strict=True):
            if key in self._variables:
                self._set(key, value)
        if self._version.startswith("2"):
            self._running.setupExperiment(startTime=0.0)
        self._running.enterInitializationMode()
        self._running.exitInitializationMode()
        self._time = 0.0

    def step(self, u_in: float, u_out: float, dt: float) -> float:
        """Hold one command, %, 0/1, for ``dt``, s; returns the pressure afterwards, cmH2O."""
        self._set("u_in", u_in)
        self._set("u_out", u_out)
        assert self._running is not None
        self._running.doStep(self._time, dt)
        self._time += dt
        shown = self._variables["pressure"]
        return float(getattr(self._running, f"get{shown.type}")([shown.valueReference])[0])

    def _instance(self) -> Any:
        from fmpy import extract
        from fmpy.simulation import instantiate_fmu

        folder = extract(str(self.path), tempfile.mkdtemp())
        weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        try:
            return instantiate_fmu(folder, self._about, "CoSimulation")
        except Exception as error:  # as above
            raise InputError(f"{self.path} cannot be started: {error}") from error

    def _set(self, key: str, value: float) -> None:
        kind = self._variables[key]
        types = {"Real": float, "Float64": float, "Float32": float, "Boolean": bool}
        typed = types.get(kind.type, int)(value)
        getattr(self._running, f"set{kind.type}")([kind.valueReference], [typed])
