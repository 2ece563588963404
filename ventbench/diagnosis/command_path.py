"""Commands as they reached the valve: some were lost, or came late and were overtaken.

A command that is lost leaves the valve at the one before. One that is late by ``lag`` samples acts
only if none that was sent after it has arrived. At each sample the valve thus either follows or
keeps what it has, and readings up to the next sample depend on no later command: a search from
sample to sample that keeps the likeliest paths (a beam) has their exact likelihoods. The sum over
the paths that are kept is a lower bound of the likelihood with all of them.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ventbench.diagnosis.hypothesis import Partition
from ventbench.diagnosis.input_response import SUPPLY, input_responses
from ventbench.system_id.data import Floats
from ventbench.system_id.problem import Problem

#: Paths that are kept in each breath, and difference of commands, %, that is none.
_PATHS, _SAME = 6, 0.3


class Paths(NamedTuple):
    """What lost or late commands do for n breaths."""

    nats: Floats  #: log-likelihood with them, ``(n,)``.
    u_in: Floats  #: commands on the likeliest path, %, ``(n, T)``.
    kept: Floats  #: at how many samples the valve did not follow a new command, ``(n,)``.
    sent: Floats  #: how many new commands there were, ``(n,)``.


def follow(
    problem: Problem, x: Floats, partition: Partition, share: float, lag: int | None
) -> Paths:
    """Find the commands that reached the valve.

    Args:
        problem: problem of the breaths with the commands that were sent.
        x: its unknowns, ``(U,)``.
        partition: the breaths.
        share: share of the commands that are lost or late.
        lag: samples by which a command is late; None if it is lost.
    """
    data, noise = partition.data, problem.noise
    n, samples = data.u_in.shape
    unit = replace(partition, data=replace(data, u_in=np.ones_like(data.u_in)))
    by_command = np.zeros((n, samples, samples))  # (n, command, reading)
    by_command[:, :-1] = input_responses(unit, problem.values(x), SUPPLY)[:, 1:]
    white = noise.whiten(by_command[:, :, None], data.weight)[:, :, 0]
    first = noise.whiten(problem.residual(x), data.weight)
    left = np.repeat(first, _PATHS, axis=1)  # (n, b, T)
    score = np.full((n, _PATHS), -np.inf)
    score[:, 0] = 0.0
    path, held = np.zeros((n, _PATHS, samples)), np.zeros((n, _PATHS), int)
    rows = np.arange(n)[:, None]
    kept = np.zeros((n, _PATHS))
    for k in range(samples - 1):
        sent = data.u_in[:, k, None]
        valve = path[:, :, k - 1] if k else np.zeros((n, _PATHS))
        if lag is not None and k >= lag:  # the late one arrives, as none has overtaken it
            valve = np.where(held >= lag, data.u_in[:, k - lag, None], valve)
        new = np.abs(valve - sent) > _SAME
        moved = np.concatenate([np.zeros_like(valve), valve - sent], axis=1)
        prior = np.concatenate(
            [np.where(new, np.log1p(-share), 0.0), np.where(new, np.log(share), -np.inf)], axis=1
        )
        both = np.concatenate([left, left], axis=1)[:, :, k + 1] + moved * white[:, k, None, k + 1]
        total = np.concatenate([score, score], axis=1) + prior - noise.loss(both)
        best = np.argsort(-total, axis=1)[:, :_PATHS]
        parent, moved = best % _PATHS, np.take_along_axis(moved, best, axis=1)
        stays = best >= _PATHS
        score = np.take_along_axis(total, best, axis=1)
        left = left[rows, parent] + moved[:, :, None] * white[:, k, None]
        path, kept = path[rows, parent], kept[rows, parent] + stays
        path[:, :, k] = sent + moved
        held = np.where(stays, held[rows, parent] + 1, 0)
    path[:, :, -1] = data.u_in[:, -1:]
    changes = np.abs(np.diff(data.u_in[:, :-1], axis=1, prepend=0.0)) > _SAME
    constant = noise.log_scale(data.weight) + data.weight.sum(axis=(1, 2)) * noise.log_norm()
    nats = np.logaddexp.reduce(score, axis=1) - noise.loss(first[:, 0, 0]) - constant
    return Paths(nats, path[:, 0], kept[:, 0], changes.sum(axis=1))
