"""Check runs whose known loads contradict the response: their loads are flagged, and those of wind runs beside them.

A balance without redundant channels has no other test of its dynamics with the rotor turning. Gyroscopic moments of a
rotor that the model lacks changed moments of a hexapod by 37 %, with a sigma of 0.003 %.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.io.percent import named_percents, percent_text
from balance_cli.reduction.check_errors import HARMONICS_COMPARED
from balance_cli.reduction.flags import EXTRAPOLATED, MODEL_CONTRADICTED, NO_ZERO
from balance_cli.reduction.model_sources import ModelSource
from balance_cli.reduction.response_sources import ResponseSource, beyond_sweeps
from balance_cli.reduction.result import RunLoads
from balance_cli.reduction.rotor_record import RotorRecord
from balance_cli.reduction.trust import MODEL_ERROR_SHARE

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

ROW_ERROR_SHARE = 0.02
"""Of the known load: error of a harmonic of a check run that matters. Force cells of exciters are not known better."""
SEVERAL_HARMONICS = 3
"""Harmonics of a component that a check run contradicts from which it does so as a whole: one is a line at a mode, and
two may lie beside it, but the response between three of them is not right either."""
INTERACTION_SHARE = 0.2
"""Of the largest applied force: a load that was not applied, from which it contradicts. An exciter that is tilted by
ten degrees applies 17 %."""
SIGNIFICANT = 5.0
"""Error of a known load over its standard deviation from which it contradicts: no load of a sound campaign has it."""
STEADY_SPEED, SPEEDS = 1e-3, 1024
"""Relative standard deviation of the speed, at so many times, up to which turbulence is told from the harmonics. At 1 %
and 0.3 Hz the sidebands of harmonics a million times the noise rang the modes of a sound rig."""


@dataclass(frozen=True)
class CheckContradiction:
    """What the known loads of a check run contradict: `components` as a whole, with their relative errors.

    And `interactions`, loads that were not applied, relative to the largest force that was; `wrong_channels`, what is
    wrong with one or two channels, where that explains the errors; `means`, components whose mean differs, with the
    relative error.
    """

    run: str
    components: dict[str, float]
    interactions: dict[str, float] = field(default_factory=dict)
    wrong_channels: str | None = None
    means: dict[str, float] = field(default_factory=dict)

    @property
    def sentence(self) -> str:
        """The finding in words."""
        parts = [named_percents(self.components)] if self.components else []
        none_applied = "of the largest applied force, where none was applied"
        parts += [f"{name} by {percent_text(size, 3)} % {none_applied}" for name, size in self.interactions.items()]
        errors = ", ".join(parts)
        cause = self.wrong_channels or "the response lacks something there"
        dynamic = f"reduced loads differ from the known loads of {self.run}, {errors}: {cause}"
        means = named_percents(self.means)
        static = (
            f"reduced mean loads differ from the stated ones of {self.run}, {means}: the zero record, the "
            "static matrix or the force cell is wrong there"
        )
        return "; ".join(text for text, is_so in ((dynamic, bool(parts)), (static, bool(means))) if is_so)


def flag_by_check_runs(runs: Mapping[str, RunLoads]) -> tuple[Mapping[str, RunLoads], tuple[CheckContradiction, ...]]:
    """Return the loads with those flagged that check runs among them contradict, and what these contradict.

    In a check run these are the harmonics that differ from the known loads by more than 2 % and five standard
    deviations. Where a component does so at several harmonics or differs as a whole by more than a tenth, or one that
    was not applied has a fifth of the largest force, all its harmonics in all runs are flagged; where half of the
    components do, those of all. Where one or two channels explain it, all loads are flagged: the mean loads rest on
    them, too. A mean that differs from the stated one is flagged in the check run, and by more than a tenth in all
    runs.
    """
    contradictory, with_wrong_rows = list[CheckContradiction](), False
    for name, loads in runs.items():
        if loads.check is None:
            continue
        with_wrong_rows |= bool(_contradicted_rows(loads).any())
        components, interactions = contradicted_components(loads), contradicted_interactions(loads)
        means = contradicted_means(loads)
        if components or interactions or means:
            wrong_channels = loads.check.wrong_channels
            contradictory.append(CheckContradiction(name, components, interactions, wrong_channels, means))
    contradictions = tuple(contradictory)
    return (_FlaggedRuns(runs, contradictions) if contradictory or with_wrong_rows else runs), contradictions


def flag_by_held_out_runs(loads: RunLoads, source: ResponseSource) -> RunLoads:
    """Return the loads with those flagged that check runs contradicted when the model was made."""
    contradicted = source.model.contradicted if isinstance(source, ModelSource) else None
    if not contradicted:
        return loads
    errors = named_percents(contradicted)
    note = f"the model misses known loads of check runs that were held out, {errors}: it lacks something there"
    rows = np.zeros(loads.amplitude.shape, bool)
    rows[1:] = _wrong_components(loads, contradicted)
    return loads.with_flag(MODEL_CONTRADICTED, note, where=rows)


def flag_beyond_sweeps(loads: RunLoads, source: ResponseSource) -> RunLoads:
    """Return the loads with those flagged whose harmonics lie outside the sweeps of the model."""
    beyond, band = beyond_sweeps(source, loads.frequency_hz), source.swept_band
    if band is None or not beyond.any():
        return loads
    harmonics = ", ".join(str(n) for n in np.flatnonzero(beyond))
    note = (
        f"harmonics {harmonics} lie outside the sweeps of the model, {band[0]:.4g} to {band[1]:.4g} Hz: nothing "
        "measured tells of the rig there; sweep that far"
    )
    return loads.with_flag(EXTRAPOLATED, note, where=np.repeat(beyond[:, None], loads.amplitude.shape[1], axis=1))


def flag_by_turbulence(loads: RunLoads, record: RotorRecord, geometry: Geometry, source: ResponseSource) -> RunLoads:
    """Return the loads of a wind run with those flagged that modes make wrong, which turbulence shows elsewhere.

    What that makes wrong by less is in the sigma of the others.
    """
    if record.run.kind != "wind" or _speed_varies(record):
        return loads
    from balance_cli.reduction.moved_modes import NOTABLE_SHARE, mode_shapes, moved_modes
    from balance_cli.reduction.operational_modes import modes_near

    shapes = mode_shapes(record, source)
    if shapes is None:
        return loads
    azimuths = (record.azimuth, *record.other_rotors)
    moved = moved_modes(modes_near(record, shapes, geometry.acquisition, azimuths))
    if moved is None:
        return loads
    share = moved.error_share(loads.frequency_hz)[1:, None]
    rows = np.zeros(loads.amplitude.shape, bool)
    rows[1:] = share > NOTABLE_SHARE
    return _with_error(loads, share).with_flag(MODEL_CONTRADICTED, moved.sentence, where=rows)


def _with_error(loads: RunLoads, share: Array) -> RunLoads:
    """Return the loads with an error in sigma that is a share (n, 1) of each, and of the rms of forces or moments.

    Modes couple the loads of one kind: one that is small beside others is wrong by a share of these.
    """
    error, size = np.zeros(loads.amplitude.shape), np.abs(loads.amplitude[1:])
    for kind in ("F", "M"):
        of_kind = [j for j, name in enumerate(loads.components) if name.startswith(kind)]
        if of_kind:
            rms = np.sqrt(np.mean(size[:, of_kind] ** 2, axis=1, keepdims=True))
            error[1:, of_kind] = share * np.maximum(size[:, of_kind], rms)
    cosine, sine = (np.hypot(sigma, error) for sigma in (loads.sigma_cosine, loads.sigma_sine))
    return replace(loads, sigma_cosine=cosine, sigma_sine=sine)


def _speed_varies(record: RotorRecord) -> bool:
    """Whether the speed varies so much that sidebands of the harmonics ring modes as turbulence does."""
    azimuth, (begin, end) = record.azimuth, record.spectra.interval
    speed = azimuth.speed(np.linspace(max(begin, azimuth.first), min(end, azimuth.last), SPEEDS))
    return bool(np.std(speed) > STEADY_SPEED * np.mean(speed))


def _wrong_components(loads: RunLoads, contradicted: Collection[str]) -> Mask:
    """Return which components (m,) to flag: those, or all where they are half of them."""
    wrong = np.array([component in contradicted for component in loads.components])
    # With so many wrong it is the channels, and only the symmetry of a rig or of its loads keeps the others right.
    return wrong | (2 * np.count_nonzero(wrong) >= len(wrong))


class _FlaggedRuns(Mapping[str, RunLoads]):
    """The loads of runs, each flagged when it is asked for: a batch has more of them than fit in memory."""

    def __init__(self, runs: Mapping[str, RunLoads], contradictions: Sequence[CheckContradiction]) -> None:
        self._runs = runs
        self._components = {name for item in contradictions for name in (*item.components, *item.interactions)}
        self._has_wrong_channels = any(item.wrong_channels for item in contradictions)
        self._means = {name for item in contradictions for name, x in item.means.items() if x > MODEL_ERROR_SHARE}
        self._sentences = tuple(item.sentence for item in contradictions)

    def __getitem__(self, name: str) -> RunLoads:
        loads = self._runs[name]
        rows = _contradicted_rows(loads)
        rows[1:] |= _wrong_components(loads, self._components)
        rows[0] |= np.array([component in self._means for component in loads.components])
        rows |= self._has_wrong_channels  # which are those of the mean loads, too
        return loads.with_flag(MODEL_CONTRADICTED, *self._sentences, where=rows) if rows.any() else loads

    def __iter__(self) -> Iterator[str]:
        return iter(self._runs)

    def __len__(self) -> int:
        return len(self._runs)


def contradicted_components(loads: RunLoads) -> dict[str, float]:
    """Return the relative error of each applied component of a check run that its known loads contradict.

    As a whole, or at several harmonics.
    """
    if loads.check is None:
        return {}
    harmonics = np.count_nonzero(_contradicted_rows(loads)[1:], axis=0)
    last = min(HARMONICS_COMPARED, len(loads.amplitude) - 1)
    deviation = np.sqrt(np.mean(_variance(loads)[1 : last + 1], axis=0))
    size = np.sqrt(np.mean(np.abs(loads.check.applied[1 : last + 1]) ** 2, axis=0))
    wrong = {}
    for name, error in loads.check.load_error.items():
        m = loads.components.index(name)
        as_a_whole = error > MODEL_ERROR_SHARE and error * size[m] > SIGNIFICANT * deviation[m]
        if as_a_whole or harmonics[m] >= SEVERAL_HARMONICS:
            wrong[name] = error
    return wrong


def contradicted_interactions(loads: RunLoads) -> dict[str, float]:
    """Return the size of each load that a check run has though it was not applied, relative to the largest force."""
    if loads.check is None:
        return {}
    last = min(HARMONICS_COMPARED, len(loads.amplitude) - 1)
    deviation = np.sqrt(np.mean(_variance(loads)[1 : last + 1], axis=0))
    reduced = np.sqrt(np.mean(np.abs(loads.amplitude[1 : last + 1]) ** 2, axis=0))
    wrong = {}
    for name, size in loads.check.interaction.items():
        m = loads.components.index(name)
        least = max(INTERACTION_SHARE, SIGNIFICANT * loads.check.interaction_noise.get(name, 0.0))
        if size > least and reduced[m] > SIGNIFICANT * deviation[m]:
            wrong[name] = size
    return wrong


def _contradicted_rows(loads: RunLoads) -> Mask:
    """Return which rows (n+1, m) of a check run differ from their known loads."""
    if loads.check is None:
        return np.zeros(loads.amplitude.shape, bool)
    applied = loads.check.applied
    known = np.array([name in loads.check.load_error for name in loads.components])
    error = np.abs(loads.amplitude - applied)
    wrong = (error > ROW_ERROR_SHARE * np.abs(applied)) & (error > SIGNIFICANT * np.sqrt(_variance(loads))) & known
    wrong[0] = [name in contradicted_means(loads) for name in loads.components]
    return np.asarray(wrong)


def contradicted_means(loads: RunLoads) -> dict[str, float]:
    """Return the relative error of each mean load of a check run that its stated mean contradicts.

    A force cell that passes no constant load states a mean that is small beside the harmonics, and a record without a
    zero has the zeros of the channels in it: these contradict nothing.
    """
    if loads.check is None:
        return {}
    last = min(HARMONICS_COMPARED, len(loads.amplitude) - 1)
    stated, wrong = np.abs(loads.check.applied[0].real), dict[str, float]()
    size = np.sqrt(np.mean(np.abs(loads.check.applied[1 : last + 1]) ** 2, axis=0))
    error = np.abs(loads.amplitude[0].real - loads.check.applied[0].real)
    for m, name in enumerate(loads.components):
        is_stated = name in loads.check.load_error and stated[m] > MODEL_ERROR_SHARE * size[m]
        if is_stated and NO_ZERO not in loads.flags[0][m] and error[m] > SIGNIFICANT * loads.sigma_cosine[0, m]:
            share = float(error[m] / stated[m])
            wrong |= {name: share} if share > ROW_ERROR_SHARE else {}
    return wrong


def _variance(loads: RunLoads) -> Array:
    """Return the variance (n+1, m) of reduced less known loads; artefacts of former versions have its upper limit."""
    assert loads.check is not None
    reduced, added = loads.sigma_cosine**2 + loads.sigma_sine**2, loads.check.added_variance
    if added is None:
        size = np.sqrt(np.mean(np.abs(loads.check.applied[1 : HARMONICS_COMPARED + 1]) ** 2, axis=0))
        added = (np.array([loads.check.load_noise.get(name, 0.0) for name in loads.components]) * size) ** 2
    return np.asarray(np.maximum(reduced + added, 0.0))
