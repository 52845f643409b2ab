"""Whether the lines of a window tell the response to the loads from the transient.

A load that acts near the start or end of a record has lines that turn slowly, and the polynomials of the transient
describe what the model leaves out of the response to it: the residual is noise, and the response is wrong. How near,
depends on the width of the window and on the degrees of both numerators. The leading term that a response leaves out is
its next degree. Of this term a fit leaves a part in the residual, where it would be noticed, and passes an error on to
the response. In windows over the whole of a random record the error has a third of the power of that part.
"""

from __future__ import annotations

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

from balance_cli.signals.local.window import WindowFit, denominator_at

ComplexArray = NDArray[np.complex128]

LARGEST_ERROR_RATIO = 2.0
"""Power of the error of the response over that of the residual which shows it. On stepped records of nine rigs, with
fewer orders to choose from, lines had a chi-square of 1.00 to 1.03 per degree of freedom below it, 1.1 to 1.2 up to
10, and then up to 40; of records with steps half as long some were at 1.1 from a ratio of 1 on."""
LEAST_POWER = 1e-300


def separates_transient(fit: WindowFit, lines: slice) -> bool:
    """Return whether an error of the response at some lines of a window would show in the residual of the window."""
    forced, transient = fit.U * _next_degree(fit, fit.orders.response)[:, None], _next_degree(fit, fit.orders.transient)
    left_out = np.column_stack([forced, transient])
    coefficients = fit.pseudoinverse @ left_out
    residual = left_out - fit.regressors @ coefficients
    of_response = len(coefficients) - (fit.orders.transient + 1)
    error = -(fit.regressors[lines, :of_response] @ coefficients[:of_response])
    error[:, :-1] += forced[lines]
    shown, passed_on = _power(fit, residual, slice(None)), _power(fit, error, lines)
    return bool(np.all(passed_on <= LARGEST_ERROR_RATIO * np.maximum(shown, LEAST_POWER)))


def _next_degree(fit: WindowFit, degree: int) -> ComplexArray:
    """The first term (M,) that a numerator of this degree leaves out."""
    return np.asarray(legendre.legval(fit.r, np.eye(degree + 2)[-1]) / denominator_at(fit, fit.r))


def _power(fit: WindowFit, values: ComplexArray, lines: slice) -> NDArray[np.float64]:
    """Weighted sum of squares (u,) of values (k, u) at some lines."""
    return np.asarray(np.sum(np.abs(values * fit.weight[lines, None]) ** 2, axis=0))
