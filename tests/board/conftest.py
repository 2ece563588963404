"""Records made on the spot: real commands of the PIDs on textbook rigs, and variations of them."""

from __future__ import annotations

import dataclasses
import functools
import runpy
import shutil
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ventbench.board import (
    attestation,
    build,
    canonical,
    create,
    record,
    replay,
    rounds,
    store,
)
from ventbench.board.record import Record, Withdrawal
from ventbench.board.replay import ReplayPlants, run_of
from ventbench.entries import reference as references
from ventbench.entries.cells import InProcessRunner, Protocol, protocol_of
from ventbench.entries.folder import open_submission, resolve
from ventbench.entries.result import Score
from ventbench.entries.runs import DRAWS, CellFailure, Runs
from ventbench.entries.scoring import run_protocol, runs_of
from ventbench.plants import frozen
from ventbench.sandbox.child.cell import Failure
from ventbench.task import draws as draw_tables
from ventbench.task import environment, protocol
from ventbench.task.lungs import LUNG_IDS

from ..textbook_rigs import TextbookRigs
from . import referee

#: Loads the frozen simulators, in whose place the tests have textbook lungs.
OFFICIAL = frozen.load

SANDBOX = {"layers": ["landlock", "seccomp"], "official": True}
NOW = datetime(2026, 11, 20, 12, tzinfo=UTC)

#: When the round of the tests closed and was frozen, and its referee's secret.
FROZEN, SECRET = datetime(2026, 11, 20, 10, tzinfo=UTC), 20261120

#: Name of the round, and all entries that any test sends to it, with what they are copies of.
ROUND = "r1"
ENTERED = {
    **dict.fromkeys(
        ("softer", "harder", "broken", "open", "home", "twin", "told", "new", "weak", "honest"),
        "pid_best",
    ),
    **dict.fromkeys(
        ("robust", "leaky", "later", "fails", "absent", "uneven", "zero", "soft"), "pid_robust"
    ),
}

#: Secret key of the leaderboards of the tests.
KEY = "01" * 32

#: Text that must never be anything but text.
HOSTILE = (
    "<script>document.title='owned'</script>\"'><img src=x onerror=alert(1)> {{ 7*7 }} \u202eevil"
)


@pytest.fixture(scope="session")
def simulators() -> TextbookRigs:
    return TextbookRigs()


@pytest.fixture(scope="session")
def entered(simulators: TextbookRigs, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A leaderboard with a round that has draws, and nothing else."""
    folder = tmp_path_factory.mktemp("entered")
    for name in ("pid_best", "pid_robust"):
        entry_folder(folder / "submissions" / name, name, name)
    for name, base in ENTERED.items():
        entry_folder(folder / "submissions" / name, base, name)
    board, names = folder / "leaderboard", ["pid_best", "pid_robust", *ENTERED]
    rounds.open_round(
        board, ROUND, FROZEN, names, delay_s=60, chain=referee.chain(SECRET), now=FROZEN
    )
    own = rounds.freeze(board, ROUND, folder / "submissions", [], simulators.about(), now=FROZEN)
    rounds.draw(board, ROUND, referee.value(SECRET, own.number))
    return board


@pytest.fixture(scope="session")
def drawn(entered: Path, simulators: TextbookRigs) -> draw_tables.Draws:
    """Draws of the round."""
    return rounds.load(entered, ROUND).draws(simulators.scored())


@pytest.fixture(scope="session")
def reference(
    entered: Path, simulators: TextbookRigs, drawn: draw_tables.Draws
) -> references.Reference:
    """The PID's true errors, and a tenth of them as what is attainable; the round is scored."""
    own = simulators.scored()
    controller = runpy.run_path(str(resolve("pid_robust") / "controller.py"))
    gains = np.tile(controller["GAINS"], (6, 1))
    plants, cells = own.cells(drawn, protocol.PIPS)
    pid = references.pid_errors(plants, cells, gains)
    about = references.settings(own.about, drawn.about())
    zero = np.zeros((*pid.shape, 33))
    made = references.Reference(about, gains, 0.1 * pid, 0.1 * pid, 0.0 * pid, pid, zero)
    sha256 = made.save(entered / "rounds" / ROUND / rounds.BOUNDS)
    content = canonical.canonical({"bounds": sha256, "records": {}, "failed": {}})
    (entered / "rounds" / ROUND / rounds.RESULT).write_bytes(content)
    return made


@pytest.fixture(autouse=True)
def _textbook(monkeypatch: pytest.MonkeyPatch, simulators: TextbookRigs) -> None:
    """Textbook lungs in the place of the frozen ones; nothing is kept on disk."""
    monkeypatch.setattr(frozen, "load", lambda path=None: simulators)
    monkeypatch.setattr(replay, "_place", lambda key: None)


@pytest.fixture(autouse=True)
def _witnesses(monkeypatch: pytest.MonkeyPatch) -> None:
    """No commands attain a tenth of the PID's errors: nobody asks for them here."""
    monkeypatch.setattr(references, "witness_errors", lambda made, *_: made.attainable)
    monkeypatch.setattr(references, "second_errors", lambda *x: np.full(len(x[-1]), np.inf))
    monkeypatch.setattr(references, "rise_errors", lambda *x: np.zeros(np.shape(x[-1].pip)))


@pytest.fixture(scope="session")
def scores(
    simulators: TextbookRigs, reference: references.Reference, drawn: draw_tables.Draws
) -> dict[str, Score]:
    """The two PIDs, scored."""
    found = {}
    for name in ("pid_best", "pid_robust"):
        result = run_protocol(
            open_submission(name),
            protocol_of(simulators.scored(), drawn=drawn, reference=reference),
            runner=InProcessRunner(),
        )
        rigs = dataclasses.replace(result.protocol.rigs, sha256=frozen.MANIFEST_SHA256)
        protocol = dataclasses.replace(result.protocol, rigs=rigs)
        found[name] = dataclasses.replace(result, sandbox=SANDBOX, protocol=protocol)
    return found


Draft = Callable[..., create.Draft]


@pytest.fixture(scope="session")
def draft(
    scores: dict[str, Score],
    simulators: TextbookRigs,
    reference: references.Reference,
    tmp_path_factory: pytest.TempPathFactory,
) -> Draft:
    """Make a record: the commands of a PID times a factor, under any name."""

    def make(
        name: str,
        base: str = "pid_best",
        factor: float = 1.0,
        *,
        sandbox: dict[str, Any] | None = SANDBOX,
        texts: str | None = None,
        failed: int = 0,
        wide_open: bool = False,
        change: Callable[[np.ndarray], None] | None = None,
        stress: Callable[[Protocol, np.ndarray], Runs] | None = None,
        **about: Any,
    ) -> create.Draft:
        score = scores[base]
        folder = entry_folder(tmp_path_factory.mktemp("entries") / name, base, name)
        manifest = dataclasses.replace(score.submission.manifest, name=name)
        if texts is not None:
            manifest = dataclasses.replace(
                manifest,
                authors=(texts.replace("\u202e", ""),),
                licence=texts,
                description=texts,
            )
        opened = dataclasses.replace(
            score.submission,
            label=str(folder),
            folder=folder,
            manifest=manifest,
            sha256=create.combined_hash(create.file_hashes(folder)),
        )
        requested = np.full_like(score.requested, 100.0) if wide_open else score.requested * factor
        if change is not None:
            change(requested)
        cells = [(i, j) for i in range(6) for j in range(6)][:failed]
        for i, j in cells:
            requested[i, 0, j] = 0.0
        failures = []
        for i, j in cells:
            what = Failure("act", texts or "raised ValueError", texts or "", 1, 2)
            message = what.message(str(folder), LUNG_IDS[i])
            failures.append(CellFailure("none", LUNG_IDS[i], score.pips[j], None, what, message))
        runs = again(score, requested, failures)
        varied = dataclasses.replace(score, submission=opened, sandbox=sandbox, runs=runs)
        if stress is not None:
            what = protocol_of(
                score.protocol.rigs, drawn=score.rig_draws, stress=DRAWS, reference=reference
            )
            own = stress(what, requested)
            varied = dataclasses.replace(varied, protocol=what, stressed=own)
        return create.create(varied, simulators, now=NOW, **about)

    return make


def again(score: Score, requested: np.ndarray, failures: Sequence[CellFailure] = ()) -> Runs:
    """Runs of other commands on the cells of a score."""
    cells = score.protocol.cells
    run = run_of(cells, environment.resolved(requested)[None])
    lungs = [lung.id for lung in cells.lungs]
    failed = {(0, lungs.index(x.lung), 0, score.pips.index(x.pip)): x.failure for x in failures}
    runs = runs_of(dataclasses.replace(run, failures=failed), cells)
    assert runs.requested is not None
    commands = requested.reshape(runs.requested.shape)
    return dataclasses.replace(runs, failures=failures, requested=commands)


def entry_folder(folder: Path, base: str, name: str) -> Path:
    """Copy a bundled submission under another name; the same files each time."""
    shutil.copytree(resolve(base), folder, ignore=lambda *_: ["__pycache__"])
    manifest = folder / "submission.toml"
    known = f'name = "{Path(base).name}"'
    manifest.write_text(manifest.read_text().replace(known, f'name = "{name}"'))
    return folder


@pytest.fixture(scope="session")
def drafts(draft: Draft) -> dict[str, create.Draft]:
    """Entries of every kind: ranked, failed, unsafe, not official, hostile."""
    return {
        "pid_best": draft("pid_best"),
        "pid_robust": draft("pid_robust", "pid_robust"),
        "softer": draft("softer", factor=0.97),
        "harder": draft("harder", factor=1.04, texts=HOSTILE),
        "robust": draft("robust", "pid_robust", factor=0.98),
        "broken": draft("broken", failed=2, texts=HOSTILE),
        "open": draft("open", wide_open=True),
        "home": draft("home", factor=1.01, sandbox=None),
    }


@pytest.fixture(scope="session")
def full(
    drafts: dict[str, create.Draft],
    simulators: TextbookRigs,
    entered: Path,
    tmp_path_factory: pytest.TempPathFactory,
) -> Path:
    """A leaderboard that nobody may change; see :func:`leaderboard`."""
    folder = shutil.copytree(entered, tmp_path_factory.mktemp("full") / "leaderboard")
    for made in drafts.values():
        put(folder, made, simulators)
    return folder


@pytest.fixture(scope="session")
def site(full: Path, simulators: TextbookRigs, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The built pages of :func:`full`."""
    pytest.importorskip("jinja2", reason="needs the extra ventbench[view]")
    out = tmp_path_factory.mktemp("site") / "site"
    build.build(full, out, lambda: simulators)
    return out


@pytest.fixture
def leaderboard(full: Path, tmp_path: Path) -> Path:
    """A leaderboard to change."""
    return shutil.copytree(full, tmp_path / "leaderboard")


def put(folder: Path, made: create.Draft, simulators: ReplayPlants | None = None) -> Record:
    """Save a draft and add it, accepted as official if it says so."""
    require = None if simulators is None else functools.partial(replay.require_replay, simulators)
    added = store.add(folder, made.save(folder.parent / "drafts"), require)
    accept(folder)
    assert isinstance(added, Record)
    return added


def accept(folder: Path) -> None:
    """Vouch for all that says that it is official, as maintainers would, and close the round."""
    listed = [record.load(path) for path in store.record_paths(folder)]
    lines = [
        f'[[second_runs]]\nrecord = "{one.sha256}"\nreason = "a test"\ndate = 2026-11-23\n'
        for one in listed
        if isinstance(one, Withdrawal) or (isinstance(one, Record) and one.official)
    ]
    attest(folder, "".join(lines))
    close(folder)


def attest(folder: Path, lines: str = "", secret: str = KEY) -> None:
    """Write and sign the list of keys and second runs."""
    path = folder / canonical.ATTESTATIONS
    path.write_text(lines + lines_of(secret))
    attestation.sign(folder, path, secret)


def close(folder: Path) -> None:
    """Write and sign the result of the round: the first record of each entry, or that it failed."""
    path = folder / "rounds" / ROUND / rounds.RESULT
    own = rounds.load(folder, ROUND)
    if own.frozen is None or own.result is None:
        return
    scored = {  # a correction comes after the result that it corrects
        key: sha256
        for key, sha256 in own.result.records.items()
        if store.path_of(folder, sha256).exists()
    }
    for one in store.in_order(map(store.read_record, store.record_paths(folder))):
        if isinstance(one, Record) and one.header.draws.season == ROUND:
            scored.setdefault(f"{one.name} ({one.track})", one.sha256)
    runs = {f"{x.name} ({track})" for x in own.frozen.entries for track in x.tracks}
    failed = dict.fromkeys(sorted(runs - set(scored)), "it was not run")
    result = {"bounds": own.result.bounds, "records": scored, "failed": failed, "seeds": {}}
    path.write_bytes(canonical.canonical(result))
    attestation.sign(folder, path, KEY)


def lines_of(secret: str) -> str:
    """Lines of attestations.toml for a secret."""
    public = attestation._private(secret).public_key().public_bytes_raw()
    return (
        f'[[keys]]\nid = "{attestation.key_id(public)}"\npublic = "{public.hex()}"\n'
        'added = 2026-11-23\nholder = "a test"\n'
    )


def opened(made: create.Draft) -> Record:
    """Return the record of a draft."""
    found = record.from_bytes(made.content, "draft")
    assert isinstance(found, Record)
    return found


def derived(made: create.Draft, simulators: ReplayPlants, own: rounds.Round) -> Record:
    """Return the record of a draft with its figures."""
    found = opened(made)
    commands = [
        store.decode(content, x.shape, "draft")
        for content, x in zip(made.commands, found.commands, strict=True)
    ]
    what = replay.protocol_of(found.header, simulators, own)
    stressed = commands[1] if len(commands) > 1 else None
    figures = replay.figures_of(found.header, commands[0], stressed, what, simulators)
    return dataclasses.replace(found, derived=figures)
