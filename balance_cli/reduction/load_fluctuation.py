"""Noise of harmonics beside light modes: loads that fluctuate, as the response transmits them at the harmonic itself.

The noise of a harmonic comes from the lines on either side of it. Fluctuating loads reach the channels through the
response, which a light mode makes different there. Their spectrum is smooth: with that of the loads, S, lines have the
covariance T S T* + N, N that of the sensors, whose noise is known from beyond the anti-alias filter. S follows from the
lines by maximum likelihood. What T S T* has more at the harmonic than at the lines is added to its noise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.reduction.harmonic_loads import channel_noise
from balance_cli.reduction.response_sources import ResponseSource
from balance_cli.reduction.rotor_record import RotorRecord
from balance_cli.reduction.speed_modulation import ChannelResponse
from balance_cli.signals.rotor.edge_weight import edge_weight
from balance_cli.signals.rotor.harmonic_noise import NoiseLines, blackman_taper
from balance_cli.signals.rotor.harmonics import Harmonics

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

NODES = 4
"""Frequencies in each bin at which the response is computed. A mode that is narrower than half a bin rings throughout
the record, and is among the free decays that the regression has."""
LOBE = 3
"""Bins on either side of a line from which its power comes: the main lobe of Blackman's taper."""
LOBE_POINTS = 512
"""Points of a taper from which its lobe is computed."""
LEAST_GAIN = 1.2
"""Power of the channels by some load at a harmonic, over that at its lines, from which the lines are examined: below,
sigma would grow by less than a tenth."""
SCREENED_GAIN = 1.05
"""The same by the response in the middle of bins alone, linear in power between them, below which a harmonic is not
examined: of 45 000 modes wider than half a bin that reach LEAST_GAIN, none was below 1.068."""
LEAST_NOISE = 1e-9
"""Noise of a harmonic over the largest one of the channel, at least: records that are computed may have none."""
STEPS = 20
"""Of the iteration, in each of which a variance comes closer to its estimate by the square root of their quotient."""
LEAST_INFORMATION = 1e-12
"""Of a direction of the loads, over the largest, that an iteration divides by: few lines leave directions without
variance."""


@dataclass(frozen=True)
class _LineGrid:
    """Frequencies around a harmonic [bins] as multiples of 1/NODES, and the shares of lines and harmonic in them.

    `at` (k, g) are the places of the lobe of each line, of which g have the shares `lobe`; `of_lines` and
    `of_harmonic` (f,) are the shares of all frequencies in the mean over the lines, and in the harmonic.
    """

    at: NDArray[np.int64]
    lobe: Array
    of_lines: Array
    of_harmonic: Array

    @property
    def middle(self) -> int:
        """The place of the harmonic."""
        return len(self.of_lines) // 2

    @property
    def frequencies(self) -> Array:
        """Distances (f,) from the harmonic [bins]."""
        return (np.arange(len(self.of_lines)) - self.middle) / NODES

    def in_bins(self) -> tuple[Array, Array]:
        """Return the shares of lines and harmonic in whole bins, for a power that is linear between them."""
        hat = 1.0 - np.abs(np.arange(1 - NODES, NODES)) / NODES
        of_lines, of_harmonic = (np.convolve(share, hat, "same") for share in (self.of_lines, self.of_harmonic))
        return of_lines[::NODES], of_harmonic[::NODES]


def add_load_fluctuation(record: RotorRecord, geometry: Geometry, source: ResponseSource) -> RotorRecord:
    """Return the record with the noise of fluctuating loads that excite its channels more at a harmonic than beside it.

    It is the same object where no harmonic is beside a mode, and where the channels do not determine the loads.
    """
    spectra, live = record.spectra, record.health.live
    picked = source.channel_combination(spectra.frequency_hz[1:2], live)
    lines, columns = spectra.noise_lines, spectra.columns(live)
    if lines is None or not picked.rows_are_channels:
        return record
    response = ChannelResponse(source, tuple(picked.rows), record.spin, geometry.acquisition)
    carried = [COMPONENTS.index(name) for name in record.components]
    grids = _line_grids(lines, spectra.revolutions[1] - spectra.revolutions[0])
    sigma = np.sqrt(np.einsum("hcc->hc", spectra.covariance[1:, columns][:, :, columns]).real)
    sigma = np.maximum(sigma, np.finfo(float).tiny)
    T = _beside_modes(spectra, response, carried, grids, sigma)
    if not T:
        return record
    scale = 2.0 * np.sqrt(channel_noise(record, geometry) / spectra.samples)
    scale = np.maximum(scale, LEAST_NOISE * np.abs(spectra.amplitude[:, columns]).max(axis=0))
    covariance = spectra.covariance.copy()
    for h in T:
        values = np.sqrt(lines.factor[h]) * lines.values[h, lines.keep[h]][:, columns]
        try:
            added = _excess(T[h] / scale[:, None], grids[h], values / scale)
        except np.linalg.LinAlgError:
            return record
        covariance[h + 1][np.ix_(columns, columns)] += scale[:, None] * added * scale
    return replace(record, spectra=replace(spectra, covariance=covariance))


def _beside_modes(
    spectra: Harmonics, response: ChannelResponse, carried: list[int], grids: list[_LineGrid], sigma: Array
) -> dict[int, ComplexArray]:
    """Return the response (f, c, m) to the `carried` loads around each harmonic that the channels see a mode beside."""
    turns, speed = spectra.revolutions[1] - spectra.revolutions[0], float(spectra.frequency_hz[1])
    bins = grids[0].frequencies

    def around(harmonics: NDArray[np.int64], bins: Array) -> ComplexArray:
        frequency = np.abs(spectra.frequency_hz[1 + harmonics, None] + bins * (speed / turns))
        T = response.at(frequency.ravel())[..., carried]
        return T.reshape(*frequency.shape, *T.shape[1:])

    every = np.arange(len(grids))
    coarse = around(every, bins[::NODES]) / sigma[:, None, :, None]
    screened = [h for h in every if _gain(coarse[h], *grids[h].in_bins()) > SCREENED_GAIN]
    if not screened:
        return {}
    fine = zip(screened, around(np.array(screened), bins), strict=True)
    shares = [(grid.of_lines, grid.of_harmonic) for grid in grids]
    return {int(h): T for h, T in fine if _gain(T / sigma[h, :, None], *shares[h]) > LEAST_GAIN}


def _gain(T: ComplexArray, of_lines: Array, of_harmonic: Array) -> float:
    """Return the largest power of the channels by a load at a harmonic, over that at its lines, for T (f, c, m)."""
    power = np.sum(np.abs(T) ** 2, axis=1)
    return float(np.max(of_harmonic @ power / np.maximum(of_lines @ power, np.finfo(float).tiny)))


def _line_grids(lines: NoiseLines, turns: int) -> list[_LineGrid]:
    """Return the grid around each harmonic: the lobes of lines and harmonic are the same for all."""
    reach = np.arange(-LOBE * NODES, LOBE * NODES + 1)
    lobe, lobe_of_harmonic = _lobes(turns)
    outermost = (int(np.abs(lines.offsets).max()) + LOBE) * NODES
    of_harmonic = np.zeros(2 * outermost + 1)
    of_harmonic[outermost + reach] = lobe_of_harmonic
    grids = []
    for keep in lines.keep:
        at = outermost + NODES * lines.offsets[keep].astype(np.int64)[:, None] + reach
        of_lines = np.bincount(at.ravel(), np.tile(lobe, len(at)), len(of_harmonic)) / len(at)
        grids.append(_LineGrid(at, lobe, of_lines, of_harmonic))
    return grids


@lru_cache(maxsize=16)
def _lobes(turns: int) -> tuple[Array, Array]:
    """Return the shares of the points of a lobe, of a line and of a harmonic: the runs of a batch have few lengths."""
    share = (np.arange(LOBE_POINTS) + 0.5) / LOBE_POINTS
    waves = np.exp(-2j * np.pi * np.outer(np.arange(-LOBE * NODES, LOBE * NODES + 1) / NODES, share))
    powers = [np.abs(waves @ taper) ** 2 for taper in (blackman_taper(share), edge_weight(share * turns, 0, turns))]
    return powers[0] / powers[0].sum(), powers[1] / powers[1].sum()


def _excess(T: ComplexArray, grid: _LineGrid, lines: ComplexArray) -> ComplexArray:
    """Return what the covariance (c, c) at a harmonic has more than the mean over its lines (k, c), nowhere less.

    Channels are in units of their noise, which `T` (f, c, m) and the lines have as one.
    """
    # Loads in combinations that the channels see alike at the harmonic.
    T = T @ np.linalg.inv(np.linalg.qr(T[grid.middle]).R)
    T = T @ _load_spectrum_root(T, grid, lines)
    at_harmonic, at_lines = _mean_power(T, grid.of_harmonic), _mean_power(T, grid.of_lines)
    root = np.linalg.cholesky(at_harmonic + at_lines + np.eye(T.shape[1]))
    inverse = np.linalg.inv(root)
    value, vectors = np.linalg.eigh(inverse @ (at_harmonic - at_lines) @ inverse.conj().T)
    larger = root @ vectors * np.sqrt(np.maximum(value, 0.0))
    return np.asarray(larger @ larger.conj().T)


def _mean_power(T: ComplexArray, share: Array) -> ComplexArray:
    """Return the sum (c, c) of T T* (f, c, m) by the shares (f,)."""
    used = np.flatnonzero(share)
    weighted = np.moveaxis(T[used] * np.sqrt(share[used])[:, None, None], 1, 0).reshape(T.shape[1], -1)
    return np.asarray(weighted @ weighted.conj().T)


def _load_spectrum_root(T: ComplexArray, grid: _LineGrid, lines: ComplexArray) -> ComplexArray:
    """Return F (m, m) of the most likely spectrum S = F F* of the loads behind lines (k, c), whose noise is one.

    Each line is turned into loads by the response at its middle. The iteration is that of variance components by
    minorization and maximization (Zhou, Hu, Zhou and Lange, J. Comput. Graph. Statist. 28, 2019, 350): the likelihood
    rises in each step, and S never loses its sign. It begins with loads that are as large as the noise.
    """
    at_middle = T[grid.at[:, len(grid.lobe) // 2]]
    adjoint = at_middle.conj().swapaxes(1, 2)
    noise = np.linalg.inv(adjoint @ at_middle)
    to_loads = noise @ adjoint
    loads = (to_loads @ lines[:, :, None])[:, :, 0]
    k, m = loads.shape
    smeared = (to_loads[:, None] @ T[grid.at]).reshape(k, -1, m * m)
    transfer = (smeared * grid.lobe[:, None]).swapaxes(1, 2) @ smeared.conj()
    transfer = transfer.reshape(k, m, m, m, m).swapaxes(2, 3).reshape(k * m * m, m * m)
    F = np.eye(m, dtype=complex)
    for _ in range(STEPS):
        inverse = np.linalg.inv((transfer @ (F @ F.conj().T).ravel()).reshape(k, m, m) + noise)
        v = (inverse @ loads[:, :, None])[:, :, 0]
        seen, expected = (
            F.conj().T @ (transfer.conj().T @ part.ravel()).reshape(m, m) @ F
            for part in (v[:, :, None] * v[:, None].conj(), inverse)
        )
        F = F @ _geometric_step(seen, expected)
    return F


def _geometric_step(seen: ComplexArray, expected: ComplexArray) -> ComplexArray:
    """Return a root (m, m) of W, for which W expected W = seen."""
    value, vectors = np.linalg.eigh(expected)
    value = np.sqrt(np.maximum(value, LEAST_INFORMATION * value.max()))
    root, inverse = (vectors * part @ vectors.conj().T for part in (value, 1.0 / value))
    value, vectors = np.linalg.eigh(root @ seen @ root)
    return np.asarray(inverse @ vectors * np.maximum(value, 0.0) ** 0.25)
