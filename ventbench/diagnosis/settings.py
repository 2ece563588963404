"""Every threshold of a verdict, in one versioned object.

``nats`` are differences of log-likelihood (natural logarithm). ``criterion`` is the Bayesian
information criterion, ``-2 log L + k log n``, so that 2 of it correspond to one nat. How they act
together is told in ``docs/missing_physics_method.md``.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

#: Raised when a value or the meaning of a setting changes.
VERSION = "selection-14"


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
    quick_tolerance: float = 0.1  #: ends the first fit of a candidate, which only has to be ranked.
    quick_iterations: int = 12  #: most steps of the first fit of a candidate.
    #: ends the fit of a breath's own parameters to a breath that is evaluated.
    breath_tolerance: float = 0.1
    breath_iterations: int = 4  #: most steps of that fit, whose parameters act almost linearly.
    #: most steps where a hypothesis is fitted again with a wider simulator, or where starts are
    #: compared.
    start_iterations: int = 3
    continued_starts: int = 2  #: starts of a candidate from which its first fit goes on.
    #: log-likelihood, nats, that another estimate of the noise must gain; less is within the
    #: tolerance of the fits.
    noise_gain: float = 2.0
    noise_rounds: int = 5  #: most times that parameters and noise are estimated in turn.
    #: log-likelihood, nats, by which another dead time must be better to be jumped to.
    delay_gain: float = 2.0
    delay_rounds: int = 2  #: most times that a fit is continued from another dead time.


@dataclass(frozen=True)
class ScreeningSettings:
    """First-order ranking of what could be added to a hypothesis."""

    #: basis terms that are candidates; None for all that are registered.
    nonparametric_terms: tuple[str, ...] | None = None


@dataclass(frozen=True)
class SearchSettings:
    """The search by evidence."""

    #: basis terms that are candidates; None for all that are registered.
    nonparametric_terms: tuple[str, ...] | None = None
    beam: int = 24  #: sets of each size that are extended by another term.
    fits: int = 4  #: sets of the linear problem that are fitted.
    most_terms: int = 5  #: most terms of a set.
    #: held-out log-likelihood, nats, from which a periodic input is accepted: more than for a term,
    #: since places and frequencies are searched.
    swing_nats: float = 8.0
    #: root mean square, cmH2O, of the error that a nonparametric term beside mechanisms explains,
    #: to be kept: less may be their form, or what every rig has.
    least_change: float = 0.1
    much: float = 100.0  #: criterion from which a set that is not accepted leaves much missing.


@dataclass(frozen=True)
class HeldOutTestSettings:
    """Test whether held-out breaths ask for a term."""

    #: log-likelihood ratio on held-out breaths, nats: log(1 / 0.01), so that chance exceeds it in
    #: at most 1 % of recordings (Markov's inequality).
    threshold: float = 4.6
    #: share of the threshold that must be left once outlying breaths are cut off.
    kept_share: float = 0.5
    #: standard deviations by which the sum over breaths must exceed its scatter.
    consistency: float = 1.3
    typical_quantile: float = 0.8  #: quantile of the gains' absolute values that counts as typical.
    outlier_factor: float = 1.5  #: times that beyond which the gain of one breath is cut off.
    #: gain of criterion on the training breaths from which cross-validation is tried where the
    #: held-out breaths are too few to tell.
    clear_criterion: float = 20.0
    #: times the threshold that cross-validation must pass, since its folds share breaths.
    cross_validation_factor: float = 1.5
    #: share of a mild strength below which a term may be negligible.
    negligible_strength: float = 0.2
    negligible_share: float = 0.1  #: share of the whole explained criterion below which it then is.


@dataclass(frozen=True)
class ForwardSelectionSettings:
    """Comparison of candidates, and the terms that are added."""

    #: first-order gain, nats, below which a candidate is not fitted.
    min_expected_gain: float = 3.0
    #: nats (and criterion) from which much is missing: first order then ranks badly, and all
    #: candidates are fitted.
    large_gain: float = 100.0
    fitted_candidates: int = 6  #: candidates that are fitted otherwise.
    #: candidates that are fitted to all training breaths in any case, where one batch of them ranks
    #: the candidates: as many as may be tried when the best one fails.
    fitted_to_all: int = 4
    #: criterion within which a candidate may still win and is fitted on.
    contender_criterion: float = 60.0
    #: share of the best candidate's gain within which a candidate may still win.
    contender_share: float = 0.1
    #: share of what the best candidate explains by which another one may be behind it after a few
    #: steps and is still fitted on. In 30 comparisons of three recordings with one, two and four
    #: effects, none that ended within a fifth was further behind.
    hopeless_share: float = 0.5
    noise_rounds: int = 3  #: most times that the winner and the noise are chosen in turn.
    max_terms: int = 6  #: most terms of a hypothesis.
    #: most comparisons; a term that was dropped may come back, but not for ever.
    max_rounds: int = 14
    #: factor between a lung's R or C and its label beyond which the search is repeated with R and C
    #: at the label. Labels that are wrong by less move none.
    label_factor: float = 1.5
    #: terms that the search at the label may have more than the one with R and C free before it
    #: must do better: three effects have been missed for one.
    more_at_label: int = 2
    #: terms of a selection with one gain from which a selection with a gain for each breath only
    #: goes on from it, and does not begin anew.
    kept_terms: int = 3
    #: terms from which a single nonparametric term is tried in their place.
    replacement_terms: int = 4
    #: share of what patient effort explains from which an effect that is the same in all breaths is
    #: preferred to it.
    shared_effect_share: float = 0.5
    fallback_candidates: int = 3  #: candidates that are tried where the best one fails its test.
    #: held-out log-likelihood, nats, from which a shape parameter is freed.
    shape_gain: float = 2.0
    #: rivals of a pair, the best first, to which each other one is added.
    exchanged_firsts: int = 3
    exchanged_twos: int = 2  #: such twos, the best first, that are kept for each pair.
    #: twos, and single terms of another form, that are fitted to the end in the place of pairs.
    exchanged_pairs: int = 4


@dataclass(frozen=True)
class RefinementSettings:
    """Backward elimination, and the search for alternatives."""

    #: nonparametric terms that are fitted; the first-order ranking has the right one near its top.
    fitted_terms: int = 5
    #: share of what a nonparametric term explains from which a mechanism that it contains as a
    #: special case stands.
    related_share: float = 0.5
    #: the same where such a mechanism is selected already, of which the term may be the form:
    #: another one must explain nearly all that the term does.
    beside_related_share: float = 0.9
    #: share of what is explained below which a mechanism beside a nonparametric term only
    #: compensates for its form.
    compensating_share: float = 0.1
    #: share of what is explained up to which a mechanism may only compensate for another one's
    #: form.
    max_compensating_share: float = 0.5
    #: root mean square, cmH2O, of the error that a nonparametric term beside mechanisms explains in
    #: any case, to be kept: less may be their form, or what every rig has.
    least_change: float = 0.1
    #: share of the noise's standard deviation that it must explain otherwise.
    least_noise_share: float = 0.5
    #: share of a mechanism's held-out gain by which a nonparametric term may fall short and still
    #: replace it.
    shortfall_share: float = 0.05
    #: nats by which a nonparametric term may fall short and still replace a mechanism, three times
    #: the held-out threshold.
    shortfall_nats: float = 3.0 * 4.6
    #: share of its held-out gain that a compensating mechanism may still have beside the
    #: nonparametric term.
    remaining_share: float = 0.1
    #: share of a mechanism's gain that a nonparametric term must promise to first order to be
    #: fitted.
    promise_share: float = 0.4
    imitation_terms: int = 3  #: terms from which a sum may imitate a single nonparametric term.
    #: criterion within which another mechanism is an alternative; a posterior probability of 1 :
    #: 150.
    close_criterion: float = 10.0
    listed_alternatives: int = 2  #: most alternatives that are listed.
    compared_alternatives: int = 3  #: most alternatives that are compared again at one noise.
    exchanges: int = 2  #: most mechanisms that are exchanged before what they leave is explained.


@dataclass(frozen=True)
class PlausibilitySettings:
    """Which fitted mechanisms are statements about a rig."""

    effort_breaths: int = 2  #: fewest breaths in which an effort must reach the least strength.
    effort_share: float = 0.1  #: least share of the breaths in which it must.
    #: least share of the sum of their squares that must pull: muscles that push at random are
    #: another effect.
    effort_pulls: float = 0.8
    bootstraps: int = 1000  #: resamplings of the held-out breaths.
    bootstrap_level: float = 0.025  #: quantile of the resampled gains that must be positive.
    bootstrap_breaths: int = 4  #: fewest held-out breaths that can be resampled.


@dataclass(frozen=True)
class LatentInputSettings:
    """Inputs that vary in time and that no command explains: Gaussian processes."""

    #: held-out log-likelihood, nats, from which an input is accepted: more than for a term, since
    #: places, scales and sizes are searched. It must also be this far ahead of coloured noise and
    #: of scatter of the valve's gain.
    threshold: float = 8.0
    #: standard deviation, cmH2O, below which an input beside mechanisms is negligible if it
    #: explains little of what they do: a fifth of a mild effort.
    least_size: float = 0.4
    #: standard deviation, cmH2O, from which a periodic input at the sensor is told; less is noise.
    sensor_amplitude: float = 0.3
    #: largest standard deviation, cmH2O, of slow noise of a sensor that patient effort must outdo;
    #: more is physics.
    sensor_noise: float = 1.0
    #: share of what inputs explain from which scatter of the valve's gain between breaths is the
    #: explanation. A course within each breath imitates the scatter and explains some noise as well
    #: (up to 1.6 times as much where gains of a stranger's valve scattered by 1.5 %); what it
    #: explains beyond the gain is found beside the gain. Where an input, or slow noise of the
    #: sensor, explains twice as much, the gain cannot be all. On the public rig, which is several
    #: rigs with gains of their own, slow noise explains three times as much, and a gain for each
    #: breath would hide the curve of the valve.
    scatter_share: float = 0.5
    #: largest scatter of the gain, as a share, that is taken before names are exchanged: what one
    #: valve repeats to. More may be several rigs, or a name that is not right yet; on the public
    #: rig, 22 % were taken for scatter then, and a name too many.
    early_scatter: float = 0.05


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
    #: error of the corrected simulator over the measurement noise from which something is missing,
    #: named or not.
    unexplained_ratio: float = 2.0
    #: least root-mean-square error beyond the noise, cmH2O, for the same.
    unexplained_error: float = 0.5


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
    #: times the scatter of quiet readings from which the model's noise may hold part of what is
    #: missing. Coloured noise scatters about a parabola by a quarter less than at all.
    absorbed: float = 1.5


@dataclass(frozen=True)
class SelectionConfig:
    """All settings of a diagnosis; :meth:`as_dict` is part of ``diagnosis.json``."""

    data: DataSettings = field(default_factory=DataSettings)
    fit: FitSettings = field(default_factory=FitSettings)
    screening: ScreeningSettings = field(default_factory=ScreeningSettings)
    search: SearchSettings = field(default_factory=SearchSettings)
    held_out_test: HeldOutTestSettings = field(default_factory=HeldOutTestSettings)
    forward: ForwardSelectionSettings = field(default_factory=ForwardSelectionSettings)
    refinement: RefinementSettings = field(default_factory=RefinementSettings)
    plausibility: PlausibilitySettings = field(default_factory=PlausibilitySettings)
    latent_inputs: LatentInputSettings = field(default_factory=LatentInputSettings)
    correction: CorrectionSettings = field(default_factory=CorrectionSettings)
    simulator: SimulatorSettings = field(default_factory=SimulatorSettings)
    residuals: ResidualSettings = field(default_factory=ResidualSettings)
    version: str = VERSION

    def as_dict(self) -> dict[str, Any]:
        """JSON values, by group and name."""
        return asdict(self)


#: What a diagnosis uses unless it is told otherwise.
DEFAULT = SelectionConfig()
