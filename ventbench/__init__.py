"""ventbench: the benchmark for mechanical-ventilator control.

Everything that a notebook needs is an attribute of this package and is imported at first use:

- recordings: ``load_recording``, ``import_recording``, ``example``, ``Breaths``;
- simulators: ``load_simulators``, ``simulate``, ``simulate_breaths``, ``open_loop``, the protocol
  ``Plant``;
- controllers: ``score``, ``rollout``, ``tune_pid``, the protocol ``Controller``;
- missing physics: ``diagnose``, ``Diagnosis``, ``isolability``;
- learned simulators: ``train_rigs``; the leaderboard: ``load_board``.

``help(ventbench.score)`` and so on say types, shapes and units and give an example.
"""

from __future__ import annotations

from functools import wraps
from importlib import import_module
from types import FunctionType
from typing import TYPE_CHECKING, Any

from ventbench.base import VERSION

if TYPE_CHECKING:
    from ventbench.base.errors import InputError as InputError
    from ventbench.base.files import example as example
    from ventbench.board.frames import load_board as load_board
    from ventbench.diagnosis.diagnose import diagnose as diagnose
    from ventbench.diagnosis.isolability import isolability as isolability
    from ventbench.diagnosis.result import Diagnosis as Diagnosis
    from ventbench.entries.result import Score as Score
    from ventbench.entries.scoring import score as score
    from ventbench.plants.catalog import load_simulators as load_simulators
    from ventbench.plants.simulators import Simulators as Simulators
    from ventbench.recordings import Breaths as Breaths
    from ventbench.recordings import load as load_recording  # noqa: F401
    from ventbench.recordings.foreign import import_recording as import_recording
    from ventbench.simulation import OpenLoopReport as OpenLoopReport
    from ventbench.simulation import Simulation as Simulation
    from ventbench.simulation import open_loop as open_loop
    from ventbench.simulation import simulate as simulate
    from ventbench.simulation import simulate_breaths as simulate_breaths
    from ventbench.task.interfaces import Controller as Controller
    from ventbench.task.interfaces import Observation as Observation
    from ventbench.task.interfaces import Plant as Plant
    from ventbench.task.interfaces import Task as Task
    from ventbench.task.lungs import LUNGS as LUNGS
    from ventbench.task.lungs import Lung as Lung
    from ventbench.train.pid_search import tune_pid as tune_pid
    from ventbench.train.rigs.train import train_rigs as train_rigs
    from ventbench.trajectories import Trajectories as Trajectories
    from ventbench.trajectories import rollout as rollout

__version__ = VERSION

#: Module and attribute of each name.
_SOURCES = {
    "Breaths": ("recordings", "Breaths"),
    "Controller": ("task.interfaces", "Controller"),
    "Diagnosis": ("diagnosis.result", "Diagnosis"),
    "InputError": ("base.errors", "InputError"),
    "LUNGS": ("task.lungs", "LUNGS"),
    "Lung": ("task.lungs", "Lung"),
    "Observation": ("task.interfaces", "Observation"),
    "OpenLoopReport": ("simulation", "OpenLoopReport"),
    "Plant": ("task.interfaces", "Plant"),
    "Score": ("entries.result", "Score"),
    "Simulation": ("simulation", "Simulation"),
    "Simulators": ("plants.simulators", "Simulators"),
    "Task": ("task.interfaces", "Task"),
    "Trajectories": ("trajectories", "Trajectories"),
    "diagnose": ("diagnosis.diagnose", "diagnose"),
    "example": ("base.files", "example"),
    "isolability": ("diagnosis.isolability", "isolability"),
    "import_recording": ("recordings.foreign", "import_recording"),
    "load_board": ("board.frames", "load_board"),
    "load_recording": ("recordings", "load"),
    "load_simulators": ("plants.catalog", "load_simulators"),
    "open_loop": ("simulation", "open_loop"),
    "rollout": ("trajectories", "rollout"),
    "score": ("entries.scoring", "score"),
    "simulate": ("simulation", "simulate"),
    "simulate_breaths": ("simulation", "simulate_breaths"),
    "train_rigs": ("train.rigs.train", "train_rigs"),
    "tune_pid": ("train.pid_search", "tune_pid"),
}

__all__ = sorted((*_SOURCES, "__version__"))  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name not in _SOURCES:
        raise AttributeError(f"module 'ventbench' has no attribute {name!r}")
    module, attribute = _SOURCES[name]
    value = getattr(import_module(f"ventbench.{module}"), attribute)
    if isinstance(value, FunctionType):
        value = _refusing_at_the_door(name, value)
    globals()[name] = value
    return value


def _refusing_at_the_door(name: str, function: FunctionType) -> Any:
    """Check types; keep frames of the package out of the traceback of what the message explains."""
    import inspect

    from ventbench.base.errors import InputError, check_types

    signature = inspect.signature(function)

    @wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        try:
            check_types(signature, args, kwargs)
            return function(*args, **kwargs)
        except (InputError, OSError) as error:
            raise error.with_traceback(None)  # noqa: B904

    # By these, it is found again where it is unpickled.
    call.__module__, call.__qualname__ = __name__, name
    return call


def __dir__() -> list[str]:
    return __all__
