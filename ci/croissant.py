"""Croissant metadata of the frozen data: `python -m ci.croissant` writes croissant.json anew.

It needs `pip install mlcroissant`, which comes without a wheel and is therefore not in the lock.

Hashes are those of the files; a test compares them with those that ventbench pins. The
responsible-AI fields say how the data came to be and what they are not for.
"""

from __future__ import annotations

import hashlib
import json
import tomllib
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
FILE = ROOT / "croissant.json"

#: What each file is; the format, as a media type, follows from the name.
FILES = {
    "data/simulators/hybrid.npz": "Weights of the simulators that are scored on, a rig a lung.",
    "data/simulators/seen.npz": "Short hashes of the training breaths.",
    "data/simulators/population.npz": "The fitted population of rigs.",
    "data/simulators/manifest.toml": "Versions, sessions, and the hashes of the recordings.",
    "data/draws-v1.npz": "The published draws of noise, lung, delay and valve.",
    "data/bounds-v2.npz": "The best attainable error and the best PID of each cell.",
    "data/examples/sound.csv": "Generated case: a recording that the simulator explains.",
    "data/examples/concealed.csv": "Generated case: a recording with concealed physics.",
    "data/examples/flow.csv": "Generated case: a recording with flow.",
}

#: Quantities of the generated cases by column; see docs/missing_physics.md.
COLUMNS = {
    "breath_id": "Number of the breath.",
    "time_step": "Time since the breath began, s.",
    "u_in": "Opening of the inspiratory valve, %.",
    "u_out": "1 where the expiratory valve is open.",
    "pressure": "Airway pressure, cmH2O.",
    "flow": "Flow into the lung, mL/s.",
    "R": "Labelled resistance, cmH2O/L/s.",
    "C": "Labelled compliance, mL/cmH2O.",
}

_MEDIA = {
    ".npz": "application/x-npz",
    ".toml": "application/toml",
    ".csv": "text/csv",
}


def metadata() -> dict[str, Any]:
    """The metadata as JSON-LD."""
    import mlcroissant as mlc  # pyright: ignore[reportMissingImports]

    simulators = tomllib.loads((ROOT / "data/simulators/manifest.toml").read_text("utf-8"))
    objects: list[Any] = [
        mlc.FileObject(
            id=name,
            name=name,
            description=about,
            content_url=name,
            content_size=f"{(ROOT / name).stat().st_size} B",
            encoding_formats=[_MEDIA[Path(name).suffix]],
            sha256=hashlib.sha256((ROOT / name).read_bytes()).hexdigest(),
        )
        for name, about in FILES.items()
    ]
    cases = [
        mlc.RecordSet(
            id=Path(name).stem,
            name=Path(name).stem,
            description=about,
            fields=[
                mlc.Field(
                    id=f"{Path(name).stem}/{column}",
                    name=column,
                    description=quantity,
                    data_types=[mlc.DataType.FLOAT],
                    source=mlc.Source(file_object=name, extract=mlc.Extract(column=column)),
                )
                for column in (ROOT / name).read_text().splitlines()[0].split(",")
                if (quantity := COLUMNS.get(column))
            ],
        )
        for name, about in FILES.items()
        if name.endswith(".csv")
    ]
    sources = ", ".join(
        f"{name} ({recording['breaths']} breaths, SHA-256 {recording['sha256']})"
        for name, recording in simulators["recordings"].items()
    )
    described = mlc.Metadata(
        name="ventbench",
        description="Frozen simulators of six test lungs, published draws, and generated cases.",
        license=["https://spdx.org/licenses/Apache-2.0"],
        creators=[mlc.Organization(name="The ventbench developers")],
        version=f"{simulators['version']}.0.0",
        cite_as="The ventbench developers: ventbench, a benchmark of ventilator control",
        distribution=objects,
        record_sets=cases,
        data_collection=f"Simulators are fitted to public recordings: {sources}. Draws and cases "
        "are generated.",
        data_collection_type=["Experiments", "Software Collection"],
        data_biases=["One kind of ventilator with one test lung; labels R and C are partly wrong."],
        data_limitations=["No patients, no spontaneous effort, no flow in the recordings fitted."],
        data_use_cases=["Comparing controllers and diagnosers in simulation; no clinical use."],
        personal_sensitive_information=["None: every lung is a test lung."],
        data_social_impact="A score is no evidence that a controller is safe for a patient.",
        data_release_maintenance_plan="Files never change; a new version has a new name.",
    )
    return described.to_json()


def main() -> None:
    """Write the file."""
    text = json.dumps(metadata(), indent=2, default=str)
    FILE.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
