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
from balance_cli.campaign.rig.attitude import gravity_directions, is_one_direction
from balance_cli.reduction.flags import NO_WEIGHT, join_flags
from balance_cli.reduction.mean_loads import MeanLoads
from balance_cli.reduction.wind_off import ZeroRecord

Array = NDArray[np.float64]

LEVEL = gravity_directions([[0.0, 0.0]])[0]
"""Direction of gravity (3,) in a rig that states no attitude."""


def without_change_of_weight(
    loads: MeanLoads, gravity: Array | None, zero: ZeroRecord | None, calibration: Calibration
) -> MeanLoads:
    """Return mean loads less what the weight of the metric part changed between the zero and the run.

    `gravity` (3,): direction in the axes of the rig during the run, None where it is not stated. The loads are flagged
    NO_WEIGHT where the calibration did not determine the weight, and where one of the two states that the rig was
    not level and the other states nothing.
    """
    if zero is None or (gravity is None and zero.gravity is None):
        return loads
    directions = np.stack([LEVEL if item is None else item for item in (gravity, zero.gravity)])
    if is_one_direction(directions):
        return loads
    if gravity is None or zero.gravity is None:
        states, silent = (zero.run, "this run") if gravity is None else ("this run", zero.run)
        return _flagged(loads, f"{states} states that the rig was not level, {silent} states no attitude")
    tares = None if calibration.all_trims is None else calibration.all_trims.tares
    if tares is None:
        differ = f"the attitude of the rig differs from that of {zero.run}"
        return _flagged(loads, f"{differ}, and the calibration has not determined the weight of the metric part")
    change = tares.loads(directions, loads.components)
    covariance = tares.difference_covariance(directions[:1], directions[1:], loads.components)[0]
    sigma = np.sqrt(loads.sigma**2 + np.diag(covariance))
    return replace(loads, loads=loads.loads - (change[0] - change[1]), sigma=sigma)


def zero_in_attitude(zero: ZeroRecord | None, gravity: Array | None, calibration: Calibration) -> ZeroRecord | None:
    """Return the zero with what the weight makes the channels read beside a shaft in the attitude of the run.

    The hub loads of the weight are taken off the mean loads; its moment about a shaft with a torque meter does not go
    through the meter, so that the redundant channels would contradict it as a load.
    """
    if zero is None or gravity is None or zero.gravity is None or calibration.all_trims is None:
        return zero
    directions = np.stack([gravity, zero.gravity])
    of_run, of_zero = calibration.all_trims.readings_beside_shaft(directions, zero.channel_names)
    return replace(zero, mean=zero.mean + (of_run - of_zero))


def _flagged(loads: MeanLoads, reason: str) -> MeanLoads:
    note = (
        f"`pitch` or `roll`: {reason}: the mean loads contain the change of its weight. Record a zero in this attitude "
        "and state it in both, or calibrate in three attitudes (name another angle otherwise)"
    )
    flags = tuple(join_flags((flag, NO_WEIGHT)) for flag in loads.flags)
    return replace(loads, flags=flags, note="; ".join(filter(None, [loads.note, note])))
