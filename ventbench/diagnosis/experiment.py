"""A recording as an experiment on a simulator: breaths with one use each, and a sealed judge.

Each breath has one use, so that no question is answered by breaths that an earlier one has used up:
*training* breaths fit hypotheses, *testing* breaths decide which terms are needed, and *judging*
breaths choose the corrected simulator and measure its error. The readings of judging breaths are
blank in the experiment, but for the first, from which every simulation starts: a :class:`Judge`
alone has them, and answers how far predictions are off. It predicts from the commands as they were
recorded, and leaves no breath out, whatever is found to act in it.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np

from ventbench.base.arrays import Bools, Floats
from ventbench.base.errors import InputError
from ventbench.diagnosis import flow_drive
from ventbench.diagnosis.findings import OpenLoopError
from ventbench.diagnosis.residual_analysis import Excess, amplitudes, excess_over_noise
from ventbench.diagnosis.settings import DEFAULT, DataSettings
from ventbench.plants.simulators import SimulatedPressures, Simulators
from ventbench.recordings.breaths import Breaths
from ventbench.recordings.decimation import decimate, is_fast
from ventbench.system_id.data import Data, Noise, make_data

#: A breath needs more inspiratory samples with a pressure than these.
_INSPIRATORY = 3

#: Breath ids that a note lists at most.
_LISTED = 5

#: Fewest breaths that must be left beside an effect of some breaths, and of each lung.
_MIN_BREATHS, _MIN_PER_LUNG = 8, 2

_NOTE_ON_FLOW = (
    "No valve command: the recorded flow drives the model, so nothing is said of the valves, R_ex "
    "and PEEP, and an offset of the flow sensor looks like a leak."
)


#: Multiples of the noise by which a breath may err in which an effect acts that nobody predicts.
_ROUGH = (4.0, 16.0, 64.0, 256.0)


@dataclass(frozen=True, eq=False)
class Split:
    """Use of n breaths; masks ``(n,)``."""

    testing: Bools  #: breaths that decide which terms a model needs.
    #: breaths that choose the corrected simulator and measure its error. A lung with few breaths
    #: has none to spare: its testing breaths judge as well.
    judging: Bools
    #: breaths that an effect of some breaths takes: they fit and test nothing, and judge all the
    #: same.
    aside: Bools

    @property
    def identifying(self) -> Bools:
        """Breaths that the identification may see: training and testing breaths."""
        return (~self.judging | self.testing) & ~self.aside

    @property
    def fitted(self) -> Bools:
        """Breaths of the final fits: all that do not judge."""
        return ~self.judging & ~self.aside

    @property
    def share_aside(self) -> float:
        """Share of the breaths of the fits that an effect of some breaths has set aside."""
        return float(self.aside[~self.judging].mean())

    @property
    def sealed(self) -> Bools:
        """Breaths whose readings nothing but the judge has."""
        return self.judging & ~self.testing


def held_out(breaths: Breaths, settings: DataSettings = DEFAULT.data) -> Bools:
    """Every third breath (by default) of each lung, from its second on, bool, ``(n,)``."""
    chosen = np.zeros(len(breaths), bool)
    for index in breaths.by_lung_index.values():
        chosen[np.sort(index)[1 :: settings.held_out_every]] = True
    return chosen


def split(
    breaths: Breaths, settings: DataSettings = DEFAULT.data, never_fitted: Collection[int] = ()
) -> Split:
    """Assign the breaths to their uses.

    Args:
        breaths: n breaths.
        settings: how many are held out, and for what.
        never_fitted: ids of breaths that were held out when the simulator was made; they judge it.
    """
    testing, judging = held_out(breaths, settings), np.zeros(len(breaths), bool)
    earlier = np.isin(breaths.breath_id, list(never_fitted))
    for index in map(np.sort, breaths.by_lung_index.values()):
        tests, judges = testing[index], np.zeros(len(index), bool)
        if earlier[index].any() and not np.all(earlier[index] | tests):
            judges = earlier[index]
        elif len(index) >= settings.judging_from:
            judges[settings.judging_every - 1 :: settings.judging_every] = True
        else:
            judges = tests
        judging[index] = judges
        if np.any(tests & ~judges):
            testing[index] = tests & ~judges
    return Split(testing, judging, np.zeros(len(breaths), bool))


def never_fitted(breaths: Breaths, simulators: Simulators) -> tuple[int, ...]:
    """Ids of the breaths that were held out when a simulator was made of the same recording."""
    origin = simulators.origin
    if breaths.sha256 is None or origin.get("recording_sha256") != breaths.sha256:
        return ()
    return tuple(int(breath) for breath in origin.get("held_out_breaths", ()))


def saturation(
    breaths: Breaths, settings: DataSettings = DEFAULT.data
) -> tuple[float, float] | None:
    """Reading at which the pressure sensor saturates, cmH2O, and its share; None if it does not.

    A saturated reading is censored: it says only that the pressure was at least that. Readings that
    merely come near a largest one thin out towards it; those that saturate pile up there. A sensor
    that saturates on one lung of a session does so on all.
    """
    pressure = np.where(breaths.valid, breaths.pressure, np.nan)
    finite = np.isfinite(pressure)
    top = float(np.max(pressure, initial=-np.inf, where=finite))

    def piles_up(readings: Floats) -> bool:
        values, counts = np.unique(readings[np.isfinite(readings)], return_counts=True)
        if len(values) < 2 or values[-1] < top:
            return False
        return bool(counts[-1] >= max(settings.saturated_share * counts.sum(), 10 * counts[-2]))

    if not any(piles_up(pressure[index]) for index in breaths.by_lung_index.values()):
        return None
    return top, float(np.mean(pressure[finite] == top))


def below(breaths: Breaths, top: float) -> Breaths:
    """The breaths without readings of ``top`` cmH2O or more."""
    return replace(breaths, pressure=np.where(breaths.pressure >= top, np.nan, breaths.pressure))


def usable(breaths: Breaths, settings: DataSettings = DEFAULT.data) -> tuple[Breaths, list[str]]:
    """Breaths that can be diagnosed, and notes on the others.

    Raises:
        InputError: if too few are left, or no lung has two.
    """
    fewest, pressure = settings.min_breaths, np.isfinite(breaths.pressure)
    good = pressure[:, 0] & (np.sum(pressure & breaths.inspiratory, axis=1) > _INSPIRATORY)
    good &= np.any(breaths.u_in > 0, axis=1)
    notes = []
    if not good.all():
        ids = ", ".join(map(str, breaths.breath_id[~good][:_LISTED].tolist()))
        notes.append(
            f"{int((~good).sum())} breaths without a first pressure, inspiration or any command "
            f"were left out (breath_id {ids}...)."
        )
    if good.sum() < fewest:
        raise InputError(
            f"{int(good.sum())} usable breaths; a diagnosis needs at least {fewest} of a lung with "
            "pressures and commands"
        )
    breaths = breaths.select(good)
    if not held_out(breaths, settings).any():
        raise InputError(
            "no lung has two usable breaths, so that none can be held out; record at least "
            f"{fewest} of a lung"
        )
    return breaths, notes


class Judge:
    """How far predictions are off on breaths whose readings nothing else has."""

    def __init__(self, breaths: Breaths, judging: Bools) -> None:
        """Take the readings.

        Args:
            breaths: n breaths of T samples.
            judging: those that judge, ``(n,)``.
        """
        self.judging = judging
        self.ids = tuple(int(i) for i in breaths.breath_id[judging])
        self._recorded = np.where(judging[:, None] & breaths.valid, breaths.pressure, np.nan)

    def error(self, predicted: Floats, where: Bools) -> OpenLoopError:
        """Error of predictions over the samples of a mask, ``(n, T)``; NaN if there is none."""
        return open_loop_error(self._recorded, predicted, where)

    def excess(self, predicted: Floats, nuisance: Floats, quiet: Bools) -> Excess:
        """What neighbouring errors share beyond noise; see :func:`.excess_over_noise`.

        Args:
            predicted: predictions, cmH2O, ``(n, T)``.
            nuisance: derivatives of the pressure by nuisance parameters of each breath, such as a
                start that differs from its first reading, which is noisy, ``(n, T, k)``.
            quiet: where nothing moves, ``(n, T)``.
        """
        error = (self._recorded - predicted)[self.judging]
        usable, nuisance = np.isfinite(error), nuisance[self.judging]
        error = np.where(usable, error, 0.0)
        error = error - np.einsum("ntk,nk->nt", nuisance, amplitudes(error, usable, nuisance))
        return excess_over_noise(error, usable, quiet[self.judging])

    def log_likelihood(self, predicted: Floats, noise: Noise, share: float) -> float:
        """Log-likelihood of predictions, nats.

        Args:
            predicted: predictions, cmH2O, ``(n, T)``.
            noise: measurement noise.
            share: of the breaths in which an effect acts that nobody predicts: these err more.
        """
        error = (predicted - self._recorded)[self.judging][:, None]
        weight = np.isfinite(error).astype(float)
        error, count = np.nan_to_num(error), weight.sum(axis=(1, 2))
        nats = noise.log_likelihood(error, weight)
        if share > 0.0:
            rough = [noise.log_likelihood(error / k, weight) - count * np.log(k) for k in _ROUGH]
            affected = np.logaddexp.reduce(rough, axis=0) - np.log(len(_ROUGH))
            nats = np.logaddexp(np.log1p(-share) + nats, np.log(share) + affected)
        return float(nats.sum())


def seal(breaths: Breaths, uses: Split) -> tuple[Breaths, Judge]:
    """The breaths without the readings of those that judge alone, and the judge that has them."""
    hidden = np.repeat(uses.sealed[:, None], breaths.pressure.shape[1], axis=1)
    hidden[:, 0] = False
    blank = np.where(hidden, np.nan, breaths.pressure)
    return replace(breaths, pressure=blank), Judge(breaths, uses.judging)


def open_loop_error(recorded: Floats, simulated: Floats, mask: Bools) -> OpenLoopError:
    """Error over the samples of a mask, all ``(n, T)``; NaN if there is none."""
    error = (simulated - recorded)[mask & np.isfinite(recorded) & np.isfinite(simulated)]
    if error.size == 0:
        return OpenLoopError(float("nan"), float("nan"))
    return OpenLoopError(float(np.mean(np.abs(error))), float(np.sqrt(np.mean(error**2))))


@dataclass(frozen=True, eq=False)
class Experiment:
    """n breaths of T samples, on the grid of the fits."""

    recorded: Breaths  #: the breaths as they were sampled; sealed.
    unsealed: Breaths  #: the breaths with all readings, for pictures of the result alone.
    #: the breaths; sealed. Commands of those that do not judge are those that reached the valve,
    #: as far as that is found.
    breaths: Breaths
    data: Data  #: the same as numbers of a fit.
    reached: Floats  #: commands that fits and tests take, %, ``(n, T)``.
    uses: Split
    before: Floats  #: pressures of the simulator as given, cmH2O, ``(n, T)``.
    judge: Judge
    simulators: Simulators  #: what is diagnosed.
    by_flow: bool  #: whether the recorded flow drives the model.
    #: reading at which the pressure sensor saturates, cmH2O, and share of the readings that do.
    saturated: tuple[float, float] | None
    notes: tuple[str, ...]

    @property
    def identification_data(self) -> Data:
        """Breaths that the identification sees."""
        return replace(self.data, u_in=self.reached).select(self.uses.identifying)

    def set_aside(self, affected: Bools, u_in: Floats | None) -> Experiment | None:
        """The experiment without an effect of some breaths; None if too little is left.

        Breaths that judge keep their commands and judge on.

        Args:
            affected: in which breaths it acts, ``(n,)``.
            u_in: commands that reached the valve, %, ``(n, T)``; None if the affected breaths are
                to be set aside.
        """
        uses = self.uses
        if u_in is not None:
            judging = uses.judging[:, None]
            breaths = replace(self.breaths, u_in=np.where(judging, self.breaths.u_in, u_in))
            changed = replace(
                self, breaths=breaths, data=replace(self.data, u_in=breaths.u_in), reached=u_in
            )
            if self.simulators.is_base_physics:
                return changed
            decimated = self.recorded.u_in.shape != u_in.shape
            if (
                isinstance(self.simulators, SimulatedPressures)
                or decimated
                or (~uses.sealed & judging[:, 0]).any()
            ):
                return None  # no answer of the simulator to these commands is known
            answered = self.simulators.pressures(breaths)
            return replace(changed, before=np.where(judging, self.before, answered))
        aside = uses.aside | affected
        remaining = replace(uses, testing=uses.testing & ~aside, aside=aside)
        of_lungs = [
            np.count_nonzero(remaining.fitted[index])
            for index in self.breaths.by_lung_index.values()
        ]
        if (
            remaining.identifying.sum() < _MIN_BREATHS
            or not remaining.testing.any()
            or min(of_lungs) < _MIN_PER_LUNG
        ):
            return None
        return replace(self, uses=remaining)


def prepare(
    breaths: Breaths,
    simulators: Simulators,
    settings: DataSettings = DEFAULT.data,
    *,
    by_flow: bool = False,
) -> Experiment:
    """Assign the breaths to their uses, simulate them, and seal those that judge.

    Args:
        breaths: recorded breaths; those that cannot be used are left out.
        simulators: what is diagnosed.
        settings: which breaths are used, and for what.
        by_flow: whether the recorded flow drives the model.

    Raises:
        InputError: if too few breaths are left.
    """
    notes: list[str] = []
    if by_flow:
        breaths, notes = flow_drive.with_flow(breaths)
    unsealed, notes_on_breaths = usable(breaths, settings)
    uses = split(unsealed, settings, never_fitted(unsealed, simulators))
    saturated = saturation(unsealed.select(~uses.sealed), settings)
    if saturated is not None:
        unsealed = below(unsealed, saturated[0])
    recorded = seal(unsealed, uses)[0]
    notes = [*notes_on_breaths, *notes]
    if by_flow:
        driven, index = flow_drive.drive_grid(unsealed)
        before = flow_drive.simulate(simulators, unsealed, driven, index)
        # Phases of the report are those of the recording.
        fitted = driven
        unsealed = replace(driven, u_out=np.take_along_axis(unsealed.u_out, index, axis=1))
        notes.append(_NOTE_ON_FLOW)
    else:
        before = simulators.pressures(unsealed)
        if is_fast(unsealed):
            rate = 1.0 / float(np.median(unsealed.dt[unsealed.valid]))
            grid = decimate(unsealed)
            unsealed, before = grid.breaths, grid.of(before)
            notes.append(_note_on_rate(rate, unsealed))
        fitted = unsealed
    sealed, judge = seal(unsealed, uses)
    data = make_data(replace(sealed, u_out=fitted.u_out))
    if by_flow:
        data = flow_drive.begun(data, fitted)
    return Experiment(
        recorded,
        unsealed,
        sealed,
        data,
        data.u_in,
        uses,
        before,
        judge,
        simulators,
        by_flow,
        saturated,
        tuple(notes),
    )


def _note_on_rate(rate: float, breaths: Breaths) -> str:
    """Note on what was kept of a fast recording."""
    commands = breaths.valid.sum(axis=1)
    readings = np.isfinite(breaths.pressure).sum(axis=1)
    return (
        f"Recorded at {rate:.0f} Hz: {int(np.median(readings))} readings of a breath are used, "
        f"and {int(np.median(commands))} samples of its commands, whose changes keep their times."
    )
