"""Identification in the frequency domain: least squares, then maximum likelihood, all runs at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.errors import UserError
from balance_cli.estimation.equation_error import least_squares
from balance_cli.estimation.gauss_newton import Minimum, minimise, prior_curvature
from balance_cli.estimation.likelihood import Curvature, data_chi2, data_curvature
from balance_cli.estimation.measurements import Batch, stacked
from balance_cli.estimation.quality import fit_quality
from balance_cli.estimation.support import parameter_support, undetermined
from balance_cli.geometry import Geometry
from balance_cli.identified import FitQuality, IdentifiedModel, ModeTable, ParameterTable, PhysicalModel
from balance_cli.model.balance import BalanceModel, balance_model
from balance_cli.model.modes import modes
from balance_cli.signals.lines import Lines, StaticPoints

Array = NDArray[np.float64]

METHODS = ("ls", "ml", "ls+ml", "computed")


@dataclass(frozen=True)
class IdentifyOptions:
    """How to identify: `method` (one of METHODS) and the band [Hz] of the lines that take part."""

    method: str = "ls+ml"
    band: tuple[float, float] = (0.0, np.inf)


def identify(
    lines: Sequence[Lines],
    statics: Sequence[StaticPoints],
    geometry: Geometry,
    options: IdentifyOptions | None = None,
    left_out: dict[str, str] | None = None,
) -> IdentifiedModel:
    """Fit the physical form to the measured lines and the static points, with priors from the tolerances.

    Raises UserError where there is nothing to fit.
    """
    options = options or IdentifyOptions()
    model = balance_model(geometry)
    batches = stacked([_in_band(item, options.band) for item in lines], statics, geometry.channel_names)
    if options.method == "computed":
        return _described(model, batches, _unfitted(model, batches), options.method, "geometry", left_out or {})
    if not batches:
        raise UserError("no sweep and no static run to identify from", remedy="Give at least one sweep run")
    minimum, start = _fitted(model, batches, options)
    return _described(model, batches, minimum, options.method, start, left_out or {})


def _in_band(lines: Lines, band: tuple[float, float]) -> Lines:
    """The lines inside the band; the same object where all are."""
    keep = (lines.frequency >= band[0]) & (lines.frequency <= band[1])
    if keep.all():
        return lines
    arrays = {name: getattr(lines, name)[keep] for name in ("frequency", "channels", "loads", "covariance")}
    return Lines(**{**lines.__dict__, **arrays})


def _unfitted(model: BalanceModel, batches: Sequence[Batch]) -> Minimum:
    """The declared parameters, with the tolerances for their covariance."""
    theta = model.parameters.value
    p = int(model.parameters.free.sum())
    chi2 = data_chi2(batches, model.system())
    data = Curvature(chi2, np.zeros(p), np.zeros((p, p)))
    return Minimum(theta, data, data + prior_curvature(model.parameters, theta), 0, True)


def _fitted(model: BalanceModel, batches: Sequence[Batch], options: IdentifyOptions) -> tuple[Minimum, str]:
    """The estimate, and where it started: least squares or geometry, whichever fits the lines better."""
    declared = model.parameters.value
    if options.method == "ml":
        return maximum_likelihood(model, batches, declared), "geometry"
    band = (max(options.band[0], 1.0), options.band[1])
    first = least_squares(model.parameters, batches, model.system, band)
    if options.method == "ls":
        data = data_curvature(batches, model.system(first.theta))
        total = data + prior_curvature(model.parameters, first.theta)
        return Minimum(first.theta, data, total, first.iterations, first.converged), "geometry"
    starts = {"least squares": first.theta, "geometry": declared}
    best = min(starts, key=lambda name: data_chi2(batches, model.system(starts[name])))
    return maximum_likelihood(model, batches, starts[best]), best


def maximum_likelihood(model: BalanceModel, batches: Sequence[Batch], start: Array) -> Minimum:
    """Maximise the likelihood of the lines (errors on channels and loads) times the priors, from `start`."""
    return minimise(
        model.parameters,
        start,
        lambda theta: data_curvature(batches, model.system(theta)),
        lambda theta: data_chi2(batches, model.system(theta)),
    )


def _described(
    model: BalanceModel,
    batches: Sequence[Batch],
    minimum: Minimum,
    method: str,
    start: str,
    left_out: dict[str, str],
) -> IdentifiedModel:
    covariance = np.linalg.inv(minimum.total.information)
    support = parameter_support(model.parameters, minimum.data.information)
    quality = fit_quality(batches, model.system(minimum.theta), support.determined)
    return IdentifiedModel(
        form="physical",
        method=method,
        start=start,
        geometry=model.geometry,
        physical=_physical(model, minimum.theta, covariance, support.rests_on),
        modes=mode_table(model, minimum.theta, covariance),
        quality=quality if method != "computed" or batches else FitQuality(float("nan"), 0.0, float("nan"), {}),
        undetermined=undetermined(model.parameters, minimum.data.information) if method != "computed" else (),
        left_out=left_out,
        iterations=minimum.iterations,
        converged=minimum.converged,
    )


def _physical(model: BalanceModel, theta: Array, covariance: Array, rests_on: tuple[str, ...]) -> PhysicalModel:
    parameters = model.parameters
    full = np.zeros((len(parameters), len(parameters)))
    full[np.ix_(parameters.free, parameters.free)] = covariance
    table = ParameterTable(
        names=parameters.names,
        units=parameters.units,
        value=theta,
        sigma=np.sqrt(np.diag(full)),
        declared=parameters.value,
        declared_sigma=parameters.sigma,
        rests_on=rests_on,
    )
    return PhysicalModel(table, full)


def mode_table(model: BalanceModel, theta: Array, covariance: Array) -> ModeTable:
    """Modes at `theta` with sigma from the covariance of the free parameters."""
    found = modes(model.system(theta))
    return ModeTable(
        coordinates=found.coordinates,
        frequency=found.frequency,
        damping_ratio=found.damping_ratio,
        sigma_frequency=_sigma(found.frequency_slope, covariance),
        sigma_damping_ratio=_sigma(found.damping_slope, covariance),
        shape=found.shape,
    )


def _sigma(slope: Array, covariance: Array) -> Array:
    return np.asarray(np.sqrt(np.maximum(np.einsum("mp,pq,mq->m", slope, covariance, slope), 0.0)))
