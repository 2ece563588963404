"""Assembles a filter of system calls: classic BPF over the kernel's ``struct seccomp_data``.

A filter is a list of rules tried in order; the first rule whose call and arguments match decides,
and what no rule matches gets the default. Calls of another architecture's table kill the process.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from typing import NamedTuple

ALLOW, KILL = 0x7FFF0000, 0x80000000

_LOAD, _AND, _RETURN = 0x20, 0x54, 0x06  # ld [k]; and #k; ret #k
_EQUAL, _AT_LEAST = 0x15, 0x35  # jeq #k, true, false; jge
_NUMBER, _ARCHITECTURE, _ARGUMENTS = 0, 4, 16  # offsets in struct seccomp_data

#: Name of the architecture in the kernel's audit table.
AUDIT = {"x86_64": 0xC000003E, "aarch64": 0xC00000B7}

#: x86-64 answers to a second table of calls (x32) from here on.
_X32 = 0x40000000


def errno_action(error: int) -> int:
    """Action: the call fails with this error number."""
    return 0x00050000 | error


class Check(NamedTuple):
    """Holds when ``argument & mask`` is one of the values.

    Attributes:
        argument: index of the argument.
        values: what may be left.
        mask: bits of its lower 32 that count.
        whole: the upper 32 bits must be zero (pointers); elsewhere the kernel drops them.
    """

    argument: int
    values: Sequence[int]
    mask: int = 0xFFFFFFFF
    whole: bool = False


class Rule(NamedTuple):
    """For one call: the action if all checks hold; else later rules are tried."""

    number: int
    action: int
    checks: tuple[Check, ...] = ()


def _instruction(code: int, k: int, true: int = 0, false: int = 0) -> bytes:
    return struct.pack("<HBBI", code, true, false, k)


def _check(check: Check, skip: int) -> list[bytes]:
    """Instructions of a check: fall through if it holds, else jump over ``skip`` more."""
    low = _ARGUMENTS + 8 * check.argument
    code = [_instruction(_LOAD, low), _instruction(_AND, check.mask)]
    for left, value in zip(range(len(check.values) - 1, -1, -1), check.values, strict=True):
        # A match jumps over the other values; the last one that fails leaves the rule.
        code.append(_instruction(_EQUAL, value, left, 0 if left else skip))
    if check.whole:
        # Checked first, so that its failure skips the code above too.
        high = [_instruction(_LOAD, low + 4), _instruction(_EQUAL, 0, 0, len(code) + skip)]
        code = high + code
    return code


def _rule(rule: Rule) -> list[bytes]:
    body = [_instruction(_RETURN, rule.action)]
    for check in reversed(rule.checks):
        body = _check(check, len(body)) + body
    reload = [_instruction(_LOAD, _NUMBER)] if rule.checks else []
    # The accumulator holds the number again for the next rule, whichever way this one is left.
    return [_instruction(_EQUAL, rule.number, 0, len(body)), *body, *reload]


def assemble(machine: str, rules: Iterable[Rule], default: int) -> bytes:
    """Return the filter as an array of ``struct sock_filter``.

    Args:
        machine: ``"x86_64"`` or ``"aarch64"``.
        rules: tried in order.
        default: action for calls that no rule decides.
    """
    kill = _instruction(_RETURN, KILL)
    code = [_instruction(_LOAD, _ARCHITECTURE), _instruction(_EQUAL, AUDIT[machine], 1, 0), kill]
    code.append(_instruction(_LOAD, _NUMBER))
    if machine == "x86_64":
        code += [_instruction(_AT_LEAST, _X32, 0, 1), kill]
    for rule in rules:
        code += _rule(rule)
    code.append(_instruction(_RETURN, default))
    if len(code) > 4096:
        raise ValueError(f"a filter of {len(code)} instructions; the kernel takes 4096")
    return b"".join(code)
