"""Each hazard of the bench manual names a test that exists, and an alarm of a known priority."""

from __future__ import annotations

import re
from pathlib import Path

HERE = Path(__file__).parent


def test_every_hazard_has_a_guard_and_a_test() -> None:
    manual = (HERE.parents[1] / "hardware_eval" / "README.md").read_text("utf-8")
    table = manual.split("## Hazards")[1].split("\n## ")[0]
    rows = [row.strip("|").split("|") for row in table.splitlines() if row.startswith("|")][2:]
    assert 10 <= len(rows) <= 20
    for cause, effect, guard, alarm, test in rows:
        assert all(cell.strip() for cell in (cause, effect, guard)), cause
        assert alarm.strip() in ("high", "medium", "low"), cause
        named = re.fullmatch(r" `([a-z_/]+\.py)::(test_\w+)` ", test)
        assert named, test
        assert f"def {named[2]}(" in (HERE / named[1]).read_text("utf-8"), test
