"""Files about one device: hashed, dated, and of no use once the device is another.

What was measured on a device, or confirmed at it, holds as long as its number and its calibration
are those that it tells, and for :data:`STALE` days.
"""

from __future__ import annotations

import datetime
import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ventbench.base import files
from ventbench.base.errors import InputError

#: Age from which what was measured or confirmed must be so again, days.
STALE = 30.0


def today() -> datetime.datetime:
    """The time of the computer."""
    return datetime.datetime.now(datetime.UTC)


def save(path: Path, content: dict[str, Any]) -> str:
    """Write JSON values with their SHA-256, which is returned; the format is one of them."""
    plain = files.json_values(content)
    digest = _digest(plain)
    files.write_json(path, {**plain, "sha256": digest})
    return digest


def load(path: Path, form: str, device: Mapping[str, str], remedy: str) -> dict[str, Any]:
    """Read what :func:`save` wrote, its hash included.

    Args:
        path: of the file.
        form: its format.
        device: what the device says that it is: its number, and the hash of wiring and
            calibration.
        remedy: the command that makes such a file.

    Raises:
        InputError: if it is none, was changed, or is of another device.
    """
    try:
        content = json.loads(path.read_text("utf-8"))
        digest, of = content.pop("sha256"), dict(content["device"])
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is no such file"
        raise InputError(f"{path} cannot be read: {reason}; make one by `{remedy}`") from None
    if digest != _digest(content) or content.get("format") != form:
        raise InputError(f"{path} was changed after it was written; run `{remedy}` again")
    if of != device:
        raise InputError(
            f"{path} is of device {of.get('device_id')} or of other settings of it, not of this "
            f"{device['device_id']}; run `{remedy}`"
        )
    return {**content, "sha256": digest}


def check_age(date: str, what: str, remedy: str) -> None:
    """Raise InputError if a date, ISO 8601, is too old, or lies ahead."""
    try:
        age = (today() - datetime.datetime.fromisoformat(date)).total_seconds() / 86400.0
    except (TypeError, ValueError) as error:
        raise InputError(f"{what} has no date ({error}); run `{remedy}` again") from None
    if not -1.0 <= age <= STALE:
        raise InputError(
            f"{what} is {age:.0f} days old, {STALE:g} are allowed; run `{remedy}` again"
        )


def _digest(content: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
