"""What a static calibration gives: C0, T0 and what is known of their errors, one set for each trim."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from balance_cli.calibration.all_trims import AllTrimsCalibration
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Hysteresis:
    """Reading on the way up less reading on the way down, of the same load, with standard errors; NaN where a
    component was not both loaded and unloaded.

    `channels` (c, k) [V] of each channel while component k moved, `loads` (k,) [N, N m] of each component's own load.
    """

    channels: Array
    channels_sigma: Array
    loads: Array
    loads_sigma: Array


@dataclass(frozen=True)
class TrimCalibration:
    """Static calibration about one trim: s = offset + C0 f and back, for c channels [V] and k load components.

    `C0` (c, k) [V/N, V/(N m)] and `T0` (k, c) with standard errors; `C0_covariance` (c, k, c, k) is that of
    the elements of C0. `offsets` (runs, c) [V]: reading of the
    unloaded rig by the straight line, each run's own. `mean_load` (k,) and `mean_channels` (c,): centre of the rows.
    `residual_covariance` (c, c) of a row about the line with `dof` degrees of freedom, `noise_covariance` (c, c) of a
    row as its neighbours tell it; `lack_of_fit` is the one over the other: 1 where a straight line is all there is.
    `full_range` (k,): the largest load applied in the calibration, over all trims; `channel_full_range` (c,) [V]: that
    of the cell. `residual` (k,) and `channel_residual` (c,): standard deviation about the applied loads and readings.
    `condition`: of C0 with loads in units of full range and channels in units of their noise.
    `left_out`: channels that could not be used, with the reason.
    """

    trim: str
    runs: tuple[str, ...]
    rows: int
    channel_names: tuple[str, ...]
    components: tuple[str, ...]
    C0: Array
    C0_sigma: Array
    T0: Array
    T0_sigma: Array
    C0_covariance: Array
    offsets: Array
    mean_load: Array
    mean_channels: Array
    residual_covariance: Array
    dof: int
    noise_covariance: Array
    lack_of_fit: float
    full_range: Array
    channel_full_range: Array
    residual: Array
    channel_residual: Array
    hysteresis: Hysteresis
    condition: float
    left_out: dict[str, str] = field(default_factory=dict)

    @property
    def misfit_share(self) -> float:
        """Share of the residual covariance that is no noise (curvature, hysteresis) and does not average out.

        All of it where the noise is not known.
        """
        return max(0.0, 1.0 - 1.0 / self.lack_of_fit) if np.isfinite(self.lack_of_fit) else 1.0

    @property
    def residual_percent_fs(self) -> dict[str, float]:
        """Standard deviation of back-calculated less applied loads, percent of full range, by component."""
        return dict(zip(self.components, (100.0 * self.residual / self.full_range).tolist(), strict=True))

    @property
    def channel_residual_percent_fs(self) -> dict[str, float]:
        """Standard deviation of the readings about the line, percent of the cell's full range, by channel."""
        percent = 100.0 * self.channel_residual / self.channel_full_range
        return dict(zip(self.channel_names, percent.tolist(), strict=True))

    def loads(self, channels: ArrayLike, zero_shift: ArrayLike = 0.0) -> Array:
        """Hub loads (..., 6) [N, N m] from readings (..., c) [V] of `channel_names`: f = mean + T0 (s - mean).

        `zero_shift` (c,) [V] is what the unloaded rig reads now more than it did in the calibration. Components that
        the balance does not carry are 0.
        """
        change = np.asarray(channels, float) - self.mean_channels - np.asarray(zero_shift, float)
        found = self.mean_load + change @ self.T0.T
        loads = np.zeros((*found.shape[:-1], len(COMPONENTS)))
        loads[..., [COMPONENTS.index(name) for name in self.components]] = found
        return loads

    def loads_covariance(self, channel_covariance: ArrayLike) -> Array:
        """Covariance (k, k) of the loads for readings with this covariance (c, c): T0 S T0'."""
        return np.asarray(self.T0 @ np.asarray(channel_covariance, float) @ self.T0.T)


@dataclass(frozen=True)
class Calibration:
    """Static calibration of a rig: one set of matrices for each trim, by its label, and one `gage` model through all.

    None where the trims have too few channels in common, or loads were applied that the balance does not carry. From a
    matrix that somebody else made there is one trim, its straight part at zero load, without runs and without errors:
    standard errors, hysteresis and lack of fit NaN, covariances of coefficients zero.
    """

    geometry: Geometry
    trims: dict[str, TrimCalibration]
    gage: AllTrimsCalibration | None = None

    @property
    def errors_known(self) -> bool:
        """Whether the standard errors of the coefficients are known."""
        return all(bool(np.isfinite(trim.C0_sigma).all()) for trim in self.trims.values())

    def nearest_trim(self, mean_load: Mapping[str, float]) -> TrimCalibration:
        """The trim whose mean load is nearest (name -> N or N m), components in units of their full range."""

        def distance(trim: TrimCalibration) -> float:
            wanted = np.array([mean_load.get(name, 0.0) for name in trim.components])
            return float(np.linalg.norm((wanted - trim.mean_load) / trim.full_range))

        return min(self.trims.values(), key=distance)
