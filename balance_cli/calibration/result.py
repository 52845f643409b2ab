"""Result of a static calibration: C0 and T0 with their errors for each trim, and the model of all trims."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from balance_cli.calibration.all_trims_result import AllTrimsCalibration
from balance_cli.calibration.temperature_terms import TemperatureTerms
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.io.result_view import ResultView, plural, warning_lines

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Hysteresis:
    """Reading while loading less reading while unloading, at the same load, with standard errors.

    `channels` (c, k) [V]: of each channel while component k is changed; `loads` (k,) [N, N m]: of each component as
    its own load. NaN where a component was not both loaded and unloaded.
    """

    channels: Array
    channels_sigma: Array
    loads: Array
    loads_sigma: Array


@dataclass(frozen=True)
class TrimCalibration:
    """Static calibration about one trim: s = offset + C0 f and back, for c channels [V] and k load components.

    `C0` (c, k) [V/N, V/(N m)] and `T0` (k, c) with standard errors; `C0_covariance` (c, k, c, k) of the elements of C0.
    `offsets` (runs, c) [V]: reading of the unloaded rig by the straight line of each run. `mean_load` (k,) [N, N m] and
    `mean_channels` (c,) [V]: center of the rows. `residual_covariance` (c, c) [V2] of a row about the line, with `dof`
    degrees of freedom; `noise_covariance` (c, c) [V2] of a row, from differences of neighboring rows; `lack_of_fit`:
    ratio of the two, 1 where a straight line describes the readings. `calibrated_range` (k,) [N, N m]: largest load
    applied over all trims; `channel_rated_range` (c,) [V]: rated range of the channel. `residual` (k,) and
    `channel_residual` (c,): standard deviation about the applied loads and the readings. `condition` of C0, loads in
    units of the calibrated range, channels in units of their noise. `excluded_channels`: unusable channels, with the
    reason. `rated_load` (k,) [N, N m]: as declared, NaN where a component has none; None where none has.
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
    calibrated_range: Array = field(metadata={"stored_as": "full_range"})
    channel_rated_range: Array = field(metadata={"stored_as": "channel_full_range"})
    residual: Array
    channel_residual: Array
    hysteresis: Hysteresis
    condition: float
    excluded_channels: dict[str, str] = field(default_factory=dict, metadata={"stored_as": "left_out"})
    rated_load: Array | None = field(default=None, metadata={"omit_if_none": True})

    @property
    def full_scale(self) -> Array:
        """The load (k,) [N, N m] that percentages refer to: rated, or the calibrated range where none is declared."""
        if self.rated_load is None:
            return self.calibrated_range
        return np.where(np.isfinite(self.rated_load), self.rated_load, self.calibrated_range)

    @property
    def misfit_share(self) -> float:
        """Share of the residual covariance that is not noise (nonlinearity, hysteresis) and does not average out.

        1 where the noise is not known.
        """
        return max(0.0, 1.0 - 1.0 / self.lack_of_fit) if np.isfinite(self.lack_of_fit) else 1.0

    @property
    def residual_percent_fs(self) -> dict[str, float]:
        """Standard deviation of back-calculated less applied loads, percent of full scale, by component."""
        return dict(zip(self.components, (100.0 * self.residual / self.full_scale).tolist(), strict=True))

    @property
    def channel_residual_percent_fs(self) -> dict[str, float]:
        """Standard deviation of the readings about the line, percent of the rated range of the channel, by channel."""
        percent = 100.0 * self.channel_residual / self.channel_rated_range
        return dict(zip(self.channel_names, percent.tolist(), strict=True))

    def loads(self, channels: ArrayLike, zero_shift: ArrayLike = 0.0) -> Array:
        """Compute hub loads (..., 6) [N, N m] from readings (..., c) [V] of `channel_names`: f = mean + T0 (s - mean).

        `zero_shift` (c,) [V]: reading of the unloaded rig less that in the calibration. Components that the balance
        does not carry are 0.
        """
        change = np.asarray(channels, float) - self.mean_channels - np.asarray(zero_shift, float)
        carried = self.mean_load + change @ self.T0.T
        loads = np.zeros((*carried.shape[:-1], len(COMPONENTS)))
        loads[..., [COMPONENTS.index(name) for name in self.components]] = carried
        return loads


@dataclass(frozen=True, repr=False)
class Calibration(ResultView):
    """Static calibration of a rig: matrices for each trim, by its label, and the calibration model of `all_trims`.

    `all_trims` is None where the trims have too few channels in common, or loads were applied that the balance does not
    carry. A calibration from a matrix file has one trim, the linear part at zero load, without runs and errors:
    standard errors, hysteresis and lack of fit are NaN, covariances of coefficients zero. `consistency`: what the
    cross-checks said of the runs, None where nothing. `temperature`: what temperature adds to the readings; None where
    it has no effect, or is not known. `stated_temperatures`: lowest and highest of the runs [degC], where these state
    any and `temperature` is None.
    """

    geometry: Geometry
    trims: dict[str, TrimCalibration]
    all_trims: AllTrimsCalibration | None = field(default=None, metadata={"stored_as": "gage"})
    consistency: tuple[str, ...] | None = field(default=None, metadata={"omit_if_none": True})
    temperature: TemperatureTerms | None = field(default=None, metadata={"omit_if_none": True})
    stated_temperatures: tuple[float, float] | None = field(default=None, metadata={"omit_if_none": True})

    @property
    def errors_known(self) -> bool:
        """Whether the standard errors of the coefficients are known."""
        return all(bool(np.isfinite(trim.C0_sigma).all()) for trim in self.trims.values())

    def nearest_trim(self, mean_load: Mapping[str, float]) -> TrimCalibration:
        """The trim whose mean load is nearest to `mean_load` [N, N m], components in units of the calibrated range."""

        def distance(trim: TrimCalibration) -> float:
            load = np.array([mean_load.get(name, 0.0) for name in trim.components])
            return float(np.linalg.norm((load - trim.mean_load) / trim.calibrated_range))

        return min(self.trims.values(), key=distance)

    def summary_lines(self) -> Iterator[str]:
        """One line for each trim, at most four."""
        trims = list(self.trims.values())
        yield f"Calibration of {self.geometry.rig}: {plural(len(trims), 'trim')}"
        shown = trims[: 3 if self.consistency else 4]
        for trim in shown:
            worst = max(trim.residual_percent_fs, key=lambda name: trim.residual_percent_fs[name])
            yield (
                f"  {trim.trim or 'one trim'}: {plural(trim.rows, 'row')}, condition {trim.condition:.1f}, "
                f"largest residual {trim.residual_percent_fs[worst]:.3g} % FS ({worst})"
            )
        if len(trims) > len(shown):
            yield f"  and {len(trims) - len(shown)} more"
        yield from warning_lines(self.consistency)

    def to_frame(self) -> pd.DataFrame:
        """One row of C0 for each trim and channel: coefficients [V/N, V/(N m)], then their standard errors."""
        import pandas as pd

        return pd.DataFrame(
            [
                {
                    "trim": trim.trim,
                    "channel": channel,
                    **dict(zip(trim.components, row, strict=True)),
                    **{f"sigma_{name}": sigma for name, sigma in zip(trim.components, sigmas, strict=True)},
                }
                for trim in self.trims.values()
                for channel, row, sigmas in zip(trim.channel_names, trim.C0, trim.C0_sigma, strict=True)
            ]
        )


def with_rated_loads(trim: TrimCalibration, geometry: Geometry) -> TrimCalibration:
    """The trim with the rated loads that a geometry declares."""
    if not geometry.rated_loads:
        return trim
    rated = [geometry.rated_loads.get(name, float("nan")) for name in trim.components]
    return replace(trim, rated_load=np.array(rated))
