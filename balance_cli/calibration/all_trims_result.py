"""Calibration of all trims together, as it is stored: the model, its rows, outliers, zeros and check loads."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.math_model import CalibrationModel
from balance_cli.calibration.noise import CalibrationNoise
from balance_cli.calibration.noniterative_model import NonIterativeModel
from balance_cli.calibration.tare_result import Tares
from balance_cli.calibration.term_choice import TermChoice
from balance_cli.calibration.untested_products import UntestedProducts, find_untested_products
from balance_cli.campaign.rig.attitude import gravity_directions

Array = NDArray[np.float64]
Index = NDArray[np.intp]
LEVEL_GRAVITY = gravity_directions([[0.0, 0.0]])


@dataclass(frozen=True)
class Outlier:
    """A row that the others do not predict: `row` from 1 in its run, `error` [V], and the error over its sigma.

    `exchanged_with`: row whose loads it seems to have; `cause`: what a single mistake would explain it. None where
    neither is found. `unit`: base unit of the error, None for V.
    """

    run: str
    row: int
    channel: str
    error: float
    over_sigma: float
    exchanged_with: int | None = field(default=None, metadata={"omit_if_none": True})
    cause: str | None = field(default=None, metadata={"omit_if_none": True})
    unit: str | None = field(default=None, metadata={"omit_if_none": True})


@dataclass(frozen=True)
class SuspectLoadSeries:
    """A load series in which a channel does not follow the prediction from the other load series.

    `gain` with `gain_sigma`: regression coefficient of its change on the prediction. `resembled_channel`: the channel
    whose prediction it follows instead, empty for none. `alternatives`: load series that may be wrong in its place.
    `cause`: the single mistake that would explain it in all channels; None where there is none.
    """

    load_series: str = field(metadata={"stored_as": "sequence"})
    channel: str
    gain: float
    gain_sigma: float
    resembled_channel: str = field(metadata={"stored_as": "like"})
    alternatives: tuple[str, ...] = field(default=(), metadata={"stored_as": "or_else"})
    cause: str | None = field(default=None, metadata={"omit_if_none": True})


@dataclass(frozen=True)
class CheckLoads:
    """Loads of a held-out run: applied (m, k) and computed (m, k) [N, N m], with half the prediction interval (m, k).

    `is_valid` (m,): rows within the calibrated loads for which the iteration converged. `method`: the model that
    computed them, None for the calibration model. `zeros`: how zeros that shift were assigned, None for a single one.
    """

    run: str
    applied: Array
    computed: Array = field(metadata={"stored_as": "found"})
    prediction_interval: Array = field(metadata={"stored_as": "interval"})
    is_valid: NDArray[np.bool_] = field(metadata={"stored_as": "solved"})
    method: str | None = field(default=None, metadata={"omit_if_none": True})
    zeros: str | None = field(default=None, metadata={"omit_if_none": True})

    @property
    def label(self) -> str:
        """The run and, where it is not the calibration model, the method."""
        return self.run if self.method is None else f"{self.run}, {self.method}"

    @property
    def interval_coverage(self) -> Array:
        """Share (k,) of the valid rows whose load lies within its prediction interval; NaN where none is known."""
        within = (np.abs(self.computed - self.applied) <= self.prediction_interval)[self.is_valid]
        if not len(within) or not np.isfinite(self.prediction_interval[self.is_valid]).all():
            return np.full(within.shape[1], np.nan)
        return np.asarray(np.mean(within, axis=0))

    @property
    def error(self) -> Array:
        """Rms error (k,) [N, N m] of the valid rows; NaN without any."""
        errors = (self.computed - self.applied)[self.is_valid]
        return np.asarray(np.sqrt(np.mean(errors**2, axis=0))) if len(errors) else np.full(errors.shape[1], np.nan)


@dataclass(frozen=True)
class Drift:
    """A straight line through the zeros of the load series in their order.

    `slope` (c,) [V per load series] with `slope_sigma` (c,); `chi2_per_dof` (c,): chi-square per degree of freedom of
    the zeros about the line, 1 where their standard errors explain the scatter. NaN for fewer than three load series.
    """

    slope: Array
    slope_sigma: Array
    chi2_per_dof: Array = field(metadata={"stored_as": "scatter"})


@dataclass(frozen=True)
class AllTrimsCalibration:
    """Calibration model of all trims, with the rows that it was fitted to.

    Of each row: `run` (m,), an index into `runs`; `loads` (m, k) [N, N m]; `residuals` (m, c) and
    `cross_validation_errors` (m, c) [V], the latter predicted without the load series of the row. Both are NaN where a
    row was excluded. `attitude_segment` (m,): index of the attitude, None where no run states one.

    `outliers` and `suspect_series` were excluded from the fit. `swapped_channels`: pairs of channels that read each
    other's loads in all runs. `screening_notes`: where the search for outliers stopped early, and why the weight of the
    metric part is not determined. `non_iterative`: the model of that method, where it was requested.

    With `tares` the loads of the rows and of the model include the weight of the metric part, and the zeros are those
    of the balance without any load.

    `load_series` (m,): number of the load series of each row; `series_notes`: how open tare points were read.
    `term_choice`: which terms the model could have. `random_terms`: the model that computes loads, where its terms are
    not the selected ones of `model`.
    """

    model: CalibrationModel
    runs: tuple[str, ...]
    run: Index
    loads: Array
    residuals: Array
    cross_validation_errors: Array = field(metadata={"stored_as": "left_out"})
    drift: Drift
    noise: CalibrationNoise
    outliers: tuple[Outlier, ...]
    suspect_series: tuple[SuspectLoadSeries, ...] = field(metadata={"stored_as": "bad_sequences"})
    swapped_channels: tuple[str, ...] = field(default=(), metadata={"stored_as": "exchanged"})
    screening_notes: tuple[str, ...] = field(default=(), metadata={"stored_as": "limits"})
    non_iterative: NonIterativeModel | None = field(default=None, metadata={"stored_as": "direct"})
    checks: tuple[CheckLoads, ...] = ()
    tares: Tares | None = None
    attitude_segment: Index | None = field(default=None, metadata={"stored_as": "stretch"})
    load_series: Index | None = field(default=None, metadata={"omit_if_none": True})
    series_notes: tuple[str, ...] | None = field(default=None, metadata={"omit_if_none": True})
    term_choice: TermChoice | None = field(default=None, metadata={"omit_if_none": True})
    random_terms: CalibrationModel | None = field(default=None, metadata={"omit_if_none": True})

    @property
    def loads_model(self) -> CalibrationModel:
        """The model by which loads are computed: that with random terms where there is one."""
        return self.model if self.random_terms is None else self.random_terms

    @property
    def used(self) -> NDArray[np.bool_]:
        """Rows (m,) that were fitted."""
        return np.asarray(np.isfinite(self.residuals).all(axis=1))

    @cached_property
    def untested_products(self) -> UntestedProducts | None:
        """Products of two loads that the rows that were fitted could not tell; None where there are none."""
        block = self.run if self.load_series is None else self.load_series
        readings = self.model.readings(self.loads[self.used]) + self.residuals[self.used]
        return find_untested_products(self.loads_model, self.loads[self.used], readings, block[self.used])

    @property
    def level_weight_loads(self) -> Array:
        """Loads (k,) [N, N m] of the weight of the metric part on the level rig; zero where the tares are not known."""
        names = self.model.components
        return np.zeros(len(names)) if self.tares is None else self.tares.loads(LEVEL_GRAVITY, names)[0]

    def readings_beside_shaft(self, gravity: Array | None, channel_names: Sequence[str]) -> Array:
        """Readings (m, c) [V] of these channels by the weight beyond its hub loads; of the level rig without gravity.

        Zero without a shaft that has a torque meter, without tares, and of channels that the model lacks.
        """
        directions = LEVEL_GRAVITY if gravity is None else gravity
        readings = np.zeros((len(directions), len(channel_names)))
        if self.tares is not None and self.tares.beside_shaft is not None:
            known = [i for i, name in enumerate(channel_names) if name in self.model.channel_names]
            at = [self.model.channel_names.index(channel_names[i]) for i in known]
            readings[:, known] = self.tares.readings_beside_shaft(directions, self.model.components)[:, at]
        return readings
