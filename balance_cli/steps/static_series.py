"""Load series of static runs that state none, as `calibrate` reads them, for the estimators.

Each load series has its own zero, since weights are removed and pans are moved between series. A calibration finds the
series from loads and readings; a fit of sweeps and static runs that took one zero for a run would take the others for
an error of its model. Where the zeros of a run do not differ it keeps the one zero: further ones would cost
information.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.identity_cache import cached_by_identity
from balance_cli.diagnosis.significance import DATA_TEST_LEVEL, chi2_p_value
from balance_cli.estimation.measured_spectra import Spectra
from balance_cli.signals.run_spectrum import StaticPoints

Array = NDArray[np.float64]
Index = NDArray[np.intp]

RANK_TOLERANCE = 1e-9
"""Singular value over the largest from which a column counts: powers of few levels are combinations of each other."""


def with_load_series(spectra: Spectra) -> Spectra:
    """Return spectra whose static runs have the load series that their rows show, where the zeros of these differ."""
    return replace(spectra, statics=tuple(_with_series(points) for points in spectra.statics))


@cached_by_identity
def _with_series(points: StaticPoints) -> StaticPoints:
    if points.series is not None:
        return points
    series = _series_of(points)
    return replace(points, series=series) if _zeros_differ(points, series) else points


def _series_of(points: StaticPoints) -> Index:
    """Number (m,) of the load series of each row, as a calibration of this run alone reads it."""
    # Ten modules that sweeps without static runs do not need.
    from balance_cli.calibration.load_series_reading import read_load_series
    from balance_cli.calibration.load_series_score import ScheduleRows

    m = len(points.loads)
    reading = read_load_series(
        ScheduleRows(
            x=_scaled_loads(points),
            channels=points.channels,
            used=np.ones(m, bool),
            segment=np.zeros(m, np.intp),
            run=np.zeros(m, np.intp),
            run_names=(points.run,),
            stated=("",) * m,
            tare=np.zeros(m, bool),
        )
    )
    return np.asarray(np.unique(reading.load_series, return_inverse=True)[1].reshape(-1), np.intp)


def _scaled_loads(points: StaticPoints) -> Array:
    """The applied loads (m, k) in units of their largest values."""
    largest = np.max(np.abs(points.loads), axis=0)
    return np.asarray(points.loads[:, largest > 0] / largest[largest > 0])


def _zeros_differ(points: StaticPoints, series: Index) -> bool:
    """Whether one zero for each series describes the readings better than noise would make it.

    Squares and cubes of the loads are fitted as well: what a nonlinear channel adds to a series is no zero.
    """
    x = _scaled_loads(points)
    smooth = _orthonormal(np.hstack([np.ones((len(x), 1)), x, x**2, x**3]))
    zeros = np.equal.outer(series, np.unique(series)).astype(float)
    further = _orthonormal(zeros - smooth @ (smooth.T @ zeros))
    if not further.shape[1]:
        return False
    z = further.T @ points.channels
    chi2 = float(np.sum(z * np.linalg.solve(points.covariance, z.T).T))
    return chi2_p_value(chi2, (z.size,), (points.dof,)) < DATA_TEST_LEVEL


def _orthonormal(columns: Array) -> Array:
    U, s, _ = np.linalg.svd(columns, full_matrices=False)
    return np.asarray(U[:, s > RANK_TOLERANCE * max(float(s.max(initial=0.0)), 1.0)])
