"""What is refused before anything of a record is used: every problem is an InputError."""

from __future__ import annotations

import json
import re
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ventbench.base.errors import InputError
from ventbench.board import canonical, record, schema


def _without(key: str):
    return lambda x: {k: v for k, v in x.items() if k != key}


WRONG: dict[str, tuple[Any, str]] = {
    "missing key": (_without("commands"), "missing required field `commands`"),
    "unknown key": (lambda x: {**x, "rank": 1}, "unknown field `rank`"),
    "name that leaves its folder": (
        lambda x: {
            **x,
            "submission": {
                **x["submission"],
                "manifest": {**x["submission"]["manifest"], "name": "../../index"},
            },
        },
        "key submission.manifest.name",
    ),
    "official without a sandbox": (lambda x: {**x, "sandbox": None}, "was not official"),
    "shape of gigabytes": (
        lambda x: {**x, "commands": {**x["commands"], "shape": [10**6] * 5}},
        "commands.shape",
    ),
    "flag as number": (lambda x: {**x, "official": 1}, "key official: Expected `bool`, got `int`"),
    "protocol 0": (lambda x: {**x, "protocol": 0}, "key protocol: Expected `int` >= 1"),
    "protocol of another time": (
        lambda x: {**x, "protocol": 1},
        f"key protocol: is 1; this ventbench reads records of protocol {schema.PROTOCOL} and no",
    ),
    "format of another time": (
        lambda x: {**x, "format": 1},
        "key format: is 1; this ventbench reads",
    ),
    "impossible date": (
        lambda x: {**x, "created": "0000-99-99T99:99:99Z"},
        "key created: 0000-99-99T99:99:99Z is no date and time",
    ),
    "29 February": (lambda x: {**x, "created": "2026-02-29T00:00:00Z"}, "is no date and time"),
    "no machine": (lambda x: {**x, "machine": {}}, "key machine.system: is missing or empty"),
    "blank machine": (
        lambda x: {**x, "machine": x["machine"] | {"kernel": " "}},
        "key machine.kernel",
    ),
    "no versions": (lambda x: {**x, "versions": {}}, "key versions.ventbench: is missing"),
    "invented hash of the submission": (
        lambda x: {**x, "submission": {**x["submission"], "sha256": "a" * 64}},
        "key submission.sha256: is not that of its files",
    ),
    "invented hashes of files": (
        lambda x: {**x, "submission": {**x["submission"], "files": {"controller.py": "x"}}},
        "key submission.files: controller.py has no SHA-256",
    ),
    "no files": (
        lambda x: {**x, "submission": {**x["submission"], "files": {}}},
        "controller.py is missing",
    ),
    "file outside": (
        lambda x: {
            **x,
            "submission": {
                **x["submission"],
                "files": {**x["submission"]["files"], "../x": "a" * 64},
            },
        },
        "'../x' is no path within a folder",
    ),
    "integer of 400 digits": (
        lambda x: {**x, "timing": {"act_median_us": 10**400}},
        "key timing: holds a whole number",
    ),
    "deep nesting": (
        lambda x: {**x, "machine": {"a": [[[[[[[[1]]]]]]]]}},
        "key machine: is nested more than 6 deep",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_malformed_record_is_refused(drafts, name: str) -> None:
    change, message = WRONG[name]
    values = change(json.loads(drafts["pid_best"].content))
    with pytest.raises(InputError, match=re.escape(message)):
        record.from_bytes(canonical.canonical(values), "it")


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"{",
        b"[]\n",
        b'{"a": 1}\n',
        b'{"a":1,"a":1}\n',
        b'{"a":NaN}\n',
        b"[" * 100_000,
        b"\xff",
    ],
)
def test_only_canonical_text_is_read(content: bytes) -> None:
    with pytest.raises(InputError):
        record.from_bytes(content, "it")


#: JSON that is meant to exhaust or to confuse a reader.
HOSTILE = {
    "digits": b"9" * 5000,
    "negative digits": b"-" + b"9" * 5000,
    "float beyond all floats": b"1e999",
    "fraction of many digits": b"0." + b"1" * 5000,
    "not a number": b"NaN",
    "infinity": b"-Infinity",
    "nesting of lists": b"[" * 100_000,
    "nesting of objects": b'{"a":' * 100_000,
    "closed nesting": b"[" * 900 + b"]" * 900,
    "half a surrogate": b'"\\ud800"',
    "bytes that are no text": b'"\xff\xfe"',
    "text without end": b'"' + b"x" * 5000 + b'"',
    "control characters": b'"\\u001b[2J\\u202e"',
}
PLACES = (
    "protocol",
    "created",
    "draws",
    "machine",
    "commands",
    "failures",
    "submission",
    "sandbox",
)


@pytest.mark.parametrize("place", [*PLACES, "no such key"])
@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_values_are_input_errors(drafts, name: str, place: str) -> None:
    values = json.loads(drafts["pid_best"].content)
    values[place] = "PLACE"
    content = canonical.canonical(values).replace(b'"PLACE"', HOSTILE[name])
    with pytest.raises(InputError) as caught:
        record.from_bytes(content, "it")
    assert str(caught.value).startswith("it")
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 1000


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_values_within_free_objects(drafts, name: str) -> None:
    values = json.loads(drafts["pid_best"].content)
    values["machine"] |= {"a": "PLACE"}
    content = canonical.canonical(values).replace(b'"PLACE"', HOSTILE[name])
    if name == "control characters":  # a text, which is fine
        assert isinstance(record.from_bytes(content, "it"), record.Record)
        return
    with pytest.raises(InputError) as caught:
        record.from_bytes(content, "it")
    assert str(caught.value).isprintable()


def test_a_message_names_a_hostile_key_printably_and_briefly(drafts) -> None:
    values = json.loads(drafts["pid_best"].content)
    values["\x1b[2J" + "k" * 10_000] = 1
    with pytest.raises(InputError) as caught:
        record.from_bytes(canonical.canonical(values), "it")
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 400


@settings(max_examples=60)
@given(st.binary(max_size=80))
def test_any_bytes_are_a_record_or_an_input_error(content: bytes) -> None:
    for read in (record.from_bytes, canonical.parse):
        with pytest.raises(InputError):
            read(b"{" + content, "it")
