"""Sections of the paper's page on controllers: PID grid, residual networks, learning."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from scipy import stats

from proofs.paper import published
from proofs.paper.report import Cell, Chart, Section, Table, Verdict, bars, below, every
from ventbench.base import compilation
from ventbench.base.arrays import Floats
from ventbench.base.errors import InputError
from ventbench.controllers.pid import PID
from ventbench.plants import frozen
from ventbench.plants.rigs import Rigs
from ventbench.task import environment, protocol, rollouts
from ventbench.task.lungs import LUNG_IDS
from ventbench.task.metrics import score as metric
from ventbench.train import pid_search

AnyFloats = NDArray[np.floating]

#: P from the end of the paper's grid on and the values of I tried at each, %/cmH2O; and the rise of
#: the error from 10 to 20 that counts as quick, %.
BEYOND, BEYOND_I = (10.0, 20.0, 50.0, 100.0), (0.1, 1.0, 3.0, 10.0, 30.0, 100.0)
QUICKLY = 5.0

#: Excess of the error over PPO's and DQN's, %, below which the whole interval must lie.
COMPARABLE = 5.0

#: Excess of the error of the paper's gains over that of the best P and I, %, that is near; excess
#: over the best final score at which a training has converged, %; breaths that the paper means.
NEAR, CONVERGED, MANY = 5.0, 2.0, 10_000

#: Lung and PIP of the example of trajectories; the paper does not name its own.
EXAMPLE, EXAMPLE_PIP = "R20C20", 20.0


def best_gains(grid: pid_search.PIDGrid) -> Section:
    """The grid of PIDs (the paper's table 2); ``ventbench train pid`` draws it."""
    rows: list[tuple[Cell, ...]] = []
    without = grid.gains[:, 2] == 0.0
    excess = []
    for index, name in enumerate(grid.lungs):
        error = grid.error[index].mean(axis=-1, dtype=np.float64)
        paper = _index(grid.gains, published.BEST_PID[name])
        best, pi = int(np.argmin(error)), int(np.argmin(np.where(without, error, np.inf)))
        better = float(np.mean(error[without] < error[paper]))
        excess.append(error[paper] / error[pi] - 1.0)
        rows.append(
            (
                name,
                _gains(grid.gains[paper], 2),
                float(error[paper]),
                _gains(grid.gains[pi], 2),
                float(error[pi]),
                _gains(grid.gains[best]),
                float(error[best]),
                f"{100 * better:.1f} %",
            )
        )
    top = sum(value < NEAR / 100.0 for value in excess)
    low, high = _interval(100.0 * np.array(excess))
    errors = {"the paper's best P, I": 2, "best P, I here": 4, "best P, I, D here": 6}
    series = {
        name: (list(grid.lungs), [x if isinstance(x := row[k], float) else None for row in rows])
        for name, k in errors.items()
    }
    return Section(
        "pid",
        "Best PIDs",
        "table 2",
        "The best gains are high, several at the end of the grid, and all have D = 0.",
        below((low, high), NEAR),
        f"On {top} of {len(excess)} lungs the gains that were best on the physical lung come "
        f"within {NEAR:g} % of the best P and I on the simulator, which was not fitted to them (by "
        f"lung {low:+.0f} to {high:+.0f} %, 95 %). With D free, the error on simulators is lower.",
        f"computed: {grid.error.size:,} trajectories without noise (the paper: "
        f"{published.TRAJECTORIES * len(grid.lungs):,} on the lung)",
        (
            Table(
                "Mean |pressure - PIP|, cmH2O, of the paper's best P, I; of the best with D = 0; "
                "of the best of the whole grid; share of P, I that beat the paper's",
                (
                    "lung",
                    "paper P, I",
                    "error here",
                    "best P, I",
                    "error",
                    "best P, I, D",
                    "error",
                    "better than the paper's",
                ),
                tuple(rows),
            ),
        ),
        (Chart("Gains on the simulators", "lung", "mean error, cmH2O", series),),
    )


def beyond_the_grid(rigs: Rigs) -> Section:
    """P above the end of the grid (the paper's appendix A.2)."""
    rigs = rigs.of_training
    drawn = rigs.draws(4, seed=pid_search.TUNING_SEED, name=pid_search.TUNING)
    names = tuple(lung.id for lung in rigs.lungs)
    gains = np.array([(*pair, 0.0) for pair in itertools.product(BEYOND, BEYOND_I)])
    error = np.stack(
        [
            pid_search.errors_on_draws(rigs, drawn, k, gains)
            .mean(axis=-1)
            .reshape(len(BEYOND), -1)
            .min(axis=1)
            for k in range(len(names))
        ]
    )
    change = 100.0 * (error / error[:, :1] - 1.0)
    quickly = int(np.sum(change[:, 1] > QUICKLY))
    return Section(
        "beyond",
        "Gains beyond the grid",
        "appendix A.2",
        "Beyond 10 the performance degrades quickly, by overshoot and ringing.",
        "agrees" if quickly == len(names) else "in part" if quickly > 3 else "differs",
        f"From P = {BEYOND[0]:g} to {BEYOND[1]:g} the error rises by more than {QUICKLY:g} % on "
        f"{quickly} of {len(names)} lungs, and falls on {int(np.sum(change[:, 1] < 0))}; at "
        f"{BEYOND[-1]:g} it is {change[:, -1].min():+.0f} to {change[:, -1].max():+.0f} %.",
        "computed: the best I at each P, D = 0, four draws for tuning on the training rigs",
        (
            Table(
                "Error, cmH2O, by P, %/cmH2O",
                ("lung", *(f"{P:g}" for P in BEYOND)),
                tuple((name, *row) for name, row in zip(names, error.tolist(), strict=True)),
            ),
        ),
    )


def example(official: frozen.Frozen, grid: pid_search.PIDGrid, residual: Floats) -> Section:
    """Trajectories of P-only, I-only, PID and residual (the paper's figures 2, 4 and 9).

    Args:
        official: simulators.
        grid: grid of PIDs.
        residual: pressures of the residual entry, cmH2O, shape ``(6, 6, 300)``.
    """
    at, pip = LUNG_IDS.index(EXAMPLE), protocol.PIPS.index(EXAMPLE_PIP)
    P, I, D = grid.gains.T  # noqa: E741
    kinds = {
        "best P-only": (I == 0) & (D == 0),
        "best I-only": (P == 0) & (D == 0),
        "best PI of the paper": np.all(grid.gains == published.BEST_PID[EXAMPLE], axis=1),
        "best PID of the grid": np.ones(len(P), bool),
    }
    error = grid.error[at].mean(axis=-1, dtype=np.float64)
    chosen = {
        name: tuple(grid.gains[int(np.argmin(np.where(among, error, np.inf)))].tolist())
        for name, among in kinds.items()
    }
    with compilation.float64():
        plant = jax.tree.map(lambda leaf: jnp.asarray(leaf[at], float), official.plants)
        controllers = PID(*(jnp.asarray(column) for column in zip(*chosen.values(), strict=True)))
        cells = environment.nominal_scenario(np.full(len(chosen), EXAMPLE_PIP))
        inspired, _ = rollouts.closed_loop(plant, controllers, cells)
        breaths = dict(zip(chosen, np.asarray(inspired.pressure[:, -1]), strict=True))
    last = protocol.BREATH_STEPS * (protocol.BREATHS - 1)
    breaths["residual"] = residual[at, pip, last : last + protocol.INSPIRATION_STEPS]
    rows = []
    for name, breath in breaths.items():
        rows.append(
            (
                name,
                _gains(chosen[name]) if name in chosen else "network on PID",
                float(np.mean(np.abs(breath - EXAMPLE_PIP))),
                float(metric.rise_time(breath, protocol.PEEP, EXAMPLE_PIP, protocol.DT)),
                float(metric.overshoot(breath, EXAMPLE_PIP)),
                float(metric.swings(breath, EXAMPLE_PIP)),
            )
        )
    after = [round(k * protocol.DT, 3) for k in range(protocol.INSPIRATION_STEPS)]
    curves = {name: (after, breath.tolist()) for name, breath in breaths.items()}
    curves["target"] = (after, [EXAMPLE_PIP] * len(after))
    ours, others = rows[-1], rows[:-1]
    faster = all(not ours[3] > row[3] for row in others if np.isfinite(row[3]))
    nearer = all(ours[2] < row[2] for row in others)
    verdict: Verdict = "agrees" if faster and nearer else "in part" if nearer else "differs"
    return Section(
        "example",
        "Trajectories of one breath",
        "figures 2, 4 and 9",
        "The trained controller rises fast and stays near the target; P-only, I-only and PID rise "
        "later, overshoot or ring.",
        verdict,
        f"Error {ours[2]:.2f} cmH2O, rise {ours[3]:.2f} s, overshoot {ours[4]:.2f} cmH2O, against "
        f"at best {min(row[2] for row in others):.2f} cmH2O by a PID. The example's lung and PIP "
        "are ours; the paper names none.",
        f"computed: {EXAMPLE} at PIP {EXAMPLE_PIP:g}, third breath",
        (
            Table(
                "Third breath: error, cmH2O; rise from 10 to 90 %, s; overshoot, cmH2O; swings "
                "around the target",
                ("controller", "P, I, D", "error", "rise", "overshoot", "swings"),
                tuple(rows),
                2,
            ),
        ),
        (Chart("Third breath", "time in the breath, s", "airway pressure, cmH2O", curves),),
    )


def performance(
    grid: pid_search.PIDGrid, residual: Floats, on_rigs: tuple[str, Floats, Floats] | None = None
) -> Section:
    """Residual network against the best PID of each lung (the paper's figure 7).

    Args:
        grid: grid of PIDs.
        residual: errors by lung and PIP, cmH2O, shape ``(6, 6)``.
        on_rigs: name of a round, and on its ranked rigs the errors of the best PID of each lung
            without a grid's edge and of the network, cmH2O, shape ``(6, 6)``.
    """
    pid = np.stack(
        [grid.error[k, int(np.argmin(grid.error[k].mean(-1)))] for k in range(len(grid.lungs))]
    )
    by_lung = tuple(_compared(name, pid[k], residual[k]) for k, name in enumerate(grid.lungs))
    by_pip = tuple(
        _compared(f"PIP {pip:g}", pid[:, k], residual[:, k]) for k, pip in enumerate(grid.pips)
    )
    wins = sum(row[2] < row[1] for row in by_lung)
    low, high = _interval(_changes(pid, residual))
    verdict = below((low, high))
    heads = ("best PID of the lung", "residual", "change, %")
    finding = (
        f"It is better on {wins} of 6 lungs and at {sum(row[2] < row[1] for row in by_pip)} of 6 "
        f"PIPs; the mean falls from {pid.mean():.3f} to {residual.mean():.3f} cmH2O "
        f"({_change(pid, residual):+.0f} %; by lung {low:+.0f} to {high:+.0f} %, 95 %)."
    )
    tables: tuple[Table, ...] = (
        Table("Mean |pressure - PIP| by lung, cmH2O", ("lung", *heads), by_lung, 2),
        Table("The same by waveform, cmH2O", ("waveform", *heads), by_pip, 2),
    )
    if on_rigs is not None:
        name, before, after = on_rigs
        ends = _interval(_changes(before, after))
        verdict = every(verdict, below(ends))
        finding += (
            f" On the rigs of round {name}, against the best PID without a grid's edge, it is "
            f"{_change(before, after):+.0f} % (by lung {ends[0]:+.0f} to {ends[1]:+.0f} %)."
        )
        rows = tuple(_compared(lung, before[k], after[k]) for k, lung in enumerate(grid.lungs))
        tables += (Table(f"On the rigs of round {name}, cmH2O", ("lung", *heads), rows, 2),)
    return Section(
        "performance",
        "A trained controller for each lung",
        "figure 7, contribution 1",
        "A network on top of a PID, trained on the simulator, beats the best PID on every lung.",
        verdict,
        finding,
        "computed: submissions/residual_mlp and the grid, nominal runs, on simulators; rigs of a "
        "round: its records",
        tables,
        tuple(bars(table, "mean error, cmH2O", heads[:2]) for table in tables),
    )


def robustness(grid: pid_search.PIDGrid, own: Floats, residual: Floats) -> Section:
    """One controller for all lungs against one PID for all (the paper's figure 8).

    Args:
        grid: grid of PIDs.
        own: errors of the networks for single lungs, cmH2O, shape ``(6, 6)``.
        residual: errors of the network for all lungs, cmH2O, shape ``(6, 6)``.
    """
    gains, _ = grid.best()
    pid = grid.error[:, _index(grid.gains, gains)]
    each = np.stack([error[int(np.argmin(error.mean(-1)))] for error in grid.error])
    rows = tuple(_compared(name, pid[k], residual[k]) for k, name in enumerate(grid.lungs))
    gain, single = _change(pid, residual), _change(each, own)
    wins = sum(row[2] < row[1] for row in rows)
    changes = _changes(pid, residual)
    ends, more = _interval(changes), _interval(changes - _changes(each, own))
    table = Table(
        "Mean |pressure - PIP|, cmH2O; neither is told the lung",
        ("lung", "best single PID", "one network", "change, %"),
        rows,
        2,
    )
    return Section(
        "robustness",
        "One controller for all lungs",
        "figure 8, contribution 2",
        "One network for all lungs beats the best single PID, by more than networks for single "
        "lungs beat their PIDs.",
        every(below(ends), below(more)),
        f"{gain:+.0f} % against the single PID ({_gains(gains)}) over six lungs (by lung "
        f"{ends[0]:+.0f} to {ends[1]:+.0f} %, 95 %), {single:+.0f} % "
        f"for networks of single lungs against theirs (difference by lung {more[0]:+.0f} to "
        f"{more[1]:+.0f}, 95 %); better on {wins} of 6 lungs. On average it "
        f"also has {residual.mean():.3f} cmH2O where the best PIDs of each lung have "
        f"{each.mean():.3f}.",
        "computed: submissions/residual_mlp_all and the grid, nominal runs",
        (table,),
        (bars(table, "mean error, cmH2O", table.columns[1:3]),),
    )


def regularisation(controllers: Mapping[str, Any]) -> Section:
    """Network on a PID against a network alone (the paper's section 5)."""
    variants = {row["variant"]: row for row in controllers["variants"]}
    base, direct = variants["base"], variants["direct"]
    rows = tuple(
        (name, row["meaning"], row["nominal"], row["draws"], row["exploitation"])
        for name, row in variants.items()
    )
    better = direct["nominal"] > base["nominal"]
    return Section(
        "regularisation",
        "The PID under the network",
        "section 5",
        "A correction of a PID does significantly better than a network that commands alone.",
        "agrees" if better else "differs",
        f"A network alone has {direct['nominal']:.3f} cmH2O, one on a PID {base['nominal']:.3f}; "
        f"but its exploitation index, the spread of the ensemble under its commands, is "
        f"{direct['exploitation']:.3f} against {base['exploitation']:.3f}. On simulators the PID "
        "keeps the network where they agree; it does not lower the error.",
        f"`{controllers['about']['command']}`, stored, simulators version "
        f"{controllers['about']['simulators']}",
        (
            Table(
                "Parts of the residual controller: error without noise and on the draws, and "
                "exploitation index, cmH2O",
                ("variant", "what", "nominal", "draws", "exploitation"),
                rows,
            ),
        ),
    )


def reinforcement(errors: Mapping[str, Floats]) -> Section:
    """Residual network, PPO and DQN on the lungs (the paper's figure 10)."""
    names = ("residual", "PPO", "DQN")
    rows = [
        (lung_id, *(float(errors[name][k].mean()) for name in names))
        for k, lung_id in enumerate(LUNG_IDS)
    ]
    rows.append(("mean", *(float(errors[name].mean()) for name in names)))
    ours, ppo, dqn = (float(x) for x in rows[-1][1:])
    ends = [_interval(_changes(errors[name], errors["residual"])) for name in names[1:]]
    table = Table("Mean |pressure - PIP|, cmH2O", ("lung", *names), tuple(rows))
    return Section(
        "reinforcement",
        "Against PPO and DQN",
        "figure 10",
        "The score is comparable to that of PPO and DQN on all simulators.",
        "agrees"
        if max(high for _, high in ends) <= COMPARABLE
        else "in part"
        if ours <= min(ppo, dqn)
        else "differs",
        f"{ours:.3f} cmH2O against {ppo:.3f} (PPO: {ends[0][0]:+.0f} to {ends[0][1]:+.0f} % by "
        f"lung, 95 %) and {dqn:.3f} (DQN: {ends[1][0]:+.0f} to {ends[1][1]:+.0f} %), after a "
        "handful of trials "
        f"each (the paper: {published.TRIALS['PPO']} and {published.TRIALS['DQN']}).",
        "computed: submissions residual_mlp, ppo, dqn, performance track, nominal runs",
        (table,),
        (bars(table, "mean error, cmH2O", names),),
    )


def sample_efficiency(samples: Mapping[str, Any]) -> Section:
    """Error against experience (the paper's figure 11)."""
    methods = {row["method"]: row for row in samples["methods"]}
    columns = {
        "final": "final",
        "low95": "from",
        "high95": "to",
        "episodes": "breaths",
        "at_100_episodes": "score at 100 breaths",
        "episodes_to_best_pid": "breaths to the best PID",
        "episodes_to_2_percent": "breaths to within 2 %",
        "seconds": "seconds, two cores",
        "compile_seconds": "compiling, s",
    }
    rows = tuple(
        (name, *(f"{x:,}" if isinstance(x, int) else x for x in map(row.get, columns)))
        for name, row in methods.items()
    )
    gradient = methods["policy-gradient"]
    reached = [methods[name]["episodes_to_best_pid"] for name in ("policy-gradient", "ppo", "dqn")]
    short = methods["policy-gradient-short"]
    if None in reached:  # such as in trainings cut short
        first = "Not all methods beat the best PID."
    else:
        fewer = [count / reached[0] for count in reached[1:]]
        first = (
            f"It beats the best PID after {reached[0]} breaths, {fewer[0]:.0f} and {fewer[1]:.0f} "
            "times fewer than PPO and DQN."
        )
    best = min(row["final"] for row in methods.values())
    low, high = (100.0 * (short[end] / best - 1.0) for end in ("low95", "high95"))
    late = [methods[name]["episodes_to_2_percent"] for name in ("ppo", "dqn")]
    slow: Verdict = "agrees" if all(n is None or n >= MANY for n in late) else "differs"
    table = Table(
        f"{samples['lung']}: score without noise, cmH2O (interquartile mean, 95 %), and breaths",
        ("method", *columns.values()),
        rows,
    )
    return Section(
        "samples",
        "Breaths of experience",
        "figure 11, contribution 4, conclusion 3",
        "The policy gradient converges in about 100 episodes, PPO and DQN in tens of thousands.",
        every(below((low, high), CONVERGED), slow),
        f"{first} But within {short['episodes']} breaths it stops at "
        f"{short['final']:.2f} cmH2O ({low:+.0f} to {high:+.0f} % over the best of all, 95 %), and "
        f"with {gradient['episodes']:,} it reaches {gradient['final']:.2f}. An episode here is one "
        "inspiration; in the paper a pass over all PIPs.",
        f"`{samples['about']['command']}`, stored, simulators version "
        f"{samples['about']['simulators']}; {samples['seeds']} seeds",
        (table,),
        (bars(table, "score, cmH2O", ("score at 100 breaths", "final")),),
    )


def stability(samples: Mapping[str, Any]) -> Section:
    """Spread of trainings over seeds (the paper's section 6)."""
    spread = {
        row["method"]: 100.0 * (row["high95"] - row["low95"]) / row["final"]
        for row in samples["methods"]
    }
    ours, *others = (spread[name] for name in ("policy-gradient", "ppo", "dqn"))
    return Section(
        "stability",
        "Stability of the training",
        "section 6",
        "The policy gradient trains stably, PPO and DQN do not.",
        "agrees" if ours < min(others) else "differs",
        f"The 95 % interval of the final score over {samples['seeds']} seeds is as wide as "
        + ", ".join(f"{wide:.1f} % ({name})" for name, wide in spread.items())
        + " of the score.",
        f"`{samples['about']['command']}`, stored",
    )


def _compared(name: str, before: AnyFloats, after: AnyFloats) -> tuple[str, float, float, float]:
    return name, float(np.mean(before)), float(np.mean(after)), _change(before, after)


def _change(before: AnyFloats, after: AnyFloats) -> float:
    """Change of the mean, %."""
    return 100.0 * (float(np.mean(after)) / float(np.mean(before)) - 1.0)


def _changes(before: AnyFloats, after: AnyFloats) -> Floats:
    """Change of the mean of each lung, %."""
    return np.array([_change(*pair) for pair in zip(before, after, strict=True)])


def _interval(values: Floats) -> tuple[float, float]:
    """95 % of the mean over lungs, by Student's t."""
    half = stats.t.ppf(0.975, len(values) - 1) * values.std(ddof=1) / np.sqrt(len(values))
    return float(values.mean() - half), float(values.mean() + half)


def _index(gains: Floats, wanted: Sequence[float]) -> int:
    at = np.flatnonzero(np.all(gains == np.asarray(wanted), axis=1))
    if not at.size:
        raise InputError(f"the grid does not contain P, I, D = {_gains(wanted)}")
    return int(at[0])


def _gains(gains: Sequence[float] | Floats, count: int = 3) -> str:
    return ", ".join(f"{gain:g}" for gain in list(gains)[:count])
