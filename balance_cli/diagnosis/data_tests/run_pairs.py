"""Sweeps of the same components compared: low level with high level, rotor at rest with rotor turning.

At every line that both runs share, and at which only one component is driven, the responses H = Y/U are compared with
the noise of channels and loads. A change proportional to f dH/df is a change of frequency (real part) or of damping
(imaginary part) of the modes there: a pole at f_p (1 + e) in one run and f_p in the other makes dH = -e f dH/df.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.diagnosis.data_test_settings import DataTestSettings, RunPairSettings
from balance_cli.diagnosis.data_tests.channel_pairs import declared_paths
from balance_cli.diagnosis.data_tests.gain_changes import describe_gain_change
from balance_cli.diagnosis.data_tests.high_pass_transient import (
    high_pass_transient,
    remove_transients,
    typical_transient_rms,
)
from balance_cli.diagnosis.result import ModelFreeTest
from balance_cli.diagnosis.significance import (
    bonferroni_min_p_value,
    chi2_p_value,
    combined_dof,
    is_invertible,
    noise_factor,
)
from balance_cli.io.percent import percent_text
from balance_cli.model.mechanics.equations import ChannelPath
from balance_cli.signals.run_spectrum import RunSpectrum

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Index = NDArray[np.intp]

LEVEL_TEST_NAME = "low against high level"
SPIN_TEST_NAME = "rest against spin"


@dataclass(frozen=True)
class _Responses:
    """Responses (k, c) of one run at frequency (k,) to the driven component (k,), and their noise (k, c, c).

    `high_pass_transient` (k, c): what the transients of the channels' own high-passes may add to them.
    """

    frequency: Array
    component: Index
    response: ComplexArray
    covariance: ComplexArray
    high_pass_transient: ComplexArray
    dof: float


@dataclass(frozen=True)
class _Change:
    """Change (k, c) from one run to another at frequency (k,), with its unbiased precision (k, c, c).

    `dof`: degrees of freedom of its noise; `response` (k, c): the mean response; `shift` (k, c): the direction in which
    a change of all frequencies moves it.
    """

    channels: tuple[str, ...]
    frequency: Array
    change: ComplexArray
    precision: ComplexArray
    dof: float
    response: ComplexArray
    shift: ComplexArray


def level_tests(runs: Sequence[RunSpectrum], geometry: Geometry, settings: DataTestSettings) -> list[ModelFreeTest]:
    """One row for each sweep and the highest-level sweep of the same components and rotor speed."""
    groups: dict[tuple[tuple[str, ...], float], list[RunSpectrum]] = {}
    for run in runs:
        groups.setdefault((run.components, run.rotor_speed), []).append(run)
    pairs = []
    for group in groups.values():
        highest = max(group, key=_rms_load)
        limit = settings.run_pairs.max_level_ratio * _rms_load(highest)
        pairs += [(run, highest) for run in group if _rms_load(run) < limit]
    return _pair_tests(LEVEL_TEST_NAME, pairs, geometry, "at the high level", settings)


def spin_tests(runs: Sequence[RunSpectrum], geometry: Geometry, settings: DataTestSettings) -> list[ModelFreeTest]:
    """One row for each sweep with a turning rotor and the sweep at rest that is nearest in level."""
    pairs = []
    for run in runs:
        resting = [rest for rest in runs if rest.components == run.components and rest.rotor_speed == 0.0]
        if run.rotor_speed > 0 and resting:
            pairs.append((min(resting, key=lambda rest: abs(np.log(_rms_load(rest) / _rms_load(run)))), run))
    return _pair_tests(SPIN_TEST_NAME, pairs, geometry, "with the rotor turning", settings)


def _rms_load(run: RunSpectrum) -> float:
    """Rms of the loads."""
    return float(np.sqrt(np.mean(np.sum(np.abs(run.loads[run.frequency > 0]) ** 2, axis=1))))


def _pair_tests(
    name: str,
    pairs: Sequence[tuple[RunSpectrum, RunSpectrum]],
    geometry: Geometry,
    finding_suffix: str,
    settings: DataTestSettings,
) -> list[ModelFreeTest]:
    paths = {path.channel: path for path in declared_paths(geometry)}
    rows = []
    for first, second in pairs:
        change = _compare_runs(first, second, paths, settings.run_pairs)
        if change is not None:
            rows.append(_test(name, f"{first.run}, {second.run}", change, finding_suffix, settings))
    return rows


def _responses(run: RunSpectrum, paths: Sequence[ChannelPath], settings: RunPairSettings) -> _Responses:
    """The responses of a run at the lines at which only one component is driven."""
    c = len(run.channel_names)
    amplitude = np.abs(run.loads)
    driven = np.argmax(amplitude, axis=1)
    noise = np.sqrt(np.maximum(np.diagonal(run.covariance, axis1=1, axis2=2).real[:, c:], 0.0))
    largest = amplitude.max(axis=1)
    limit = np.maximum(settings.cross_load_share * largest[:, None], settings.cross_load_sigma * noise)
    others = amplitude > limit
    others[np.arange(len(driven)), driven] = False
    lines = np.flatnonzero((run.frequency > 0) & (largest > 0) & ~others.any(axis=1))
    places = np.array([run.channel_names.index(path.channel) for path in paths], dtype=np.intp)
    signals = np.concatenate([np.broadcast_to(places, (len(lines), len(places))), c + driven[lines, None]], axis=1)
    covariance = run.covariance[lines[:, None, None], signals[:, :, None], signals[:, None, :]]
    U = run.loads[lines, driven[lines]]
    H = run.channels[lines[:, None], places] / U[:, None]
    identity = np.broadcast_to(np.eye(len(places)), (len(lines), len(places), len(places)))
    combine = np.concatenate([identity, -H[:, :, None]], axis=2) / U[:, None, None]
    noise_of_response = combine @ covariance @ combine.conj().swapaxes(1, 2)
    transients = [
        settings.transient_factor * typical_transient_rms(run, path) * high_pass_transient(run, path, lines) / U
        for path in paths
    ]
    return _Responses(run.frequency[lines], driven[lines], H, noise_of_response, np.stack(transients, axis=1), run.dof)


def _compare_runs(
    first: RunSpectrum, second: RunSpectrum, paths: Mapping[str, ChannelPath], settings: RunPairSettings
) -> _Change | None:
    """The change from the first run to the second; None where they share too few lines."""
    names = tuple(name for name in first.channel_names if name in second.channel_names)
    if not names:
        return None
    before, after = (_responses(run, [paths[name] for name in names], settings) for run in (first, second))
    i, j = _shared_lines(before, after)
    if len(i) < settings.min_shared_lines:
        return None
    covariance = before.covariance[i] + after.covariance[j]
    share = np.trace(np.linalg.solve(covariance, before.covariance[i]), axis1=1, axis2=2).real.mean() / len(names)
    dof = combined_dof((float(share), 1.0 - float(share)), (before.dof, after.dof))
    precision = _precision(covariance, dof)
    change = remove_transients(
        after.response[j] - before.response[i], precision, (before.high_pass_transient[i], after.high_pass_transient[j])
    )
    response = 0.5 * (before.response[i] + after.response[j])
    return _Change(
        channels=names,
        frequency=before.frequency[i],
        change=change,
        precision=precision,
        dof=dof,
        response=response,
        shift=_shift(before.frequency[i], before.component[i], response),
    )


def _shared_lines(first: _Responses, second: _Responses) -> tuple[Index, Index]:
    """Indices of the lines of the same frequency and component in both runs."""
    keys, other_keys = (np.rint(run.frequency * 1e6) * 8 + run.component for run in (first, second))
    _, i, j = np.intersect1d(keys, other_keys, return_indices=True)
    return np.asarray(i), np.asarray(j)


def _precision(covariance: ComplexArray, dof: float) -> ComplexArray:
    c = covariance.shape[1]
    if is_invertible(dof, c):
        return np.asarray(np.linalg.inv(covariance) * noise_factor(dof, c))
    variance = np.diagonal(covariance, axis1=1, axis2=2).real
    return np.asarray(noise_factor(dof, 1) / variance[:, :, None] * np.eye(c), complex)


def _shift(frequency: Array, component: Index, response: ComplexArray) -> ComplexArray:
    """-f dH/df (k, c), component by component; zero where a component has too few lines."""
    shift = np.zeros_like(response)
    for driven in np.unique(component):
        lines = np.flatnonzero(component == driven)
        if len(lines) > 2:
            shift[lines] = -frequency[lines, None] * np.gradient(response[lines], frequency[lines], axis=0)
    return shift


def _test(name: str, place: str, change: _Change, finding_suffix: str, settings: DataTestSettings) -> ModelFreeTest:
    """Chi-square against no change: in total, in each band, and for a change of the modes in each band."""
    c = len(change.channels)
    weighted = np.matmul(change.precision, change.change[:, :, None])[:, :, 0]
    chi2 = 2.0 * np.sum(change.change.conj() * weighted, axis=1).real
    noise = 2.0 * (c * max(change.dof - c, 1.0) if is_invertible(change.dof, c) else change.dof)
    limits = settings.run_pairs
    count = min(limits.bands, max(1, len(chi2) // limits.min_shared_lines))
    bands = np.array_split(np.arange(len(chi2)), count)
    modal, sigma = _modal_changes(change, weighted, bands)
    p_values = [chi2_p_value(float(chi2.sum()), (2.0 * c * len(chi2),), (noise,))]
    p_values += [chi2_p_value(float(chi2[band].sum()), (2.0 * c * len(band),), (noise,)) for band in bands]
    p_values += [
        chi2_p_value(2.0 * abs(value) ** 2 / s**2, (2.0,), (noise,)) for value, s in zip(modal, sigma, strict=True) if s
    ]
    p_value = bonferroni_min_p_value(p_values)
    if p_value > settings.significance_level:
        return ModelFreeTest(name, place, float(chi2.sum()), 2.0 * c * len(chi2), p_value, "equal")
    excess = np.array([chi2[band].sum() / (2.0 * c * len(band)) for band in bands])
    gains = 2.0 * np.abs(modal) ** 2 / np.where(sigma > 0, sigma, np.inf) ** 2
    finding = _describe_location(change, bands[int(np.argmax(excess))])
    variance = 1.0 / np.diagonal(change.precision, axis1=1, axis2=2).real
    of_gains = describe_gain_change(change.channels, change.change, change.response, variance, settings)
    if of_gains:
        finding = f"{finding}; {of_gains} {finding_suffix}"
        return ModelFreeTest(name, place, float(chi2.sum()), 2.0 * c * len(chi2), p_value, finding)
    best = int(np.argmax(gains))
    # The remaining chi-square widens sigma (Birge ratio), because the derivative is taken at one point only.
    remaining = (chi2[bands[best]].sum() - gains[best]) / (2.0 * c * len(bands[best]))
    of_modes = _describe_mode_change(
        change.frequency[bands[best]], modal[best], sigma[best] * np.sqrt(max(remaining, 1.0)), finding_suffix, limits
    )
    finding = "; ".join(part for part in (finding, of_modes) if part)
    return ModelFreeTest(name, place, float(chi2.sum()), 2.0 * c * len(chi2), p_value, finding)


def _modal_changes(change: _Change, weighted: ComplexArray, bands: Sequence[Index]) -> tuple[ComplexArray, Array]:
    """Relative change of frequency + j damping in each band and its complex standard deviation; zero without modes."""
    along = np.sum(change.shift.conj() * weighted, axis=1)
    through = np.matmul(change.precision, change.shift[:, :, None])[:, :, 0]
    size = np.sum(change.shift.conj() * through, axis=1).real
    total = np.array([size[band].sum() for band in bands])
    value = np.array([along[band].sum() for band in bands]) / np.where(total > 0, total, 1.0)
    sigma = np.where(total > 0, 1.0 / np.sqrt(np.where(total > 0, total, 1.0)), 0.0)
    return np.asarray(value, complex), sigma


def _describe_location(change: _Change, band: Index) -> str:
    """The size of the change, and the channel and band in which it is largest."""
    per_channel = 2.0 * np.abs(change.change[band]) ** 2 * np.diagonal(change.precision[band], axis1=1, axis2=2).real
    channel = change.channels[int(np.argmax(per_channel.sum(axis=0)))]
    size = np.linalg.norm(change.change[band]) / np.linalg.norm(change.response[band])
    low, high = change.frequency[band[0]], change.frequency[band[-1]]
    return f"differ most from {low:.4g} to {high:.4g} Hz, by {percent_text(float(size))} %, in {channel}"


def _describe_mode_change(
    frequency: Array, change: complex, sigma: float, finding_suffix: str, settings: RunPairSettings
) -> str:
    """Changes of frequency and damping in words; rounded, because derivatives are taken between lines."""
    half = settings.clear_sigma * sigma / np.sqrt(2.0)
    parts = []
    if abs(change.real) > max(half, settings.minor_share * abs(change.imag)):
        sense = "higher" if change.real > 0 else "lower"
        parts.append(f"frequencies about {percent_text(abs(change.real))} % {sense}")
    if abs(change.imag) > max(half, settings.minor_share * abs(change.real)):
        sense = "larger" if change.imag > 0 else "smaller"
        parts.append(f"damping ratios about {abs(change.imag):.2g} {sense}")
    if not parts:
        return ""
    return f"from {frequency[0]:.4g} to {frequency[-1]:.4g} Hz {' and '.join(parts)} {finding_suffix}"
