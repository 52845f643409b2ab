"""The likelihood of measured lines under a balance model, with noise on channels and loads.

Each line is z = [Y, U] = [T; I] U0 + noise with precision S. The true loads U0 are eliminated (Pintelon and Schoukens,
System Identification, 2nd ed., chapter 9): with M = [T; I], U0 = (M' S M)^-1 M' S z and r = z - M U0,

    chi2 = 2 sum r* S r,   gradient = -4 Re sum dY* (S r)_Y,   curvature = 4 Re sum dY* P dY (Gauss-Newton)

where dY = dT U0 and P = S_YY - S_YM (M'SM)^-1 S_MY. With noise on the channels alone U0 = U and P = S_YY.
The transients of records that began at rest are linear too, and are eliminated run by run (see `transients`). The
contributions of offsets and of nonlinear forces to z are known for given parameters and are subtracted first. Mains
interference of unknown phase is eliminated last (see `mains_interference`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from balance_cli.estimation.batch import Batch, map_batches, split_large_batches
from balance_cli.estimation.cell_forces import RunCellForces
from balance_cli.estimation.channel_distortions import RunDistortions
from balance_cli.estimation.inner_products import (
    LINES_AT_ONCE,
    MANY_PARAMETERS,
    ParameterChannels,
    information_product,
    parameter_channels,
    product_with_derivatives,
    real_inner_product,
    weighted_information,
    weighted_squares,
)
from balance_cli.estimation.line_derivatives import channel_derivatives
from balance_cli.estimation.mains_interference import MainsTone, ToneTerms, join_tones, mains_tones
from balance_cli.estimation.prediction import BatchPrediction, predict_batch
from balance_cli.estimation.shared_solutions import SharedSolutions
from balance_cli.estimation.transients import (
    RunTransient,
    TransientTerms,
    add_transient_derivatives,
    eliminate_transient,
    fit_transients,
)
from balance_cli.model.system import System
from balance_cli.model.system_response import Solution

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Index = NDArray[np.intp]


@dataclass(frozen=True)
class BatchEvaluation:
    """One batch at one parameter vector, transients and interference subtracted.

    `loads` (K, 6) are estimated; `residual` (K, c) is that of the channels about the measured loads, `weighted` (K, c)
    the weighted residual S r, `chi2` (K,) that of each line. `precision` P (K, c, c) has the loads eliminated;
    `nonlinear` are the forces along the springs and the distortions of channels that are not linear, `mains_tones` the
    interference in each run.
    """

    loads: ComplexArray
    weighted: ComplexArray
    residual: ComplexArray
    chi2: Array
    precision: ComplexArray
    transients: tuple[RunTransient, ...]
    nonlinear: tuple[RunCellForces | RunDistortions, ...]
    mains_tones: tuple[MainsTone, ...]

    @property
    def total(self) -> float:
        """Chi-square of all lines and of the priors of the transients, averaged over the phases of interference."""
        of_priors = sum(transient.chi2 for transient in self.transients)
        return float(self.chi2.sum() + of_priors + sum(tone.chi2 for tone in self.mains_tones))


@dataclass(frozen=True)
class Curvature:
    """Chi-square with half its gradient (p,) and half its Gauss-Newton curvature (p, p): the information matrix."""

    chi2: float
    gradient: Array
    information: Array

    def __add__(self, other: Curvature) -> Curvature:
        return Curvature(self.chi2 + other.chi2, self.gradient + other.gradient, self.information + other.information)


def evaluate_batch(
    batch: Batch, system: System, solution: Solution, derivatives: bool = False, shared: SharedSolutions | None = None
) -> BatchEvaluation:
    """Eliminate the true loads of every line and the transient of every run, and weight the residual.

    With `derivatives` the nonlinear forces and the transients come with theirs. `shared`: with other runs.
    """
    shared = SharedSolutions(system) if shared is None else shared
    prediction = predict_batch(batch, system, solution, derivatives, shared)
    return evaluate_prediction(batch, system, prediction, derivatives, shared)


def evaluate_prediction(
    batch: Batch, system: System, prediction: BatchPrediction, derivatives: bool, shared: SharedSolutions
) -> BatchEvaluation:
    """The same from the prediction of the lines, which batches with other precisions share."""
    loads, residual = prediction.loads, prediction.residual.copy()
    precision, load_influence = _eliminate_loads(batch, prediction.columns)

    def apply_weight(lines: slice, values: ComplexArray) -> ComplexArray:
        return np.asarray(np.matmul(precision[lines], values), complex)

    transients = fit_transients(batch, shared, residual, apply_weight, derivatives)
    tones: tuple[MainsTone, ...] = ()
    if system.equations.interference_tones:
        tones, transients = mains_tones(batch, system, residual, apply_weight, transients)
    for transient in transients:
        residual[transient.lines] -= transient.columns @ transient.x
    weighted = apply_weight(slice(None), residual[:, :, None])[:, :, 0]
    chi2 = 2.0 * np.real(np.sum(residual.conj() * weighted, axis=1))
    if load_influence is not None:
        # z - M U = [residual, 0], so the correction of the loads needs the residual alone.
        loads = loads + np.matmul(load_influence, residual[:, :, None])[:, :, 0]
    six_loads = _expand_to_six_components(batch, loads)
    return BatchEvaluation(six_loads, weighted, residual, chi2, precision, transients, prediction.nonlinear, tones)


def _eliminate_loads(batch: Batch, columns: ComplexArray) -> tuple[ComplexArray, ComplexArray | None]:
    """P (K, c, c), and the change of the loads (K, u, c) per unit residual; for columns T (K, c, u) of the loads.

    None in place of the second where the loads carry no noise.
    """
    c, S = batch.lines.channels.shape[1], batch.lines.precision
    if batch.has_exact_loads:
        return S[:, :c, :c], None
    precision, influence = np.empty((len(S), c, c), complex), np.empty((len(S), columns.shape[2], c), complex)
    for start in range(0, len(S), LINES_AT_ONCE):  # some lines at a time, whose products stay in the cache
        lines = slice(start, start + LINES_AT_ONCE)
        removed, influence[lines] = _load_share(S[lines], columns[lines])
        np.subtract(S[lines, :c, :c], removed, out=precision[lines])
    return precision, influence


def _load_share(S: ComplexArray, columns: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
    """What the elimination of the loads takes off S (k, c+u, c+u), (k, c, c), and their change (k, u, c)."""
    c = columns.shape[1]
    SM = np.matmul(S[:, :, :c], columns) + S[:, :, c:]
    normal = np.matmul(columns.conj().swapaxes(1, 2), SM[:, :c]) + SM[:, c:]
    transposed = SM[:, :c].conj().swapaxes(1, 2)
    if normal.shape[1] == 1:  # one excited component at a time, as in most sweeps: no matrix to invert
        influence = transposed / normal
        return SM[:, :c] * influence, influence
    influence = np.asarray(np.linalg.solve(normal, transposed), complex)
    return np.matmul(SM[:, :c], influence), influence


def _expand_to_six_components(batch: Batch, loads: ComplexArray) -> ComplexArray:
    """Loads (K, u) as six columns (K, 6)."""
    six = np.zeros((len(loads), 6), complex)
    np.put_along_axis(six, batch.lines.components, loads, axis=1)
    return six


@dataclass(frozen=True)
class BatchDerivatives:
    """One batch with its derivatives (K, c, p), those of the transients included.

    `further_terms` of gradient and information come from the elimination of the transients and from tones of the mains.
    """

    batch: Batch
    fit: BatchEvaluation
    derivatives: ComplexArray
    further_terms: tuple[TransientTerms | ToneTerms, ...]

    def gradient(self) -> Array:
        """Half the gradient (p,) of chi-square."""
        gradient = -2.0 * real_inner_product(self.derivatives, self.fit.weighted[:, :, None])[:, 0]
        return np.asarray(gradient + sum(term.gradient for term in self.further_terms))

    @cached_property
    def _shown(self) -> ParameterChannels:
        """Where the parameters show."""
        return parameter_channels(self.derivatives)

    def weighted(self, columns: Index | slice = slice(None)) -> ComplexArray:
        """P dY (K, c, q) of the selected parameters, with the true loads eliminated."""
        return np.asarray(np.matmul(self.fit.precision, self.derivatives[:, :, columns]), complex)

    def cross_information(self, rows: Index) -> Array:
        """The rows (f, p) of 2 Re sum dY* P dY."""
        information = 2.0 * product_with_derivatives(self.weighted(rows), self.derivatives, self._shown)
        for term in self.further_terms:
            information += term.information(rows, slice(None))
        return information

    def full_information(self) -> Array:
        """2 Re sum dY* P dY (p, p)."""
        every = slice(None)
        if self.derivatives.shape[2] < MANY_PARAMETERS:
            return self._block(every)
        information = 2.0 * information_product(self.derivatives, self.fit.precision)
        for term in self.further_terms:
            information += term.information(every, every)
        return information

    def diagonal_blocks(self, blocks: Sequence[Index]) -> list[Array]:
        """The information of each block of parameters; those of a single parameter, which are many, all at once."""
        diagonal = 2.0 * weighted_squares(self.derivatives, self.fit.precision, self._shown)
        for term in self.further_terms:
            diagonal += term.diagonal()
        return [self._block(block) if len(block) > 1 else diagonal[block][:, None] for block in blocks]

    def _block(self, own: Index | slice) -> Array:
        """The information (q, q) of some parameters."""
        information = 2.0 * weighted_information(self.derivatives[:, :, own], self.fit.precision)
        for term in self.further_terms:
            information = information + term.information(own, own)
        return np.asarray(information)


def batch_derivatives(batch: Batch, system: System, shared: SharedSolutions | None = None) -> BatchDerivatives:
    """The batch at one parameter vector, with the derivatives of all its lines; `shared` with other batches."""
    shared = SharedSolutions(system) if shared is None else shared
    solution = shared.solution(batch.frequency, batch.spin)
    fit = evaluate_batch(batch, system, solution, derivatives=True, shared=shared)
    derivatives = channel_derivatives(batch, system, solution, fit.loads, fit.nonlinear)
    for transient in fit.transients:
        add_transient_derivatives(transient, derivatives[transient.lines])
    tones = [tone.curvature(derivatives[tone.form.lines]) for tone in fit.mains_tones]
    transients = [eliminate_transient(run, derivatives[run.lines]) for run in fit.transients]
    return BatchDerivatives(batch, fit, derivatives, (*transients, *([join_tones(tones)] if tones else [])))


def batch_curvature(batch: Batch, system: System, shared: SharedSolutions | None = None) -> Curvature:
    """Chi-square, gradient and information of one batch."""
    item = batch_derivatives(batch, system, shared)
    return Curvature(item.fit.total, item.gradient(), item.full_information())


def data_curvature(batches: Sequence[Batch], system: System) -> Curvature:
    """Chi-square, gradient and information of all measured lines."""
    p, shared = system.parameters, SharedSolutions(system)
    total = Curvature(0.0, np.zeros(p), np.zeros((p, p)))
    for part in map_batches(lambda batch: batch_curvature(batch, system, shared), split_large_batches(batches, p)):
        total = total + part  # the fixed order fixes the rounding
    return total


def data_chi2(batches: Sequence[Batch], system: System) -> float:
    """Chi-square of all measured lines, without derivatives."""
    shared = SharedSolutions(system)

    def chi2(batch: Batch) -> float:
        solution = shared.solution(batch.frequency, batch.spin)
        return evaluate_batch(batch, system, solution, shared=shared).total

    return float(sum(map_batches(chi2, batches)))


def count_measured_values(batches: Sequence[Batch]) -> float:
    """Number of real measured values."""
    return float(sum(batch.lines.count.sum() for batch in batches))
