"""A diagnosis and what can be made of it: text, JSON, a table, files."""

from __future__ import annotations

import html
from dataclasses import asdict, dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ventbench.base import VERSION, errors, files
from ventbench.base.compilation import float64
from ventbench.diagnosis import report_text
from ventbench.diagnosis.findings import (
    ErrorRegion,
    Findings,
    MissingMechanism,
    NonparametricTerm,
)
from ventbench.physics import mechanism
from ventbench.physics.model import Physics
from ventbench.plants.corrected import Corrected
from ventbench.plants.plant_files import save_plants
from ventbench.system_id.data import Floats
from ventbench.task.interfaces import Plant

if TYPE_CHECKING:
    import pandas as pd

#: Version of the layout of ``diagnosis.json``; keys are only ever added.
FORMAT = "ventbench-diagnosis-1"

#: File of the commands to record next.
RECORD_NEXT = "record_next.csv"

#: Columns of :meth:`Diagnosis.to_frame`.
_COLUMNS = (
    "mechanism",
    "parameter",
    "value",
    "unit",
    "ci95_low",
    "ci95_high",
    "simulator_value",
    "confidence",
    "nats",
    "alternatives",
)


@dataclass(frozen=True, eq=False)
class Diagnosis(Findings):
    """What a simulator lacks, by a recording; see :class:`~.findings.Findings` for the fields.

    ``print`` shows it in sentences, a notebook as sentences and a table.
    """

    @property
    def corrected_pressures(self) -> Floats:
        """Pressures of the corrected simulator for the recorded commands, cmH2O, ``(n, T)``.

        Rows are the breaths of ``traces.breaths``: those of the recording that could be used.
        """
        return self.traces.after

    def plants_at(self, position: float) -> dict[str, Plant]:
        """The corrected simulators as the rig was at one moment of the recording, by label.

        :attr:`plants` are those at its end, which ``corrected.json`` holds. Both are the same where
        nothing changes in the course of the recording.

        Args:
            position: 0 for the first breath, 1 for the last.
        """
        with float64():
            return {
                lung: at_position(plant, float(position)) for lung, plant in self.plants.items()
            }

    def to_frame(self) -> pd.DataFrame:
        """The missing mechanisms as a table, one row a parameter.

        Columns: mechanism, parameter, value, unit, ci95_low, ci95_high, simulator_value (NaN unless
        the simulator has the mechanism too), confidence (0..1), nats (held-out log-likelihood that
        is lost without the mechanism) and alternatives (names separated by commas).
        """
        import pandas as pd

        rows = [
            (
                missing.name,
                name,
                estimate.value,
                estimate.unit,
                *estimate.ci95,
                missing.simulator_values.get(name, float("nan")),
                missing.confidence,
                missing.nats,
                ", ".join(missing.alternatives),
            )
            for missing in self.mechanisms
            for name, estimate in missing.parameters.items()
        ]
        return pd.DataFrame(rows, columns=list(_COLUMNS))

    def save(self, folder: Path | str) -> list[Path]:
        """Write the diagnosis as JSON, a page and a rerun file, and what follows from it.

        ``diagnosis.json``, ``report.html`` and ``diagnosis.rrd``. ``corrected.json`` holds the
        corrected plants, which every ``--simulator`` takes; it is left out if the simulator has no
        plants. ``record_next.csv`` holds the commands of the breaths to record next, for an
        operator or ``ventbench simulate``; it is left out if nothing is open.

        Args:
            folder: folder to write to; created if missing.

        Returns:
            The paths of the files.

        Raises:
            InputError: if the extra ``ventbench[view]`` is missing.
            OSError: if a file cannot be written.
        """
        errors.require("jinja2", "rerun")
        # Pictures lie above the diagnosis; they are imported only when they are asked for.
        views = "ventbench.pages.diagnosis"
        report, log = (import_module(f"{views}.{name}") for name in ("report", "rerun_log"))
        folder = Path(folder)
        plain, corrected = folder / "diagnosis.json", folder / "corrected.json"
        files.write_json(plain, self.as_dict())
        written = [
            plain,
            report.write(folder / "report.html", self),
            log.write(folder / "diagnosis.rrd", self),
        ]
        commands = folder / RECORD_NEXT
        if self.request is None:
            commands.unlink(missing_ok=True)  # that of an earlier diagnosis
        else:
            files.write_text(commands, self.request.to_csv())
            written.append(commands)
        if not self.plants:
            corrected.unlink(missing_ok=True)
            return written
        breaths = self.traces.breaths
        metadata = {
            "corrected": self.simulator,
            "mechanisms": [missing.name for missing in self.mechanisms],
            "recording": breaths.source,
            "recording_sha256": breaths.sha256,
            "held_out_breaths": list(self.open_loop.held_out_breaths),
            "chosen": dict(self.chosen),
            "ventbench": VERSION,
        }
        save_plants(corrected, self.plants, metadata)
        return [*written, corrected]

    def __repr__(self) -> str:
        """The verdict in one sentence."""
        return f"<Diagnosis of {self.simulator}: {report_text.sentences(self)[0]}>"

    def __str__(self) -> str:
        """The diagnosis in sentences, the most important first."""
        return "\n".join(report_text.sentences(self))

    def _repr_html_(self) -> str:
        """Sentences and table for a notebook."""
        first, *rest = (html.escape(text) for text in report_text.sentences(self))
        table = ""
        if self.mechanisms:
            table = self.to_frame().to_html(index=False, float_format="%.4g", na_rep="")
        return f"<p><b>{first}</b></p>{table}" + "".join(f"<p>{text}</p>" for text in rest)

    def as_dict(self) -> dict[str, Any]:
        """JSON values of ``diagnosis.json``; numbers that are not finite become None.

        R is in cmH2O/(L/s), C in mL/cmH2O, errors in cmH2O. ``lung`` is the first of ``lungs``.
        """
        lungs = [asdict(match) for match in self.lungs]
        comparison = {"unit": "cmH2O", "unexplained": self.open_loop.unexplained}
        plain = {
            "verdict": self.verdict,
            "mechanisms": [_mechanism(missing) for missing in self.mechanisms],
            "slot": _nonparametric(self.nonparametric),
            "form": _nonparametric(self.form),
            "location": [_region(region) for region in self.location],
            "remaining": [_region(region) for region in self.remaining],
            "open_loop": asdict(self.open_loop) | comparison,
            "lung": lungs[0] if lungs else None,
            "lungs": lungs,
            "request": None if self.request is None else asdict(self.request),
            "noise": {"sd": self.noise[0], "correlation": self.noise[1], "unit": "cmH2O"},
            "plant": self.simulator,
            "split": self.split,
            "chosen": self.chosen,
            "changes": [asdict(change) for change in self.changes],
            "saturated": None
            if self.saturated is None
            else {"reading": self.saturated[0], "share": self.saturated[1]},
            "left_out": self.left_out,
            "gain_scatter": self.gain_scatter,
            "posterior": [{"terms": t, "probability": p} for t, p in self.posterior],
            "detection_limits": {
                name: {"strength": limit, "unit": mechanism(name).description.strength.unit}
                for name, limit in self.detection_limits.items()
            },
            "sentences": report_text.sentences(self),
            "would_change": report_text.would_change(self),
            "notes": self.notes,
            "seconds": self.seconds,
            "settings": asdict(self.settings),
            "format": FORMAT,
            "ventbench": VERSION,
        }
        return files.json_values(plain)


def at_position(plant: Any, position: float) -> Any:
    """A plant at a position of the recording; the same one if nothing changes in it."""
    if isinstance(plant, Corrected):
        return replace(plant, with_mechanisms=at_position(plant.with_mechanisms, position))
    changes = isinstance(plant, Physics) and "position" in plant.names
    return plant.having(position=position) if changes else plant


def _mechanism(missing: MissingMechanism) -> dict[str, Any]:
    plain = asdict(missing)
    return plain | {
        "probability": missing.confidence,
        "simulator_has": plain.pop("simulator_values"),
        "first_breath": plain.pop("breaths"),
        "affected_breaths": plain.pop("affected"),
    }


def _nonparametric(term: NonparametricTerm | None) -> dict[str, Any] | None:
    if term is None:
        return None
    plain = asdict(term)
    shape = {key: plain.pop(key) for key in ("x", "x_unit", "y", "y_unit")}
    return plain | {"of": plain.pop("form_of"), "places": dict(term.places), "shape": shape}


def _region(region: ErrorRegion) -> dict[str, Any]:
    plain = asdict(region)
    return plain | {"range": [plain.pop("low"), plain.pop("high")]}
