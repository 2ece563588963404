"""What a browser and the rerun viewer make of the files."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ventbench.pages import write_report, write_rerun
from ventbench.trajectories import Trajectories

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
QUIET = [
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--hide-scrollbars",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--allow-file-access-from-files",
    "--enable-logging=stderr",
]


@pytest.fixture(scope="module")
def browser() -> str:
    found = next(filter(None, map(shutil.which, BROWSERS)), None)
    if found is None:
        pytest.skip(f"no browser: none of {', '.join(BROWSERS)} is installed")
    pytest.importorskip("jinja2", reason="needs the extra ventbench[view]")
    return found


def browse(browser: str, folder: Path, page: Path, *options: str) -> tuple[str, str]:
    done = subprocess.run(
        [browser, *QUIET, f"--user-data-dir={folder / 'profile'}", *options, page.as_uri()],
        capture_output=True,
        text=True,
        timeout=600,
        check=True,
    )
    return done.stdout, done.stderr


def colors(path: Path) -> np.ndarray:
    image = pytest.importorskip("PIL.Image")
    return np.asarray(image.open(path).convert("RGB")).reshape(-1, 3).astype(int)


def test_report_in_a_browser(
    browser: str, best: Trajectories, robust: Trajectories, tmp_path: Path
) -> None:
    page, picture = write_report(tmp_path / "r.html", [best, robust]), tmp_path / "r.png"
    _, log = browse(browser, tmp_path, page, f"--screenshot={picture}", "--window-size=1400,2000")
    assert "CONSOLE" not in log
    pixels = colors(picture)
    assert (pixels > 240).all(axis=1).mean() > 0.3, "light ground"
    for color in ((0, 0x65, 0xB3), (0xC8, 0x6A, 0x12)):
        assert (np.abs(pixels - color).max(axis=1) < 12).sum() > 1000, "each run is drawn"


def test_report_on_a_phone(
    browser: str, best: Trajectories, failed: Trajectories, tmp_path: Path
) -> None:
    """At 390 pixels nothing sticks out; measured from outside, as the report runs no script."""
    page, outer = write_report(tmp_path / "r.html", [failed, best]), tmp_path / "phone.html"
    outer.write_text(
        f"""<iframe src="{page.name}" style="width:390px;height:800px;border:0" onload="
        const d = this.contentDocument;
        document.body.append('width ' + d.documentElement.scrollWidth
          + ' figures ' + d.querySelectorAll('figure').length
          + ' scripts ' + d.scripts.length)"></iframe>"""
    )
    dom, log = browse(browser, tmp_path, outer, "--dump-dom", "--virtual-time-budget=5000")
    assert "CONSOLE" not in log
    assert "width 390 figures 36 scripts 0" in dom


def viewer_command() -> list[str]:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    return [
        sys.executable,
        "-m",
        "rerun",
        "--headless",
        "--window-size",
        "1600x900",
        "--port",
        str(port),
    ]


@pytest.mark.slow
def test_rerun_viewer(best: Trajectories, robust: Trajectories, tmp_path: Path) -> None:
    experimental: Any = pytest.importorskip("rerun.experimental", reason="needs rerun >= 0.41")
    path = write_rerun(tmp_path / "run.rrd", [best, robust])
    command, log = viewer_command(), tmp_path / "log.txt"
    environment = {**os.environ, "XDG_RUNTIME_DIR": str(tmp_path)}
    with log.open("wb") as file:
        viewer = subprocess.Popen(
            [*command, str(path)],
            stdout=file,
            stderr=file,
            env=environment,
            start_new_session=True,
        )
    try:
        client = connect(experimental, command[-1], viewer, log)
        deadline = time.monotonic() + 600
        views = []
        while not views and time.monotonic() < deadline:
            time.sleep(0.3)
            try:
                views = client.get_state().views
            except ConnectionError:  # it may end only now for want of a graphics driver
                client = connect(experimental, command[-1], viewer, log)
        names = [view.name for view in views]
        assert len(names) == 3 * 6 + 6 * 3 + 1
        assert all(not view.reports for view in views), "no view complains"
        time.sleep(3.0)
        picture = tmp_path / "view.png"
        picture.write_bytes(client.take_screenshot())
    finally:
        with contextlib.suppress(ProcessLookupError):  # it has ended by itself
            os.killpg(viewer.pid, signal.SIGTERM)
        viewer.wait(600)
    pixels = colors(picture)
    for color in ((0xE2, 0x60, 0x3C), (0x6F, 0x83, 0xDE), (0x12, 0xA0, 0x73)):
        assert (np.abs(pixels - color).max(axis=1) < 12).sum() > 200, "PIPs and scored bar"


def connect(experimental: Any, port: str, viewer: subprocess.Popen[bytes], log: Path) -> Any:
    deadline = time.monotonic() + 600
    while time.monotonic() < deadline:
        if viewer.poll() is not None or "panicked" in log.read_text(errors="replace"):
            said = log.read_text(errors="replace")
            if "graphics adapter" in said or "wgpu" in said:
                pytest.skip("no Vulkan driver: install mesa-vulkan-drivers")
            pytest.fail(said[-2000:])
        try:
            client = experimental.ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
            client.get_state()
        except Exception:
            time.sleep(0.3)
        else:
            return client
    pytest.fail("the viewer did not answer in 60 s: " + log.read_text(errors="replace")[-2000:])
