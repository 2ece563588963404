"""Notebooks of ``examples/`` with their outputs: executed as a reader does, and stored.

A test executes them again and compares what is shown. Usage:

    python -m ci.notebooks [NAME...]
"""

from __future__ import annotations

import copy
import re
import sys
import tempfile
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "examples").glob("*.ipynb"))


def executed(notebook: Path, folder: Path) -> Any:
    """A notebook as it is once every cell has run in a folder, without paths of this machine."""
    import nbformat
    from nbclient import NotebookClient

    for name in ("data", "submissions"):
        (folder / name).symlink_to(ROOT / name)
    content = copy.deepcopy(nbformat.read(notebook, as_version=4))
    resources = {"metadata": {"path": str(folder)}}
    NotebookClient(content, timeout=None, record_timing=False, resources=resources).execute()
    content.metadata.language_info = {"name": "python"}
    for cell in content.cells:
        if "outputs" in cell:  # progress and warnings of the machine are none
            cell.outputs = [x for x in cell.outputs if x.get("name") != "stderr"]
    text = nbformat.writes(content)
    return nbformat.reads(text.replace(f"{ROOT}/", ""), as_version=4)


def shown(notebook: Any) -> list[str]:
    """What a reader sees below the cells, without what machines may vary.

    These are numbers, pictures, and why a score of this machine is not official.
    """
    texts = []
    for cell in notebook.cells:
        for output in cell.get("outputs", ()):
            data = output.get("data", {})
            parts = [output.get("text", ""), data.get("text/plain", ""), *sorted(data)]
            texts.append(
                re.sub(
                    r"\(not official[^)]*\)|[-+]?\d[\d.,]*(?:e[-+]?\d+)?|\s+", " ", "\n".join(parts)
                )
            )
    return texts


def main() -> None:
    """Execute every notebook and store its outputs."""
    import nbformat

    for notebook in NOTEBOOKS:
        if sys.argv[1:] and notebook.stem not in sys.argv[1:]:
            continue
        with tempfile.TemporaryDirectory() as folder:
            nbformat.write(executed(notebook, Path(folder)), notebook)
        print(f"{notebook.relative_to(ROOT)}: {notebook.stat().st_size} bytes")


if __name__ == "__main__":
    main()
