"""What comes when nothing was asked for is found at every moment, by words that tell which."""

import os
import time

import pytest

from ventbench.sandbox.child import wire
from ventbench.sandbox.pipes import Pipes

PATIENCE_S = 300.0


@pytest.fixture
def pipes():
    pipes = Pipes()
    yield pipes
    pipes.close_all()


@pytest.fixture
def cell(pipes):
    """Open a cell's pipes; returns the end that the cell writes its replies to."""
    opened = []

    def make(number):
        pipes.open(number, lambda far: opened.append(os.dup(far[1])))
        return opened[-1]

    yield make
    for descriptor in opened:
        os.close(descriptor)


def reply(sequence):
    return wire.pack_reply(sequence, wire.COMMAND, 50.0)


def collect(pipes, due, sequence):
    deadline = time.monotonic() + PATIENCE_S
    return pipes.collect(due, [sequence] * 2, wire.COMMAND, PATIENCE_S, deadline)


def test_between_two_observations(pipes, cell):
    own = cell(0)
    os.write(own, reply(1))
    assert collect(pipes, {0}, 1)[0].value == 50.0
    assert pipes.early() == {}
    os.write(own, reply(1))
    assert str(pipes.early()[0]) == "bytes came after the reply"


def test_while_another_cell_is_due(pipes, cell):
    own, other = cell(0), cell(1)
    os.write(own, reply(1))
    assert collect(pipes, {0}, 1)[0].value == 50.0
    os.write(own, reply(1))
    os.write(other, reply(1))
    # Both have written: the one that was not due is read in the same turn.
    found = collect(pipes, {1}, 1)
    assert str(found[0]) == "bytes came after the reply"
    assert found[1].value == 50.0


def test_with_the_reply(pipes, cell):
    os.write(cell(0), reply(1) * 2)
    assert "bytes" in str(collect(pipes, {0}, 1)[0])


def test_instead_of_the_next_reply(pipes, cell):
    os.write(cell(0), reply(1))
    assert str(collect(pipes, {0}, 2)[0]) == "a reply to observation 1 came, not to 2"


def test_silence_is_waited_out(pipes, cell):
    cell(0)
    due = {0}
    before = time.monotonic()
    assert pipes.collect(due, [1], wire.COMMAND, 0.05, float("inf")) == {}
    assert due == {0}
    assert time.monotonic() - before >= 0.05


def test_some_are_taken_without_the_others(pipes, cell):
    own, _ = cell(0), cell(1)
    os.write(own, reply(3))
    due = {0, 1}
    found = pipes.collect(due, [3, 7], wire.COMMAND, PATIENCE_S, float("inf"), some=True)
    assert found[0].value == 50.0
    assert due == {1}, "it may take its time"
    os.write(own, reply(3))
    assert set(pipes.early({1})) == {0}


def test_a_deadline_ends_patience(pipes, cell):
    cell(0)
    assert pipes.collect({0}, [1], wire.COMMAND, 300.0, time.monotonic() + 0.05) == {}


def test_an_ended_cell_is_none(pipes):
    pipes.open(0, lambda far: None)
    assert pipes.early() == {0: None}
