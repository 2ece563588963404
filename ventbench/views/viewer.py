"""Opening a rerun file where there is a screen, saying how to where there is none."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from ventbench import extras


def has_display() -> bool:
    """Whether a window can be opened here."""
    if sys.platform.startswith("linux"):
        return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
    return True


def open_viewer(path: Path | str) -> bool:
    """Open a rerun file in the viewer, which outlives this process.

    Args:
        path: of the ``.rrd`` file.

    Returns:
        Whether a viewer was started; if not, how to open the file was printed.

    Raises:
        InputError: if the extra is missing.
        OSError: if the file is not there.
    """
    path = Path(path)
    path.open("rb").close()
    extras.require("rerun")
    if not has_display():
        print(
            f"No display here. Open the file where there is one: rerun {path}\n"
            f"or from this machine in a browser: rerun --web-viewer {path}"
        )
        return False
    subprocess.Popen(
        [sys.executable, "-m", "rerun", str(path)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    return True
