"""Lines of records that do not repeat, in the form that identification uses for periodic records.

The local models describe the transient and the curvature of the response within a few lines. Both are subtracted from
a group of neighboring lines, which then are u independent experiments at one frequency: with Q R the (weighted) loads
of the group, Q* Y = R G' + noise. Groups do not overlap, and are narrow compared with the distance to the nearest pole,
so that hardly any information on the response is lost. The covariance accounts for the coefficients that describe what
is subtracted, and for its poles.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import Run
from balance_cli.signals.local.models import RECORD_MODEL_ORDERS, LocalModels, fit_local_models
from balance_cli.signals.local.record_drift import record_drift
from balance_cli.signals.local.scaled_spectrum import LEAST_POWER_SHARE, record_spectrum
from balance_cli.signals.local.separation import separates_transient
from balance_cli.signals.local.window import Remainder, denominator_errors, poles, remainder_at_center
from balance_cli.signals.run_samples import run_error, sample_rate
from balance_cli.signals.run_spectrum import RunSpectrum

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Index = NDArray[np.intp]

GROUP_POLE_SHARE = 0.3
"""Width of a group over the distance to the nearest pole: the curvature that is subtracted remains a correction."""
GROUP_WINDOW_SHARE = 0.1
"""Greatest width of a group over that of its window, within which the polynomials are well determined."""
LEAST_GROUP_SIGNAL_TO_NOISE = 5.0
"""Amplitude of the largest load of a group over its noise, which alone is as large at one line of 1e11. A nonlinear
force counts as noise of the loads: with 10 a record of an axis with dry friction had kept 10 groups."""
LEAST_SHARE_OF_STRONG = float(np.sqrt(LEAST_POWER_SHARE))
"""Amplitude of a load in a group over that where the load is strong; as for the lines at which it counts as excited."""
CENTRAL_SHARE = 0.5
"""Part of the half-width of a window that is used; its polynomials err most toward the ends."""


@dataclass(frozen=True)
class _Experiments:
    """The u experiments of one group of lines, at one `frequency` [Hz].

    `channels` (u, c) and `loads` (u, u) are in scaled units. `line` is the index of the middle line. `power` (u,) is
    the noise power over that of this line, `errors` (u, c, na+1) the standard deviations of the channels by what was
    subtracted. `rows` (u, M) are the weights of the lines of the window, from `first` on.
    """

    frequency: float
    channels: ComplexArray
    loads: ComplexArray
    line: int
    power: Array
    errors: ComplexArray
    first: int
    rows: ComplexArray


@dataclass(frozen=True)
class NonperiodicRecord:
    """Lines for identification, and their origin: sums over `weight` (K, M) times the lines of the record.

    `bin_index` (R,) are the frequency bins of the R lines of the record; a sum begins at entry `first` (K,) of them.
    """

    spectrum: RunSpectrum
    bin_index: Index
    first: Index
    weight: ComplexArray


def nonperiodic_spectrum(
    run: Run, channel_names: Sequence[str], band: tuple[float, float] = (0.0, np.inf)
) -> RunSpectrum:
    """Return the spectrum of `nonperiodic_record`."""
    return nonperiodic_record(run, channel_names, band).spectrum


def nonperiodic_record(
    run: Run, channel_names: Sequence[str], band: tuple[float, float] = (0.0, np.inf)
) -> NonperiodicRecord:
    """Estimate independent lines of a random, sine-sweep or stepped record within `band` [Hz].

    Each group of neighboring lines gives as many experiments as components were excited, one after the other at the
    same frequency. The covariance is that of the noise of channels and loads, without correlation between them. Raises
    UserError where the run has no loads, its record is too short, or the loads exceed their noise at no line.
    """
    models = fit_local_models(record_spectrum(run, channel_names, band))
    groups = [group for w in range(len(models.fit)) for group in _line_groups(models, w)]
    groups = _excited_groups(groups, models.noise.loads)
    if not groups:
        raise run_error(run, "the loads exceed their noise at no line", _remedy(models), "loads")
    u = models.spectrum.loads.shape[1]
    bin_index = np.rint(models.spectrum.frequency * run.samples / sample_rate(run)).astype(np.intp)
    first, weight = _rows_of_one_width(groups, len(bin_index))
    return NonperiodicRecord(_to_run_spectrum(models, groups), bin_index, np.repeat(first, u), weight)


def _remedy(models: LocalModels) -> str:
    """Noise that covers the loads is there, or it is what models of too few poles leave of a short record."""
    lines = min(len(fit.r) for fit in models.fit)
    most = max(orders.denominator for orders in RECORD_MODEL_ORDERS)
    width = lines * (models.spectrum.frequency[1] - models.spectrum.frequency[0])
    remedy = f"record for longer, where there are more than {most} modes within {lines} lines, {width:.3g} Hz"
    return f"Excite more strongly; or {remedy}"


def _rows_of_one_width(groups: Sequence[_Experiments], lines: int) -> tuple[Index, ComplexArray]:
    """First line (G,) and weights (G u, M) of all groups, with zeros about those of windows that are not the widest."""
    width = max(group.rows.shape[1] for group in groups)
    first = np.minimum([group.first for group in groups], lines - width)
    before = [group.first - start for group, start in zip(groups, first, strict=True)]
    after = [width - gap - group.rows.shape[1] for group, gap in zip(groups, before, strict=True)]
    padded = [np.pad(g.rows, ((0, 0), gaps)) for g, gaps in zip(groups, zip(before, after, strict=True), strict=True)]
    return first, np.concatenate(padded)


def _line_groups(models: LocalModels, window: int) -> list[_Experiments]:
    """Experiments of the groups of lines for which this window is used; none where it mixes loads and transient."""
    fit, first = models.fit[window], int(models.first[window])
    if not separates_transient(fit, slice(*(models.assigned_lines[window] - first))):
        return []
    noise = models.noise.equation_error_covariance(models.response, slice(first, first + len(fit.r)))
    errors = denominator_errors(fit, noise)
    central = np.abs(fit.r) <= CENTRAL_SHARE
    groups = []
    for lines in _partition_lines(models, window, models.spectrum.loads.shape[1]):
        if np.all(models.spectrum.excited[lines] & central[lines - first]):
            groups.append(_experiments(models, first, lines, noise, remainder_at_center(fit, lines - first, errors)))
    return groups


def _partition_lines(models: LocalModels, window: int, inputs: int) -> list[Index]:
    """Groups of neighboring lines, narrower than a share of the distance to the nearest pole."""
    start, stop = models.assigned_lines[window]
    half = (len(models.fit[window].r) - 1) / 2
    pole_positions = poles(models.fit[window]) * half + half + models.first[window]
    groups = []
    while start < stop:
        distance = np.min(np.abs(pole_positions - start), initial=np.inf)
        size = int(np.clip(GROUP_POLE_SHARE * distance, inputs, max(GROUP_WINDOW_SHARE * 2 * half, 2 * inputs)))
        size = size if stop - start - size >= inputs else stop - start
        groups.append(np.arange(start, start + size))
        start += size
    return [group for group in groups if len(group) >= inputs]


def _experiments(
    models: LocalModels, first: int, lines: Index, noise: ComplexArray, remainder: Remainder
) -> _Experiments:
    """Return independent experiments at the middle of a group of lines, of a window from line `first` on.

    `noise` (M, c, c) is that of the outputs of the window.
    """
    s, level = models.spectrum, models.level
    in_window = slice(first, first + len(noise))
    middle = int(lines[len(lines) // 2])
    weight = 1.0 / np.sqrt(level[lines])
    Q, R = np.linalg.qr(s.loads[lines] * weight[:, None])
    mix = Q.conj().T * weight
    rows = mix @ remainder.operator
    root = np.linalg.cholesky((rows * level[in_window]) @ rows.conj().T / level[middle])
    rows, loads = np.asarray(np.linalg.solve(root, rows), complex), np.linalg.solve(root, R)
    errors = np.tensordot(np.linalg.solve(root, mix), remainder.errors, axes=1)
    # Steady tones stay in the lines: identification has an effect for them.
    channels = rows @ (s.channels[in_window] + models.tones[in_window])
    power = _relative_noise_power(rows, noise, noise[middle - first])
    return _Experiments(float(s.frequency[middle]), channels, loads, middle, power, errors, first, rows)


def _relative_noise_power(rows: ComplexArray, noise: ComplexArray, reference: ComplexArray) -> Array:
    """Noise of weighted sums (u, M) over lines of noise (M, c, c), over the noise `reference` (c, c)."""
    summed = np.tensordot(np.abs(rows) ** 2, noise, axes=1)
    return np.asarray(np.trace(np.linalg.solve(reference, summed), axis1=1, axis2=2).real / len(reference))


def _excited_groups(groups: Sequence[_Experiments], noise: ComplexArray) -> list[_Experiments]:
    """The groups in which some load exceeds its noise by far, and is no side effect of the excitation of other lines.

    Between the lines of a multisine that is not declared as periodic a load has power around a line, but none at it.
    """
    if not groups:
        return []
    amplitude = np.sqrt([np.sum(np.abs(group.loads) ** 2, axis=0) for group in groups])
    strong = np.quantile(amplitude, 0.95, axis=0)
    least = np.maximum(LEAST_GROUP_SIGNAL_TO_NOISE * np.sqrt(np.diagonal(noise).real), LEAST_SHARE_OF_STRONG * strong)
    return [group for group, excited in zip(groups, np.any(amplitude > least, axis=1), strict=True) if excited]


def _to_run_spectrum(models: LocalModels, groups: Sequence[_Experiments]) -> RunSpectrum:
    """Return all experiments as lines, in SI units."""
    s = models.spectrum
    u = s.loads.shape[1]
    c = len(s.channel_names)
    line = np.repeat([group.line for group in groups], u)
    covariance = np.zeros((len(line), c + u, c + u), complex)
    covariance[:, :c, :c] = models.noise.channels[line]
    covariance[:, c:, c:] = models.noise.loads
    covariance *= np.concatenate([group.power for group in groups])[:, None, None]
    covariance[:, :c, :c] += np.concatenate([group.errors @ group.errors.conj().swapaxes(1, 2) for group in groups])
    scale = np.concatenate([s.channel_scale, s.load_scale])
    covariance *= scale[:, None] * scale
    return RunSpectrum(
        run=s.run.name,
        channel_names=s.channel_names,
        components=s.components,
        frequency=np.repeat([group.frequency for group in groups], u),
        channels=np.asarray(np.concatenate([group.channels for group in groups]) * s.channel_scale, complex),
        loads=np.asarray(np.concatenate([group.loads for group in groups]) * s.load_scale, complex),
        covariance=covariance,
        dof=models.noise.dof,
        rotor_speed=s.run.rotor_speed,
        level=s.run.level,
        drift=record_drift(models),
    )
