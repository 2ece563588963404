"""Speed of closed-loop rollouts relative to matrix products on the same machine.

For batched PID rollouts in float32 on a learned plant of the paper's size (9 x 150), prints the
environment steps/s, the GFLOP/s (multiplications and additions of every executed layer, boundary
network included) and the ratio to plain matrix products of the same layer shapes. Also prints the
latency of one run of 300 steps, the steps/s of the other plants, and for the frozen hybrid, which
has no matrix products, the share of its own roofline: the time that its operations would take at
the rates that vector kernels of the same operations reach in the same run. Usage:

    python benchmarks/rollout_speed.py [--batch 512 1024 2048] [--rounds 5] [--cpu-time]
        [--json FILE]

Rounds alternate rollouts and products, and the best of each is compared, because other work on the
machine slows both. With ``--cpu-time`` the clock counts the processor seconds of this process over
all threads, so the ratio also holds on a busy machine; the rates are then those of one core.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ventbench.base.files import write_json
from ventbench.controllers.pid import PID
from ventbench.plants import frozen
from ventbench.plants.learned import Architecture, Learned, learned
from ventbench.plants.single_compartment import single_compartment
from ventbench.plants.stacking import take
from ventbench.plants.two_balloon import two_balloon
from ventbench.task import protocol
from ventbench.task.environment import Scenario, nominal_scenario
from ventbench.task.interfaces import Plant
from ventbench.task.lungs import LUNGS
from ventbench.task.rollouts import closed_loop

#: Environment steps of one run without and with its expirations.
STEPS = protocol.BREATHS * protocol.INSPIRATION_STEPS
WHOLE_STEPS = protocol.BREATHS * protocol.BREATH_STEPS

#: Plants that are compared besides the learned one; add a line for each new kind.
OTHERS: dict[str, Callable[[], Plant]] = {
    "single_compartment": lambda: single_compartment(LUNGS[4]),
    "two_balloon": lambda: two_balloon(LUNGS[4]),
    "frozen hybrid": lambda: take(frozen.load().plants, 4),
}


#: The clock in use.
_CLOCK = [time.perf_counter]


def layers(plant: Learned) -> list[tuple[int, int]]:
    """Return the shapes of the matrices that one step multiplies with."""
    shapes = [w.shape for w in plant.general.weights]
    if plant.boundary is not None:
        shapes += [plant.boundary.hidden.shape, plant.boundary.output.shape]
    return [(int(a), int(b)) for a, b in shapes]


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


def xla_products(plant: Learned, batch: int) -> Callable[[], Any]:
    """Return a call that multiplies the matrices of the general network, once for each step."""
    weights = plant.general.weights

    @jax.jit
    def run(weights: tuple[jax.Array, ...], x: jax.Array) -> jax.Array:
        def step(x: jax.Array, _: None) -> tuple[jax.Array, None]:
            h = x
            for w in weights:
                h = h @ w
            # Feed a little of the result back, so that no product can be left out.
            return x.at[:, :2].add(1e-3 * h), None

        return jax.lax.scan(step, x, None, length=STEPS)[0]

    x = jax.random.normal(jax.random.key(0), (batch, weights[0].shape[0]), jnp.float32)
    return lambda: run(weights, x)


def blas_products(plant: Learned, batch: int) -> Callable[[], Any]:
    """Return the same products by NumPy's BLAS, in place."""
    weights = [np.asarray(w) for w in plant.general.weights]
    rng = np.random.default_rng(0)
    inputs = rng.standard_normal((batch, weights[0].shape[0]), np.float32)
    outputs = [np.zeros((batch, w.shape[1]), np.float32) for w in weights]

    def run() -> np.ndarray:
        for _ in range(STEPS):
            x = inputs
            for w, out in zip(weights, outputs, strict=True):
                x = np.matmul(x, w, out=out)
        return outputs[-1]

    return run


def throughput(plant: Learned, batches: list[int], rounds: int) -> list[dict[str, float]]:
    """Return the best rates for each batch size, in GFLOP/s and steps/s."""
    step_flop = 2.0 * sum(a * b for a, b in layers(plant))
    product_flop = 2.0 * sum(w.shape[0] * w.shape[1] for w in plant.general.weights)
    rows = []
    jobs = {}
    for batch in batches:
        pid, scenario = cells(batch)
        jobs[batch] = {
            "rollout": lambda pid=pid, scenario=scenario: closed_loop(plant, pid, scenario),
            "xla": xla_products(plant, batch),
            "blas": blas_products(plant, batch),
        }
        for run in jobs[batch].values():
            jax.block_until_ready(run())
    best = {(batch, name): np.inf for batch in batches for name in jobs[batch]}
    for _ in range(rounds):
        for batch, runs in jobs.items():
            for name, run in runs.items():
                best[batch, name] = min(best[batch, name], seconds(run))
    for batch in batches:
        rate = batch * STEPS / best[batch, "rollout"]
        rows.append(
            {
                "batch": batch,
                "steps_per_s": rate,
                "rollout_gflops": rate * step_flop / 1e9,
                "xla_gflops": batch * STEPS * product_flop / best[batch, "xla"] / 1e9,
                "blas_gflops": batch * STEPS * product_flop / best[batch, "blas"] / 1e9,
            }
        )
    return rows


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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--batch", type=int, nargs="+", default=[1024, 2048, 4096, 8192])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--width", type=int, default=150)
    parser.add_argument("--depth", type=int, default=9)
    parser.add_argument("--activation", default="tanh")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--cpu-time", action="store_true")
    options = parser.parse_args()
    if options.cpu_time:
        _CLOCK[0] = time.process_time
    shape = Architecture(width=options.width, depth=options.depth, activation=options.activation)
    plant = learned(jax.random.key(0), shape)
    name = f"learned {options.depth} x {options.width} {options.activation}"
    device = jax.devices()[0]
    print(f"{device.platform} {device.device_kind}, {os.cpu_count()} cores, JAX {jax.__version__}")

    print(f"\n{name}, closed-loop PID, float32; GFLOP/s")
    print(f"{'batch':>6} {'steps/s':>10} {'rollout':>8} {'XLA':>6} {'BLAS':>6} {'ratio':>6}")
    rows = throughput(plant, options.batch, options.rounds)
    for row in rows:
        reference = max(row["xla_gflops"], row["blas_gflops"])
        print(
            f"{row['batch']:6.0f} {row['steps_per_s']:10.0f} {row['rollout_gflops']:8.1f} "
            f"{row['xla_gflops']:6.1f} {row['blas_gflops']:6.1f} "
            f"{row['rollout_gflops'] / reference:6.2f}"
        )
    fastest = max(row["rollout_gflops"] for row in rows)
    reference = max(max(row["xla_gflops"], row["blas_gflops"]) for row in rows)
    ratio = fastest / reference
    print(f"best rollout / best product of any batch: {ratio:.2f} (goal 0.80)")

    single = latency(plant)
    print(f"\none run, {name} (goal 4 ms):")
    for key, value in single.items():
        print(f"  {key:24} {value:8.2f}")

    print("\nother plants, steps/s at the largest batch")
    others = {}
    pid, scenario = cells(max(options.batch))
    for other, build in OTHERS.items():
        run = lambda plant=build(): closed_loop(plant, pid, scenario)  # noqa: B008, E731
        jax.block_until_ready(run())
        others[other] = max(options.batch) * STEPS / min(seconds(run) for _ in range(10))
        print(f"  {other:24} {others[other]:12.0f}")
    # With a batch that fits into the first cache, as the vector kernels have it.
    small = min(options.batch)
    pid, scenario = cells(small)
    hybrid = OTHERS["frozen hybrid"]()
    run = lambda: closed_loop(hybrid, pid, scenario)  # noqa: E731
    jax.block_until_ready(run())
    rate = small * STEPS / min(seconds(run) for _ in range(30))
    share, counts = roofline_share(hybrid, small, rate)
    listed = ", ".join(f"{count} {kind}" for kind, count in counts.items())
    print(f"\nfrozen hybrid, batch {small}: {rate:.0f} steps/s, {share:.2f} of its roofline")
    print(f"  operations of one step: {listed}")
    moved, loops = bytes_moved(hybrid, small)
    stream = stream_rate(small)
    print(f"  a step takes {1e9 / rate:.0f} ns a cell; its {loops} loops move {moved:.0f} bytes,")
    print(f"  which takes {1e9 * moved / stream:.0f} ns at {stream / 1e9:.0f} GB/s")
    if options.json:
        result = {"plant": name, "rows": rows, "ratio": ratio, "latency": single}
        result |= {"others": others, "hybrid_roofline": share, "hybrid_operations": counts}
        write_json(options.json, result)


if __name__ == "__main__":
    main()
