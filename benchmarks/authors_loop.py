"""Our rollouts against the authors' loop, by their code or rewritten with jit, on one network.

Both run PIDs on the paper's 9 x 150 network with one boundary network, three breaths of 100 steps.
*Theirs* does what the authors' loop does (google/deluca-lung, described in the paper's appendix),
written anew: a scan over all 300 steps with a float clock, from which target and phase follow; the
lung keeps windows of normalised pressures and commands; ``lax.switch`` selects the boundary or the
general network by the step of the breath; while the expiratory valve is open the windows start
anew. It is compiled once and mapped over trajectories, which their code does not do. ``--code``
takes a checkout of google/deluca and adds their code itself, compiled and mapped in the same way.
*Ours* is :func:`ventbench.task.rollouts.closed_loop`, which selects without branches and runs
inspirations only, as no score depends on expirations; and with them (*whole*).

Prints milliseconds of one run, seconds of the paper's grid of 2,400 trajectories, and ratios.
Runs alternate, the best of each counts, and the clock is the processor time of this process.
Usage:

    python benchmarks/authors_loop.py [--code DIR] [--trajectories 2400] [--rounds 3] [--json FILE]
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import io
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ventbench.base.files import write_json
from ventbench.controllers.pid import PID, TIME_CONSTANT
from ventbench.plants.learned import REFERENCE_DT, Architecture, Learned, learned
from ventbench.task import protocol
from ventbench.task.environment import nominal_scenario
from ventbench.task.rollouts import closed_loop

#: Seconds of a breath, of its inspiration at PIP, and at which the target reaches PEEP.
BREATH_S, HOLD_S, FALL_S = 3.0, 1.0, 1.5


def authors_loop(plant: Learned) -> Callable[..., Any]:
    """Return a compiled map from gains and PIPs, ``(n,)`` each, to pressures, ``(n, 300)``."""
    past_pressures, past_controls = plant.windows
    steps = protocol.BREATHS * protocol.BREATH_STEPS

    def target(time: Any, pip: Any) -> Any:
        phase = time % BREATH_S
        fall = pip + (protocol.PEEP - pip) * (phase - HOLD_S) / (FALL_S - HOLD_S)
        return jnp.where(phase < HOLD_S, pip, jnp.maximum(fall, protocol.PEEP))

    def networks(features: Any, count: Any) -> Any:
        boundary = plant.boundary
        assert boundary is not None

        def first(x: Any) -> Any:
            hidden = jnp.tanh(x @ boundary.hidden + boundary.hidden_bias)
            return hidden @ boundary.output + boundary.output_bias[0]

        return jax.lax.switch(jnp.minimum(count, 1), [first, lambda x: plant.general(x)], features)

    def run(P: Any, I: Any, pip: Any) -> Any:  # noqa: E741
        def step(carry: Any, _: None) -> Any:
            pressures, controls, count, clock, integral = carry
            pressure = pressures[-1]
            inspiring = clock % BREATH_S < HOLD_S + 0.5 * protocol.DT
            error = target(clock, pip) - pressure
            decay = protocol.DT / (protocol.DT + TIME_CONSTANT)
            integral = integral + decay * (error - integral)
            u_in = jnp.clip(P * error + I * integral, 0.0, protocol.U_MAX)
            shifted = jnp.append(controls[1:], u_in)
            features = jnp.concatenate(
                [
                    (pressures - plant.pressure_mean) / plant.pressure_scale,
                    (shifted - plant.control_mean) / plant.control_scale,
                ]
            )
            out = networks(features, count)
            change = (u_in - controls[-1]) / plant.control_scale
            jump = plant.jump_scale * out[0] * change
            after = pressure + jump + plant.rate_scale * out[1] * protocol.DT / REFERENCE_DT
            fallen = protocol.PEEP + (pressure - protocol.PEEP) * jnp.exp(-protocol.DT / plant.tau)
            going = (jnp.append(pressures[1:], after), shifted, count + 1, integral)
            rest = (
                jnp.full(past_pressures, fallen), jnp.zeros(past_controls),
                jnp.zeros_like(count), jnp.zeros_like(integral),
            )  # fmt: skip
            chosen = jax.tree.map(lambda a, b: jnp.where(inspiring, a, b), going, rest)
            new_pressures, new_controls, new_count, new_integral = chosen
            state = (new_pressures, new_controls, new_count, clock + protocol.DT, new_integral)
            return state, pressure

        start = (
            jnp.full(past_pressures, protocol.PEEP), jnp.zeros(past_controls),
            jnp.asarray(0), jnp.asarray(0.0), jnp.asarray(0.0),
        )  # fmt: skip
        return jax.lax.scan(step, start, None, length=steps)[1]

    return jax.jit(jax.vmap(run))


def authors_code(checkout: Path, shape: Architecture) -> dict[str, Callable[..., Any]]:
    """As :func:`authors_loop`, by their own lung, PID and waveform, with untrained networks.

    A copy of their package is imported in which the one syntax error of its head is mended. Their
    lung's clock starts anew at each expiration, which therefore lasts one step, and nearly all
    steps run the network. With a clock that goes on, two thirds do not.

    Args:
        checkout: of google/deluca.
        shape: sizes of the networks.

    Returns:
        Maps of gains, ``(n,)`` each, as it is and with such a clock.
    """
    folder = Path(tempfile.mkdtemp())
    shutil.copytree(checkout / "deluca", folder / "deluca")
    wrong = folder / "deluca/lung/utils/nn/lstm.py"
    wrong.write_text(wrong.read_text("utf-8").replace("LSTMCell.(", "LSTMCell("), "utf-8")
    sys.path.insert(0, str(folder))
    core, lungs, pids, transform = (
        importlib.import_module(f"deluca.lung.{name}")
        for name in ("core", "envs", "controllers", "utils.data.transform")
    )
    with contextlib.redirect_stdout(io.StringIO()):  # they print what they make
        scale = transform.ShiftScaleTransform([jnp.asarray([0.0, 50.0])])
        lung = lungs.LearnedLung.create(
            u_window=shape.controls,
            p_window=shape.pressures,
            u_normalizer=scale,
            p_normalizer=scale,
            num_boundary_models=shape.boundaries,
            boundary_hidden_dim=shape.boundary_width,
            default_model_parameters={
                "hidden_dim": shape.width,
                "out_dim": 1,
                "n_layers": shape.depth,
                "droprate": 0.0,
                "activation_fn": jnp.tanh,
            },
        )
        pid = pids.PID.create()

    # One waveform, which their PID compares by identity.
    waveform = core.BreathWaveform.create(peep=protocol.PEEP, pip=25.0)

    def run(P: Any, I: Any, goes_on: bool) -> Any:  # noqa: E741
        controller = pid.replace(params={"K": {"kernel": jnp.stack([P, I, 0.0 * P])[:, None]}})

        def step(carry: Any, k: Any) -> Any:
            state, seen, memory = carry
            seen = seen.replace(time=k * protocol.DT) if goes_on else seen
            memory, u_in = controller(memory, seen)
            u_out = jnp.where(waveform.is_in(seen.time), 0, 1)
            state, after = lung(state, (u_in.squeeze(), u_out))
            return (state, after, memory), seen.predicted_pressure

        start = (*lung.reset(), controller.init(waveform))
        steps = protocol.BREATHS * protocol.BREATH_STEPS
        return jax.lax.scan(step, start, jnp.arange(steps))[1]

    names = {"authors' code": False, "authors' code, clock goes on": True}
    return {name: jax.jit(jax.vmap(partial(run, goes_on=on))) for name, on in names.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--trajectories", type=int, default=2400)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--code", type=Path, help="checkout of google/deluca")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    plant = learned(jax.random.key(0), Architecture())
    code = authors_code(options.code, Architecture()) if options.code else {}
    rng = np.random.default_rng(0)

    def jobs(count: int) -> dict[str, Callable[[], Any]]:
        gains = [jnp.asarray(rng.uniform(0.0, 5.0, count), jnp.float32) for _ in range(2)]
        pips = np.resize(protocol.PIPS, count)
        cells, pid, theirs = nominal_scenario(pips), PID(*gains), authors_loop(plant)
        as_float32 = jnp.asarray(pips, jnp.float32)
        own = {name: partial(run, *gains) for name, run in code.items()}
        return own | {
            "authors' loop with jit": lambda: theirs(*gains, as_float32),
            "ours, whole breaths": lambda: closed_loop(plant, pid, cells, whole=True),
            "ours": lambda: closed_loop(plant, pid, cells),
        }

    result: dict[str, Any] = {}
    for count in (1, options.trajectories):
        runs = jobs(count)
        for run in runs.values():
            jax.block_until_ready(run())
        theirs = np.asarray(runs["authors' loop with jit"]())
        first = np.asarray(runs["ours"]()[0].pressure)[:, 0]
        apart = float(np.max(np.abs(theirs[:, : first.shape[1]] - first)))
        best = dict.fromkeys(runs, np.inf)
        for _ in range(options.rounds * (20 if count == 1 else 1)):
            for name, run in runs.items():
                started = time.process_time()
                jax.block_until_ready(run())
                best[name] = min(best[name], time.process_time() - started)
        print(f"\n{count} trajectories of 300 steps, 9 x 150: processor ms, and times ours")
        for name, seconds in best.items():
            print(f"  {name:28} {1e3 * seconds:10.2f} {seconds / best['ours']:8.2f}")
        print(f"  largest difference of pressures in the first inspiration: {apart:.1e} cmH2O")
        result[str(count)] = {name: float(seconds) for name, seconds in best.items()}
    if options.json:
        write_json(options.json, result)


if __name__ == "__main__":
    main()
