"""Simulators of rigs: from any folder of recordings to the files of a version, resumably.

Fits: one to all breaths, the scored one; one without each fold of the measured breaths; a few to
resampled breaths, for the intervals of R and C; and one without some rigs of every lung, so that
each rig is held out once. The last are made twice: then nothing is learned from the session
of each lung that fits its label worst, so that it cannot make the others look wrong.
"""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tomli_w
from scipy.special import ndtri

from ventbench import simulation
from ventbench.base import compilation, files
from ventbench.base.arrays import Floats, Ints
from ventbench.base.errors import InputError
from ventbench.base.resume import Checkpoint, WorkFolder
from ventbench.plants import frozen, sessions
from ventbench.plants.frozen import BY_ALL, training_list
from ventbench.plants.hybrid import Hybrid
from ventbench.plants.plant_files import save_plant
from ventbench.plants.sessions import Sessions
from ventbench.recordings import Breaths
from ventbench.task.lungs import LUNG_IDS, lung
from ventbench.task.metrics.open_loop import command_counts
from ventbench.train.rigs.data import (
    SAMPLES,
    InspirationData,
    RigRecordings,
    WholeBreaths,
    complete_breaths,
    groups_of,
    groups_of_sessions,
    inspirations,
    load_rig_recordings,
)
from ventbench.train.rigs.fit import (
    LAMINAR_SHARE,
    Centre,
    FitConfig,
    Fitted,
    Noise,
    Pooled,
    Scales,
    centre,
    fit,
    fit_expiration,
    plants,
)
from ventbench.train.rigs.label_test import LabelTest, label_errors, label_tests

#: Called with what is being done and the share of all that is done, 0..1.
Progress = Callable[[str, float], None]

#: Version of the recipe, written into the manifest.
VERSION = 2

#: Packages that have a part in the numbers.
PACKAGES = ("flax", "jax", "jaxlib", "numpy", "optax")

#: Share of the rigs of each lung that passed which is held out of every training, rounded up.
HELD_OUT_SHARE = 1.0 / 3.0

#: Standard deviation between members of the logarithm of the valve's slope where it is hardly
#: recorded: from what the recordings say at 100 % it reaches to the data sheet.
UNRECORDED_SLOPE = 0.4

# Iterations of a fit that starts at the fit to all breaths.
_RESAMPLED_ITERATIONS = 100


@dataclass(frozen=True)
class RigConfig:
    """Settings of the training."""

    #: folds of the cross-validation, and members of the ensemble beside the scored one.
    folds: int = 5
    resamples: int = 3  #: fits to resampled breaths, for intervals.
    #: weight of a breath whose pressure is partly blank; a measured one has 1.
    reconstructed: float = 0.4
    unlisted: float = 0.2  #: weight of a breath of a lung that is not listed.
    seed: int = 0  #: seed of folds, drawn priors and resampling.
    #: part of the labelled resistance that does not depend on the flow, around which the prior of
    #: the resistances lies: 0.4 as in a QuickLung, 1 for a linear resistor.
    laminar_share: float = LAMINAR_SHARE
    fit: FitConfig = field(default_factory=FitConfig)  #: settings of the optimisation.

    def __post_init__(self) -> None:
        """Refuse a share that is none.

        Raises:
            InputError: naming it.
        """
        if not 0.0 <= self.laminar_share <= 1.0:
            raise InputError(f"laminar share {self.laminar_share:g} is outside 0..1")


@dataclass(frozen=True)
class _Problem:
    """Recordings arranged once, so that all fits share one compilation."""

    data: RigRecordings
    listed: tuple[str, ...]
    table: Sessions
    inspirations: InspirationData
    full_breaths: WholeBreaths
    weight: Floats
    centre: Centre
    config: RigConfig

    @property
    def session(self) -> Ints:
        return np.asarray(self.inspirations.groups.session)

    @property
    def rounds(self) -> list[list[int]]:
        """Sessions to leave out together: one of each listed lung, and all in the end.

        Lungs that are not listed may lose more than one, so that they cost no round of their own.
        """
        by_lung = {
            label.id: [i for i, row in enumerate(self.table.table) if row.lung == label.id]
            for label in self.data.labels
        }
        repeated = [sessions for sessions in by_lung.values() if len(sessions) > 1]
        listed = [len(by_lung[name]) for name in self.listed if len(by_lung[name]) > 1]
        count = max(listed, default=0)
        return [
            [i for sessions in repeated for i in sessions[turn::count]] for turn in range(count)
        ]


def train_rigs(
    folder: Path | str,
    out: Path | str = "runs/simulators",
    *,
    lungs: Sequence[str] | None = None,
    config: RigConfig | None = None,
    progress: Progress = lambda stage, share: None,
) -> frozen.Frozen:
    """Learn simulators from any folder of recordings in the public schema.

    The result is a folder that every ``--simulator`` takes. Finished fits are kept in ``out/parts``
    until all is done, so that an interrupted training goes on. On one machine with the same
    packages the files are the same byte for byte.

    Example::

        simulators = ventbench.train_rigs("my-recordings", "runs/my-rig")
        ventbench.tune_pid(simulator="runs/my-rig")

    Args:
        folder: folder of recordings; any labels R and C.
        out: folder for the files; existing ones are replaced at the end.
        lungs: ids of the lungs to be listed; others only help to learn what all share. By default
            every lung that was recorded.
        config: settings of the training.
        progress: see :data:`Progress`.

    Returns:
        The simulators, read back.

    Raises:
        InputError: if a recording is malformed, there are too few breaths, or ``out`` holds parts
            of another training.
        OSError: if a file cannot be read or written.
    """
    folder, out = Path(folder), Path(out)
    config = config or RigConfig()
    progress("reading the recordings", 0.0)
    data = load_rig_recordings(folder, folds=config.folds, seed=config.seed)
    listed = _listed(data, lungs)
    provenance = _provenance(data, listed, config)
    parts = WorkFolder(out / "parts", provenance)
    with compilation.float32():  # enough for a fit to noisy recordings, and twice as fast
        problem = _arrange(data, listed, config)
        fits = _fits(problem, parts, progress)
        manifest, simulators = _assess(problem, fits, out)
    _write(simulators, provenance | manifest)
    parts.delete()
    progress("done", 1.0)
    return frozen.load(path=out)


def _listed(data: RigRecordings, lungs: Sequence[str] | None) -> tuple[str, ...]:
    recorded = tuple(label.id for label in data.labels)
    missing = [name for name in lungs or () if lung(name).id not in recorded]
    if missing:
        raise InputError(f"lung {missing[0]} was not recorded; recorded are {', '.join(recorded)}")
    # Six lungs of the protocol first, in the order of every table.
    requested = recorded if lungs is None else tuple(lung(name).id for name in lungs)
    return (
        *(name for name in LUNG_IDS if name in requested),
        *(name for name in requested if name not in LUNG_IDS),
    )


def _arrange(data: RigRecordings, listed: tuple[str, ...], config: RigConfig) -> _Problem:
    # Clocks alone tell sessions apart; no pressure is looked at.
    table = sessions.find(data.breaths)
    weight = np.where(np.arange(len(data.breaths)) < data.measured, 1.0, config.reconstructed)
    weight = weight * np.where(np.isin(data.breaths.lung_ids, listed), 1.0, config.unlisted)
    longest = int(np.count_nonzero(data.breaths.inspiratory, axis=1).max())
    return _Problem(
        data,
        listed,
        table,
        inspirations(data.breaths, table, data.labels, max(SAMPLES, longest + 1)),
        complete_breaths(data.measured_breaths, table, data.labels),
        weight,
        centre(data.labels, len(table), config.laminar_share),
        config,
    )


@dataclass(frozen=True)
class _Fits:
    """All fits of a training."""

    scored: Fitted  #: fit to all breaths.
    members: list[Fitted]  #: fits without each fold.
    excluding_rigs: list[Fitted]  #: fits without the sessions of each round.
    tests: list[LabelTest]  #: tests of the labels of all sessions.


def _fits(problem: _Problem, parts: WorkFolder, progress: Progress) -> _Fits:
    config, rng = problem.config, np.random.default_rng(problem.config.seed)
    m, n = problem.data.measured, len(problem.weight)
    template = Fitted(
        problem.centre.pooled, jnp.zeros(n), jnp.zeros(n), jnp.zeros(len(problem.table))
    )
    total = 1.0 + config.folds + 2.0 * len(problem.rounds) + 0.5 * config.resamples
    completed = 0.0

    def run(
        name: str,
        stage: str,
        weight: Floats,
        *,
        expiration: bool = False,
        start: Fitted | None = None,
    ) -> Fitted:
        nonlocal completed
        settings, cost = config.fit, 1.0
        if start is not None:
            shorter = min(config.fit.iterations, _RESAMPLED_ITERATIONS)
            settings, cost = dataclasses.replace(config.fit, iterations=shorter), 0.5
        began = completed
        completed += cost

        def tell(share: float) -> None:
            progress(stage, 0.95 * (began + cost * share) / total)

        tell(0.0)
        checkpoint = Checkpoint(parts.checkpoint(name), {})
        stored, finished = checkpoint.restore(template)
        if finished:
            return stored
        fitted = fit(
            problem.inspirations, jnp.asarray(weight), problem.centre, settings, start, tell
        )
        if expiration:
            pooled = fit_expiration(fitted.pooled, problem.full_breaths, jnp.asarray(weight[:m]))
            fitted = dataclasses.replace(fitted, pooled=pooled)
        checkpoint.save(fitted, 1)
        return fitted

    scored = run("all", "all breaths", problem.weight, expiration=True)
    members = []
    for fold in range(config.folds):
        weight = problem.weight.copy()
        weight[:m][problem.data.fold == fold] = 0.0
        members.append(run(f"member-{fold}", f"member {fold + 1}", weight, expiration=True))
    resampled = []
    for turn in range(config.resamples):
        weight = problem.weight * rng.exponential(size=n)
        stage = f"resampled breaths, {turn + 1}"
        resampled.append(run(f"resample-{turn}", stage, weight, start=scored))

    def excluding_rigs(name: str, doubtful: Sequence[int]) -> list[Fitted]:
        out = []
        for turn, held_out in enumerate(problem.rounds):
            silent = np.isin(problem.session, [*held_out, *doubtful])
            weight = np.where(silent, 0.0, problem.weight)
            out.append(run(f"{name}-{turn}", f"rigs held out, {name} {turn + 1}", weight))
        return out

    first = excluding_rigs("rigs", [])
    doubtful = _worst(_label_tests(problem, scored, resampled, first))
    second = excluding_rigs("again", doubtful) if doubtful else first
    tests = _label_tests(problem, scored, resampled, second)
    return _Fits(scored, members, second, tests)


def _worst(tests: Sequence[LabelTest]) -> list[int]:
    """Of each lung the session that failed with the largest error under its own label."""
    failed: dict[str, LabelTest] = {}
    for test in tests:
        previous = failed.get(test.lung.id)
        if test.reasons and (previous is None or test.error_own_label > previous.error_own_label):
            failed[test.lung.id] = test
    return sorted(test.session for test in failed.values())


def _label_tests(
    problem: _Problem, scored: Fitted, resampled: Sequence[Fitted], excluding_rigs: Sequence[Fitted]
) -> list[LabelTest]:
    data, table = problem.data, problem.table
    held_out = [index for sessions in problem.rounds for index in sessions]
    # The only session of its lung cannot be left out.
    untested = [index for index in range(len(table)) if index not in held_out]
    errors: dict[int, Sequence[float]] = {}
    for part, some in zip([*excluding_rigs, scored], [*problem.rounds, untested], strict=True):
        if some:
            errors |= label_errors(part.pooled, some, problem.inspirations, data.labels)
    counts = [
        np.bincount(part, minlength=len(table))
        for part in (problem.session[: data.measured], problem.session)
    ]
    groups = groups_of_sessions(table, data.labels)
    fitted, *resampled_plants = (plants(part.pooled, groups) for part in (scored, *resampled))
    return label_tests(
        fitted,
        resampled_plants,
        errors,
        table,
        data.labels,
        (counts[0], counts[1]),
        problem.config.laminar_share,
    )


def _widened(pooled: Pooled, member: int, count: int) -> Pooled:
    """Spread the members where the valve is hardly recorded: its last slope, above 70 %.

    Member k of the folds gets the quantile of rank k + 1/2 of a normal distribution of logarithms.
    """
    shift = UNRECORDED_SLOPE * float(ndtri((member + 0.5) / count))
    return dataclasses.replace(pooled, slopes=pooled.slopes.at[-1].add(shift))


def _assess(problem: _Problem, fits: _Fits, out: Path) -> tuple[dict[str, Any], frozen.Frozen]:
    """Choice of rigs and held-out errors; and the simulators, still without a manifest."""
    data, table, tests = problem.data, problem.table, fits.tests
    of_sessions = groups_of_sessions(table, data.labels)
    pooled = [fits.scored.pooled] + [
        _widened(part.pooled, k, len(fits.members)) for k, part in enumerate(fits.members)
    ]
    members = jax.tree.map(
        lambda *leaves: np.stack([np.asarray(leaf, np.float64) for leaf in leaves]),
        *(plants(part, of_sessions) for part in pooled),
    )
    of_measured = problem.session[: data.measured]
    rigs = {
        name: choose_rigs([t for t in tests if t.lung.id == name], table) for name in problem.listed
    }

    measured = data.measured_breaths
    # The members of the folds follow the scored one.
    unmeasured = np.full(len(data.breaths) - data.measured, BY_ALL)
    training = training_list(data.breaths, np.append(data.fold + 1, unmeasured))
    simulators = frozen.Frozen(out, {}, "", table, members, training)
    cross_fitted_error = simulation.open_loop_errors(simulators.cross_fitted, measured)
    unseen = np.full(data.measured, np.nan)
    for held_out, part in zip(problem.rounds, fits.excluding_rigs, strict=True):

        def shared(breaths: Breaths, pooled: Pooled = part.pooled) -> Hybrid:
            wide = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), pooled)
            return plants(wide, groups_of(breaths, table, data.labels))

        selected = np.isin(of_measured, held_out)
        unseen[selected] = simulation.open_loop_errors(shared, measured)[selected]
    counted = np.asarray(problem.inspirations.share) > 0
    lungs = {}
    for name in problem.listed:
        index = measured.by_lung_index.get(name, np.empty(0, np.int64))
        scored = index[np.isin(of_measured[index], rigs[name]["rigs"])]
        recorded = counted & np.isin(problem.session, rigs[name]["rigs"])[:, None]
        lungs[name] = {
            "R": lung(name).R,
            "C": lung(name).C,
            **rigs[name],
            **_figures("own_rig_", cross_fitted_error[scored]),
            **_figures("unseen_rig_", unseen[scored]),
            **_figures("held_out_", cross_fitted_error[index]),
            "recorded_commands": command_counts(
                np.asarray(problem.inspirations.u_in)[recorded]
            ).tolist(),
        }
    return {
        "lungs": lungs,
        "label_tests": [test.as_dict() for test in tests],
        "sessions": table.to_list(),
    }, simulators


def choose_rigs(tests: Sequence[LabelTest], table: Sessions) -> dict[str, Any]:
    """Choose the rigs of one lung: label-true ones, the reference first, and those held out.

    The reference has the most measured breaths. Held out is a third, rounded up: first one on
    another kind of ventilator if there is such, with as many measured breaths as possible; then by
    the hash of the clock, which nobody can choose. The reference never is. If no session is
    label-true, those stand for the lung whose label cannot be told, and if there is none of those
    either, the one with the most measured breaths; ``label_test`` says so.

    Args:
        tests: tests of all its sessions.
        table: the sessions.
    """

    def recorded(test: LabelTest) -> tuple[int, int, int]:
        return -test.measured, -test.breaths, test.session

    passed = sorted((test for test in tests if test.label_true), key=recorded)
    open_ = sorted((test for test in tests if not test.reasons), key=recorded)
    chosen = passed or open_ or sorted(tests, key=recorded)[:1]
    verdict = "passed" if passed else "cannot be told" if open_ else "no session passed"
    reference, alternates = chosen[0], chosen[1:]
    out: dict[str, Any] = {
        "session": reference.session,
        "rigs": [reference.session, *sorted(test.session for test in alternates)],
        "label_test": verdict,
    }
    if alternates:
        kind = table.table[reference.session].rig
        held_out = min(alternates, key=lambda t: (table.table[t.session].rig == kind, *recorded(t)))
        remaining = sorted(
            (t.session for t in alternates if t is not held_out), key=partial(_digest, table)
        )
        count = math.ceil(HELD_OUT_SHARE * len(chosen))
        out["held_out_rigs"] = [held_out.session, *remaining][:count]
    return out


def _digest(table: Sessions, session: int) -> str:
    """Hash of a session's clock, by which nobody can choose."""
    return hashlib.sha256(repr(table.table[session]).encode()).hexdigest()


def _figures(prefix: str, error: Floats) -> dict[str, Any]:
    """Summary to 1e-6 cmH2O, empty where there is no breath, as TOML knows no null."""
    summary = simulation.error_summary(prefix, error)
    if not summary[f"{prefix}breaths"]:
        return {}
    return jax.tree.map(lambda x: round(x, 6) if isinstance(x, float) else x, summary)


def _provenance(data: RigRecordings, listed: tuple[str, ...], config: RigConfig) -> dict[str, Any]:
    return {
        "format": frozen.FORMAT,
        "version": VERSION,
        "kind": "hybrid",
        "packages": {name: metadata.version(name) for name in PACKAGES},
        "recordings": data.sources,
        "skipped": list(data.skipped),
        "listed": list(listed),
        "split": {"by": "breath", "seed": config.seed, "folds": config.folds},
        "recipe": {
            "rigs": dataclasses.asdict(config),
            "scales": dataclasses.asdict(Scales()),
            "noise": dataclasses.asdict(Noise()),
        },
    }


def _write(simulators: frozen.Frozen, manifest: dict[str, Any]) -> None:
    out, training = simulators.folder, simulators.training_breaths
    save_plant(out / frozen.MEMBERS, simulators.members)
    arrays = {**vars(training.prints), "fold": training.fold}
    files.write_atomically(out / frozen.TRAINING_LIST, lambda file: np.savez(file, **arrays))  # pyright: ignore[reportArgumentType]
    names = (frozen.MEMBERS, frozen.TRAINING_LIST)
    hashes = {"files": {name: {"sha256": files.sha256(out / name)} for name in names}}
    files.write_text(out / frozen.MANIFEST, tomli_w.dumps(manifest | hashes))
