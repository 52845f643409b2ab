"""Identification in the paper's form, with a result of the same structure as that of the physical form."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.estimation.fit_quality import frf_band_of_lines
from balance_cli.estimation.identified_model import FitQuality, IdentifiedModel, ModeTable, ParameterTable, RunFit
from balance_cli.estimation.measured_spectra import Spectra
from balance_cli.estimation.paper.fit import identify_paper_form
from balance_cli.estimation.paper.result import PaperFit, PaperOptions
from balance_cli.estimation.paper_rows import estimate_row_error
from balance_cli.io.errors import UserError

Array = NDArray[np.float64]


def identify_in_paper_form(spectra: Spectra, geometry: Geometry, options: PaperOptions) -> IdentifiedModel:
    """Identify in the paper's form; static runs are not used, torque sweeps only for the error of the torque.

    Source: the paper, corrected as in docs/theory/paper-notes.md, notes 3 to 11.
    """
    if not spectra.lines:
        raise UserError("no sweep run to identify from", remedy="Give sweeps of Fx, Fy, Fz, Mx and My")
    lines = np.concatenate([run.frequency[run.frequency > 0] for run in spectra.lines])
    fit = identify_paper_form(geometry, spectra.lines, options, frf_band_of_lines(lines, geometry))
    return IdentifiedModel(
        form="paper",
        method=options.method,
        start=fit.start,
        geometry=geometry,
        parameters=_parameters(fit),
        covariance=fit.covariance,
        modes=_modes(fit),
        quality=_quality(fit),
        unidentifiable=("the scale of M, D, K and C: this form holds their quotients only",),
        channels_left_out=spectra.channels_left_out,
        iterations=fit.iterations,
        converged=fit.converged,
        response_error=estimate_row_error(fit, geometry, spectra.lines),
        paper=fit,
        usual_noise=spectra.usual_noise or None,
        excited_band=(float(lines.min()), float(lines.max())),
    )


def _parameters(fit: PaperFit) -> ParameterTable:
    undeclared = np.full(len(fit.parameters), np.nan)
    return ParameterTable(
        names=fit.parameter_names,
        units=fit.parameter_units,
        value=fit.parameters,
        sigma=fit.sigma,
        declared=undeclared,
        declared_sigma=np.full(len(fit.parameters), np.inf),
        informed_by=("data",) * len(fit.parameters),
    )


def _modes(fit: PaperFit) -> ModeTable:
    return ModeTable(
        coordinates=fit.rule.names,
        frequency=np.array([mode.frequency_hz for mode in fit.modes]),
        damping_ratio=np.array([mode.damping_ratio for mode in fit.modes]),
        sigma_frequency=np.array([mode.sigma_frequency_hz for mode in fit.modes]),
        sigma_damping_ratio=np.array([mode.sigma_damping_ratio for mode in fit.modes]),
        shape=np.zeros((0, len(fit.rule.names)), complex),
    )


def _quality(fit: PaperFit) -> FitQuality:
    unknown = float("nan")
    runs = {name: RunFit(unknown, unknown, error, unknown) for name, error in fit.misfit.frf_errors.items()}
    return FitQuality(float(fit.misfit.chi2), float(fit.misfit.dof), fit.misfit.frf_error, runs, fit.misfit.frf_band)
