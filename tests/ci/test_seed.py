"""Scores on hidden draws: what the workflow hands on and says, and where the seed is seen."""

from datetime import date

import msgspec
import numpy as np
import pytest
from typer.testing import CliRunner

from ci import official, propose, publish, seed
from ci.git import Git
from ci.take import TakeError, take
from ventbench import protocol, rig_draws, seasons
from ventbench.board import attestation, build, record, store
from ventbench.board.verify import verify
from ventbench.cli import app
from ventbench.errors import InputError
from ventbench.headroom import reference as references
from ventbench.submissions.errors import Failure
from ventbench.submissions.runner import InProcessRunner
from ventbench.submissions.scaffold import contents

from ..textbook_rigs import TextbookRigs
from .conftest import PATH
from .test_official import checked_out

SECRET = "01" * 32


@pytest.fixture
def opened(repository, tmp_path):
    """A leaderboard with a season and a key; of protocol 1, which can be scored everywhere."""
    leaderboard = checked_out(repository, tmp_path / "checkout") / "leaderboard"
    season, secret = seasons.new_season(
        id="spring", protocol=1, draws=20, opens=date(2000, 1, 1), closes=date(9999, 1, 1),
        runs_per_week=3,
    )  # fmt: skip
    seasons.write_season(store.season_path(leaderboard, "spring"), season)
    public = attestation._private(SECRET).public_key().public_bytes_raw()
    (leaderboard / "keys.toml").write_text(
        f'[[keys]]\nid = "{attestation.key_id(public)}"\npublic = "{public.hex()}"\n'
        'added = 2026-11-23\nholder = "a test"\n'
    )
    return leaderboard, season, secret


def test_from_hidden_draws_to_the_pages(repository, simulators, opened, tmp_path):
    leaderboard, season, secret = opened
    files = {f"{PATH}/{name}": content for name, content in contents("demo", "pid").items()}
    commit = repository.commit(files, repository.base)
    taken = take(repository.url, repository.base, commit, "demo", tmp_path / "taken")
    out = tmp_path / "records"
    lines = official.score_taken(
        taken, repository.url, "robustness", simulators, InProcessRunner(), out,
        official.Hidden(season, secret),
    )  # fmt: skip
    assert sorted(path.suffix for path in out.iterdir()) == [".json", ".sealed"]
    public = record.load(next(out.glob("*.json")))
    assert isinstance(public, record.Sealed)
    score = public.content.scores["score_cmh2o"]
    assert lines[-1].startswith(f"demo: robustness: score_cmh2o {score}, not official; ")

    (unsigned,) = propose.add(out, leaderboard, simulators, SECRET)
    assert not attestation.signature_path(leaderboard, unsigned.sha256).exists()
    for path in (leaderboard / "chain.jsonl", leaderboard / "records" / f"{unsigned.sha256}.json"):
        path.unlink()
    (added,) = propose.add(out, leaderboard, simulators, SECRET, secret)
    assert attestation.signature_path(leaderboard, added.sha256).exists()
    assert verify(leaderboard, lambda _: simulators).problems == []
    assert verify(leaderboard, lambda _: simulators, seed=secret).replayed == 1

    branch = propose.commit(leaderboard.parent, [added])
    git = Git(leaderboard.parent)
    pages = publish.pages(git, git.text("rev-parse", branch))
    assert pages is not None
    listed = git.text("ls-tree", "-r", "--name-only", pages).splitlines()
    assert "seasons/spring.toml" in listed
    assert f"records/{public.content.sealed.sha256}.sealed" in listed


class Talkative(InProcessRunner):
    """Fails in a scored cell with a text that quotes what the controller saw."""

    def start(self, submission, tasks):
        session = super().start(submission, tasks)
        if len(tasks) == 6 * 21 * 6:
            act = session.act

            def tell(observations):
                commands = act(observations)
                for cell in (5, 300):
                    told = f"I saw {observations[cell, 1]!r}"
                    failure = Failure("act", "raised ValueError", told, 1, 1)
                    if cell not in session.failures:
                        session.failures[cell] = failure  # type: ignore[index]
                return commands

            session.act = tell  # type: ignore[method-assign]
        return session


@pytest.mark.parametrize("hide", [True, False])
def test_messages_of_hidden_cells_are_not_said(repository, simulators, opened, tmp_path, hide):
    _, season, secret = opened
    files = {f"{PATH}/{name}": content for name, content in contents("demo", "pid").items()}
    commit = repository.commit(files, repository.base)
    taken = take(repository.url, repository.base, commit, "demo", tmp_path / "taken")
    hidden = official.Hidden(season, secret) if hide else None
    given = (taken, repository.url, "robustness", simulators, Talkative(), tmp_path / "out", hidden)
    lines = official.score_taken(*given)
    published = b"".join(path.read_bytes() for path in (tmp_path / "out").iterdir())
    told = "\n".join(lines).encode() + published
    assert (b"I saw" in told) is not hide, "the control says it"


def test_a_season_of_another_protocol_is_not_scored(repository, simulators, opened, tmp_path, demo):
    _, season, secret = opened
    commit = repository.commit(demo, repository.base)
    taken = take(repository.url, repository.base, commit, "demo", tmp_path / "taken")
    later = msgspec.structs.replace(season, protocol=99)
    with pytest.raises(InputError, match="protocol version 99"):
        official.score_taken(
            taken, "url", "all", simulators, InProcessRunner(), tmp_path / "out",
            official.Hidden(later, secret),
        )  # fmt: skip


def test_the_seed_goes_through_a_private_file_that_does_not_stay(opened, tmp_path, monkeypatch):
    leaderboard, season, secret = opened
    path = tmp_path / "seed"
    assert not seed.hand_over("", secret.hex(), path)
    assert not path.exists()
    assert seed.hand_over("spring", secret.hex() + "\n", path)
    assert path.stat().st_mode & 0o777 == 0o600
    assert seed.take_over("spring", path, leaderboard) == (season, secret)
    assert not path.exists()
    seasons.write_seed(path, bytes(32))
    with pytest.raises(InputError, match="not the one of its commitment"):
        seed.take_over("spring", path, leaderboard)
    assert not path.exists()
    with pytest.raises(InputError, match="VENTBENCH_SEASON_SEED does not hold a seed"):
        seed.hand_over("spring", "", path)


def test_main_hands_over_what_the_environment_holds(opened, tmp_path, monkeypatch, capsys):
    _, _, secret = opened
    monkeypatch.setenv("SEED_FILE", str(tmp_path / "seed"))
    monkeypatch.setenv("SEASON", "spring")
    monkeypatch.setenv(seed.SECRET, secret.hex())
    assert seed.main() == 0
    assert seasons.read_seed(tmp_path / "seed") == secret
    assert secret.hex() not in capsys.readouterr().out


def test_errors_of_hidden_scores_are_not_said(
    repository, simulators, opened, tmp_path, monkeypatch
):
    _, season, secret = opened
    files = {f"{PATH}/{name}": content for name, content in contents("demo", "pid").items()}
    commit = repository.commit(files, repository.base)
    taken = take(repository.url, repository.base, commit, "demo", tmp_path / "taken")

    def fail(*_, **__):
        raise InputError("does not replay: says 1.2345 in cell 7")

    monkeypatch.setattr(official.create, "create", fail)
    with pytest.raises(TakeError) as raised:
        official.score_taken(
            taken, "url", "robustness", simulators, InProcessRunner(), tmp_path / "out",
            official.Hidden(season, secret),
        )  # fmt: skip
    assert "1.2345" not in str(raised.value)


def test_hidden_draws_of_version_2_from_the_reference_to_the_reveal(
    repository, tmp_path, monkeypatch, opened
):
    """Everything of a season of rigs: reference errors, score, seal, replay, reveal, board."""
    rigs = TextbookRigs()
    leaderboard, _, _ = opened
    season, secret = seasons.new_season(
        id="rigs", protocol=2, draws=20, opens=date(2000, 1, 1), closes=date(9999, 1, 1),
        runs_per_week=3,
    )  # fmt: skip
    seasons.write_season(store.season_path(leaderboard, "rigs"), season)
    own = rigs.scored()
    drawn = rig_draws.build(own.sessions or (), own.members, seed=secret, season="rigs", n=20)
    plants, cells = own.cells(drawn, protocol.PIPS)
    gains = np.tile([[6.0, 6.0, 0.3]], (6, 1))
    pid = references.pid_errors(plants, cells, gains)
    about = references.settings(own.about, drawn.about())
    zero = np.zeros((*pid.shape, 33))
    made = references.Reference(about, gains, 0.1 * pid, 0.1 * pid, 0.0 * pid, pid, zero)
    made.save(tmp_path / "reference.npz")
    seasons.write_seed(tmp_path / "held", secret)
    given = ["seal-reference", "rigs", str(tmp_path / "reference.npz")]
    options = ["--seed", str(tmp_path / "held"), "--folder", str(leaderboard)]
    sealing = CliRunner().invoke(app, ["board", *given, *options])
    assert sealing.exit_code == 0, sealing.output
    assert isinstance(CliRunner().invoke(app, ["board", *given, *options]).exception, InputError)

    seasons.write_seed(tmp_path / "seed", secret)
    hidden = official.hidden_draws("rigs", tmp_path / "seed", leaderboard)
    assert not (tmp_path / "seed").exists()
    assert hidden.reference is not None
    files = {f"{PATH}/{name}": content for name, content in contents("demo", "pid").items()}
    commit = repository.commit(files, repository.base)
    taken = take(repository.url, repository.base, commit, "demo", tmp_path / "taken")
    out = tmp_path / "records"
    lines = official.score_taken(
        taken, repository.url, "robustness", rigs, InProcessRunner(), out, hidden
    )
    assert "normalised" in lines[-1]
    (added,) = propose.add(out, leaderboard, rigs, SECRET, secret)
    assert isinstance(added, record.Sealed)
    assert added.content.complete
    build.build(leaderboard)
    assert verify(leaderboard, lambda _: rigs, seed=secret).problems == []
    revealed = store.reveal(leaderboard, "rigs", secret, rigs)
    assert [score.name for score in revealed.opened] == ["demo"]
    assert not revealed.void
    build.build(leaderboard)
    assert verify(leaderboard, lambda _: rigs).problems == []
