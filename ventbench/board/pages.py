"""What all pages share: the template environment, style and script, addresses, and their policy.

Pages stand alone: no network, no cookie, no address outside the leaderboard. The policy in their
head allows the one style and the one script that are in them, by hash; all text of records is
escaped by the templates and printable.
"""

from __future__ import annotations

import base64
import functools
import hashlib
from collections.abc import Sequence
from importlib import resources
from typing import TYPE_CHECKING, Any

from ventbench import protocol
from ventbench.board import text
from ventbench.extras import require

if TYPE_CHECKING:
    import jinja2

#: Version that this ventbench scores.
CURRENT = protocol.VERSION

TITLES = {"performance": "Performance", "robustness": "Robustness"}


def environment() -> jinja2.Environment:
    """Make the template environment; every value is escaped.

    Raises:
        InputError: if jinja2 is not installed.
    """
    require("jinja2")
    import jinja2

    made = jinja2.Environment(
        loader=jinja2.PackageLoader("ventbench.board"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=text.plain,
    )
    style, script = (_asset(name) for name in ("board.css", "board.js"))
    made.globals.update(
        style=trusted(style),
        script=trusted(script),
        policy=(
            f"default-src 'none'; style-src 'sha256-{_hash(style)}'; "
            f"script-src 'sha256-{_hash(script)}'; base-uri 'none'; form-action 'none'"
        ),
    )
    return made


def version_path(version: int, versions: Sequence[int]) -> str:
    """Address of a version's board; the newest one is the front page.

    Args:
        version: of the protocol.
        versions: all of them, newest first.
    """
    return "index.html" if version == versions[0] else f"version-{version}.html"


def entry_path(version: int, track: str, name: str) -> str:
    """Address of an entry; names are checked when records are read."""
    return f"entries/v{version}/{track}/{name}.html"


@functools.cache
def _asset(name: str) -> str:
    return resources.files("ventbench.board").joinpath("templates", name).read_text("utf-8")


def _hash(content: str) -> str:
    return base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()


def trusted(content: str) -> Any:
    """Mark text of our own making, in which nothing comes from a record, as not to be escaped."""
    from markupsafe import Markup

    return Markup(content)
