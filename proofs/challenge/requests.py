"""Breaths that a diagnoser requests, recorded on the concealed rig of its case."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np

from hardware_eval.emulation.cases import random_generator
from proofs.challenge.contract import Answer
from proofs.challenge.folder import ChallengeFolder
from proofs.challenge.generators import generator_of
from ventbench.base.errors import InputError
from ventbench.recordings.breaths import join, write
from ventbench.recordings.read import load


def record(folder: ChallengeFolder, secret: str, diagnoser: str) -> list[str]:
    """Record the breaths that a diagnoser's answers request, and append them to the recordings.

    The withheld breaths stay withheld. A request whose breaths have another number of samples is
    cut or continued with its last command.

    Args:
        folder: first round of a challenge.
        secret: secret of the challenge.
        diagnoser: name of the diagnoser.

    Returns:
        Names of the cases with a request.

    Raises:
        InputError: if the secret is another one, or there are no answers.
    """
    second, names = ChallengeFolder(folder.path, 2), []
    answers = folder.answers(diagnoser)
    if not answers:
        raise InputError(f"{folder.path} has no answers of {diagnoser}; run `answer` first")
    for drawn, _ in folder.truth(secret):
        case = drawn.case
        given = answers.get(case.name, {}).get("answer")
        asked = () if given is None else msgspec.convert(given, Answer, strict=False).record_next
        if not asked:
            continue
        breaths = load(folder.recording(case.name))
        samples, dt = breaths.time.shape[1], float(np.median(breaths.dt))
        ticks = np.arange(samples) * dt
        time, u_in, u_out = np.zeros((3, len(asked), samples))
        for k, commands in enumerate(asked):
            at = np.searchsorted(commands.time, ticks + 1e-9, side="right") - 1
            time[k] = ticks
            u_in[k], u_out[k] = np.array(commands.u_in)[at], np.array(commands.u_out)[at]
        rng = random_generator(secret, "second recording", case.name)
        more = generator_of(case).record_commands(case, time, u_in, u_out.astype(np.int8), rng)
        number = breaths.breath_id.max() + 1 + np.arange(len(asked))
        both = join([breaths, replace(more, breath_id=number)])
        write(both, second.recording(case.name, diagnoser))
        names.append(case.name)
    return names
