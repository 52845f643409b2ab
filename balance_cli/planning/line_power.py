"""The power of a multisine's lines: where it tells most of effects and hub loads.

The information of a sweep is that of its lines, and that of a line is proportional to its power. With the bands b of
the sweeps of all components and the factors x_b on the power of a flat spectrum

    I = I_before + sum_b x_b I_b,    sum_b x_b k_b = 1 of each component,

k_b being the share of a band in what limits the level: of the exciter's rms, or of the force in the cell with the least
range. The worth of `design` is concave in I but for the loads' part, and its derivative by x_b is a trace with I_b. The
weights w_b = x_b k_b follow from the multiplicative algorithm w_b <- w_b (d worth / dx_b) / k_b, divided by the sum of
all (Silvey, Titterington and Torsney, Commun. Stat. A 7 (1978) 1379; Yu, Ann. Stat. 38 (2010) 1593): it raises the
worth in each step. A part of the power stays flat, for effects that no candidate describes.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.model.modes import modes
from balance_cli.planning.choices import Aim
from balance_cli.planning.design import COARSEST_SIZE
from balance_cli.planning.detectability import InformationRows, ProjectedRows, information_rows, project_rows
from balance_cli.planning.extended_model import ExtendedModel
from balance_cli.planning.hall import RecordSettings
from balance_cli.planning.hub_loads import LoadForecast, total_sigma
from balance_cli.planning.information import RunInformation
from balance_cli.signals.periodic import LEAST_SHARE_OF_STRONGEST
from balance_cli.simulation.excitation import Power
from balance_cli.simulation.plans import Component

Array = NDArray[np.float64]

FLAT_PART = 0.2
"""Part of the power that stays flat: what no candidate describes is then seen with 45 % of the amplitude."""
STEPS = 8
"""Steps of the multiplicative algorithm: the worth of rig A rises by 1.025 in four, by 0.006 in four more, and by 0.001
in the next sixteen."""
EVEN_BANDS = 16
"""Bands that divide the sweep evenly: beside those of the modes."""
MODE_HALF_WIDTHS = 3.0
"""Half-widths of a mode on either side that make a band: there the response turns its phase by 140 degrees."""
LEAST_LINES = 3
"""Lines of a band."""
USABLE = 2.0
"""Least amplitude of a line over that from which spectra use it: noise and the exciter's own dynamics take a part."""
DIGITS = 3
"""Significant digits of the power of a band in a plan."""


@dataclass(frozen=True)
class BandInformation:
    """The bands of a flat sweep of one component: first frequencies (b,) [Hz], `share` (b,) of what limits its level.

    `information` (b): that of the lines of each band; of a thousand parameters and two hundred bands the whole would
    be gigabytes.
    """

    component: Component
    edges: Array
    share: Array
    information: tuple[InformationRows, ...]


@dataclass(frozen=True)
class PowerProblem:
    """What the power is chosen for: the sweeps of all components, what is known before, and the aim."""

    sweeps: Sequence[BandInformation]
    before: RunInformation
    model: ExtendedModel
    forecast: LoadForecast | None
    aim: Aim

    def total(self, factors: Sequence[Array]) -> InformationRows:
        """What is known, priors included, with these factors on the power of the bands of each sweep."""
        parts = (
            part * factor
            for sweep, factors_of_sweep in zip(self.sweeps, factors, strict=True)
            for part, factor in zip(sweep.information, factors_of_sweep.tolist(), strict=True)
        )
        known_before = self.before.information + self.model.prior_information
        return sum(parts, information_rows(known_before, self.model))


def band_edges(settings: RecordSettings, model: ExtendedModel) -> Array:
    """First frequencies [Hz] of the bands: evenly in the logarithm, and about each mode; each has some lines."""
    low, high = settings.band
    table = modes(model.model.system(model.theta))
    width = MODE_HALF_WIDTHS * table.damping_ratio * table.frequency
    edges = np.concatenate(
        [np.geomspace(low, high, EVEN_BANDS + 1)[:-1], table.frequency - width, table.frequency + width]
    )
    kept = [low]
    for edge in np.sort(edges[(edges > low) & (edges < high)]).tolist():
        if edge - kept[-1] >= LEAST_LINES / settings.period and high - edge >= LEAST_LINES / settings.period:
            kept.append(edge)
    return np.array(kept)


def bands_of_sweep(
    component: Component, edges: Array, frequency: Array, limiting: Array, parts: Iterable[InformationRows]
) -> BandInformation:
    """The bands of a flat sweep; `limiting` (f,) at `frequency` (f,) is what a unit of power takes of the limit."""
    place = np.searchsorted(edges, frequency * (1.0 + 1e-9), side="right") - 1
    share = np.bincount(place, limiting, minlength=len(edges))
    # A band without a frequency of the grid is narrower than the grid: it takes its part of the band's width.
    width = np.diff(np.append(edges, frequency[-1]))
    share = np.where(share > 0, share, np.interp(edges, frequency, limiting) * width / (frequency[1] - frequency[0]))
    return BandInformation(component, edges, share / share.sum(), tuple(parts))


def optimal_powers(problem: PowerProblem) -> Mapping[Component, Power]:
    """The relative power of the lines of each component, from each frequency on."""
    weights = [sweep.share.copy() for sweep in problem.sweeps]
    for _ in range(STEPS):
        gradients = _gradients(problem, [_factors(w, s) for w, s in zip(weights, problem.sweeps, strict=True)])
        for weight, gradient, sweep in zip(weights, gradients, problem.sweeps, strict=True):
            weight *= np.maximum(gradient, 0.0) / sweep.share
            weight /= max(float(weight.sum()), np.finfo(float).tiny)
    return {
        sweep.component: tuple(
            (round(float(edge), 6), float(f"{factor:.{DIGITS}g}"))
            for edge, factor in zip(sweep.edges, raise_weak_lines(_factors(weight, sweep)), strict=True)
        )
        for weight, sweep in zip(weights, problem.sweeps, strict=True)
    }


def raise_weak_lines(power: Array) -> Array:
    """Power (b,) of bands in which no line is so weak beside the strongest that spectra leave it out."""
    return np.asarray(np.maximum(power, (USABLE * LEAST_SHARE_OF_STRONGEST) ** 2 * power.max()))


def _factors(weight: Array, sweep: BandInformation) -> Array:
    return np.asarray(FLAT_PART + (1.0 - FLAT_PART) * weight / sweep.share)


def _gradients(problem: PowerProblem, factors: Sequence[Array]) -> list[Array]:
    """Derivative of the worth by the factor of each band, of each sweep."""
    model = problem.model
    projected = project_rows(problem.total(factors), model)
    weight = _effect_weights(projected, model) if problem.aim != "loads" or problem.forecast is None else None
    through = None
    if problem.aim != "effects" and problem.forecast is not None:
        through = _load_weights(problem.forecast, model, projected.covariance)
    return [
        np.array([_trace(part, projected, model, weight, through) for part in sweep.information])
        for sweep in problem.sweeps
    ]


def _effect_weights(projected: ProjectedRows, model: ExtendedModel) -> Array:
    """Derivative (t,) of the part of the worth that comes from the effects, by the diagonal of V."""
    names = model.tested_effects
    count = {str(name): np.count_nonzero(names == name) for name in names}
    equal = np.array([1.0 / count[str(name)] for name in names]) / max(len(count), 1)
    return np.asarray(0.5 * equal / (projected.diagonal + (COARSEST_SIZE * model.scales) ** -2))


def _load_weights(forecast: LoadForecast, model: ExtendedModel, covariance: Array) -> Array:
    """W (f, f) for which tr(W dI) is the change of the part of the worth that comes from the hub loads."""
    through = forecast.jacobian[:, :, :, model.indices.fitted] @ covariance
    variance = total_sigma(forecast, model, covariance) ** 2
    scaled = through / np.sqrt(4.0 * variance * variance.size)[:, :, None, None]
    rows = scaled.reshape(-1, scaled.shape[-1])
    return np.asarray(np.real(rows.conj().T @ rows))


def _trace(
    information: InformationRows,
    projected: ProjectedRows,
    model: ExtendedModel,
    weight: Array | None,
    through: Array | None,
) -> float:
    """Derivative of the worth by a part of the information."""
    fitted = model.indices.fitted
    tested = np.concatenate([*model.indices.tested, np.zeros(0, np.intp)]).astype(np.intp)
    among, value = information.rows[:, fitted], 0.0
    if weight is not None and len(tested):
        P, cross = projected.projection, information.rows[:, tested]
        change = information.diagonal[tested] - 2.0 * np.sum(P * cross, axis=0) + np.sum(P * (among @ P), axis=0)
        value += float(weight @ np.maximum(change, 0.0))
    return value + (0.0 if through is None else float(np.sum(through * among)))
