"""CSV and pages: a pure function of the records, the same bytes at every build."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ventbench import files
from ventbench.board import (
    entry_page,
    frames,
    hardware_table,
    index_page,
    layout,
    pages,
    ranking,
    store,
)
from ventbench.board.store import Store


@dataclass(frozen=True)
class Built:
    """What a build did.

    Attributes:
        records: how many there are.
        pages: how many files belong to the leaderboard, CSV included.
        changed: relative paths that were written or removed.
    """

    records: int
    pages: int
    changed: tuple[str, ...]


def content(leaderboard: Store) -> dict[str, bytes]:
    """Return every built file by its path within the leaderboard's folder.

    Args:
        leaderboard: all of its records.

    Raises:
        InputError: if jinja2 is not installed.
    """
    boards = ranking.boards(leaderboard.records, leaderboard.attested, leaderboard.breaches) or {
        pages.CURRENT: ranking.empty(pages.CURRENT)
    }
    built = {"leaderboard.csv": frames.csv_text(boards).encode()}
    environment = pages.environment()
    versions = list(boards)
    for version, tracks in boards.items():
        page = index_page.render(environment, leaderboard, version, versions, tracks)
        built[pages.version_path(version, versions)] = page.encode()
        for track in tracks:
            measured = hardware_table.rows(leaderboard.records, track)
            built.update(entry_page.render_all(environment, track, versions, measured))
    return built


def build(folder: Path) -> Built:
    """Bring CSV and pages up to date with the records; only files that differ are written.

    Files that no build writes are left alone.

    Args:
        folder: of the leaderboard.

    Raises:
        InputError: if a record or the chain was changed, or jinja2 is not installed.
        OSError: if a file cannot be read or written.
    """
    leaderboard = store.load(folder)
    built = content(leaderboard)
    changed = []
    for name, text in built.items():
        path = folder / name
        if not path.is_file() or path.read_bytes() != text:
            files.write_atomically(path, lambda file, text=text: file.write(text))
            changed.append(name)
    for name in sorted(present(folder) - built.keys()):
        (folder / name).unlink()
        changed.append(name)
    return Built(len(leaderboard.records), len(built), tuple(changed))


def present(folder: Path) -> set[str]:
    """Relative paths of the built files that are there now."""
    return {name for name in layout.walk(folder)[0] if layout.BUILT.fullmatch(name)}
