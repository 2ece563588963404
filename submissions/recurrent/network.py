"""The network: an encoder of whole breaths and a recurrent feedback, for numpy and for JAX alike.

Functions take any batch shape ``(...)`` and ``xp``, which is ``numpy`` or ``jax.numpy``.
"""

#: Readings of an inspiration, and commands that move one of them.
READINGS, COMMANDS = 34, 33

#: Breaths before the last of a run, whose commands and readings are encoded.
BEFORE = 2

#: Units of the encoder and of the feedback's memory; terms of the linear feedback.
WIDTH, MEMORY, TERMS = 192, 24, 3

#: Numbers that the encoder reads, and numbers of a step that the feedback reads.
INPUTS, SEEN = BEFORE * (READINGS + COMMANDS + 1) + 3, 9

#: What the encoder gives, in order, with the shape of each.
OUTPUTS = {
    "plan": (COMMANDS,),
    "expected": (READINGS,),
    "gains": (TERMS, COMMANDS),
    "context": (2 * MEMORY,),
}

#: Scales: % of commands, cmH2O of pressures.
COMMAND, PRESSURE = 50.0, 10.0

#: Share of the sum of surprises that is kept from step to step.
KEPT = 0.9

#: The valve is shut while a reading is above this, cmH2O, or as much above the target.
CAP, ROOM = 50.0, 9.0


def features(xp, commands, readings, done, target, dt, first):
    """What the encoder reads.

    Args:
        xp: see the module.
        commands: of the two breaths before, %, zero where not yet done, ``(..., 2, COMMANDS)``.
        readings: of these, cmH2O, zero where not yet done, ``(..., 2, READINGS)``.
        done: whether each is done, 0/1, ``(..., 2)``.
        target: cmH2O, ``(...)``.
        dt: control step, s, ``(...)``.
        first: first reading of this breath, cmH2O, ``(...)``.

    Returns:
        Shape ``(..., INPUTS)``.
    """
    whole = done[..., None]
    u = whole * (commands / COMMAND - 0.4)
    p = whole * ((readings - target[..., None, None]) / PRESSURE)
    flat = (*target.shape, -1)
    now = [(target - 20.0) / PRESSURE, (dt / 0.03 - 1.0) / 0.05, (first - 5.0) / 0.5]
    return xp.concatenate([u.reshape(flat), p.reshape(flat), done, xp.stack(now, -1)], -1)


def silu(xp, x):
    return 0.5 * x * (1.0 + xp.tanh(0.5 * x))


def encode(xp, weights, x, target):
    """Plan of a breath, %; readings that it expects, cmH2O; gains of the feedback; its context."""
    hidden = silu(xp, x @ weights["in"] + weights["in_bias"])
    for k in range(2):
        hidden = hidden + silu(xp, hidden @ weights[f"deep{k}"] + weights[f"deep{k}_bias"])
    out = hidden @ weights["out"] + weights["out_bias"]
    parts, at = {}, 0
    for name, shape in OUTPUTS.items():
        size = shape[0] * (shape[1] if len(shape) > 1 else 1)
        parts[name] = out[..., at : at + size].reshape(*out.shape[:-1], *shape)
        at += size
    parts["plan"] = COMMAND * parts["plan"]
    parts["expected"] = target[..., None] + PRESSURE * parts["expected"]
    return hidden, parts


def begin(xp, shape):
    """State of the feedback before a breath: memory, last surprises and last deviations.

    Here and below features lie on the leading axis and ``shape`` is that of the batch: then every
    operation of a batch runs over contiguous numbers.
    """
    zero = xp.zeros(shape)
    return xp.zeros((MEMORY, *shape)), (zero, zero, zero), (zero, zero)


def feedback(xp, weights, state, reading, target, plan, step):
    """Correct the plan by what differs from what was expected.

    Args:
        xp: see the module.
        weights: of the network.
        state: from :func:`begin` or :func:`remember`.
        reading: cmH2O, ``(...)``.
        target: cmH2O, ``(...)``.
        plan: command of this step, of the next, expected reading, ``(...)``, gains, ``(TERMS,
            ...)``, and context, ``(2 * MEMORY, ...)``.
        step: biases of this step, ``(2 * MEMORY,)``.

    Returns:
        The command, %, not bounded, ``(...)``, and the state that :func:`remember` takes.
    """
    memory, (last, before, kept), deviations = state
    now, following, expected, gains, context = plan
    surprise = reading - expected
    kept = KEPT * kept + surprise
    seen = [
        *(xp.arcsinh(x) for x in (surprise, last, before, kept, target - reading)),
        *(0.1 * x for x in deviations),
        now / COMMAND,
        following / COMMAND,
    ]
    x = xp.concatenate([xp.stack(seen), memory])
    gates = weights["gates"] @ x + context + step.reshape(-1, *[1] * (memory.ndim - 1))
    new = xp.tanh(gates[MEMORY:])
    memory = memory + 0.5 * (1.0 + xp.tanh(gates[:MEMORY])) * (new - memory)
    linear = gains[0] * surprise + gains[1] * last + gains[2] * kept
    asked = now + 10.0 * (weights["correct"] @ memory + linear)
    return asked, (memory, (surprise, last, kept), deviations)


def remember(state, command, plan):
    """The state with what was applied instead of the plan, %."""
    memory, surprises, deviations = state
    return memory, surprises, (command - plan, deviations[0])
