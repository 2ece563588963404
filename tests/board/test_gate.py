"""The gate of every rank: what is invented, vouched for by its sender, or taken for another."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from ventbench.base.errors import InputError
from ventbench.board import attestation, canonical, frames, gate, ranking, record, replay, store
from ventbench.board.record import HardwareRecord
from ventbench.task import protocol

from .conftest import KEY, accept, attest

#: The key of the leaderboard; it may sign what was simulated, and no bench.
SECRET = "07" * 32

LUNG, PIP, RAW = "R5C20", 20.0, "9" * 64


def pressures(seed: int = 0) -> list[Any]:
    """Two repetitions of a rise from PEEP with the noise of a sensor, 0.001 cmH2O."""
    random = np.random.default_rng(seed)
    time = np.arange(protocol.INSPIRATION_STEPS) * protocol.DT
    rise = PIP + (protocol.PEEP - PIP) * np.exp(-time / 0.1)
    shape = (2, len(protocol.SCORED_BREATHS), protocol.INSPIRATION_STEPS)
    return np.rint(1000.0 * (rise + 0.2 * random.standard_normal(shape))).astype(int).tolist()


def hardware(template: dict[str, Any], runs: list[Any], **changed: Any) -> bytes:
    """A hardware record of one lung and PIP; its errors are those of the pressures."""
    table = np.array(runs) / 1000.0
    errors = np.abs(table - PIP).mean(axis=(1, 2))
    own = {
        key: template[key]
        for key in ("format", "protocol", "created", "submission", "sandbox", "versions", "machine")
    }
    own |= {
        "kind": "hardware",
        "track": "hardware",
        "simulated_track": "performance",
        "device": {
            "name": "bench",
            "firmware": "1",
            "calibration": "a",
            "emulated": False,
            "about": {},
        },
        "operator": "A. Person",
        "notes": "",
        "lungs": [LUNG],
        "pips": [PIP],
        "repeats": len(runs),
        "errors": [[errors.tolist()]],
        "stops": [],
        "safe": [True],
        "peak_pressure_cmH2O": [float(table.max())],
        "trace": {
            "pressure_milli_cmH2O": [[runs]],
            "u_in_tenths_percent": [[(0 * np.array(runs)).tolist()]],
        },
        "recording": {"sha256": RAW, "bytes": 1, "breaths": 6},
        "plan": {},
        "control": {},
        "safety": {},
        "timing": {},
        "provenance": {},
        "selftest": {LUNG: ["leak"]},
    }
    return canonical.canonical(own | changed)


@pytest.fixture
def template(drafts) -> dict[str, Any]:
    return json.loads(drafts["pid_best"].content)


def measured(content: bytes) -> HardwareRecord:
    made = record.from_bytes(content, "it")
    assert isinstance(made, HardwareRecord)
    return made


def _perfect(runs: np.ndarray) -> np.ndarray:
    return np.full_like(runs, 1000 * PIP)


def _higher(runs: np.ndarray) -> np.ndarray:
    runs[..., 3:] += 100_000
    return runs


def _repeated(runs: np.ndarray) -> np.ndarray:
    runs[1] = runs[0]
    return runs


@pytest.mark.parametrize(
    ("forge", "changed", "message"),
    [
        (_perfect, {}, "begins 15.0 cmH2O from PEEP, before any command acts"),
        (_higher, {}, "key safe: R5C20 says true, its pressures are above the limit"),
        (_repeated, {}, "repeats a breath to the last digit"),
        (lambda x: x, {"peak_pressure_cmH2O": [12.0]}, "key peak_pressure_cmH2O"),
    ],
)
def test_forged_hardware_is_refused(
    template, forge: Callable[[np.ndarray], np.ndarray], changed: dict[str, Any], message: str
) -> None:
    runs = pressures()
    assert measured(hardware(template, runs)).score < 10.0, "control"
    forged = forge(np.array(runs)).tolist()
    with pytest.raises(InputError, match=message):
        measured(hardware(template, forged, **changed))


def test_unsafe_hardware_that_says_so_has_no_rank(template) -> None:
    runs = _higher(np.array(pressures())).tolist()
    made = measured(hardware(template, runs, safe=[False]))
    vouched = store.Store(Path(), (), frozenset([made.sha256]))
    assert gate.measured(made, vouched) == ("did not pass the safety gate on R5C20",)


@pytest.mark.parametrize("parts", [{LUNG: ["lung", "sweep"]}, {}])
def test_a_lung_that_was_not_identified_has_no_rank(template, parts: dict[str, list[str]]) -> None:
    made = measured(hardware(template, pressures(), selftest=parts))
    vouched = store.Store(Path(), (), frozenset([made.sha256]))
    unknown = f"no self-test of which lung was mounted on {LUNG}"
    zero = () if parts else (f"no self-test of the sensor's zero on {LUNG}",)
    assert gate.measured(made, vouched) == (*zero, unknown)


def added(folder: Path, content: bytes) -> HardwareRecord:
    path = folder.parent / "new.json"
    path.write_bytes(content)
    made = store.add(folder, path)
    assert isinstance(made, HardwareRecord)
    return made


def log_of(sha256: str, recording: str = RAW) -> str:
    return (
        f'[[bench_logs]]\nrecord = "{sha256}"\nrecording = "{recording}"\n'
        'witness = "a test"\ndate = 2026-11-23\n'
    )


def test_only_a_bench_log_ranks_hardware(leaderboard: Path, template) -> None:
    """Neither a signature nor a second run: nobody behind them has seen a bench."""
    made = added(leaderboard, hardware(template, pressures()))
    listed = leaderboard / canonical.ATTESTATIONS
    before = listed.read_text()

    def listing(text: str) -> None:
        listed.write_text(text)
        attestation.sign(leaderboard, listed, KEY)

    def row():
        return frames.load_tracks(leaderboard, track="performance")[0].hardware[0]

    assert (row().rank, row().reasons) == (None, (gate.NO_BENCH_LOG,))
    public = attestation._private(SECRET).public_key().public_bytes_raw()
    key = (
        f'[[keys]]\nid = "{attestation.key_id(public)}"\npublic = "{public.hex()}"\n'
        'added = 2026-11-23\nholder = "a test"\n'
    )
    listing(before + key)
    attestation.sign(leaderboard, store.path_of(leaderboard, made.sha256), SECRET)
    assert row().rank is None
    second = f'[[second_runs]]\nrecord = "{made.sha256}"\nreason = "a test"\ndate = 2026-11-23\n'
    listing(before + key + second)
    with pytest.raises(InputError, match="was measured: it needs a bench log"):
        row()
    listing(before + key + log_of(made.sha256, "8" * 64))
    with pytest.raises(InputError, match="is not of recording 8888"):
        row()
    listing(before + key + log_of(made.sha256))
    assert (row().rank, row().count, row().reasons) == (1, 1, ())


def test_an_emulators_record_is_no_hardware(leaderboard: Path, template) -> None:
    """Its bit costs the rank; without the bit, the bench log is missing."""
    device = {"name": "bench", "firmware": "1", "calibration": "a", "about": {}}
    honest = added(
        leaderboard, hardware(template, pressures(), device={**device, "emulated": True})
    )
    attest(leaderboard, log_of(honest.sha256))
    (row,) = frames.load_tracks(leaderboard, track="performance")[0].hardware
    assert row.rank is None
    assert row.reasons == ("software stood in for the ventilator and its lung",)
    turned = added(
        leaderboard, hardware(template, pressures(), device={**device, "emulated": False})
    )
    rows = frames.load_tracks(leaderboard, track="performance")[0].hardware
    assert [x.reasons for x in rows if x.record.sha256 == turned.sha256] == [(gate.NO_BENCH_LOG,)]
    assert not any(x.rank for x in rows)


def test_an_invented_record_has_no_rank(leaderboard: Path) -> None:
    """Nobody vouches for the changed record: its hash is another one."""
    board = replay.load(leaderboard)
    honest = next(x for x in board.scores if x.name == "pid_robust")
    assert gate.simulated(honest, board) == (), "control"
    assert honest.figures.stressed is None
    assert not any(row.stress_place for track in ranking.board(board) for row in track.rows)
    forged = dataclasses.replace(honest, sha256="f" * 64)
    assert gate.UNATTESTED in gate.simulated(forged, board)


def test_what_a_record_says_of_itself_ranks_nothing(leaderboard: Path) -> None:
    for path in (leaderboard / canonical.ATTESTATIONS, *leaderboard.rglob("*.sig")):
        path.unlink()
    board = replay.load(leaderboard)
    named = {score.name: score for score in board.scores}
    for name in ("softer", "robust", "pid_best"):
        assert named[name].official
        assert gate.simulated(named[name], board) == (gate.UNATTESTED,)
    accept(leaderboard)
    board = store.load(leaderboard)
    assert gate.simulated(named["softer"], board) == ()
    home = gate.simulated(named["home"], board)
    assert home[0].startswith("not official: its sandbox lacked a layer")


@pytest.mark.parametrize("author", ["A\u034fda", "\u3164", "\u0410da Lovelace", "x\u200b", " "])
def test_authors_that_look_like_others_are_refused(template, author: str) -> None:
    template["submission"]["manifest"]["authors"] = [author]
    with pytest.raises(InputError, match=r"authors|cannot be seen"):
        measured(hardware(template, pressures()))


@pytest.mark.parametrize("author", ["Ada Łovelace", "Анна Ч.", "山田 太郎", "東京カナ"])
def test_names_of_any_one_script_are_welcome(template, author: str) -> None:
    template["submission"]["manifest"]["authors"] = [author]
    made = measured(hardware(template, pressures()))
    assert msgspec.to_builtins(made.manifest)["authors"] == [author]
