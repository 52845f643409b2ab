"""Names of the estimators of frequency responses. Imports nothing, so that the command line can offer them."""

from __future__ import annotations

from typing import Literal, get_args

AUTO, PERIODIC, LOCAL_RATIONAL, LOCAL_POLYNOMIAL = "auto", "periodic", "lrm", "lpm"
AVERAGED_ESTIMATORS = ("h1", "h2", "hv")
"""Estimators from averaged spectra."""
Estimator = Literal["auto", "periodic", "lrm", "lpm", "h1", "h2", "hv"]
ESTIMATORS: tuple[Estimator, ...] = get_args(Estimator)
"""All estimators; the first is the default."""
