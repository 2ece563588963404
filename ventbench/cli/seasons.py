"""``ventbench board new-season``, ``seal-reference``, ``reveal``: draws hidden for a season."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

Folder = Annotated[
    Path,
    typer.Option(
        "--folder", metavar="DIR", help="Folder of the leaderboard; default: leaderboard."
    ),
]
SeedFile = Annotated[
    Path | None,
    typer.Option(
        "--seed", metavar="FILE", help="Secret seed of the season, to look into sealed records."
    ),
]
FOLDER = Path("leaderboard")


def seed_of(path: Path | None) -> bytes | None:
    """Read a file of a secret seed; None where there is none."""
    from ventbench import seasons

    return None if path is None else seasons.read_seed(path)


def new_season(
    season: Annotated[str, typer.Argument(help="Name: lower-case letters, digits, hyphens.")],
    seed: Annotated[
        Path,
        typer.Option(metavar="FILE", help="New file for the secret seed; outside of --folder."),
    ],
    opens: Annotated[str, typer.Option(metavar="DATE", help="First day of scores, UTC.")],
    closes: Annotated[str, typer.Option(metavar="DATE", help="Last day of scores, UTC.")],
    protocol: Annotated[int, typer.Option(min=1, help="Version of the protocol.")] = 2,
    draws: Annotated[int, typer.Option(min=1, help="Number of hidden draws.")] = 20,
    runs_per_week: Annotated[
        int, typer.Option(min=1, help="Official scores of an author in a calendar week.")
    ] = 3,
    folder: Folder = FOLDER,
) -> None:
    """Open a season: a secret seed, and a season file with the commitment to it.

    The season file is for everybody, the seed for the scorer alone until the season is over.

    Example: `ventbench board new-season 2027-spring --opens 2027-03-01 --closes 2027-06-30
    --seed ~/2027-spring.seed`
    """
    from datetime import date

    from ventbench import seasons
    from ventbench.board import store
    from ventbench.errors import InputError

    try:
        days = {"opens": date.fromisoformat(opens), "closes": date.fromisoformat(closes)}
    except ValueError as error:
        raise InputError(f"--opens and --closes need days such as 2027-03-01: {error}") from None
    if seed.resolve().is_relative_to(folder.resolve()):
        raise InputError(f"{seed} lies in {folder}, which is published; choose another place")
    path = store.season_path(folder, season)
    if path.exists():
        raise InputError(f"{path} exists; a season is opened once")
    opened, secret = seasons.new_season(
        id=season, protocol=protocol, draws=draws, runs_per_week=runs_per_week, **days
    )
    # The seed first: a season whose seed is lost can never be verified.
    seasons.write_seed(seed, secret)
    seasons.write_season(path, opened)
    typer.echo(f"secret seed: {seed}; back it up, and show it to nobody before {opened.closes}")
    typer.echo(f"commitment: {opened.commitment}; {path} is to be published before the first score")


def seal_reference(
    season: Annotated[str, typer.Argument(help="Name of the season.")],
    reference: Annotated[Path, typer.Argument(help="File that `ventbench headroom` made.")],
    seed: Annotated[Path, typer.Option(metavar="FILE", help="File of the secret seed.")],
    folder: Folder = FOLDER,
) -> None:
    """Encrypt the reference errors of a season's draws, which official scores need.

    They tell the draws; they are readable for everybody once the seed is revealed.

    Example: `ventbench board seal-reference 2027-spring runs/2027-spring.npz
    --seed ~/2027-spring.seed`
    """
    from ventbench import seasons
    from ventbench.board import sealed, store
    from ventbench.headroom import reference as references

    known, secret = seasons.read_season(store.season_path(folder, season)), seasons.read_seed(seed)
    about = dict(references.load(reference).about["draws"] or {})
    if about.get("sha256") != known.commitment:
        from ventbench.errors import InputError

        raise InputError(
            f"{reference} is of other draws; make it with `ventbench headroom --season "
            f"{store.season_path(folder, season)} --seed {seed}`"
        )
    path = sealed.reference_path(folder, season)
    sealed.seal_reference(path, reference.read_bytes(), known, secret)
    typer.echo(f"{path} is to be published before the first score")


def reveal(
    season: Annotated[str, typer.Argument(help="Name of the season.")],
    seed: Annotated[Path, typer.Option(metavar="FILE", help="File of the secret seed.")],
    folder: Folder = FOLDER,
) -> None:
    """Publish the seed of a season that is over, and open all of its sealed records.

    Example: `ventbench board reveal 2027-spring --seed ~/2027-spring.seed`
    """
    from datetime import UTC, datetime

    from ventbench import seasons
    from ventbench.board import store
    from ventbench.errors import InputError
    from ventbench.plants import frozen
    from ventbench.text import plain

    secret = seasons.read_seed(seed)
    known = store.read_seasons(folder)
    if season in known and datetime.now(UTC).date() <= known[season].closes:
        raise InputError(
            f"season {season} is open until {known[season].closes}; its draws stay secret so long"
        )
    revealed = store.reveal(folder, season, secret, frozen.load)
    for score in revealed.opened:
        typer.echo(f"opened {score.name} ({score.track}): record {score.sha256}")
    for reason in revealed.void.values():
        typer.echo(f"void: {plain(reason)}")
    typer.echo(
        f"season {season} is revealed, {len(revealed.opened)} records opened, "
        f"{len(revealed.void)} void"
    )
    typer.echo("next: ventbench board build")


def register(parent: typer.Typer) -> None:
    """Add the commands to those of the leaderboard."""
    parent.command(name="new-season")(new_season)
    parent.command(name="seal-reference")(seal_reference)
    parent.command()(reveal)
