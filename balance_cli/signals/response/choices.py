"""Names of the estimators and interpolations of frequency responses. Imports nothing heavy."""

from __future__ import annotations

from typing import Literal, get_args

AUTO, PERIODIC, LOCAL_RATIONAL, LOCAL_POLYNOMIAL = "auto", "periodic", "lrm", "lpm"
AVERAGED_ESTIMATORS = ("h1", "h2", "hv")
"""Estimators from averaged spectra."""
Estimator = Literal["auto", "periodic", "lrm", "lpm", "h1", "h2", "hv"]
ESTIMATORS: tuple[Estimator, ...] = get_args(Estimator)
"""All estimators; the first is the default."""
Interpolation = Literal["local", "spline", "first-order", "nearest"]
INTERPOLATIONS: tuple[Interpolation, ...] = get_args(Interpolation)
"""How a measured response is interpolated; the first is the default."""
