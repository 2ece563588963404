from __future__ import annotations

import hashlib

import pytest

from hardware_eval.emulation.cases import commitment, encrypt, random_generator, unseal
from proofs.challenge.folder import decode_answers, encode_answers
from proofs.challenge.generators import FIRST
from ventbench.base.errors import InputError


def answers(secret="s"):
    drawn = FIRST.draw("all", 12, random_generator(secret, "plan"))
    return drawn, encode_answers(secret, drawn, [[30.0] * len(d.case.effects) for d in drawn])


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
