"""Whatever is removed, swapped, cut or edited on a published board is found, and named."""

from __future__ import annotations

import json
import shutil
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import tomli_w

from ventbench.board import attestation, build, canonical, replay, rounds, store
from ventbench.board.record import Record
from ventbench.board.verify import verify

from .conftest import KEY, ROUND, Draft, put

pytest.importorskip("cryptography", reason="needs the extra ventbench[attest]")
pytest.importorskip("jinja2", reason="needs the extra ventbench[view]")

#: Least number of mutations, and most of the leaves of one file.
LEAST, LEAVES = 400, 24


@pytest.fixture(scope="module")
def published(
    drafts: dict[str, Any], draft: Draft, simulators, entered: Path, tmp_path_factory
) -> Path:
    """A board as it is published: two records, a withdrawal, notes, and pages beside them."""
    folder = shutil.copytree(entered, tmp_path_factory.mktemp("published") / "leaderboard")
    for name in ("pid_best", "softer", "robust"):
        put(folder, drafts[name], simulators)
    softer = next(x for x in store.load(folder).scores if x.name == "softer")
    withdrawal = store.withdraw(folder, softer.sha256, "a bug")
    attestation.sign(folder, store.path_of(folder, withdrawal.sha256), KEY)
    _with_seeds(folder, drafts["harder"], simulators)
    notes = folder / "rounds" / ROUND / canonical.NOTES
    notes.write_text(tomli_w.dumps({"entries": {"pid_best": "The hundred of the scale."}}))
    attestation.sign(folder, notes, KEY)
    build.build(folder, folder, lambda: simulators)
    return folder


def _with_seeds(folder: Path, made: Any, simulators) -> None:
    """Let an entry have a seed whose commands are those of another draft."""
    own, key = rounds.load(folder, ROUND), "pid_best (performance)"
    assert own.result is not None
    entry = store.read_record(store.path_of(folder, own.result.records[key]))
    assert isinstance(entry, Record)
    commands = store.described(made.commands[0], entry.header.commands.shape)
    store.commands_path(commands, folder / store.RECORDS).write_bytes(made.commands[0])
    where = folder / store.RECORDS
    scores = replay.seed_scores(entry, [commands], where, simulators, own, {})
    result = msgspec.to_builtins(own.result) | {"seeds": {key: scores}}
    path = own.folder / rounds.RESULT
    path.write_bytes(canonical.canonical(result))
    attestation.sign(folder, path, KEY)
    listed = {key: [msgspec.to_builtins(commands)]}
    (own.folder / canonical.SEEDS).write_bytes(canonical.canonical(listed))


def leaves(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Paths of all leaves of nested dicts and lists."""
    items = value.items() if isinstance(value, dict) else enumerate(value)
    for key, part in items:
        if isinstance(part, dict | list) and part:
            yield from leaves(part, (*path, key))
        else:
            yield (*path, key)


def other(value: Any) -> Any:
    """Another value of the same type."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, int | float):
        return value + 1
    if isinstance(value, str):
        return ("b" if value[:1] == "a" else "a") + value[1:]
    if isinstance(value, dict | list):
        return {"x": 1} if isinstance(value, dict) else [1]
    return 1 if value is None else value.replace(year=value.year + 1)


def edited(content: bytes, suffix: str, random: np.random.Generator) -> Iterator[tuple[str, bytes]]:
    """Every leaf of a file of JSON or TOML, up to some, with another value, and without it."""
    values = json.loads(content) if suffix == ".json" else tomllib.loads(content.decode())
    every = list(leaves(values))
    chosen = random.permutation(len(every))[:LEAVES]
    for path in (every[k] for k in sorted(chosen)):
        for what in ("another value", "removed"):
            fresh = json.loads(content) if suffix == ".json" else tomllib.loads(content.decode())
            part = fresh
            for key in path[:-1]:
                part = part[key]
            if what == "removed":
                del part[path[-1]]
            else:
                part[path[-1]] = other(part[path[-1]])
            written = (
                canonical.canonical(fresh) if suffix == ".json" else tomli_w.dumps(fresh).encode()
            )
            yield f"{'.'.join(map(str, path))} {what}", written


Mutation = tuple[str, Callable[[Path], object]]


def mutations(folder: Path) -> Iterator[Mutation]:
    """Every file removed, cut, longer, with a flipped bit, in another's place, and edited."""
    random = np.random.default_rng(20261128)
    names = sorted(canonical.walk(folder)[0])
    for at, name in enumerate(names):
        content, suffix = (folder / name).read_bytes(), Path(name).suffix
        alike = [x for x in names if Path(x).suffix == suffix and x != name]
        places = random.integers(0, len(content), 3).tolist()

        def write(new: bytes, name: str = name) -> Callable[[Path], object]:
            return lambda copy: (copy / name).write_bytes(new)

        yield f"{name} removed", lambda copy, name=name: (copy / name).unlink()
        yield f"{name} cut", write(content[: len(content) // 2])
        yield f"{name} emptied", write(b"")
        yield f"{name} longer", write(content + b" ")
        for place in places:
            flipped = bytearray(content)
            flipped[place] ^= 1 << int(random.integers(8))
            yield f"{name} byte {place}", write(bytes(flipped))
        if alike:
            yield (
                f"{name} in place of another",
                write((folder / alike[at % len(alike)]).read_bytes()),
            )
        if suffix in (".json", ".toml", ".sig"):
            kind = ".toml" if suffix == ".toml" else ".json"
            for what, new in edited(content, kind, random):
                if new != content:
                    yield f"{name} {what}", write(new)


def test_every_mutation_of_a_published_board_is_named(
    published: Path, simulators, tmp_path: Path
) -> None:
    memo: dict[Any, Any] = {}

    def problems(folder: Path) -> list[str]:
        return verify(folder, lambda: simulators, memo=memo).problems

    copy = shutil.copytree(published, tmp_path / "leaderboard")
    assert problems(copy) == [], "control"
    count, missed = 0, []
    for what, change in mutations(published):
        change(copy)
        found = problems(copy)
        name = what.split(" ")[0]
        if not any(name in x or Path(name).stem in x for x in found):
            missed.append((what, found))
        count += 1
        (copy / name).write_bytes((published / name).read_bytes())
    assert problems(copy) == [], "control"
    assert not missed, "\n".join(map(str, missed))
    assert count >= LEAST
