"""Train the classifier among the diagnosers on simulated recordings; writes its weights.

Recordings are drawn from all three generators, in the shares of a challenge, with seeds that are no
challenge's; from each, summaries of two thirds of its breaths are taken as well as those of all.
Each network leaves out another tenth of the recordings, which ends its training; the printed log
loss is theirs.

Usage:

    python benchmarks/train_classifier.py [--faults 120] [--first 220] [--stranger 220]
"""

from __future__ import annotations

import hashlib
import json
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import typer

from hardware_eval.emulation.cases import random_generator
from proofs import code_version
from proofs.challenge.contract import TERMS
from proofs.challenge.first import rig
from proofs.challenge.generators import generator
from proofs.challenge.make import record_within_limits
from proofs.challenge.stranger import laboratory
from proofs.challenge.truth import concealed
from proofs.diagnosers.classifier import WEIGHTS, summaries
from ventbench.base.errors import InputError

#: Coarse integration, since networks see summaries only.
RECORD = {"first": partial(rig.record, steps=6), "stranger": partial(laboratory.record, steps=32)}

#: Networks, hidden units, weight of all weights, steps and size of each, seed of the starts.
NETWORKS, HIDDEN, DECAY, STEPS, RATE, SEED = 4, 64, 2e-3, 800, 3e-3, 20261127

TERM = sorted(TERMS)


def drawn(world: str, count: int) -> Iterator[tuple[list[np.ndarray], list[bool]]]:
    """Summaries of recordings, two rows each, and which terms are right."""
    secret = f"training of a classifier, {world}"
    began = time.process_time()
    plan = generator(world).draw("all", count, random_generator(secret, "plan"))
    for k, question in enumerate(plan):
        case = replace(question, case=replace(question.case, name=f"case_{k:04d}"))
        try:
            breaths = record_within_limits(secret, case, gentle=2, record=RECORD.get(world))
        except InputError:
            continue
        some = random_generator(secret, case.case.name).random(len(breaths)) < 2 / 3
        some[:: max(len(breaths) // 8, 1)] = True
        truth = concealed(case, [np.inf] * len(case.case.effects))
        right = {min(effect.terms, key=lambda t: (":" in t, t)) for effect in truth}
        yield [summaries(breaths), summaries(breaths.select(some))], [t in right for t in TERM]
    spent = time.process_time() - began
    print(f"{world}: {count} recordings, {spent:.0f} s of processor time", file=sys.stderr)


def trained(x: np.ndarray, y: np.ndarray, apart: np.ndarray, key: jax.Array) -> dict[str, Any]:
    """Weights of a network at the step that is best on the rows left out, and its loss there."""
    keys = jax.random.split(key)
    weights: Any = {
        "w1": jax.random.normal(keys[0], (x.shape[1], HIDDEN)) / x.shape[1] ** 0.5,
        "b1": jnp.zeros(HIDDEN),
        "w2": 0.1 * jax.random.normal(keys[1], (HIDDEN, y.shape[1])) / HIDDEN**0.5,
        "b2": jnp.full(y.shape[1], -3.5),
    }
    weights = jax.tree.map(lambda w: w.astype(jnp.float32), weights)

    def loss(weights: Any, x: Any, y: Any) -> jax.Array:
        logits = jnp.tanh(x @ weights["w1"] + weights["b1"]) @ weights["w2"] + weights["b2"]
        return optax.sigmoid_binary_cross_entropy(logits, y).sum(axis=1).mean()

    optimiser = optax.adamw(optax.cosine_decay_schedule(RATE, STEPS), weight_decay=DECAY / RATE)
    state, own, check = optimiser.init(weights), (x[~apart], y[~apart]), jax.jit(loss)

    @jax.jit
    def step(weights: Any, state: Any) -> tuple[Any, Any]:
        updates, state = optimiser.update(jax.grad(loss)(weights, *own), state, weights)
        return optax.apply_updates(weights, updates), state

    best = {"loss": np.inf}
    for k in range(STEPS):
        weights, state = step(weights, state)
        if k % 20 == 19 and (value := float(check(weights, x[apart], y[apart]))) < best["loss"]:
            best = {"loss": value, **weights}
    return best


def main(faults: int = 120, first: int = 220, stranger: int = 220) -> None:
    """Train the classifier among the diagnosers; the options are numbers of recordings."""
    counts = {"faults": faults, "first": first, "stranger": stranger}
    began = time.process_time()
    every = [row for world, count in counts.items() for row in drawn(world, count)]
    x = np.array([row for rows, _ in every for row in rows])
    y = np.repeat(np.array([right for _, right in every], np.float32), 2, axis=0)
    mean, sd = np.median(x, axis=0), x.std(axis=0) + 1e-3
    z = np.clip((x - mean) / sd, -4.0, 4.0).astype(np.float32)
    group = np.repeat(np.random.default_rng(SEED).permutation(len(every)) % 10, 2)
    keys = jax.random.split(jax.random.key(SEED), NETWORKS)
    found = [trained(z, y, group == k, keys[k]) for k in range(NETWORKS)]
    frequency = y.mean(axis=0).clip(1e-3)
    alone = -(y * np.log(frequency) + (1 - y) * np.log1p(-frequency)).sum(axis=1).mean()
    about = {
        "code": code_version(),
        "recordings": counts,
        "seed": SEED,
        "processor seconds": round(time.process_time() - began),
        "log loss of terms left out, nats": [round(each["loss"], 3) for each in found],
        "by frequencies alone": round(float(alone), 3),
    }
    plain: dict[str, Any] = {
        name: np.stack([np.asarray(each[name], np.float32) for each in found])
        for name in ("w1", "b1", "w2", "b2")
    }
    np.savez_compressed(
        WEIGHTS,
        **plain,
        mean=mean,
        sd=sd,
        terms=TERM,
        about=json.dumps(about),
    )
    print(f"{WEIGHTS}: {hashlib.sha256(WEIGHTS.read_bytes()).hexdigest()} {about}")


if __name__ == "__main__":
    typer.run(main)
