"""A copy of a submission whose controller can be reset and made anew in the middle of a run."""

from __future__ import annotations

import contextlib
import dataclasses
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from ventbench.submissions.folder import CONTROLLER, Submission

#: Observations with these times, which no run has, ask for a reset, or a new controller and reset.
RESET, RENEW = -1.0, -2.0

# Runs at the end of controller.py, under a name of its own: the author's lines keep their numbers,
# and the driver's are never taken for the author's. The class itself stays, as its code may name
# it; only its `act` is replaced.
_DRIVER = f"""
def _drive(theirs):
    from inspect import getattr_static

    act, news, tasks = getattr_static(theirs, "act"), {{}}, {{}}
    reset = getattr_static(theirs, "reset")

    def bound(function, self):
        return function.__get__(self, type(self)) if hasattr(function, "__get__") else function

    def driven_reset(self, task):
        tasks[id(self)] = task
        return bound(reset, self)(task)

    def driven_act(self, observation):
        if observation.time >= 0.0:
            return bound(act, news.get(id(self), self))(observation)
        if observation.time == {RENEW}:
            news[id(self)] = theirs()
        bound(reset, news.get(id(self), self))(tasks[id(self)])
        return 0.0

    theirs.reset, theirs.act = driven_reset, driven_act


_found = globals().get("Controller")
if isinstance(_found, type) and hasattr(_found, "reset") and hasattr(_found, "act"):
    _drive(_found)
"""


@contextlib.contextmanager
def driven(submission: Submission) -> Iterator[Submission]:
    """Give a submission whose controller obeys :data:`RESET` and :data:`RENEW`.

    Args:
        submission: stays as it is.
    """
    with tempfile.TemporaryDirectory() as parent:
        # Links resolved: Landlock and messages compare real paths.
        folder = Path(parent).resolve() / submission.folder.name
        shutil.copytree(submission.folder, folder, ignore=shutil.ignore_patterns("__pycache__"))
        path = folder / CONTROLLER
        path.chmod(0o644)
        with open(path, "ab") as file:
            code = f'\nexec(compile({_DRIVER!r}, "<contract>", "exec"))\n'
            file.write(code.encode())
        yield dataclasses.replace(submission, folder=folder)
