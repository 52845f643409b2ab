"""Tuning constants of a diagnosis, with reasons; chi-square is that of -2 ln likelihood, a share a fraction of one."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from balance_cli.diagnosis.choices import SIGNIFICANCE_LEVEL
from balance_cli.diagnosis.data_test_settings import DataTestSettings
from balance_cli.diagnosis.fit_settings import FitSettings, LateChannelSettings, TimedFitSettings
from balance_cli.diagnosis.hold_out_settings import FreeSimulationSettings, HoldOutSettings
from balance_cli.estimation.deadline import Deadline


@dataclass(frozen=True)
class ScoreSettings:
    """The score test of candidates, before any refit."""

    min_information_share: float = 1e-9
    """Share of a candidate's information that the fitted parameters must leave: less may be rounding."""
    min_remaining_share: float = 1e-12
    """The same of one parameter alone, whose small differences are computed without errors of first order."""
    screening_lines: int = 2000
    """Spectral lines on which all candidates are scored: enough to rank them."""
    tone_lines: int = 5
    """Lines of a run that a tone fills: its main lobe, and one on either side for a tone that is not quite there."""
    full_score_candidates: int = 40
    """Best candidates of the screening that are scored on all lines: ten times as many as are refitted."""
    step_fractions: tuple[float, ...] = (1.0, 0.3, 0.1, 0.03)
    """Fractions of a score's step that are tried in turn until chi-square falls: the score is only linear."""
    min_noise_dof: float = 1.0
    """Degrees of freedom of a noise of which nothing is known: with one, F makes hardly any gain significant."""
    min_tested_gain: float = 10.0
    """Gain above which the noise of each static line is looked at: a smaller one is not significant in any noise."""


@dataclass(frozen=True)
class RoundSettings:
    """Rounds of the search, each of which adds one effect."""

    max_effects: int = 12
    """Effects that a search adds: a bound for data that no set of effects describes."""
    max_leading: int = 3
    """Leading effects of a round that are refitted: a score ranks them only approximately."""
    min_score_share: float = 0.2
    """Share of the best score that makes a leading effect worth a refit."""
    nuisance_score_share: float = 0.1
    """The same for effects with several nuisance parameters, whose scores can be far too small."""
    max_nuisance_trials: int = 1
    """Such effects that are refitted beside the leading ones."""
    min_rival_score_share: float = 0.1
    """Score without nuisance parameters, over a gain with them, worth a refit: without cause they gain 4 times it."""
    max_full_fits: int = 2
    """Candidates of a round that are fitted until stable."""
    min_partial_gain_share: float = 0.7
    """Share of the best gain of first steps that makes a candidate one of them."""
    slow_progress: float = 0.7
    """Model error after a round, over that before, above which the fit may be in a wrong minimum."""
    min_progress: float = 0.05
    """Relative decrease of the model error that counts as progress. Smaller steps describe and do not explain."""
    small_error: float = 1e-3
    """Model error (share of the response) below which the tests against the noise take over."""
    stuck_error: float = 0.05
    """Model error above which single motions are restarted: beside a right support little is left."""
    max_restarts: int = 4
    """Values of effects that are replaced one after another where a fit is stuck: each takes a fit for each motion."""
    gross_error: float = 0.3
    """Model error above which effects of all channels are tried by whole fits: a wrong delay or filter leaves it."""
    large_error: float = 3e-3
    """Model error above which a fit may be in a wrong minimum, and its weights must carry the error."""
    alternative_gain_share: float = 0.9
    """Share of an effect's gain by which another candidate of its round becomes an alternative."""


@dataclass(frozen=True)
class UnmodelledModeSettings:
    """Resonances of free shape, where the library is exhausted."""

    max_peaks: int = 5
    """Frequencies at which a resonance is tried: not every peak of the residual is a mode."""
    peak_width: float = 0.08
    """Half-width of a peak over its frequency: a mode of damping ratio 0.02 has fallen to a quarter there."""
    max_modes: int = 3
    """Resonances added at most: one for each direction."""
    max_rounds: int = 6
    """Rounds, each of which adds a resonance or an effect that one had hidden: as many effects as resonances."""
    max_whole_fits: int = 3
    """Frequencies from which a resonance is fitted where a search is stuck: each takes as long as a round."""


@dataclass(frozen=True)
class PointMassSettings:
    """The place of a point mass that gains most, and its fit."""

    strained_sigma: float = 3.0
    """Standard deviations of the priors' chi-square from which a mass is also scored as a part of the declared ones."""
    grid: int = 25
    """Points along each axis of the grid from which the best place is refined."""
    min_remaining_share: float = 1e-12
    """Share of a mass's information that remains at least, so that nothing is divided by rounding error."""
    steps: int = 3
    """Gauss-Newton steps of mass and place: a bound, the valley along mass times arm is followed step by step."""
    follow_steps: int = 4
    """Steps of all parameters after each: beside a narrow resonance the change of the mass was a large one."""


@dataclass(frozen=True)
class MassRegionSettings:
    """Differential evolution (Storn and Price, J. Global Optim. 11 (1997) 341) over the places of a mass."""

    rounds: int = 60
    """Generations."""
    children: int = 3000
    """Places evaluated in each generation: all at once, as one product of matrices."""
    survivors: int = 600
    """Places kept beside the extremes: enough for differences in all directions of the region."""
    end_places: int = 5
    """Places kept at each end of each parameter: their differences lead along the end."""
    widest_step: float = 0.3
    """Largest random step, relative to the reach of the rig."""
    narrowest_step: float = 1e-5
    """Smallest random step, relative to the reach of the rig: it fixes how well the ends are resolved."""
    stride: float = 2.0
    """Longest step along a difference of two places: the factor F of Storn and Price, who recommend 0 to 2."""
    max_gain_deficit: float = 12.0
    """Loss of chi-square against the best place up to which a place is kept: three times that of the region."""
    seed: int = 1985
    """Seed of the random numbers, so that the same data give the same region."""


@dataclass(frozen=True)
class MainsFrequencySettings:
    """Search of the mains frequency around a fitted one."""

    search_range: float = 0.5
    """Distance from the fitted frequency [Hz] that is searched: grids keep within 0.2 Hz."""
    max_departure: float = 0.2
    """Distance of a fitted frequency [Hz] from its start from which it is no grid's, and the start is searched too."""
    spacing: float = 0.005
    """Spacing of the grid [Hz]: the main lobe of a one-minute record is 0.03 Hz wide."""
    looks_per_lobe: float = 2.0
    """Looks in each lobe of 1/T: so counted, the p-value of chi-square bounds the gains of tones in simulated noise."""
    amplitude_range: float = 30.0
    """Factor by which the amplitude may be larger or smaller: beside a main lobe it is fitted far too small."""
    amplitude_count: int = 60
    """Amplitudes that are tried at each frequency: steps of 12 %."""


@dataclass(frozen=True)
class CrossValidationSettings:
    """Gain on lines from which a step was not taken."""

    folds: int = 8
    """Parts of the lines: each step sees seven eighths of them."""
    block: int = 8
    """Adjacent lines that stay together: neighbors share what is wrong with them."""
    max_fold_share: float = 0.8
    """Share of the information above which a fold cannot be predicted from the others."""
    min_predictable_share: float = 0.5
    """Share of the information that must lie in predictable folds for the test to say anything."""


@dataclass(frozen=True)
class SelectionSettings:
    """Tests of the effects against the noise, on all lines."""

    significance_level: float = SIGNIFICANCE_LEVEL
    """Bonferroni-corrected p-value below which an effect is accepted: one false alarm in 300 campaigns."""
    negligible_p_value: float = 1e-3
    """p-value above which a smaller place of an effect serves as well: without correction, one place is one test."""
    max_rounds: int = 8
    """Rounds, each of which adds one effect: a bound, as for the search."""
    max_passes: int = 2
    """Passes through confirmation, pruning and comparison: a second one where an alternative was better."""
    min_effect_share: float = 0.1
    """Share of the unexplained chi-square that an effect must take off: any effect can imitate a little of another."""
    strong_gain: float = 1e3
    """Gain of chi-square above which Wald's statistic is enough and no refit without the effect is needed."""
    hurried_steps: int = 3
    """Steps of a fit once the time is over: the first is the linear one, two correct it."""
    max_refits: int = 4
    """Candidates of a round that are refitted."""
    refit_score_deficit: float = 12.0
    """Score below the best one up to which a refit may reverse the order, beside `score_inaccuracy`."""
    score_inaccuracy: float = 0.1
    """Relative error of a score: it takes the effect for a linear one."""
    nuisance_score_share: float = 0.2
    """Share of the best score that makes a candidate with nuisance parameters worth its first steps."""
    max_nuisance_refits: int = 2
    """Such candidates whose first steps are taken."""
    max_alternatives: int = 4
    """Alternatives of an effect that are refitted."""
    alternative_score_deficit: float = 8.0
    """As `refit_score_deficit`, for alternatives of a weak effect, whose loss a refit has measured."""
    max_causes: int = 4
    """Causes that a rig may have at once: more are less likely than one that no effect of the library describes."""
    equal_sigma: float = 4.0
    """Standard deviations within which two values are one: of eight channels none departs so far by chance."""
    equal_share: float = 0.05
    """Share of a value that a difference must stay below, too: values known no better agree with any other."""
    doubt_bands: int = 8
    """Bands of a run whose pulls on an effect are compared: the narrowest hold a mode each."""
    doubt_sigma: float = 3.0
    """Sigma by the scatter of these pulls that an effect must have beside a residual: one part alone makes less."""
    max_replaced: int = 6
    """Effects that alternatives may replace: two that replace each other in turn must end."""
    invisible_chi2: float = 1e-3
    """Change of chi-square that counts as none at all."""
    detectable_chi2: float = 4.0
    """Change of chi-square that can be told from noise: two sigma of one parameter."""
    too_good_chi2_per_dof: float = 0.7
    """chi2/dof below which the noise was smaller than was measured."""


@dataclass(frozen=True)
class ResidualMapSettings:
    """The residual by run, frequency band and channel, and the sentence that describes it."""

    bands: int = 30
    """Frequency bands: as many as a figure can show."""
    clear_rms: float = 1.1
    """Rms of a run, band or channel, over the noise, that is more than an error of the noise itself."""
    clear_field: float = 2.5
    """Rms of a single field of the map that is more than noise: for one line its p-value is exp(-2.5^2) = 0.002."""
    field_values: int = 2
    """Real values that a field holds at least: one complex line."""
    sigma: float = 4.0
    """Standard deviations by which chance may raise a mean square: p = 3e-5, for thirty bands and more."""
    named_share: float = 0.3
    """Share of the largest excess that makes a run, band or channel worth naming."""
    lags: int = 20
    """Lags of the correlation between lines, as many as of the innovations of a filter (see `kalman.innovations`)."""
    max_named: int = 3
    """Runs, bands or channels named at most."""


@dataclass(frozen=True)
class WorthSettings:
    """What forgetting an effect does to the hub loads."""

    harmonics: int = 8
    """Harmonics of the rotor speed, as `reduce` takes by default."""
    negligible: float = 0.1
    """Worth below which an effect is of no consequence: a tenth of a sigma is lost in the error of the sigma itself."""
    refit_rounds: int = 2
    """Rounds of fit and model error without a large effect: the second has the weights of what it leaves."""
    refit_steps: int = 6
    """Steps of each: 12 steps and 8 rounds change the worth of the sample campaign's effects by up to 3 %."""


@dataclass(frozen=True)
class SearchSettings:
    """All tuning constants of a diagnosis."""

    score: ScoreSettings = field(default_factory=ScoreSettings)
    fit: FitSettings = field(default_factory=FitSettings)
    rounds: RoundSettings = field(default_factory=RoundSettings)
    late_channels: LateChannelSettings = field(default_factory=LateChannelSettings)
    modes: UnmodelledModeSettings = field(default_factory=UnmodelledModeSettings)
    mains: MainsFrequencySettings = field(default_factory=MainsFrequencySettings)
    point_mass: PointMassSettings = field(default_factory=PointMassSettings)
    mass_region: MassRegionSettings = field(default_factory=MassRegionSettings)
    cross_validation: CrossValidationSettings = field(default_factory=CrossValidationSettings)
    selection: SelectionSettings = field(default_factory=SelectionSettings)
    data_tests: DataTestSettings = field(default_factory=DataTestSettings)
    residual_map: ResidualMapSettings = field(default_factory=ResidualMapSettings)
    worth: WorthSettings = field(default_factory=WorthSettings)
    hold_out: HoldOutSettings = field(default_factory=HoldOutSettings)
    free_simulation: FreeSimulationSettings = field(default_factory=FreeSimulationSettings)
    parameter_cost: float = 6.0
    """What a parameter costs in chi-square: AIC asks 2, BIC ln n = 5.7 for the 300 lines of the search."""
    indistinguishable_chi2: float = 6.0
    """Difference of chi-square within which two explanations are equally good: a log-likelihood ratio of 3."""
    alternative_gap: float = 30.0
    """Difference of chi-square on which an explanation is not yet rejected: the plate, or all lines, may reverse it."""
    time_limit: float = 300.0
    """Seconds of computing after which no further round begins and fits hurry to their end: the longest wait."""
    excluded: tuple[str, ...] = ()
    """Effects (NAME or NAME@PLACE) that are no candidates: by the user, or contradicted by a free simulation."""
    suspected: tuple[str, ...] = ()
    """Effects (NAME or NAME@PLACE) that are tried first, and tested in any case."""

    def begin(self) -> SearchSettings:
        """Return the settings with the time running, if it is not yet."""
        if self.fit.deadline is not None:
            return self
        deadline = Deadline(self.time_limit, hurried_iterations=self.selection.hurried_steps)
        return replace(self, fit=TimedFitSettings(**vars(self.fit), deadline=deadline))

    def without_deadline(self) -> SearchSettings:
        """Return the settings as they are stored."""
        return replace(self, fit=self.fit.without_deadline())


DEFAULT_SETTINGS = SearchSettings()
