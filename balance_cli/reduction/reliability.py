"""What the residual test does not show: how far an error of one sensor changes the loads before it is noticed.

An error in the response of a sensor adds the vector b to the readings y = T f + e: the share of its error times what it
reads. It changes the loads by G b and raises chi-square by b' Q b, Q = W - W T (T' W T)^-1 T' W. Where a sensor is the
only one that tells a load, Q b is zero and the test stays silent whatever the error. Baarda (A testing procedure for
use in geodetic networks, Netherlands Geodetic Commission 2 (5), 1968) calls the least error that is noticed the
internal and its effect on the result the external reliability.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.campaign.rig.components import UNIT_OF
from balance_cli.reduction.weighted_least_squares import LoadEquations, residual_chi2

Array = NDArray[np.float64]

SENSOR_ERROR = 0.01
"""Error of the response of a sensor, as a share, for which the loads are examined: what a gain or a mounting
changes by between two campaigns. Below the error that is noticed, all changes are in proportion to it."""
NOTABLE_CHANGE = 0.1
"""Change of a load, as a share of it, from which it is said: one known to 10 % does not serve to compare rotors."""
NOTABLE_SIGMAS = 2.0
"""Standard deviations of a load below which a change is within what is stated of it."""

MASS_SHARE = 0.01
"""Of the mass that moves, for which the loads are examined: a tool, a fixture of the exciter, or a hub of another kind.
A change of eigenfrequencies by half of that is the least that turbulence shows (`moved_modes`)."""


@dataclass(frozen=True)
class NotableChange:
    """Change of a load of a harmonic [N, N m] by an error of a sensor that the residual test does not show."""

    sensor: str
    component: str
    harmonic: int
    change: float
    load: float


@dataclass(frozen=True)
class UnnoticedErrors:
    """Change of each load (h, m) by an error of the worst sensor that the residual test leaves, up to SENSOR_ERROR.

    change (h, m) in N and N m; sensor (h, m): the place of that sensor among `sensors`.
    """

    sensors: tuple[str, ...]
    sensor: NDArray[np.int64]
    change: Array

    def notable_changes(self, components: Sequence[str], size: Array, sigma: Array) -> tuple[NotableChange, ...]:
        """Return the changes that matter for loads of this size and sigma (h, m), of each load the largest."""
        share = np.where(self.change > NOTABLE_SIGMAS * sigma, self.change / np.where(size > 0.0, size, np.inf), 0.0)
        change = np.where(share > NOTABLE_CHANGE, self.change, 0.0)
        largest = np.argmax(change, axis=0)
        return tuple(
            NotableChange(
                self.sensors[self.sensor[n, j]], component, int(n) + 1, float(change[n, j]), float(size[n, j])
            )
            for j, (n, component) in enumerate(zip(largest, components, strict=True))
            if change[n, j] > 0.0
        )

    def describe(self, components: Sequence[str], size: Array, sigma: Array) -> str:
        """Return the notable changes in words, empty without any."""
        parts_by_sensor: dict[str, list[str]] = {}
        for item in self.notable_changes(components, size, sigma):
            unit = UNIT_OF.get(item.component, "")
            place = f"{item.component} at harmonic {item.harmonic}"
            part = f"{place} by {item.change:.2g} {unit} (load {item.load:.2g} {unit})"
            parts_by_sensor.setdefault(item.sensor, []).append(part)
        return "; ".join(
            f"an error of up to {100.0 * SENSOR_ERROR:g} % in {sensor}, which the residual test does not show, changes "
            f"{', '.join(parts)}"
            for sensor, parts in parts_by_sensor.items()
        )


@dataclass(frozen=True)
class UndeclaredMass:
    """Change of each load (h, m) [N, N m] by `mass` [kg] at the worst of some `places`, as far as no channel shows it.

    `place` (h, m) is the index of that place.
    """

    mass: float
    places: tuple[str, ...]
    place: NDArray[np.int64]
    change: Array

    def describe(self, components: Sequence[str], sigma: Array) -> str:
        """Return which loads of sigma (h, m) it changes by more than they are stated to be known, else empty."""
        over_sigma = self.change / np.where(sigma > 0.0, sigma, np.inf)
        notable = np.where(over_sigma > NOTABLE_SIGMAS, self.change, 0.0)
        parts = []
        for j, n in enumerate(np.argmax(notable, axis=0)):
            if notable[n, j] > 0.0:
                name, place = components[j], self.places[self.place[n, j]]
                size = f"{self.change[n, j]:.2g} {UNIT_OF.get(name, '')} ({over_sigma[n, j]:.2g} sigma)"
                parts.append(f"{name} at harmonic {n + 1} by {size} if at {place}")
        if not parts:
            return ""
        return (
            f"{self.mass:.3g} kg ({100.0 * MASS_SHARE:g} % of the mass that moves) more or less than in the sweeps "
            f"would not show in the channels, and changes {', '.join(parts)}"
        )


def unnoticed_errors(equations: LoadEquations, sensors: Sequence[str], degrees: Array, limit: Array) -> UnnoticedErrors:
    """Return how far an error of one sensor changes the loads before the residual test shows it.

    `sensors` names the source of each complex row; `degrees` and `limit` (h,) are those of the residual test, which
    shows an error in half of the cases where chi-square is then expected at its limit.
    """
    error = readings_of_sensors((*sensors, *sensors)) * equations.readings[:, None, :]
    size = unnoticed_changes(equations, error, degrees, limit, SENSOR_ERROR)
    worst = np.argmax(size, axis=1)
    names = tuple(dict.fromkeys(sensors))
    return UnnoticedErrors(names, worst, np.take_along_axis(size, worst[:, None, :], axis=1)[:, 0])


def unnoticed_changes(equations: LoadEquations, error: Array, degrees: Array, limit: Array, most: float) -> Array:
    """Return the change (h, s, m) of the loads by errors (h, s, a) of the readings, each times its share.

    That is `most`, or less where the residual test shows the error.
    """
    change = np.einsum("hba,hsa->hsb", equations.estimator, error)
    m = change.shape[2] // 2
    noticed = noticed_share(equations, error, degrees, limit)
    return np.asarray(np.minimum(noticed, most)[:, :, None] * np.hypot(change[..., :m], change[..., m:]))


def readings_of_sensors(sensors: Sequence[str]) -> Array:
    """Return 1 (s, a) where a reading is that of a sensor, 0 elsewhere; `sensors` names the source of each reading."""
    return np.array([[sensor == name for sensor in sensors] for name in dict.fromkeys(sensors)], float)


def noticed_share(equations: LoadEquations, error: Array, degrees: Array, limit: Array) -> Array:
    """Return the share (h, s) of errors (h, s, a) of readings at which chi-square is expected at its limit.

    `degrees` and `limit` (h,) are those of the residual test. Infinite where there is none, or no error changes it.
    """
    tested = degrees > 0
    excess = np.where(tested, (np.where(tested, limit, 1.0) - 1.0) * degrees, np.inf)
    with np.errstate(divide="ignore"):
        chi2 = residual_chi2(equations.redundant, error.swapaxes(1, 2), equations.covariance)
        return np.asarray(np.sqrt(excess[:, None] / chi2))


def join_harmonics(parts: Sequence[UnnoticedErrors | None]) -> UnnoticedErrors | None:
    """Return the first harmonic of each part, one below the other; None where a part has other sensors or none."""
    known = [part for part in parts if part is not None]
    if len(known) < len(parts) or len({part.sensors for part in known}) != 1:
        return None
    return UnnoticedErrors(
        known[0].sensors,
        np.concatenate([part.sensor[:1] for part in known]),
        np.concatenate([part.change[:1] for part in known]),
    )
