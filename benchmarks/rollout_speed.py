"""Speed of closed-loop rollouts of a PID on the plants, and of what limits them.

Prints environment steps/s of each plant in float32, milliseconds of one run of the frozen hybrid,
and the share that it reaches of its own roofline: the time that its operations would take at the
rates that vector kernels of the same operations reach in the same run. Usage:

    python benchmarks/rollout_speed.py [--batch 8192] [--small 1024] [--cpu-time]

With ``--cpu-time`` the clock counts the processor seconds of this process over all threads, so that
figures also hold on a busy machine; the rates are then those of one core.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import typer

from ventbench.controllers.pid import PID
from ventbench.plants import frozen
from ventbench.plants.single_compartment import single_compartment
from ventbench.plants.stacking import take
from ventbench.plants.two_balloon import two_balloon
from ventbench.task import protocol
from ventbench.task.environment import Scenario, nominal_scenario
from ventbench.task.interfaces import Plant
from ventbench.task.lungs import LUNGS
from ventbench.task.rollouts import closed_loop

#: Environment steps of one run, without its expirations.
STEPS = protocol.BREATHS * protocol.INSPIRATION_STEPS

#: Plants that are run; add a line for each new kind.
PLANTS: dict[str, Callable[[], Plant]] = {
    "single_compartment": lambda: single_compartment(LUNGS[4]),
    "two_balloon": lambda: two_balloon(LUNGS[4]),
    "frozen hybrid": lambda: take(frozen.load().plants, 4),
}

#: The clock in use.
_CLOCK = [time.perf_counter]


def seconds(run: Callable[[], Any]) -> float:
    """Return the time of one call by :data:`_CLOCK`, s, including its asynchronous work."""
    started = _CLOCK[0]()
    jax.block_until_ready(run())
    return _CLOCK[0]() - started


def cells(batch: int) -> tuple[PID, Scenario]:
    """Return random PIDs and their nominal cells, shape ``(batch,)``."""
    rng = np.random.default_rng(0)
    pid = PID(*(jnp.asarray(rng.uniform(0, 5, batch), jnp.float32) for _ in range(2)))
    return pid, nominal_scenario(np.resize(protocol.PIPS, batch))


#: Operations that cost more than an addition, by their names in a jaxpr; all others count as one.
DEAR = ("div", "sqrt", "exp", "tanh")


def operations(plant: Plant, batch: int) -> dict[str, int]:
    """Count the operations of one step on a batch: ``simple`` ones and each of :data:`DEAR`.

    What occurs twice with equal operands counts once, and what no cell differs in not at all.
    """
    state, _ = plant.init(jnp.full(batch, 5.0))
    command = jnp.full(batch, 20.0)
    dt = jnp.full(batch, protocol.DT)
    closed = jax.make_jaxpr(plant.step)(state, command, jnp.zeros(batch), dt)
    counts: dict[str, int] = dict.fromkeys(("simple", *DEAR), 0)
    names: dict[Any, Any] = {}
    seen: dict[Any, int] = {}

    def name(variable: Any) -> Any:
        return str(variable) if hasattr(variable, "val") else names.get(variable, variable)

    def visit(jaxpr: Any) -> None:
        for equation in jaxpr.eqns:
            inner = equation.params.get("jaxpr")
            if inner is not None:
                body = getattr(inner, "jaxpr", inner)
                names.update(zip(body.invars, map(name, equation.invars), strict=True))
                visit(body)
                names.update(zip(equation.outvars, map(name, body.outvars), strict=True))
                continue
            kind = equation.primitive.name
            key = (kind, str(equation.params), tuple(map(name, equation.invars)))
            first = seen.setdefault(key, len(seen))
            names.update({out: (first, k) for k, out in enumerate(equation.outvars)})
            # Moving data is no arithmetic.
            free = ("broadcast_in_dim", "convert_element_type", "squeeze", "reshape", "slice")
            if first == len(seen) - 1 and kind not in free and key not in counted:
                counted.add(key)
                if equation.outvars[0].aval.size >= batch:
                    counts[kind if kind in DEAR else "simple"] += 1

    counted: set[Any] = set()
    visit(closed.jaxpr)
    return counts


def vector_rates(batch: int, repeats: int = 200, chain: int = 8) -> dict[str, float]:
    """Return operations/s of this machine on vectors that stay in the cache, by kind."""
    kernels: dict[str, tuple[int, Callable[[jax.Array], jax.Array]]] = {
        "simple": (4, lambda x: jnp.minimum(jnp.maximum(x * 0.999 + 0.001, 0.1), 3.0)),
        "div": (1, lambda x: 1.7 / x),
        "sqrt": (1, jnp.sqrt),
        "exp": (1, lambda x: jnp.exp(-x)),
        "tanh": (1, jnp.tanh),
    }
    rates = {}
    x = jnp.linspace(0.5, 2.0, batch, dtype=jnp.float32)
    for name, (_, kernel) in kernels.items():

        @jax.jit
        def run(x: jax.Array, kernel: Callable[[jax.Array], jax.Array] = kernel) -> jax.Array:
            def body(_: int, x: jax.Array) -> jax.Array:
                for _ in range(chain):
                    x = kernel(x)
                return x

            return jax.lax.fori_loop(0, repeats, body, x)

        jax.block_until_ready(run(x))
        best = min(seconds(lambda run=run: run(x)) for _ in range(10))
        each = kernels[name][0] if name == "simple" else 1
        rates[name] = batch * repeats * chain * each / best
    return rates


#: Arrays of the loop that measures how fast data moves: as many as a step of the hybrid hands on.
STREAMS = 40


def bytes_moved(plant: Plant, batch: int) -> tuple[float, int]:
    """Bytes that one compiled step of a cell reads and writes, by XLA, and the number of loops."""
    state, _ = plant.init(jnp.full(batch, 5.0))
    command, dt = jnp.full(batch, 20.0), jnp.full(batch, protocol.DT)
    step = jax.jit(type(plant).step)
    compiled = step.lower(plant, state, command, jnp.zeros(batch), dt).compile()
    analysis: Any = compiled.cost_analysis()
    return analysis["bytes accessed"] / batch, str(compiled.as_text()).count(" fusion(")


def stream_rate(batch: int, repeats: int = 1000) -> float:
    """Bytes/s that loops over :data:`STREAMS` vectors of the batch read and write."""

    @jax.jit
    def run(values: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        def body(_: int, values: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
            return tuple(0.5 * value + 0.1 for value in (*values[1:], values[0]))

        return jax.lax.fori_loop(0, repeats, body, values)

    values = tuple(jnp.full(batch, float(k), jnp.float32) for k in range(STREAMS))
    jax.block_until_ready(run(values))
    best = min(seconds(lambda: run(values)) for _ in range(10))
    return 2 * STREAMS * batch * 4 * repeats / best


def roofline_share(plant: Plant, batch: int, steps_per_s: float) -> tuple[float, dict[str, int]]:
    """Share of the rate that the operations of a step alone would allow, and their counts."""
    counts, rates = operations(plant, batch), vector_rates(batch)
    bound = 1.0 / sum(count / rates[kind] for kind, count in counts.items())
    return steps_per_s / bound, counts


def latency(plant: Plant, repeats: int = 50) -> dict[str, float]:
    """Return best and median milliseconds of one compiled run of one cell."""
    pid, scenario = PID(1.0, 3.0), nominal_scenario(20.0)
    found = {}
    for whole in (False, True):
        run = lambda whole=whole: closed_loop(plant, pid, scenario, whole=whole)  # noqa: E731
        jax.block_until_ready(run())
        times = [1e3 * seconds(run) for _ in range(repeats)]
        name = "300_steps" if whole else "inspirations"
        found |= {f"{name}_best_ms": min(times), f"{name}_median_ms": float(np.median(times))}
    return found


def main(batch: int = 8192, small: int = 1024, cpu_time: bool = False) -> None:
    """Speed of closed-loop rollouts of a PID on the plants, and of what limits them.

    --small: fits into the first cache.
    """
    if cpu_time:
        _CLOCK[0] = time.process_time
    device = jax.devices()[0]
    print(f"{device.platform} {device.device_kind}, {os.cpu_count()} cores, JAX {jax.__version__}")

    def rate(plant: Plant, batch: int, rounds: int) -> float:
        pid, scenario = cells(batch)
        run = lambda: closed_loop(plant, pid, scenario)  # noqa: E731
        jax.block_until_ready(run())
        return batch * STEPS / min(seconds(run) for _ in range(rounds))

    print(f"\nclosed-loop PID, float32, batch {batch}: steps/s")
    rates = {}
    for name, build in PLANTS.items():
        rates[name] = rate(build(), batch, 10)
        print(f"  {name:24} {rates[name]:12.0f}")
    hybrid = PLANTS["frozen hybrid"]()
    single = latency(hybrid)
    print("\none run, frozen hybrid (goal 4 ms):")
    for key, value in single.items():
        print(f"  {key:24} {value:8.2f}")
    # With a batch that fits into the first cache, as the vector kernels have it.
    fast = rate(hybrid, small, 30)
    share, counts = roofline_share(hybrid, small, fast)
    listed = ", ".join(f"{count} {kind}" for kind, count in counts.items())
    print(f"\nfrozen hybrid, batch {small}: {fast:.0f} steps/s, {share:.2f} of its roofline")
    print(f"  operations of one step: {listed}")
    moved, loops = bytes_moved(hybrid, small)
    stream = stream_rate(small)
    print(f"  a step takes {1e9 / fast:.0f} ns a cell; its {loops} loops move {moved:.0f} bytes,")
    print(f"  which takes {1e9 * moved / stream:.0f} ns at {stream / 1e9:.0f} GB/s")


if __name__ == "__main__":
    typer.run(main)
