from __future__ import annotations

import hashlib
from dataclasses import replace

import pytest

from hardware_eval.emulation.cases import random_generator
from proofs.challenge.folder import decode_answers, encode_answers
from proofs.challenge.generators import FIRST, GENERATORS
from proofs.challenge.seal import commitment, encrypt, unseal
from ventbench.base.errors import InputError


def answers(secret="s"):
    drawn = FIRST.draw("all", 12, random_generator(secret, "plan"))
    return drawn, encode_answers(secret, drawn)


def test_answers_come_back():
    drawn, text = answers()
    assert [d for d, _ in decode_answers(text)] == drawn


def test_the_seal_hides_and_opens():
    _, text = answers()
    data = encrypt(text, "s", b"public")
    assert b"kind" not in data
    assert len(set(data)) > 250  # looks random
    promised = hashlib.sha256(text).hexdigest()
    assert unseal(data, "s", b"public", promised) == text


@pytest.mark.parametrize(("secret", "public"), [("t", b"public"), ("s", b"other")])
def test_another_secret_does_not_open_it(secret, public):
    _, text = answers()
    data = encrypt(text, "s", b"public")
    with pytest.raises(InputError, match="was published"):
        unseal(data, secret, public, commitment(text))


def test_changed_answers_break_the_commitment():
    _, text = answers()
    data = encrypt(text.replace(b"mild", b"strong", 1), "s", b"")
    with pytest.raises(InputError, match="was published"):
        unseal(data, "s", b"", commitment(text))


def test_random_numbers_differ_by_secret_and_purpose():
    first = random_generator("a", "x").integers(2**62)
    assert first == random_generator("a", "x").integers(2**62)
    assert first != random_generator("a", "y").integers(2**62)
    assert first != random_generator("b", "x").integers(2**62)


def test_the_commitment_holds_nothing_that_a_machine_computes():
    """What is lost without an effect is fitted, and differs in its digits between machines."""
    _, text = answers()
    assert b"nats" not in text
    old = text.replace(b'"case"', b'"nats": [30.0],\n   "case"')  # as before: still to be read
    assert unseal(encrypt(old, "s", b"p"), "s", b"p", hashlib.sha256(old).hexdigest()) == old
    assert {nats for _, nats in decode_answers(old)} == {(30.0,)}
    assert {nats for _, nats in decode_answers(text)} == {()}


@pytest.mark.parametrize(
    ("source", "seed", "commitment_of"),
    [
        (
            "faults",
            "qdv1clvqT2RP8yWl",
            "3ea1b2a5d817cfd4f13018e1c18087d290f0e77a7166b5fb7015802a037149a2",
        ),
        (
            "first",
            "-JnWeAhWc3fMoYTn",
            "76f3e0a1e0a3399ab36e79727d15bddd978391d5114f0541f75180b3d0b634e0",
        ),
        (
            "stranger",
            "UQYGafmCqtl3Az9i",
            "6b4ef2dfe5e2227f62d6d0092b2b72203988d8cd2bf19552d17a38eb33359c11",
        ),
    ],
)
def test_the_published_draws_have_these_commitments_on_every_machine(
    source: str, seed: str, commitment_of: str
) -> None:
    cases = GENERATORS[source].draw("all", 60, random_generator(seed, "plan"))
    drawn = [
        replace(x, case=replace(x.case, name=f"case_{k:04d}")) for k, x in enumerate(cases, start=1)
    ]
    assert commitment(encode_answers(seed, drawn)) == commitment_of
