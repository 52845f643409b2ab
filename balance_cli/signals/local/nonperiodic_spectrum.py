"""Lines of records that do not repeat, in the form that identification uses for periodic records.

The local models describe the transient and the curvature of the response within a few lines. Both are subtracted from
a group of neighboring lines, which then are u independent experiments at one frequency: with Q R the (weighted) loads
of the group, Q* Y = R G' + noise. Groups do not overlap, and are narrow compared with the distance to the nearest pole,
so that hardly any information on the response is lost. The covariance accounts for the coefficients of the transient.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import Run
from balance_cli.signals.local.models import LocalModels, fit_local_models
from balance_cli.signals.local.scaled_spectrum import LEAST_POWER_SHARE, record_spectrum
from balance_cli.signals.local.window import design_matrix, design_pseudoinverse, poles, response_rows
from balance_cli.signals.run_samples import run_error, sample_rate
from balance_cli.signals.run_spectrum import RunSpectrum

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Index = NDArray[np.intp]

GROUP_POLE_SHARE = 0.3
"""Width of a group over the distance to the nearest pole: the curvature that is subtracted remains a correction."""
GROUP_WINDOW_SHARE = 0.1
"""Greatest width of a group over that of its window, within which the polynomials are well determined."""
LEAST_GROUP_SIGNAL_TO_NOISE = 10.0
"""Amplitude of the largest load of a group over its noise; as for the lines of periodic records."""
LEAST_SHARE_OF_STRONG = float(np.sqrt(LEAST_POWER_SHARE))
"""Amplitude of a load in a group over that where the load is strong; as for the lines at which it counts as excited."""
CENTRAL_SHARE = 0.5
"""Part of the half-width of a window that is used; its polynomials err most toward the ends."""


@dataclass(frozen=True)
class _Experiments:
    """The u experiments of one group of lines, at one `frequency` [Hz].

    `channels` (u, c) and `loads` (u, u) are in scaled units. `line` is the index of the middle line, `power` (u,) the
    noise power over that of this line. `rows` (u, M) are the weights of the lines of the window, from `first` on.
    """

    frequency: float
    channels: ComplexArray
    loads: ComplexArray
    line: int
    power: Array
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
        raise run_error(run, "the loads exceed their noise at no line", "Excite more strongly", "loads")
    u = models.spectrum.loads.shape[1]
    first = np.repeat([group.first for group in groups], u)
    bin_index = np.rint(models.spectrum.frequency * run.samples / sample_rate(run)).astype(np.intp)
    return NonperiodicRecord(
        _to_run_spectrum(models, groups), bin_index, first, np.concatenate([group.rows for group in groups])
    )


def _line_groups(models: LocalModels, window: int) -> list[_Experiments]:
    """Experiments of the groups of lines for which this window is used."""
    excited = models.spectrum.excited
    u = models.spectrum.loads.shape[1]
    inverse = design_pseudoinverse(models.fit[window])
    first = models.first[window]
    noise = models.noise.equation_error_covariance(models.response, slice(first, first + inverse.shape[1]))
    central = np.abs(models.fit[window].r) <= CENTRAL_SHARE
    groups = []
    for lines in _partition_lines(models, window, u):
        if np.all(excited[lines] & central[lines - first]):
            groups.append(_experiments(models, window, inverse, noise, lines))
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
    models: LocalModels, window: int, inverse: ComplexArray, noise: ComplexArray, lines: Index
) -> _Experiments:
    """Subtract transient and curvature from a group of lines; return independent experiments at its middle line."""
    s, level = models.spectrum, models.level
    fit = models.fit[window]
    inside = lines - models.first[window]
    in_window = slice(models.first[window], models.first[window] + len(fit.r))
    middle = int(lines[len(lines) // 2])
    center = response_rows(fit, fit.r[inside][len(lines) // 2 : len(lines) // 2 + 1])
    forced_at_center = np.sum(s.loads[lines][:, :, None] * center, axis=1)
    curvature_and_transient = design_matrix(fit)[inside] - forced_at_center
    # The remainder is linear in the outputs of the window: those of the group less a part of the coefficients.
    operator = -(curvature_and_transient @ inverse)
    operator[np.arange(len(lines)), inside] += 1.0
    weight = 1.0 / np.sqrt(level[lines])
    Q, R = np.linalg.qr(s.loads[lines] * weight[:, None])
    rows = (Q.conj().T * weight) @ operator
    covariance = (rows * level[in_window]) @ rows.conj().T / level[middle]
    root = np.linalg.cholesky(covariance)
    rows = np.linalg.solve(root, rows)
    # Steady tones stay in the lines: identification has an effect for them.
    channels, loads = rows @ (s.channels + models.tones)[in_window], np.linalg.solve(root, R)
    power = _relative_noise_power(rows, noise, noise[middle - models.first[window]])
    return _Experiments(float(s.frequency[middle]), channels, loads, middle, power, int(models.first[window]), rows)


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
    covariance[:, :c, :c] = models.noise.channels[line] * (s.channel_scale[:, None] * s.channel_scale)
    covariance[:, c:, c:] = models.noise.loads * (s.load_scale[:, None] * s.load_scale)
    covariance *= np.concatenate([group.power for group in groups])[:, None, None]
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
    )
