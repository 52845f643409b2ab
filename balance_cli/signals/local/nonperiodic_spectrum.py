"""Lines of records that do not repeat, for the same identification as periodic ones.

The local models know the transient and how the response bends within a few lines. Both are taken out of a group of
neighbouring lines, which then are u independent experiments at one frequency: with Q R the (weighted) loads of the
group, Q* Y = R G' + noise. Groups do not overlap, and are narrow against the distance to the nearest pole, so that
next to nothing is lost of what the lines say on the response. (Subtracting the estimated transient costs what its few
coefficients cost; the covariance holds that.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.recording.run import Run
from balance_cli.signals.local.models import LocalModels, fit_local_models, record_spectrum
from balance_cli.signals.local.window import design_matrix, design_pseudoinverse, poles, response_rows
from balance_cli.signals.run_samples import run_error, sample_rate
from balance_cli.signals.run_spectrum import RunSpectrum

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Index = NDArray[np.intp]

GROUP_POLE_SHARE = 0.3
GROUP_WINDOW_SHARE = 0.1
LEAST_GROUP_SIGNAL_TO_NOISE = 10.0

# Half of the window: towards its ends, where lines lie at the edge of the spectrum alone, its polynomials err most.
CENTRAL_SHARE = 0.5


@dataclass(frozen=True)
class _Experiments:
    """u experiments of one group: frequency [Hz], channels (u, c) and loads (u, u) in scaled units, line (index), and

    noise power (u,) in units of that of the line; `rows` (u, M), the weights of the window's lines, from `first` on.
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
    """Lines of a record, and what they are: sums over `weight` (K, M) times the record's lines from number `first` on.

    `number` (R,) are those of the neighbours to which `first` (K,) refers.
    """

    spectrum: RunSpectrum
    bin_index: Index
    first: Index
    weight: ComplexArray


def nonperiodic_spectrum(
    run: Run, channel_names: Sequence[str], band: tuple[float, float] = (0.0, np.inf)
) -> RunSpectrum:
    """The lines of `nonperiodic_record`."""
    return nonperiodic_record(run, channel_names, band).spectrum


def nonperiodic_record(
    run: Run, channel_names: Sequence[str], band: tuple[float, float] = (0.0, np.inf)
) -> NonperiodicRecord:
    """Independent lines of a random, sine-sweep or stepped record within `band` [Hz].

    Each group of neighbouring lines gives as many experiments as components were excited, one after the other at the
    same frequency. The covariance holds the channels' noise and the loads', without correlation between them.
    UserError: no loads, record too short, or no line at which the loads stand above their noise.
    """
    models = fit_local_models(record_spectrum(run, channel_names, band))
    everything = [group for w in range(len(models.fit)) for group in _line_groups(models, w)]
    noise = models.noise.loads
    kept = [group for group in everything if _exceeds_noise(group.loads, noise)]
    if not kept:
        raise run_error(run, "no line of the loads stands above their noise", "Excite more strongly", "loads")
    u = models.spectrum.loads.shape[1]
    first = np.repeat([group.first for group in kept], u)
    bin_index = np.rint(models.spectrum.frequency * run.samples / sample_rate(run)).astype(np.intp)
    return NonperiodicRecord(
        _to_run_spectrum(models, kept), bin_index, first, np.concatenate([group.rows for group in kept])
    )


def _line_groups(models: LocalModels, window: int) -> list[_Experiments]:
    """The groups of lines for which this window speaks."""
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
    """Neighbouring lines, in groups narrower than a share of the distance to the nearest pole."""
    start, stop = models.assigned_lines[window]
    half = (len(models.fit[window].r) - 1) / 2
    own = poles(models.fit[window]) * half + half + models.first[window]
    groups = []
    while start < stop:
        distance = np.min(np.abs(own - start), initial=np.inf)
        size = int(np.clip(GROUP_POLE_SHARE * distance, inputs, max(GROUP_WINDOW_SHARE * 2 * half, 2 * inputs)))
        size = size if stop - start - size >= inputs else stop - start
        groups.append(np.arange(start, start + size))
        start += size
    return [group for group in groups if len(group) >= inputs]


def _experiments(
    models: LocalModels, window: int, inverse: ComplexArray, noise: ComplexArray, lines: Index
) -> _Experiments:
    """Take transient and bend out of a group of lines, and turn it into independent experiments at its middle."""
    s, level = models.spectrum, models.level
    fit = models.fit[window]
    inside = lines - models.first[window]
    everywhere = slice(models.first[window], models.first[window] + len(fit.r))
    middle = int(lines[len(lines) // 2])
    center = response_rows(fit, fit.r[inside][len(lines) // 2 : len(lines) // 2 + 1])
    driven_at_centre = np.sum(s.loads[lines][:, :, None] * center, axis=1)
    bend_and_transient = design_matrix(fit)[inside] - driven_at_centre
    # What is left is linear in the window's outputs: their rows in the group less the coefficients' share.
    operator = -(bend_and_transient @ inverse)
    operator[np.arange(len(lines)), inside] += 1.0
    weight = 1.0 / np.sqrt(level[lines])
    Q, R = np.linalg.qr(s.loads[lines] * weight[:, None])
    rows = (Q.conj().T * weight) @ operator
    covariance = (rows * level[everywhere]) @ rows.conj().T / level[middle]
    root = np.linalg.cholesky(covariance)
    rows = np.linalg.solve(root, rows)
    # A steady tone stays: whoever knows of it says what it is.
    channels, loads = rows @ (s.channels + models.tones)[everywhere], np.linalg.solve(root, R)
    power = _relative_noise_power(rows, noise, noise[middle - models.first[window]])
    return _Experiments(float(s.frequency[middle]), channels, loads, middle, power, int(models.first[window]), rows)


def _relative_noise_power(rows: ComplexArray, noise: ComplexArray, own: ComplexArray) -> Array:
    """Noise of weighted sums (u, M) over lines of noise (M, c, c), in units of the noise `own` (c, c)."""
    summed = np.tensordot(np.abs(rows) ** 2, noise, axes=1)
    return np.asarray(np.trace(np.linalg.solve(own, summed), axis1=1, axis2=2).real / len(own))


def _exceeds_noise(loads: ComplexArray, noise: ComplexArray) -> bool:
    """Whether some load of the group stands well above its noise."""
    amplitude = np.sqrt(np.sum(np.abs(loads) ** 2, axis=0))
    return bool(np.any(amplitude > LEAST_GROUP_SIGNAL_TO_NOISE * np.sqrt(np.diagonal(noise).real)))


def _to_run_spectrum(models: LocalModels, groups: Sequence[_Experiments]) -> RunSpectrum:
    """All experiments as lines, in volts and newtons."""
    s = models.spectrum
    u = s.loads.shape[1]
    c = len(s.channel_names)
    places = np.repeat([group.line for group in groups], u)
    covariance = np.zeros((len(places), c + u, c + u), complex)
    covariance[:, :c, :c] = models.noise.channels[places] * (s.channel_scale[:, None] * s.channel_scale)
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
