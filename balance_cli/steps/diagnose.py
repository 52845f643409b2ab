"""Diagnosis of a model: find the effects that it lacks, add them, and say how much they explain."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.rig_scales import rig_frequency
from balance_cli.diagnosis.causes import judge_number_of_causes
from balance_cli.diagnosis.channel_causes import likely_channel_cause
from balance_cli.diagnosis.common_delay import judge_common_delay
from balance_cli.diagnosis.common_load_gain import judge_common_load_gain
from balance_cli.diagnosis.conclusions import (
    decide_verdict,
    describe_added_effects,
    diagnosis_notes,
    judge_drifts,
)
from balance_cli.diagnosis.data_tests.model_free import model_free_tests
from balance_cli.diagnosis.exclusions import ExclusionResult, find_exclusion
from balance_cli.diagnosis.model_update import UpdateResult, add_zeros, effect_labels, model_quality, update_model
from balance_cli.diagnosis.residual_map import describe_residual_location, residual_map
from balance_cli.diagnosis.result import (
    CHANNEL,
    EXPLAINED,
    NOTHING_MISSING,
    Diagnosis,
    FoundEffect,
    LeftOut,
    ResidualMap,
)
from balance_cli.diagnosis.search.mass_region import mass_intervals
from balance_cli.diagnosis.selection.response_effects import settings_for_responses, untestable_by_responses
from balance_cli.diagnosis.selection.testability import find_untestable_effects
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS, SearchSettings
from balance_cli.diagnosis.unidentifiable_effects import judge_unidentifiable_effects
from balance_cli.diagnosis.worse_update import refuse_worse_update
from balance_cli.diagnosis.zero_drift import add_drift_variance, find_zeros, judge_zero_drift, share_with_forces
from balance_cli.estimation.batch import Batch
from balance_cli.estimation.force_noise import add_force_noise
from balance_cli.estimation.identified_model import FitQuality, IdentifiedModel
from balance_cli.estimation.measured_spectra import Spectra
from balance_cli.estimation.measurements import stack_runs
from balance_cli.estimation.recorded_loads import swept_components
from balance_cli.io.errors import UserError
from balance_cli.model.balance import Estimate, balance_model
from balance_cli.model.placed_effects import declared_effects
from balance_cli.steps.identify import build_identified_model, identified_effects
from balance_cli.steps.static_series import with_load_series

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]
Announce = Callable[[str], bool]


def diagnose(
    model: IdentifiedModel,
    spectra: Spectra,
    progress: Progress | None = None,
    settings: SearchSettings = DEFAULT_SETTINGS,
) -> tuple[Diagnosis, IdentifiedModel]:
    """Return the diagnosis, without hold-out runs, and the updated model.

    `spectra` include means and waveforms; lines outside the band of the model are left out. Raises UserError for a
    model of the paper's form, and without any sweep or any line in the band.
    """
    spectra, settings = _check_inputs(model, spectra, settings)
    announce = _Announcer(progress, settings)
    before = balance_model(model.geometry).at(np.array(model.parameters.value, float))
    zeros = find_zeros(before.system(), spectra, settings.data_tests)
    measured, spectra = spectra, add_drift_variance(spectra, zeros.drift)
    start = add_zeros(before, zeros.offsets, settings)
    batches = stack_runs(spectra.lines, spectra.statics, model.geometry.channel_names)
    quality = model_quality(before, add_force_noise(batches, before.system(derivatives=False)))
    update = update_model(start, spectra, batches, effect_labels(before), announce, settings)
    update = refuse_worse_update(start, batches, update, settings)
    exclusion = _exclusion(start, spectra, batches, update, announce, settings)
    if exclusion is not None:
        spectra, batches, update = exclusion.spectra, exclusion.batches, exclusion.update
    fit = update.fit
    batches = add_force_noise(batches, fit.system())
    updated = build_identified_model(fit.model, batches, fit.minimum, "ml", "diagnosis", spectra)
    updated = replace(updated, band=model.band)
    same_effects = effect_labels(fit) == effect_labels(before)
    # With the same effects, a fit that had to carry a model error may describe the data worse.
    stays = same_effects and exclusion is None and updated.quality.chi2 > quality.chi2
    updated = model if stays else updated
    residual = residual_map(batches, before, before if stays else fit, settings.residual_map)
    intervals = mass_intervals(fit, batches, settings)
    effects = describe_added_effects(
        declared_effects(updated.geometry), identified_effects(updated), update, intervals, batches, settings
    )
    left_out = None if exclusion is None else exclusion.left_out
    diagnosis = _build_diagnosis(model, quality, updated, effects, update, residual, spectra, settings, left_out)
    drift = share_with_forces(zeros.drift, fit.system(), measured, settings.data_tests)
    diagnosis = _note_time_limit(judge_zero_drift(judge_drifts(diagnosis), drift), announce, settings)
    diagnosis, updated = judge_common_load_gain(diagnosis, updated, spectra, settings.data_tests.common_load_gain)
    diagnosis = judge_unidentifiable_effects(judge_number_of_causes(diagnosis), settings.data_tests.unidentifiable)
    announce("done")
    return judge_common_delay(diagnosis, updated, swept_components(batches))


def _note_time_limit(diagnosis: Diagnosis, announce: _Announcer, settings: SearchSettings) -> Diagnosis:
    """Return the diagnosis with a note where the time was over before its end."""
    if not announce.is_over:
        return diagnosis
    limit = f"the time limit of {settings.time_limit:g} s of computing"
    note = f"{limit} was reached: this is the best model up to then"
    return replace(diagnosis, notes=(*diagnosis.notes, note), is_unfinished=True)


def _build_diagnosis(
    model: IdentifiedModel,
    quality: FitQuality,
    updated: IdentifiedModel,
    effects: tuple[FoundEffect, ...],
    update: UpdateResult,
    residual: ResidualMap,
    spectra: Spectra,
    settings: SearchSettings,
    left_out: LeftOut | None,
) -> Diagnosis:
    """The diagnosis of `model`, which describes the data with `quality`, from its update."""
    verdict = decide_verdict(effects, update, updated, settings, left_out)
    # Something is left out only where all other data are described.
    explained = verdict in (NOTHING_MISSING, EXPLAINED) or left_out is not None
    scores, updated_geometry = update.confirmation.scores, update.fit.geometry
    # A model that stays has one quality; the one stored with it is that of its identification, without means.
    after = quality if updated is model else updated.quality
    untestable = find_untestable_effects(scores, update.trials, spectra, updated_geometry, settings.selection)
    return Diagnosis(
        geometry=model.geometry,
        verdict=verdict,
        effects=effects,
        trials=update.trials,
        data_tests=model_free_tests(spectra, model.geometry, _lowest_mode(updated), settings),
        untestable_effects=(*untestable, *untestable_by_responses(spectra, updated_geometry, untestable)),
        chi2_per_dof_before=quality.chi2_per_dof,
        chi2_per_dof_after=after.chi2_per_dof,
        frf_error_before=quality.frf_error,
        frf_error_after=after.frf_error,
        modes_before=model.modes,
        modes_after=updated.modes,
        residual=residual,
        candidate_count=len(scores),
        location="" if explained else describe_residual_location(residual, settings.residual_map),
        notes=diagnosis_notes(spectra, update.fit, updated, settings),
        settings=settings.without_deadline(),
        left_out=left_out,
        dof=after.dof,
    )


def _exclusion(
    before: Estimate,
    spectra: Spectra,
    batches: Sequence[Batch],
    update: UpdateResult,
    announce: Announce,
    settings: SearchSettings,
) -> ExclusionResult | None:
    """The channel or run without which there is nothing to explain, where the update does not explain all data."""
    if update.is_good:
        return None
    residual = residual_map(batches, before, update.fit, settings.residual_map)
    exclusion = find_exclusion(before, spectra, residual, announce, settings)
    if exclusion is None:
        return None
    trials, left_out = (*update.trials, *exclusion.update.trials), exclusion.left_out
    if left_out.kind == CHANNEL:
        cause = likely_channel_cause(exclusion.update.fit, left_out.name, batches, announce, settings)
        left_out = replace(left_out, likely_cause=cause)
    return replace(exclusion, left_out=left_out, update=replace(exclusion.update, trials=trials))


def _lowest_mode(model: IdentifiedModel) -> float:
    """The lowest eigenfrequency [Hz], of an overdamped rig that of its declared stiffness and mass."""
    return float(model.modes.frequency.min()) if len(model.modes.frequency) else rig_frequency(model.geometry)


def _check_inputs(model: IdentifiedModel, spectra: Spectra, settings: SearchSettings) -> tuple[Spectra, SearchSettings]:
    """Return the spectra within the band of the model, and the settings for them, if it can be diagnosed with them."""
    if model.form != "physical":
        raise UserError("the paper's form has no parameters to add to", "MODEL", remedy="Identify with --form physical")
    if not spectra.lines:
        raise UserError("no sweep run to diagnose with", remedy="Give at least one sweep run")
    return with_load_series(spectra.in_band(model.band)), settings_for_responses(spectra, settings).begin()


class _Announcer:
    """Reports the progress: each call begins a step, and `done` is the end; tells whether the time is over."""

    WORK = (
        ("search, round", 3.5),
        ("search", 2.0),
        ("maximum likelihood", 2.0),
        ("all lines", 4.0),
        ("resonances", 2.0),
    )
    """Work of a step by the beginning of its text, relative to others, as diagnoses of campaigns took."""
    USUAL_WORK = 0.3
    """Work of any other step, most of which test one effect."""
    EXPECTED_WORK = 17.0
    """Work of a usual diagnosis: two rounds of the search, one on all lines. Further steps stay below LAST_SHARE."""
    LAST_SHARE = 0.95

    def __init__(self, progress: Progress | None, settings: SearchSettings) -> None:
        self._progress, self._done, self._at_work = progress, 0.0, 0.0
        self._fits = settings.fit

    @property
    def is_over(self) -> bool:
        """Whether the time limit has been reached."""
        return self._fits.is_over

    def __call__(self, text: str) -> bool:
        self._done += self._at_work
        self._at_work = next((work for begin, work in self.WORK if text.startswith(begin)), self.USUAL_WORK)
        if self._progress is not None:
            share = min(self._done / self.EXPECTED_WORK, self.LAST_SHARE)
            self._progress(text, 1.0 if text == "done" else share)
        return self.is_over
