"""Every threshold of a verdict, in one versioned object.

``nats`` are differences of log-likelihood (natural logarithm). ``criterion`` is the Bayesian
information criterion, ``-2 log L + k log n``, so that 2 of it correspond to one nat. How they act
together is told in ``docs/missing_physics_method.md``.
"""

from __future__ import annotations

from dataclasses import dataclass, field

#: Raised when a value or the meaning of a setting changes.
VERSION = "evidence-4"


@dataclass(frozen=True)
class DataSettings:
    """Selection of the breaths that are used, and of those that are held out."""

    min_breaths: int = 4  #: fewest usable breaths, since each side of the split needs two.
    held_out_every: int = 3  #: every how many-th breath of a lung is held out to test terms.
    #: every how many-th breath of a lung is held out of fits and tests alike, to choose the
    #: corrected simulator and to measure its error.
    judging_every: int = 6
    #: breaths of a lung from which some can be spared for that; with fewer, those that test terms
    #: judge as well, and fits never see them.
    judging_from: int = 18
    #: breaths that are simulated at once. One size means one compilation; two thirds of 60 breaths
    #: are one batch.
    batch_size: int = 40
    #: share of the readings that must equal the largest one exactly to be taken for a saturated
    #: sensor; ten times as many as equal the next smaller reading.
    saturated_share: float = 0.01
    #: scale, as a share, of the differences between a lung's R and C and its label: tolerances of
    #: test lungs, and of the valve's gain, which scales both.
    label_tolerance: float = 0.15


@dataclass(frozen=True)
class FitSettings:
    """Maximum-likelihood fits of a hypothesis and of its noise."""

    #: expected fall of the cost, nats, at which a fit ends; far below any gain that is compared.
    tolerance: float = 0.02
    iterations: int = 14  #: most steps of a fit.
    #: ends the fit of a breath's own parameters to a breath that is evaluated.
    breath_tolerance: float = 0.1
    breath_iterations: int = 4  #: most steps of that fit, whose parameters act almost linearly.
    #: log-likelihood, nats, that another estimate of the noise must gain; less is within the
    #: tolerance of the fits.
    noise_gain: float = 2.0
    noise_rounds: int = 5  #: most times that parameters and noise are estimated in turn.
    #: log-likelihood, nats, by which another dead time must be better to be jumped to.
    delay_gain: float = 2.0
    delay_rounds: int = 2  #: most times that a fit is continued from another dead time.


@dataclass(frozen=True)
class SearchSettings:
    """The search by evidence."""

    #: basis terms that are candidates; None for all that are registered.
    nonparametric_terms: tuple[str, ...] | None = None
    beam: int = 24  #: sets of each size that are extended by another term.
    fits: int = 4  #: sets of the linear problem that are fitted.
    most_terms: int = 5  #: most terms of a set.
    far_behind: float = 500.0  #: log evidence, nats, by which a set is behind that is given up.
    #: factor between a refitted R or C and its label beyond which sets are also enumerated around
    #: the label: strong lags let a refit take R to nothing.
    label_factor: float = 1.3
    #: log-likelihood, nats, that a course in time must gain: more than a term, since breaths and
    #: frequencies are searched.
    course_nats: float = 8.0
    #: root mean square, cmH2O, of the error that a nonparametric term beside mechanisms explains,
    #: to be kept: less may be their form, or what every rig has.
    least_change: float = 0.1
    #: noise that smoothing leaves of a flow that drives the model, mL/s; 0 where commands drive it.
    #: Times R, it is error that a filter takes away though no rig has one: a term must take more.
    drive_noise: float = 0.0
    #: what every ventilator has: edges of its outlet, valve, supply, and tubes. Where what a search
    #: leaves is no noise of a sensor, it is repeated from these.
    ventilator: tuple[str, ...] = (
        "exhalation_valve_delay",
        "exhalation_valve_closing",
        "valve_curve",
        "valve_dead_band",
        "valve_delay",
        "supply_droop",
        "turbulent_resistance",
        "circuit_compliance",
    )
    #: open-loop error on held-out breaths over that of the first search, below which the second
    #: stands.
    error_ratio: float = 0.9
    much: float = 100.0  #: criterion from which a set that is not accepted leaves much missing.


@dataclass(frozen=True)
class HeldOutTestSettings:
    """Test whether held-out breaths ask for a term."""

    #: log-likelihood ratio on held-out breaths, nats: log(1 / 0.01), so that chance exceeds it in
    #: at most 1 % of recordings (Markov's inequality).
    threshold: float = 4.6
    resampled: float = 2.3  #: the same of resampled breaths, in 97.5 % of draws: log(10).
    #: gain of criterion on the training breaths from which cross-validation is tried where the
    #: held-out breaths are too few to tell.
    clear_criterion: float = 20.0
    #: times the threshold that cross-validation must pass, since its folds share breaths.
    cross_validation_factor: float = 1.5
    #: share of a mild strength below which a term that a simulator has may differ from its own.
    negligible_strength: float = 0.2
    negligible_share: float = 0.1  #: share of what all terms gain below which it then is no other.


@dataclass(frozen=True)
class PlausibilitySettings:
    """Which fitted mechanisms are statements about a rig."""

    effort_breaths: int = 2  #: fewest breaths in which an effort must reach the least strength.
    effort_share: float = 0.1  #: least share of the breaths in which it must.
    #: least share of the sum of their squares that must pull: muscles that push at random are
    #: another effect.
    effort_pulls: float = 0.8


@dataclass(frozen=True)
class CorrectionSettings:
    """The corrected simulator, and what it leaves unexplained."""

    #: factors on the labels' R and C from which refits start as well; a label may be that of
    #: another lung.
    lung_factors: tuple[float, ...] = (0.3, 0.5, 0.7, 1.0, 1.5, 2.2, 3.3)
    #: whitened size, in standard deviations, from which outliers count less in refits for the least
    #: open-loop error.
    tail: float = 5.0
    #: error of such a refit over that of the reported parameters, below which the corrected
    #: simulator has the refit's parameters.
    drift_ratio: float = 0.98


@dataclass(frozen=True)
class SimulatorSettings:
    """Comparison of the recording with the simulator under diagnosis."""

    #: share of the recording-only model's error below which the recording is modelled as the
    #: simulator plus a residual model.
    residual_model_share: float = 0.9
    #: times the joint half-width of two 95 % intervals by which strengths differ; each mechanism of
    #: many simulators is compared, and false alarms are to be rare.
    separation: float = 1.4
    noise_seed: int = 20260101  #: seed of the noise that is added to the simulator's response.


@dataclass(frozen=True)
class ResidualSettings:
    """Test of where the simulator errs: ranges of phase, command, pressure and so on."""

    min_breaths: int = 5  #: fewest breaths that a range must have.
    flips: int = 2000  #: random sign flips; a p-value is at least ``1 / (flips + 1)``.
    level: float = 0.05  #: family-wise chance that any range is reported if nothing is missing.
    certain: float = 0.01  #: p-value below which ranges are ordered by their share of the error.
    #: false discovery rate of the tests that veto "nothing is missing": as rare as a false name, by
    #: ``held_out_test.threshold``.
    veto_level: float = 0.01
    #: root-mean-square error, cmH2O, below which an effect is worth nothing: the step of a
    #: converter of 12 bits over 80 cmH2O.
    negligible: float = 0.02


@dataclass(frozen=True)
class SelectionConfig:
    """All settings of a diagnosis, which are part of ``diagnosis.json``."""

    data: DataSettings = field(default_factory=DataSettings)
    fit: FitSettings = field(default_factory=FitSettings)
    search: SearchSettings = field(default_factory=SearchSettings)
    held_out_test: HeldOutTestSettings = field(default_factory=HeldOutTestSettings)
    plausibility: PlausibilitySettings = field(default_factory=PlausibilitySettings)
    correction: CorrectionSettings = field(default_factory=CorrectionSettings)
    simulator: SimulatorSettings = field(default_factory=SimulatorSettings)
    residuals: ResidualSettings = field(default_factory=ResidualSettings)
    version: str = VERSION


#: Settings of a diagnosis by default.
DEFAULT = SelectionConfig()
