"""Loads that rest on one sensor: nothing contradicts them whatever it reads, though other loads have redundant sensors.

A sensor that is dead, doubled or reversed has an error of 100 or 200 % of what it should read, at all harmonics alike.
Where the residual test does not show that, each load that the error changes by half or more is untested. A torque
meter beside the shaft is the only one that tells Mz: reversed, it had given loads 784 standard deviations off.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.reduction.reliability import noticed_share, readings_of_sensors
from balance_cli.reduction.weighted_least_squares import LoadEquations, residual_chi2

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

DEAD, REVERSED = 1.0, 2.0
"""Errors of a dead (or doubled) and of a reversed sensor, as shares of what it should read. A smaller one that is
noticed shows that the sensor is tested."""
UNTESTED_CHANGE = 0.2
"""Change of a load by such an error, as a share of it, from which it is untested. At 0.5 a cell that nothing tests,
reversed, had made 8 of 11 loads without a flag up to 74 standard deviations wrong; at 0.2 the loads of three sound
rigs are as tested as before, but for 3 of 54 where one cell is alone."""
LEAST_CHANGE_SIGMAS = 10.0
"""Change of a load, over its standard deviation, from which it counts. Of two equal sensors of one load the test shows
the failure of one from 7 to 10 standard deviations on: no redundancy tests smaller loads."""
TEST_LOAD_SIGMAS = 100.0
"""A load, over its standard deviation, at which sensors are examined where the load is smaller: one known to 1 %."""
LEAST_MISFIT = 10.0
"""Chi-square per degree of freedom, by the noise of the channels and the errors of the response, from which a mistake
in the channels is sought, of all harmonics together. Gusts do not reach it: the response explains what they make. In
short records the residual test takes them for noise where a mistake keeps the response from that."""
FEWEST_REJECTED, REJECTED_SHARE = 3, 1.0 / 3.0
"""Harmonics, and share of them, at which the residual test rejects the response, from which it is rejected at all: the
others have less redundancy or more noise. By chance three of eight are one in ten million."""


def sensors_of_channels(geometry: Geometry) -> dict[str, str]:
    """Return what each channel measures, by its name: the channel itself where that is unknown."""
    return {channel.name: channel.source or channel.name for channel in geometry.channels}


def row_sensors(
    live: Sequence[str], rows: Sequence[int], geometry: Geometry, rows_are_channels: bool
) -> tuple[str, ...]:
    """Return what each row of the equations measures; a row that is formed from several channels counts as one."""
    sources = sensors_of_channels(geometry)
    return tuple(sources[name] for name in live) if rows_are_channels else tuple(str(row) for row in rows)


def untested_harmonics(
    equations: LoadEquations,
    sensors: Sequence[str],
    degrees: Array,
    limit: Array,
    sigma: Array,
    channel_covariance: Array | None = None,
    response_covariance: Callable[[Array], Array] | None = None,
) -> Mask:
    """Return which harmonic loads (h, m) rest on one sensor that no other one tests.

    `sensors` names the source of each complex reading; `degrees` and `limit` (h,) are those of the residual test; sigma
    (h, m) that of the loads. An error is noticed where the test shows it, and everywhere where it does at so many
    harmonics that the response is rejected. `channel_covariance` (h, a, a) of the readings by the noise of
    the channels themselves: with it, an error is noticed that the search for mistakes in the channels finds.
    `response_covariance` maps loads (s h, 2m) to that (s h, a, a) of the readings by the errors of the response: the
    loads that a wrong sensor makes have an error of their own, which no test takes for that of the sensor.
    """
    both = (*sensors, *sensors)
    error = readings_of_sensors(both) * equations.readings[:, None, :]
    added = _response_errors(equations, error, response_covariance)
    least = np.where(degrees > 0, (np.where(degrees > 0, limit, 1.0) - 1.0) * degrees, np.inf)[:, None]
    noticed = _noticed(equations, error, equations.covariance, added, least, _at_each)
    fewest = harmonics_to_reject(len(noticed))
    if fewest <= len(noticed):
        noticed = np.minimum(noticed, np.sort(noticed, axis=0)[fewest - 1])
    if channel_covariance is not None and degrees.sum() > 0:
        misfit = np.full((1, 1), LEAST_MISFIT * degrees.sum())
        noticed = np.minimum(noticed, _noticed(equations, error, channel_covariance, added, misfit, _of_all))
    return _untested(equations, both, noticed, (degrees, limit), sigma, _amplitude)


def _response_errors(
    equations: LoadEquations, error: Array, response_covariance: Callable[[Array], Array] | None
) -> Array:
    """Covariance (s, h, a, a) of the readings by errors of the response to the loads that errors (h, s, a) make."""
    h, s, a = error.shape
    if response_covariance is None:
        return np.zeros((s, 1, 1, 1))
    loads = np.einsum("hba,hsa->shb", equations.estimator, error)
    return response_covariance(loads.reshape(s * h, -1)).reshape(s, h, a, a)


def _at_each(chi2: Array) -> Array:
    return chi2


def _of_all(chi2: Array) -> Array:
    return np.asarray(chi2.sum(axis=0, keepdims=True))


def _noticed(
    equations: LoadEquations,
    error: Array,
    covariance: Array,
    added: Array,
    least: Array,
    gather: Callable[[Array], Array],
) -> Array:
    """Return the share (h or 1, s) of errors (h, s, a) at which chi-square is the `least` (h or 1, 1).

    Chi-square (h, s) is first gathered over the harmonics. The covariance (h, a, a) grows by `added` (s, h, a, a) times
    the square of the share. It is taken for a dead sensor, and for a reversed one where a dead one is not noticed.
    """
    shares = []
    for share in (DEAD, REVERSED):
        chi2 = np.stack(
            [
                residual_chi2(equations.redundant, error[:, i, :, None], covariance + share**2 * added[i])[:, 0]
                for i in range(error.shape[1])
            ],
            axis=1,
        )
        with np.errstate(divide="ignore"):
            shares.append(np.sqrt(least / gather(chi2)))
    return np.where(shares[0] <= DEAD, shares[0], np.maximum(shares[1], DEAD))


def harmonics_to_reject(harmonics: int) -> int:
    """Return at how many of the harmonics the residual test rejects a response that is rejected at all of them."""
    return int(np.ceil(max(FEWEST_REJECTED, REJECTED_SHARE * harmonics)))


def untested_means(equations: LoadEquations, sensors: Sequence[str], limit: float, sigma: Array) -> Mask:
    """Return which mean loads (m,) rest on one sensor that no other one tests.

    The `equations` are real, of one set of readings (a,), and `limit` is that of their residual test; sigma (m,). All
    are untested where no sensor is redundant.
    """
    one = LoadEquations(
        T=equations.T[None],
        readings=equations.readings[None],
        covariance=equations.covariance[None],
        estimator=equations.estimator[None],
    )
    return np.asarray(untested_points(one, sensors, np.array([limit]), sigma[None])[0])


def untested_points(equations: LoadEquations, sensors: Sequence[str], limit: Array, sigma: Array) -> Mask:
    """Return the same (h, m) for h sets of real readings, with `limit` (h,) and sigma (h, m)."""
    readings, loads = equations.T.shape[1:]
    if len(set(sensors)) <= loads:
        return np.ones(sigma.shape, bool)
    test = np.full(len(limit), float(readings - loads)), limit
    error = readings_of_sensors(sensors) * equations.readings[:, None, :]
    return _untested(equations, sensors, noticed_share(equations, error, *test), test, sigma, np.abs)


def _amplitude(loads: Array) -> Array:
    """Return the amplitudes (..., m) of loads (..., 2m) that are real and imaginary parts."""
    m = loads.shape[-1] // 2
    return np.hypot(loads[..., :m], loads[..., m:])


def _untested(
    equations: LoadEquations,
    sensors: Sequence[str],
    noticed: Array,
    test: tuple[Array, Array],
    sigma: Array,
    amplitude: Callable[[Array], Array],
) -> Mask:
    """Return which loads (h, m) rest on a sensor whose error is `noticed` at a share (h, s) that is too large for them.

    Either the readings show it, or those of one load alone: a load that is zero in this run is tested where the same
    load of TEST_LOAD_SIGMAS would be.
    """
    T, G, (h, m) = equations.T, equations.estimator, sigma.shape
    belongs = readings_of_sensors(sensors)
    share = np.where(noticed < DEAD, 0.0, np.minimum(noticed, REVERSED))[:, :, None]
    change = amplitude(np.einsum("hba,sa,ha->hsb", G, belongs, equations.readings))
    size = amplitude(np.einsum("hba,ha->hb", G, equations.readings))
    wrong = share * change > np.maximum(UNTESTED_CHANGE * size, LEAST_CHANGE_SIGMAS * sigma)[:, None, :]
    unit_loads = np.einsum("sa,ham->hsma", belongs, T[..., :m])
    change = amplitude(np.einsum("hba,hsma->hsmb", G, unit_loads)).diagonal(axis1=2, axis2=3)
    errors = (TEST_LOAD_SIGMAS * sigma[:, None, :, None] * unit_loads).reshape(h, -1, T.shape[1])
    seen = noticed_share(equations, errors, *test).reshape(h, -1, m)
    return np.asarray(np.any(wrong | (np.minimum(share, seen) * change > UNTESTED_CHANGE), axis=1))
