"""Mean loads of a run whose zero was recorded in another attitude: the weight of the metric part has turned.

The zero takes the weight out of the mean loads only where gravity has the same direction in the axes of the rig. A
rig that is pitched by 8 deg after its zero has 14 % of the weight of its metric part in Fx, and nothing in the channels
tells it from a load.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.result import Calibration
from balance_cli.campaign.rig.attitude import is_one_direction
from balance_cli.reduction.flags import NO_WEIGHT, join_flags
from balance_cli.reduction.mean_loads import MeanLoads, ZeroRecord

Array = NDArray[np.float64]


def without_change_of_weight(
    loads: MeanLoads, gravity: Array | None, zero: ZeroRecord | None, calibration: Calibration
) -> MeanLoads:
    """Return mean loads less what the weight of the metric part changed between the zero and the run.

    `gravity` (3,): direction in the axes of the rig during the run. Nothing is changed where it or that of the zero is
    not known (None). Where the calibration did not determine the weight, the loads are flagged NO_WEIGHT.
    """
    if zero is None or zero.gravity is None or gravity is None or is_one_direction(np.stack([zero.gravity, gravity])):
        return loads
    tares = None if calibration.all_trims is None else calibration.all_trims.tares
    if tares is None:
        flags = tuple(join_flags((flag, NO_WEIGHT)) for flag in loads.flags)
        note = (
            f"`pitch` or `roll`, the attitude of the rig, differ from those of {zero.run}, and the calibration has not "
            "determined the weight of the metric part: the mean loads contain its change. Record a zero in this "
            "attitude, or calibrate in three attitudes (name another angle otherwise)"
        )
        return replace(loads, flags=flags, note="; ".join(filter(None, [loads.note, note])))
    change = tares.loads(np.stack([gravity, zero.gravity]), loads.components)
    covariance = tares.difference_covariance(gravity[None], zero.gravity[None], loads.components)[0]
    sigma = np.sqrt(loads.sigma**2 + np.diag(covariance))
    return replace(loads, loads=loads.loads - (change[0] - change[1]), sigma=sigma)
