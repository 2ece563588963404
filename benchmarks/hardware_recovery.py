"""Sessions on bad days: none may be lost, and every lung must be vented at the end.

In virtual time the board restarts, also whenever its port opens, another host calls, messages are
lost or late, readings are lost, and answers are late (``tests/hardware_eval/bad_day.py``).

    python benchmarks/hardware_recovery.py [--sessions 500] [--repeats 1]

Prints what happened, the sessions that were lost or did not vent, and their seeds.
"""

from __future__ import annotations

import gc
import tempfile
import time
from collections import Counter
from pathlib import Path

import typer

from tests.hardware_eval.bad_day import bad_day


def main(sessions: int = 500, repeats: int = 1, seed: int = 0) -> None:
    """Sessions on bad days: none may be lost, and every lung must be vented at the end.

    --repeats: runs of each session beside its ramp.
    --seed: of the first session.
    """
    gc.freeze()  # each run collects garbage; what has been imported is none
    begun = time.process_time()
    happened: Counter[str] = Counter()
    wrong: list[str] = []
    attempts = unvented = lost = 0
    for number in range(seed, seed + sessions):
        with tempfile.TemporaryDirectory() as folder:
            day = bad_day(Path(folder) / "raw.jsonl", number, repeats)
        happened += day.happened
        attempts += day.attempts
        unvented += not day.vented
        lost += bool(day.reason or day.lost)
        if day.reason or day.lost or not day.vented:
            wrong.append(f"seed {number}: {day.lost} runs lost, vented {day.vented}: {day.reason}")
    seconds = time.process_time() - begun
    print(f"{sessions} sessions of {1 + repeats} runs, {attempts} attempts at them: ", end="")
    print(", ".join(f"{count} {name}" for name, count in sorted(happened.items())))
    print(f"{lost} lost, {unvented} not vented; {seconds / sessions:.2f} s each")
    print(*wrong, sep="\n")
    if wrong:
        raise typer.Exit(1)


if __name__ == "__main__":
    typer.run(main)
