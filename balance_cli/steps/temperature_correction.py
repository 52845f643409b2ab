"""Temperature of static runs: its terms, estimated from the rows, and the runs as they would read without it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.all_trims_result import AllTrimsCalibration
from balance_cli.calibration.block_zeros import subtract_block_means
from balance_cli.calibration.least_squares import CollinearError, solve_least_squares
from balance_cli.calibration.math_model import CalibrationModel
from balance_cli.calibration.result import Calibration, TrimCalibration
from balance_cli.calibration.static_matrices import inverse_matrix, inverse_sigma, standard_errors
from balance_cli.calibration.temperature import TemperatureRows, estimate_temperature_terms
from balance_cli.calibration.temperature_terms import TemperatureTerms
from balance_cli.calibration.terms import all_terms, linear_terms, term_values
from balance_cli.calibration.weight_covariance import weight_covariance
from balance_cli.campaign.recording.run import MemorySource, Run, read_channels
from balance_cli.campaign.recording.temperature import run_temperature
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.load_components import load_components
from balance_cli.steps.calibrate_all_trims import stack_points
from balance_cli.steps.load_point_rows import load_point_rows
from balance_cli.steps.trim_tasks import rows_of_tasks, trim_tasks

Array = NDArray[np.float64]

MIN_TEMPERATURE_RANGE = 0.5
"""Range of temperature [K] below which no term is sought: sensors differ by that much from strain gauges."""
ROWS_PER_TERM = 3
"""Rows for each column from which squares and products stand beside the loads while temperature is estimated."""
MIN_ROWS_PER_TERM = 2
"""The same beside the terms of the calibration model: the scatter is then known to 15 % in a table of 90 rows."""
MIN_TOLD_SHARE = 0.05
"""Part of a square or product that zeros and other terms must leave for it to stand beside those of temperature."""
TEMPERATURE_FITS = 2
"""Fits where temperature matters: the first finds the nonlinear terms, beside which the second has temperature."""


def fit_without_temperature(
    static: Sequence[Run],
    hold_out: Sequence[Run],
    geometry: Geometry,
    fit: Callable[[Sequence[Run], Sequence[Run]], Calibration],
) -> Calibration:
    """Calibrate by `fit` from static runs that are referred to one temperature, where all state theirs and it matters.

    `hold_out`: runs that check the calibration, referred to that temperature too.
    """
    terms, stated = initial_temperature_terms(static, geometry), _stated_temperatures(static)
    if terms is None:
        result = replace(fit(static, hold_out), stated_temperatures=stated)
        return _note_missing_temperatures(result, static)
    for number in range(1, TEMPERATURE_FITS + 1):
        at_reference = [without_temperature(run, terms, geometry) for run in static]
        result = replace(
            fit(at_reference, [without_temperature(run, terms, geometry) for run in hold_out]), temperature=terms
        )
        if result.all_trims is None or number == TEMPERATURE_FITS:
            break
        terms = refined_temperature_terms(static, result.all_trims)
    return _with_reference_errors(result, terms, static)


def _stated_temperatures(static: Sequence[Run]) -> tuple[float, float] | None:
    """The lowest and the highest temperature [degC] of the runs that state theirs; None where none does."""
    stated = [values for run in static if (values := run_temperature(run)) is not None and len(values)]
    return (min(float(each.min()) for each in stated), max(float(each.max()) for each in stated)) if stated else None


def _note_missing_temperatures(result: Calibration, static: Sequence[Run]) -> Calibration:
    """The calibration with a note where some runs state a temperature and others do not."""
    missing = [run.name for run in static if run_temperature(run) is None]
    if not missing or len(missing) == len(static) or result.all_trims is None:
        return result
    note = f"the effect of temperature was not determined: {', '.join(missing)} do not state it for all rows"
    all_trims = replace(result.all_trims, screening_notes=(*result.all_trims.screening_notes, note))
    return replace(result, all_trims=all_trims)


def _with_reference_errors(result: Calibration, terms: TemperatureTerms, static: Sequence[Run]) -> Calibration:
    """The calibration whose sensitivities have the error of referring them to the reference temperature."""
    trims = {label: _trim_with_errors(trim, terms) for label, trim in result.trims.items()}
    if result.all_trims is None:
        return replace(result, trims=trims)
    model, random = result.all_trims.model, result.all_trims.random_terms
    effects = _effects_in_rows(result.all_trims, terms, static)
    all_trims = replace(
        result.all_trims,
        model=_model_with_errors(model, terms, result.all_trims, effects),
        random_terms=None if random is None else _model_with_errors(random, terms, result.all_trims, effects),
    )
    return replace(result, trims=trims, all_trims=all_trims)


def _effects_in_rows(all_trims: AllTrimsCalibration, terms: TemperatureTerms, static: Sequence[Run]) -> Array:
    """What each term of temperature is multiplied with in the rows that were fitted (m, 1 + k), less their zeros."""
    temperature = np.concatenate([each for each in map(run_temperature, static) if each is not None])[all_trims.used]
    loads = all_trims.loads[all_trims.used]
    effects = (temperature - terms.reference)[:, None] * np.column_stack([np.ones(len(loads)), loads])
    return subtract_block_means(effects, _series_of_rows(all_trims))


def _series_of_rows(all_trims: AllTrimsCalibration) -> NDArray[np.intp]:
    """Number (m,) of the load series of the rows that were fitted."""
    return (all_trims.run if all_trims.load_series is None else all_trims.load_series)[all_trims.used]


def _model_with_errors(
    model: CalibrationModel, terms: TemperatureTerms, all_trims: AllTrimsCalibration, effects: Array
) -> CalibrationModel:
    """The model whose coefficients have the errors by which its readings were referred to the reference temperature.

    With the matrix (X'X)^-1 of the fit and the `effects` Z of its rows they are (X'X)^-1 X'Z times those of the terms
    of temperature. In the linear ones this is by the temperature under each load, as `error_variance` counts the rest.
    """
    k, covariance = len(model.components), model.covariance.copy()
    values = term_values(model.parsed_terms, all_trims.loads[all_trims.used] / model.calibrated_range)
    products = subtract_block_means(values, _series_of_rows(all_trims)).T @ effects
    variance = np.maximum(np.diag(model.residual_covariance), np.finfo(float).tiny)
    for channel, name in enumerate(model.channel_names):
        if name not in terms.channel_names:
            continue
        share = model.covariance[channel] / variance[channel] @ products
        share[:k] = np.column_stack(
            [np.zeros(k), np.diag((terms.under_load - terms.reference) * model.calibrated_range)]
        )
        covariance[channel] += share @ terms.covariance[terms.channel_names.index(name)] @ share.T
    return replace(model, covariance=covariance)


def _trim_with_errors(trim: TrimCalibration, terms: TemperatureTerms) -> TrimCalibration:
    covariance, added = trim.C0_covariance.copy(), _of_channels(terms, trim.channel_names)
    for channel, own in enumerate(added):
        covariance[channel, :, channel, :] += own
    _, derivative = inverse_matrix(trim.C0, weight_covariance(trim.residual_covariance, trim.dof))
    return replace(
        trim,
        C0_covariance=covariance,
        C0_sigma=standard_errors(covariance),
        T0_sigma=inverse_sigma(derivative, covariance),
    )


def _of_channels(terms: TemperatureTerms, names: Sequence[str]) -> Array:
    """Covariance (c, k, k) of the sensitivities of the named channels; zero for one without terms of temperature."""
    by_name = dict(zip(terms.channel_names, terms.sensitivity_covariance(), strict=True))
    k = len(terms.components)
    return np.stack([by_name.get(name, np.zeros((k, k))) for name in names])


def initial_temperature_terms(runs: Sequence[Run], geometry: Geometry) -> TemperatureTerms | None:
    """Estimate the terms of temperature from static runs, robustly, beside the loads and their squares and products.

    None where a run states no temperature, it hardly varied, or nothing depends on it.
    """
    temperatures = [run_temperature(run) for run in runs]
    known = [each for each in temperatures if each is not None]
    if len(known) < len(runs) or np.ptp(np.concatenate(known)) < MIN_TEMPERATURE_RANGE:
        return None
    components = load_components(geometry)
    members = rows_of_tasks(runs, trim_tasks(load_point_rows(runs), geometry, components))
    points = stack_points(members, components)
    used = points.weight > 0
    x, series = points.x[used], points.load_series[used]
    k = len(components.names)
    quadratic = (*linear_terms(k), *(term for term in all_terms(k) if term.is_quadratic))
    is_enough = len(x) >= ROWS_PER_TERM * (len(quadratic) + len(np.unique(series)))
    columns = term_values(quadratic if is_enough else linear_terms(k), x)
    try:
        solve_least_squares(columns, points.channels[used], series, points.weight[used])
    except CollinearError:
        columns = term_values(linear_terms(k), x)
    rows = TemperatureRows(
        points.channel_names,
        components.names,
        points.channels[used],
        points.loads[used],
        np.concatenate(known)[used],
        [columns] * len(points.channel_names),
        series,
        points.weight[used],
    )
    try:
        terms = estimate_temperature_terms(rows, robust=True)
    except CollinearError:
        return None
    return None if terms.is_empty else terms


def refined_temperature_terms(runs: Sequence[Run], all_trims: AllTrimsCalibration) -> TemperatureTerms:
    """Estimate the terms of temperature beside the terms of the calibration model, from the rows that it fits.

    Where that is nonlinear, the squares and products that these rows tell stand beside them, too: in a ramp of several
    loads at one temperature a product that was not significant looks like a drift of the sensitivities, by more than
    their standard errors. `runs`: as they were read.
    """
    model, used = all_trims.model, all_trims.used
    block = _series_of_rows(all_trims)
    merged = [rows.run for rows in load_point_rows(runs)]
    x = all_trims.loads[used] / model.calibrated_range
    values = term_values(model.parsed_terms, x)
    columns = [values[:, np.isfinite(column)] for column in model.t.T]
    temperature = np.concatenate([each for each in map(run_temperature, runs) if each is not None])
    return estimate_temperature_terms(
        TemperatureRows(
            model.channel_names,
            model.components,
            np.vstack([read_channels(run, model.channel_names) for run in merged])[used],
            all_trims.loads[used],
            temperature[used],
            [_with_quadratic_terms(each, x, block) if model.is_nonlinear else each for each in columns],
            block,
            np.ones(int(used.sum())),
        )
    )


def _with_quadratic_terms(columns: Array, x: Array, series: NDArray[np.intp]) -> Array:
    """The columns (m, p) of a channel, with the squares and products of loads x (m, k) that the rows tell beside them.

    The columns alone, where the rows are too few for all of these.
    """
    further = term_values([term for term in all_terms(x.shape[1]) if term.is_quadratic], x)
    if len(x) < MIN_ROWS_PER_TERM * (columns.shape[1] + further.shape[1] + len(np.unique(series))):
        return columns
    kept, basis = [columns], subtract_block_means(columns, series)
    for column in further.T[:, :, None]:
        own = subtract_block_means(column, series)
        left = own - basis @ np.linalg.lstsq(basis, own, rcond=None)[0]
        if np.linalg.norm(left) > MIN_TOLD_SHARE * np.linalg.norm(column):
            kept.append(column)
            basis = np.hstack([basis, own])
    return np.hstack(kept)


def without_temperature(run: Run, terms: TemperatureTerms, geometry: Geometry) -> Run:
    """A static run with known loads as it would read at the reference temperature; itself where that is not known."""
    temperature = run_temperature(run)
    if temperature is None or not run.has_loads:
        return run
    block = run.read()
    assert block.loads is not None
    loads = load_components(geometry).from_hub_loads(np.asarray(block.loads, float))
    added = terms.readings(temperature, loads)
    channels = np.array(block.channels, float)
    for column, name in enumerate(terms.channel_names):
        if name in run.channel_names:
            channels[:, run.channel_names.index(name)] -= added[:, column]
    return replace(run, source=MemorySource(channels, block.loads))
