"""The operator at a terminal, and what a session shows while it runs."""

from __future__ import annotations

import contextlib
import json
import os
import re
import select
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from hardware_eval.bench.loop import BreathLog, EmergencyStop, Operator, Show
from hardware_eval.bench.plan import Plan, PlannedRun
from hardware_eval.bench.raw_log import LoggedBreath
from hardware_eval.emulation.emulator import LoopbackDevice
from ventbench.base.errors import InputError, require
from ventbench.base.files import json_values
from ventbench.task import protocol

#: What the operator does by hand.
_BY_HAND = {
    "leak": ("open the leak port NOW", "close the leak port"),
    "pinch": ("pinch the tube NOW", "let the tube go"),
}

#: Time that a person takes at least to answer what has just been shown, s.
REACTION = 0.2

#: Keys that are read at once, and what stands for a terminal that has gone.
_KEYS, _GONE = 4096, b"\x04"

#: Heights of a bar, and those of a terminal that has no blocks.
_BARS, _PLAIN_BARS = " ▁▂▃▄▅▆▇█", " .:-=+*%#"


class ConsoleOperator(Operator):
    """Asks and tells at a terminal; while a run goes on, any key is the emergency stop.

    Keys are read from the terminal's descriptor and nowhere else, so that none waits in a buffer.
    A key that was pressed before a question was shown is no answer to it: it was meant as a stop.

    Args:
        yes: confirm everything; for an emulator and for tests.
        device: a device that is emulated in this process, whose tube is disturbed by itself.
        reaction: time after a question was shown in which a key cannot be an answer yet, s.

    Attributes:
        hidden: what is made of all that is asked and told; see :class:`Blind`.
    """

    def __init__(
        self,
        *,
        yes: bool = False,
        device: LoopbackDevice | None = None,
        reaction: float = REACTION,
    ) -> None:
        self._yes, self._device = yes, device
        self._reaction = reaction
        self.hidden: Callable[[str], str] = str
        self._terminal: int | None = None

    @contextlib.contextmanager
    def keys(self) -> Iterator[None]:
        """Let single keys arrive without Enter; does nothing where stdin is no terminal.

        What was typed before is dropped: nothing could move yet.
        """
        if sys.stdin is None or not sys.stdin.isatty():  # it is None where it was closed
            yield
            return
        import termios
        import tty

        terminal = sys.stdin.fileno()
        before = termios.tcgetattr(terminal)
        tty.setcbreak(terminal, termios.TCSAFLUSH)  # Ctrl-C still interrupts
        # Ctrl-Z is a key as others, and stops; suspended, the host would just fall silent.
        own = termios.tcgetattr(terminal)
        own[6][termios.VSUSP] = b"\0"
        termios.tcsetattr(terminal, termios.TCSAFLUSH, own)
        self._terminal = terminal
        try:
            yield
        finally:
            self._terminal = None
            with contextlib.suppress(termios.error):  # it has gone
                termios.tcsetattr(terminal, termios.TCSAFLUSH, before)

    def confirm(self, question: str) -> bool:
        """Ask within :meth:`keys`: the key y alone confirms, every other one declines.

        Without a terminal only ``--yes`` confirms.

        Raises:
            EmergencyStop: if a key was pressed before the question had been shown.
        """
        print(f"{self.hidden(question)} [y/n] ", end="", flush=True)
        if self._yes or self._terminal is None:
            print("y (--yes)" if self._yes else "n (no terminal; give --yes to confirm)")
            return self._yes
        self._react()
        answer = self._pressed(None)
        print(answer.decode("ascii", "replace"), flush=True)
        return answer.lower() == b"y"

    def number(self, question: str) -> float:
        """Ask for a number within :meth:`keys`; keys that come before the question are stops.

        Raises:
            EmergencyStop: as :meth:`confirm`, or if the terminal has gone.
            InputError: if there is no terminal, or it is no number.
        """
        if self._terminal is None or self._yes:
            raise InputError(f"{question}nobody is there to answer (no terminal, or --yes)")
        print(question, end="", flush=True)
        self._react()
        typed = b""
        while not typed.endswith((b"\n", b"\r")):
            keys = self._pressed(None)
            if keys == _GONE:
                raise EmergencyStop
            typed = typed[:-1] if keys in (b"\x7f", b"\x08") else typed + keys
            print(keys.decode("ascii", "replace"), end="", flush=True)
        try:
            return float(typed)
        except ValueError:
            said = typed.decode("ascii", "replace").strip()
            raise InputError(f"{said!r} is no number; run the command again") from None

    def stop(self) -> bool:
        """Whether a key has been pressed, or the terminal has gone."""
        return self._terminal is not None and bool(self._pressed(0.0))

    def _react(self) -> None:
        """Let a person read a question; a key that comes before is a stop."""
        if self._pressed(self._reaction):
            print("stop (a key came before the question)", flush=True)
            raise EmergencyStop

    def _pressed(self, timeout: float | None) -> bytes:
        """Keys that come within a time, s; those of a terminal that has gone are end-of-file."""
        assert self._terminal is not None
        if not select.select([self._terminal], [], [], timeout)[0]:
            return b""
        try:
            return os.read(self._terminal, _KEYS) or _GONE
        except OSError:
            return _GONE

    def tell(self, text: str) -> None:
        """Print a line."""
        print(self.hidden(text), flush=True)

    def disturb(self, perturbation: str, on: bool) -> None:
        """Have a leak opened or the tube pinched, by hand or by the emulator."""
        if self._device is not None:
            hal: Any = self._device.service.hal
            hal.disturb(perturbation if on else "")
            return
        print(f"\a{_BY_HAND[perturbation][0 if on else 1]}", flush=True)


class Blind:
    """Calls entries by numbers, whatever is asked, told or shown; or hides nothing.

    Attributes:
        called: what each entry is called, by its name.
    """

    def __init__(self, plan: Plan, hides: bool = True) -> None:
        """Draw the numbers from the plan's seed, so that a session that continues keeps them."""
        names = sorted(plan.entries) if hides else []
        order = np.random.default_rng([plan.seed, 1]).permutation(len(names))
        self.called = {name: f"entry {k + 1}" for k, name in zip(order, names, strict=True)}
        either = "|".join(re.escape(x) for x in sorted(self.called, key=len, reverse=True))
        self._names = re.compile(rf"(?<![\w-])(?:{either or '(?!)'})(?![\w-])")

    def hidden(self, text: str) -> str:
        """A text without names of entries."""
        return self._names.sub(lambda found: self.called[found[0]], text)

    def hiding(self, show: Show) -> Show:
        """What shows breaths, without the names of entries."""
        return lambda run, *breath: show(replace(run, entry=self.hidden(run.entry)), *breath)


def show_bars(run: PlannedRun, breath: BreathLog, done: int, total: int) -> None:
    """Print a line: where the plan is, the error, and the inspiration as bars."""
    inspired = np.array(breath.pressure[: protocol.INSPIRATION_STEPS])
    inspired = inspired[np.isfinite(inspired)]
    if not inspired.size:
        return
    error = float(np.mean(np.abs(inspired - run.pip)))
    share = (inspired - protocol.PEEP) / (run.pip - protocol.PEEP)
    bars = _BARS
    try:
        bars.encode(getattr(sys.stdout, "encoding", None) or "ascii")
    except UnicodeEncodeError:
        bars = _PLAIN_BARS
    heights = np.clip(share * 6.5, 0, len(bars) - 1).astype(int)  # the target is at 6.5 of 8
    worst = 1e3 * max(breath.late)
    print(
        f"{done + 1:4d}/{total} {run.kind:9s} {run.entry:16.16s} {run.lung:6s} "
        f"PIP {run.pip:2.0f} #{run.repeat:<2d} error {error:6.2f} "
        f"peak {inspired.max():5.1f} late {worst:4.1f} ms "
        f"|{''.join(bars[h] for h in heights)}|",
        flush=True,
    )


def show_in_rerun(target: str) -> Show:
    """Return what sends breaths to a rerun viewer or file, each after those before it.

    Args:
        target: ``"live"`` for a viewer that is started, else the path of an ``.rrd`` file.

    Raises:
        InputError: if rerun is not installed, or the file cannot be written.
    """
    require("rerun")
    import rerun as rr

    stream = rr.RecordingStream("ventbench-hardware")
    try:
        if target == "live":
            stream.spawn()
        else:
            stream.save(target)
    except RuntimeError as error:  # whatever its core meets
        raise InputError(f"--rerun {target}: {error}") from None
    elapsed = 0.0

    def show(run: PlannedRun, breath: BreathLog, done: int, total: int) -> None:
        nonlocal elapsed
        start = elapsed - breath.time[0]
        elapsed += breath.time[-1] - breath.time[0] + protocol.DT
        times = rr.TimeColumn("bench_time", duration=np.array(breath.time) + start)
        late = 1e3 * np.array(breath.late)
        shown = {"pressure": breath.pressure, "target": breath.target, "u_in": breath.u_in}
        for name, values in {**shown, "late_ms": late}.items():
            columns = rr.Scalars.columns(scalars=np.array(values, float))
            stream.send_columns(f"/{name}", indexes=[times], columns=columns)
        stream.set_time("bench_time", duration=float(breath.time[0] + start))
        stream.log("/runs", rr.TextLog(_told(run)))

    return show


#: Samples of a breath in an MCAP file.
_SAMPLES = ("pressure", "flow", "target", "requested", "u_in", "u_out", "late")


def write_mcap(path: Path, breaths: Iterable[LoggedBreath]) -> None:
    """Write breaths to an MCAP file, for Foxglove and its kin: JSON, one message a step.

    The topic ``/breath`` has the samples in the log's units, null where there is none, and what
    runs; times are those of the bench, from 0.

    Raises:
        InputError: if mcap is not installed.
        OSError: if the file cannot be written.
    """
    require("mcap", extra="mcap", what="MCAP files")
    from mcap.writer import Writer

    number = {"type": ["number", "null"]}
    properties = {"run": {"type": "string"}, **dict.fromkeys(_SAMPLES, number)}
    schema = json.dumps({"type": "object", "properties": properties}).encode()
    writer, start = Writer(str(path)), 0.0
    writer.start(library="ventbench")
    known = writer.register_schema("ventbench.breath", "jsonschema", schema)
    channel = writer.register_channel("/breath", "json", known)
    for run, breath in ((each.run, each.log) for each in breaths):
        columns = [getattr(breath, name) for name in _SAMPLES]
        for time, *row in zip(breath.time, *columns, strict=True):
            values = {"run": _told(run), **dict(zip(_SAMPLES, json_values(row), strict=True))}
            at = round(1e9 * (start + time - breath.time[0]))
            writer.add_message(channel, at, json.dumps(values).encode(), at)
        start += breath.time[-1] - breath.time[0] + protocol.DT
    writer.finish()


def _told(run: PlannedRun) -> str:
    return f"{run.kind} {run.entry} {run.lung} PIP {run.pip:g} #{run.repeat}"
