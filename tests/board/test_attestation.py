"""Official is what somebody vouches for who may, never what a record says of itself."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import pytest

from ventbench.base.errors import InputError
from ventbench.board import attestation, build, canonical, frames, store
from ventbench.board.verify import verify

from .conftest import KEY, accept, attest, lines_of, put

pytest.importorskip("cryptography")


def status(folder: Path) -> dict[str, str]:
    board = frames.load_board(folder, track="performance")
    return dict(zip(board["name"], board["status"], strict=True))


@pytest.fixture
def unsigned(leaderboard: Path) -> Path:
    """A leaderboard whose records say "official", and nobody else does."""
    for path in (leaderboard / canonical.ATTESTATIONS, *leaderboard.rglob("*.sig")):
        path.unlink()
    return leaderboard


def sha_of(folder: Path, name: str) -> str:
    return next(score.sha256 for score in store.load(folder).scores if score.name == name)


def test_official_is_not_self_declared(unsigned: Path, simulators) -> None:
    assert all(score.official for score in store.load(unsigned).scores if score.name != "home")
    assert set(status(unsigned).values()) == {"not official"}
    problems = verify(unsigned, lambda: simulators).problems
    assert all("is signed by no key" in problem for problem in problems)
    assert any("result.json is" in problem for problem in problems)
    build.build(unsigned, unsigned.parent / "site")
    page = (unsigned.parent / "site" / "index.html").read_text()
    assert "not official: no key of this leaderboard has signed the record" in page
    assert "not official: its sandbox lacked a layer" in page
    accept(unsigned)
    assert status(unsigned)["softer"] == "ranked", "control"


def test_a_signed_record_is_official(unsigned: Path, simulators) -> None:
    attest(unsigned)
    for name in ("softer", "home"):
        attestation.sign(unsigned, store.path_of(unsigned, sha_of(unsigned, name)), KEY)
    found = status(unsigned)
    assert found["softer"] == "ranked"
    assert found["harder"] == "not official"
    assert found["home"] == "not official", "a signature gives nobody a sandbox"
    problems = "\n".join(verify(unsigned, lambda: simulators).problems)
    assert problems.count("is signed by no key") == 7, "six records of the round, and its result"
    assert f"{sha_of(unsigned, 'softer')}.json" not in problems


def test_an_unsigned_record_does_not_take_the_place_of_a_signed_one(
    leaderboard: Path, draft, simulators, monkeypatch: pytest.MonkeyPatch
) -> None:
    accepted = (leaderboard / canonical.ATTESTATIONS).read_text()
    old = sha_of(leaderboard, "softer")
    monkeypatch.setattr(store, "conflicts", lambda *_, **__: [])  # as if nobody had looked
    put(leaderboard, draft("softer", factor=0.5), simulators)
    (leaderboard / canonical.ATTESTATIONS).write_text(accepted)
    attestation.sign(leaderboard, leaderboard / canonical.ATTESTATIONS, KEY)
    board = frames.load_board(leaderboard, track="performance").query("name == 'softer'")
    assert dict(zip(board["record"], board["status"], strict=True)) == {old: "ranked"}


def test_wrong_signatures_are_named(unsigned: Path, simulators) -> None:
    attest(unsigned)
    softer, harder = (sha_of(unsigned, name) for name in ("softer", "harder"))
    path = attestation.sign(unsigned, store.path_of(unsigned, softer), KEY)
    good = path.read_bytes()
    values = json.loads(good)

    def problem() -> str:
        found = verify(unsigned, lambda: simulators).problems
        with pytest.raises(InputError):
            store.load(unsigned)
        return "\n".join(x for x in found if path.parent.name in x or "attestations.toml" in x)

    wrong = {
        "signs another file": {"record": harder},
        "the signature is not by key": {"signature": "0" * 128},
        "is not in attestations.toml": {"key": "0" * 16},
        "key signature": {"signature": "0"},
    }
    for message, change in wrong.items():
        path.write_bytes(canonical.canonical(values | change))
        assert message in problem()
    path.write_bytes(good[:-1])
    assert "not in canonical form" in problem()
    path.write_bytes(b"x" * 2000)
    assert "is not JSON" in problem()
    path.write_bytes(good)
    # The signature of one record is none of another.
    moved = attestation.signature_path(store.path_of(unsigned, harder))
    moved.write_bytes(canonical.canonical(values | {"record": harder}))
    assert "the signature is not by key" in problem()
    moved.unlink()
    attestations = unsigned / canonical.ATTESTATIONS
    attestations.write_text(lines_of(KEY).replace(json.loads(good)["key"], "0" * 16))
    assert "attestations.toml: key" in problem()
    attest(unsigned, secret="02" * 32)
    assert "is not in attestations.toml" in problem()


def test_lists_are_checked(leaderboard: Path, simulators) -> None:
    path = leaderboard / canonical.ATTESTATIONS
    good = path.read_text()
    path.write_text(
        f'[[second_runs]]\nrecord = "{"a" * 64}"\nreason = "x"\ndate = 2026-11-23\n{good}'
    )
    attestation.sign(leaderboard, path, KEY)
    (problem,) = verify(leaderboard, lambda: simulators).problems
    assert f"record {'a' * 64} is not there" in problem
    path.write_text(good.replace('reason = "a test"', 'reason = " "'))
    assert any("attestations.toml: " in x for x in verify(leaderboard, lambda: simulators).problems)
    path.unlink()
    path.symlink_to("/dev/zero")
    assert any("is no plain file" in x for x in verify(leaderboard, lambda: simulators).problems)


def test_only_a_listed_key_signs(unsigned: Path) -> None:
    attest(unsigned)
    record = store.path_of(unsigned, sha_of(unsigned, "softer"))
    with pytest.raises(InputError, match="is not in"):
        attestation.sign(unsigned, record, "02" * 32)
    with pytest.raises(InputError, match="not a key of 64") as refused:
        attestation.sign(unsigned, record, "very secret")
    assert "very secret" not in str(refused.value)


def test_without_the_library_there_is_advice(unsigned: Path, monkeypatch) -> None:
    attest(unsigned)
    attestation.sign(unsigned, store.path_of(unsigned, sha_of(unsigned, "softer")), KEY)
    monkeypatch.setitem(sys.modules, "cryptography", None)
    with pytest.raises(InputError, match=r"pip install 'ventbench\[attest\]'"):
        store.load(unsigned)


def test_a_new_key_signs(unsigned: Path, monkeypatch) -> None:
    from typer.testing import CliRunner

    from ventbench.cli import app

    made = CliRunner().invoke(app, ["board", "new-key"]).output
    secret = made.splitlines()[1]
    (unsigned / canonical.ATTESTATIONS).write_text(made[made.index("[[keys]]") :])
    monkeypatch.setitem(os.environ, attestation.SECRET, secret)
    name = sha_of(unsigned, "softer")
    for named in (name[:12], str(unsigned / canonical.ATTESTATIONS)):
        signed = CliRunner().invoke(app, ["board", "sign", named, "--folder", str(unsigned)])
        assert signed.exit_code == 0
        assert signed.output.startswith("signed ")
    assert (unsigned / "records" / f"{name}.sig").is_file()
    assert status(unsigned)["softer"] == "ranked"
