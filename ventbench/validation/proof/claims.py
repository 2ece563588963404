"""What the proof claims, computed from the figures of its parts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ventbench.validation.proof.figures import named

#: Least cut of the error by named physics alone, %.
CUT = 60.0


@dataclass(frozen=True)
class Claim:
    """One claim.

    Attributes:
        part: whose figures it is about.
        what: that is claimed.
        value: what came out, in words.
        met: whether it holds.
    """

    part: str
    what: str
    value: str
    met: bool


def claims(parts: Mapping[str, Mapping[str, Any]], impossible: Mapping[str, str]) -> list[Claim]:
    """Judge what is finished.

    Args:
        parts: figures by name.
        impossible: why a part could not be set up, by name.
    """
    made = []
    if "rc" in parts:
        share = parts["rc"]["cut_percent"]
        value = "not known" if share is None else f"{share:.0f} %"
        what = f"held-out error cut by at least {CUT:g} % by named physics alone"
        made.append(Claim("rc", what, value, share is not None and share >= CUT))
    for name in ("removed", "injected"):
        if name in parts:
            made.append(_found(name, parts))
        elif name in impossible:
            made.append(Claim(name, "what was removed is named again", impossible[name], False))
    return made


def _found(name: str, parts: Mapping[str, Mapping[str, Any]]) -> Claim:
    part = parts[name]
    wanted = part["wanted"]
    item = named(part["mechanisms"], wanted)
    value = _estimate(item) if item else f"not named; named: {_names(part['mechanisms'])}"
    if name == "injected" and "frozen" in parts:
        # What the same simulators lack on the same breaths before anything was injected.
        control = named(parts["frozen"]["mechanisms"], wanted)
        value += f"; without injection {_estimate(control) if control else 'not named'}"
    return Claim(name, f"{wanted} is named", value, item is not None)


def _estimate(item: Mapping[str, Any]) -> str:
    said = []
    for name, one in item["parameters"].items():
        unit = "" if one["unit"] == "1" else f" {one['unit']}"
        low, high = one["ci95"]
        said.append(f"{name} {one['value']:.3g}{unit} [{low:.3g}, {high:.3g}]")
    return (", ".join(said) or "named") + _others(item)


def _names(mechanisms: list[dict[str, Any]]) -> str:
    return ", ".join(f"{item['name']}{_others(item)}" for item in mechanisms) or "nothing"


def _others(item: Mapping[str, Any]) -> str:
    """Names that the recording cannot tell from it."""
    return f" (or {', '.join(item['alternatives'])})" if item["alternatives"] else ""
