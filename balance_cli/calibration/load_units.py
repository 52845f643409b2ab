"""Loads whose unit is doubtful: all of a component in N where kN was meant, or the reverse.

Where a series of a component differs from its other series, the search for suspect load series finds it. Where all are
in the wrong unit, the calibration is consistent in itself. Then rated loads tell it and, without them, the response to
the other components of the same kind: forces that act on one balance differ by a factor of ten or so in their effect.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from balance_cli.calibration.result import TrimCalibration
from balance_cli.campaign.rig.equilibrium import equilibrium
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.campaign.rig.geometry_checks import missing_mechanics

MOST_OF_RATED = 3.0
"""Calibrated range over the rated load from which the unit is doubtful: balances are proof-loaded to twice at most."""
LEAST_OF_RATED = 0.01
"""The same below: a hundredth of the rated load calibrates nothing."""
UNIT_RATIO = 300.0
"""Ratio of the responses to two forces, or two moments, from which the unit is doubtful: well above what designs differ
by, and below the 1000 of a prefix."""


def doubtful_units(trim: TrimCalibration, units: tuple[str, ...]) -> Iterator[str]:
    """Notes on the components whose loads seem to be in another unit; `units` (k,) of the components: N or N m."""
    if trim.rated_load is not None:
        for name, unit, largest, rated in zip(
            trim.components, units, trim.calibrated_range, trim.rated_load, strict=True
        ):
            share = largest / rated
            if share > MOST_OF_RATED or share < LEAST_OF_RATED:
                yield (
                    f"{name} was loaded to {largest:.4g} {unit}, {share:.3g} times its rated load of {rated:.4g} "
                    f"{unit}: is the unit of one of them right?"
                )
    response = np.linalg.norm(trim.C0 / np.sqrt(np.diag(trim.noise_covariance))[:, None], axis=0)
    for j, name in enumerate(trim.components):
        same_unit = [i for i, unit in enumerate(units) if unit == units[j] and i != j]
        is_rated = trim.rated_load is not None and bool(np.isfinite(trim.rated_load[j]))
        ratios = response[j] / response[same_unit]
        if is_rated or len(same_unit) < 2 or not (np.all(ratios > UNIT_RATIO) or np.all(ratios < 1.0 / UNIT_RATIO)):
            continue
        # A wrong unit leaves the signal at the largest load as it is; noise of some channels (friction) changes that.
        signals = ratios * trim.calibrated_range[j] / trim.calibrated_range[same_unit]
        if not np.all(np.abs(np.log(signals)) < 0.5 * np.abs(np.log(ratios))):
            continue
        ratio = float(np.median(ratios))
        way = "larger" if ratio > 1.0 else "smaller"
        others = ", ".join(trim.components[i] for i in same_unit)
        yield (
            f"the channels respond to a {units[j]} of {name} by a factor of {max(ratio, 1.0 / ratio):.3g} {way} "
            f"than to one of {others}: is the unit of {name} right? Declare `rated_loads` in the geometry"
        )


def scale_evidence(geometry: Geometry, trim: TrimCalibration) -> tuple[str, ...]:
    """What the scale of the loads is held against beside the table itself, in words; empty where nothing is.

    Loads in pounds that a table calls newtons are consistent with themselves. Declared sensitivities contradict them,
    with stiffness and masses or where the cells that are read balance several loads; rated loads only beyond their own
    factors, and components of different scale among each other.
    """
    evidence = []
    measured = [item.name for item in geometry.channels if item.measures_mechanics and item.name in trim.channel_names]
    if measured and (not missing_mechanics(geometry) or len(equilibrium(geometry, measured).components) > 1):
        evidence.append("declared sensitivities")
    if trim.rated_load is not None and np.isfinite(trim.rated_load).any():
        evidence.append("rated loads")
    return tuple(evidence)
